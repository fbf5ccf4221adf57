"""A search tries, gives up and goes on as if it had never been stopped; its best trial is what ``train`` gets."""

import csv
import io
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import pytest
from search_files import search_file
from tiny_runs import TINY, Trained, train_in_this_process

from marl_encircle import files
from marl_encircle.experiments import checkpoint, executors
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.divergence import Diverged, DivergenceGuard
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.search_space import Space, load_space
from marl_encircle.experiments.signals import Stopped
from marl_encircle.experiments.train import OtherRunError, run_folder
from marl_encircle.experiments.trials import Outcome, Row
from marl_encircle.experiments.tuning import tune
from marl_encircle.experiments.yaml_files import ConfigError

pytest.importorskip("optuna", reason="Optuna is not installed; it is the extra 'tune'")

SEARCH = (
    "{algorithm: {learning_rate: {low: 1e-4, high: 1e-2, log: true}, net_arch: {choices: [[16], [8, 8]]}}, "
    "reward: {terms: {contraction: {low: 0.5, high: 2.0}}}}"
)


SEEDS = "[950, 951]"
EASY = [*TINY, "scenario.movement_range_limit=8.0", "scenario.max_cycles=60", "evaluation.curve_episodes=20"]
"""In which beginners succeed now and then."""


def tiny_search(folder: Path, **changes: str) -> Space:
    overrides = "[" + ", ".join(f'"{text}"' for text in EASY) + "]"
    return load_space(search_file(folder, **{"seeds": SEEDS, "search": SEARCH, "overrides": overrides, **changes}))


@pytest.fixture
def space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Space:
    """A search with two seeds of a tiny training, in this process."""
    train_in_this_process(monkeypatch)
    return tiny_search(tmp_path)


class Found(NamedTuple):
    """A search of two trials that was not stopped, to be read only."""

    space: Space
    out: Path
    outcome: Outcome
    told: list[Row]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    folder = tmp_path_factory.mktemp("found")
    told: list[Row] = []
    with pytest.MonkeyPatch.context() as patch:
        train_in_this_process(patch)
        space = tiny_search(folder)
        return Found(space, folder / "out", tune(space, folder / "out", 2, 1, told.append), told)


def curve(folder: Path) -> list[float]:
    rows = csv.DictReader(io.StringIO((folder / "progress.csv").read_text()))
    return [float(row["success"]) for row in rows]


class Judged(NamedTuple):
    """How a search with scripted trainings ended: its rows, which trainings were started, and which were killed."""

    rows: list[Row]
    started: list[tuple[str, int]]
    killed: list[Path]


class Scripted:
    """A training that writes its learning curve point by point, one each time it is looked at, until it is killed."""

    def __init__(self, job: Job, out: Path, success: list[float], killed: list[Path]) -> None:
        self.folder = run_folder(job.config, job.seed, out)
        self.left, self.lines, self.killed = list(success), ["world_steps,success\n"], killed
        files.write_text(self.folder / checkpoint.NAME, "")

    def poll(self) -> int | None:
        if self.folder in self.killed:
            return -9
        if self.left:
            self.lines.append(f"{len(self.lines)},{self.left.pop(0)}\n")
            files.write_text(self.folder / "progress.csv", "".join(self.lines))
        return None

    def kill(self) -> None:
        self.killed.append(self.folder)

    def wait(self) -> int:
        return -9


def test_trials_are_worth_the_last_points_of_their_curves(found: Found) -> None:
    rows = found.outcome.rows
    assert [row.number for row in rows] == [0, 1]
    assert rows[0].values == found.space.base, "the values in use come first"
    begun = [row._replace(state="running", success=None, points=0) for row in rows]
    assert found.told == [begun[0], rows[0], begun[1], rows[1]]
    for row in rows:
        folder = found.out / "trials" / f"{row.number:04}"
        curves = [curve(run_folder(job.config, job.seed, folder)) for job in found.space.jobs(row.values)]
        assert row.success == pytest.approx(mean(mean(each[-2:]) for each in curves))
        assert (row.state, row.points) == ("complete", 4)
    assert found.outcome.best == max(rows, key=lambda row: row.success or 0.0)
    assert rows[0].success, "else little was compared"


def test_the_table_has_every_trial(found: Found) -> None:
    rows = list(csv.DictReader(io.StringIO((found.out / "trials.csv").read_text())))
    assert list(rows[0]) == ["trial", "state", "success", "points", *found.space.dimensions]
    assert [(row["trial"], row["state"], float(row["success"])) for row in rows] == [
        (str(row.number), "complete", row.success) for row in found.outcome.rows
    ]
    assert rows[0]["algorithm.net_arch"] == "[16]"


def test_the_best_trial_is_what_train_gets(found: Found) -> None:
    best, written = found.outcome.best, found.outcome.written
    assert best is not None
    assert written == {"algorithm": found.out / "best.yaml", "reward": found.out / "best_reward.yaml"}
    tried = found.space.jobs(best.values)[0].config
    rest = [text for text in found.space.file.overrides if not text.startswith("algorithm.")]
    config = load_config(written["reward"], algorithm=written["algorithm"], profile="smoke", overrides=rest)
    assert (config.algorithm, config.scenario, config.training) == (tried.algorithm, tried.scenario, tried.training)
    assert config.reward.name == "ours_tuned"
    assert config.reward.model_copy(update={"name": "ours"}) == tried.reward


def test_a_base_of_ones_own_is_found_from_the_best_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train_in_this_process(monkeypatch)
    (tmp_path / "mine.yaml").write_text("base: maddpg\ngamma: 0.8\n")
    monkeypatch.chdir(tmp_path)
    search_file(tmp_path, algorithm="mine.yaml")
    outcome = tune(load_space("search.yaml"), "results/deep/out", 1, 1)
    assert list(outcome.written) == ["algorithm"]
    assert load_config(algorithm=outcome.written["algorithm"]).algorithm.gamma == 0.8


def test_more_trials_go_on_as_if_there_had_been_no_stop(space: Space, found: Found, tmp_path: Path) -> None:
    for n_trials in (1, 1, 2):
        outcome = tune(space, tmp_path / "out", n_trials, 1)
        assert len(outcome.rows) == n_trials
    assert outcome.rows == found.outcome.rows


def test_a_search_that_is_stopped_anywhere_goes_on_with_its_trial(
    space: Space, found: Found, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[tuple[str, int]] = []
    stops = list(range(4))

    def start(job: Job, out: Path) -> Trained:
        if stops and len(trained) == stops[0]:
            del stops[0]
            raise Stopped(15)
        trained.append((out.name, job.seed))
        return Trained(job, out)

    monkeypatch.setattr(executors, "_start", start)
    while stops:
        with pytest.raises(Stopped):
            tune(space, tmp_path / "out", 2, 1)
    assert tune(space, tmp_path / "out", 2, 1).rows == found.outcome.rows
    assert trained == [("0000", 950), ("0000", 951), ("0001", 950), ("0001", 951)], "each once"


def test_another_search_in_the_folder_is_refused_with_the_difference(found: Found, tmp_path: Path) -> None:
    out = shutil.copytree(found.out, tmp_path / "out")
    before = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    other = tiny_search(tmp_path, seeds="[950, 952]")
    line = r"\n  seeds: \[950, 952\] here, \[950, 951\] there$"
    with pytest.raises(OtherRunError, match=f"out already holds another search; choose another folder:{line}"):
        tune(other, out, 3, 1)
    assert {path: path.read_bytes() for path in out.iterdir() if path.is_file()} == before


# pruning

GOOD = [0.0, 0.1, 0.5, 0.5]


@pytest.fixture
def judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Judged]:
    """A search in which the first two trials are trained, as it were, with the curve ``GOOD``; later ones by script."""
    train_in_this_process(monkeypatch)

    def run(pruning: str, n_workers: int, script: Callable[[Job], list[float]]) -> Judged:
        judged = Judged([], [], [])

        def start(job: Job, out: Path) -> Any:
            judged.started.append((out.name, job.seed))
            if out.name >= "0002":
                return Scripted(job, out, script(job), judged.killed)
            worker = Trained(job, out)
            lines = [f"{point},{success}\n" for point, success in enumerate(GOOD, 1)]
            files.write_text(
                run_folder(job.config, job.seed, out) / "progress.csv", "".join(["world_steps,success\n", *lines])
            )
            return worker

        monkeypatch.setattr(executors, "_start", start)
        space = tiny_search(tmp_path, pruning=pruning)
        judged.rows.extend(tune(space, tmp_path / "out", 3, n_workers).rows)
        assert [(row.state, row.success) for row in judged.rows[:2]] == [("complete", 0.5)] * 2
        return judged

    return run


def test_a_trial_that_is_worse_than_half_is_given_up_at_once(judged: Callable[..., Judged]) -> None:
    done = judged("{rule: median, startup_trials: 2, warmup_points: 2}", 2, lambda _: [0.0, 0.0, 0.0])
    row = done.rows[2]
    assert (row.state, row.points, row.success) == ("pruned", 2, 0.0)
    assert len(done.killed) == 2, "the processes of both seeds"
    assert not any((folder / checkpoint.NAME).exists() for folder in done.killed)


def test_halving_gives_up_who_is_not_among_the_best_of_a_rung(judged: Callable[..., Judged]) -> None:
    done = judged("{rule: halving, warmup_points: 3, reduction: 2}", 2, lambda _: [0.9, 0.9, 0.4])
    row = done.rows[2]
    assert (row.state, row.points, row.success) == ("pruned", 3, 0.4)


def test_the_seeds_that_wait_are_not_trained_for_a_trial_that_is_given_up(judged: Callable[..., Judged]) -> None:
    done = judged("{rule: median, startup_trials: 2, warmup_points: 1}", 1, lambda _: [0.0, 0.0])
    assert (done.rows[2].state, done.rows[2].points) == ("pruned", 2)
    assert done.started == [("0000", 950), ("0000", 951), ("0001", 950), ("0001", 951), ("0002", 950)]


def test_a_point_is_the_mean_of_the_seeds_once_all_that_were_started_have_it(judged: Callable[..., Judged]) -> None:
    curves = {950: [0.1, 0.2, 0.1, 0.1], 951: [0.0, 0.0, 0.3]}
    done = judged("{rule: median, startup_trials: 2, warmup_points: 2}", 2, lambda job: curves[job.seed])
    row = done.rows[2]
    assert (row.state, row.points, row.success) == ("pruned", 3, pytest.approx(0.2)), "GOOD has 0.5 there"


# what goes wrong


def test_a_training_that_diverged_is_worth_nothing(
    space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check = DivergenceGuard.check

    def diverging(self: DivergenceGuard) -> None:
        if self.model.seed == 951 and self.model.num_timesteps >= 3 * 380:
            raise Diverged("a loss is nan")
        check(self)

    monkeypatch.setattr(DivergenceGuard, "check", diverging)
    (row,) = tune(space, tmp_path / "out", 1, 1).rows
    job = space.jobs(row.values)[0]
    good, bad = (curve(run_folder(job.config, seed, tmp_path / "out" / "trials" / "0000")) for seed in (950, 951))
    assert bad[-1] > 0, "it diverged after a good point"
    assert (row.state, row.success) == ("complete", pytest.approx(mean(good[-2:]) / 2))


def test_a_training_that_fails_costs_its_trial_and_another_comes(
    space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failed(Trained):
        def __init__(self, *_: Any) -> None:
            pass

        def poll(self) -> int:
            return 1

    monkeypatch.setattr(
        executors, "_start", lambda job, out: Failed() if (out.name, job.seed) == ("0001", 951) else Trained(job, out)
    )
    outcome = tune(space, tmp_path / "out", 2, 1)
    assert [row.state for row in outcome.rows] == ["complete", "fail"]
    assert outcome.failed == 1
    again = tune(space, tmp_path / "out", 2, 1)
    assert [row.state for row in again.rows] == ["complete", "fail", "complete"]
    assert again.failed == 0


def test_a_training_whose_process_is_killed_is_tried_again(
    space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(Trained):
        def __init__(self, *_: Any) -> None:
            pass

        def poll(self) -> int:
            return -9

    started: list[Job] = []

    def start(job: Job, out: Path) -> Trained:
        started.append(job)
        return Killed() if len(started) == 1 else Trained(job, out)

    monkeypatch.setattr(executors, "_start", start)
    (row,) = tune(space, tmp_path / "out", 1, 1).rows
    assert row.state == "complete"
    assert [job.seed for job in started] == [950, 951, 950]


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ("1,0.5\n2,nan\n", "success must"),
        ("1,0.5\n2,1.5\n", "success must"),
        ("1,0.5\n1,0.5\n", "world_steps must"),
        ("", "the training has finished"),
    ],
    ids=["no number", "no share", "no later step", "no points"],
)
def test_a_search_refuses_a_damaged_learning_curve(
    space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, points: str, reason: str
) -> None:
    class Damaged(Trained):
        def __init__(self, job: Job, out: Path) -> None:
            super().__init__(job, out)
            files.write_text(run_folder(job.config, job.seed, out) / "progress.csv", f"world_steps,success\n{points}")

    monkeypatch.setattr(executors, "_start", Damaged)
    with pytest.raises(files.DamagedFileError, match=rf"seed950/progress\.csv: no learning curve: {reason}"):
        tune(space, tmp_path / "out", 1, 1)


def test_a_search_without_optuna_names_the_extra_and_writes_nothing(
    space: Space, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"pip install 'marl-encircle\[tune\]'"):
        tune(space, tmp_path / "out", 1, 1)
    assert not (tmp_path / "out").exists()


def test_a_record_that_leads_elsewhere_is_not_written_to(space: Space, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "study.db").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(files.DamagedFileError, match=r"study\.db: a link"):
        tune(space, tmp_path / "out", 1, 1)
    assert not (tmp_path / "elsewhere").exists()


def test_a_damaged_record_is_named_and_kept(space: Space, tmp_path: Path) -> None:
    path = tmp_path / "out" / "study.db"
    files.write_text(path, "no database, whatever its name says; " * 50)
    before = path.read_bytes()
    with pytest.raises(files.DamagedFileError, match=r"study\.db: not the record of a search"):
        tune(space, tmp_path / "out", 1, 1)
    assert path.read_bytes() == before
