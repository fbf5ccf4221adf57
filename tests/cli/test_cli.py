"""The command: what it prints, what it leaves, and with which code it ends."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common import logger
from tiny_runs import (
    TINY,
    Done,
    Trained,
    contents,
    copy_of_finished,
    everything_in,
    finished,
    in_another_process,
    tiny_arguments,
)

from marl_encircle import cli, files, locks
from marl_encircle.cli import kinds, machine
from marl_encircle.experiments import executors, export, train
from marl_encircle.experiments import grid as grids
from marl_encircle.experiments import sweep as sweeps
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.metrics import summarise_run, wilson_interval
from marl_encircle.experiments.records import Setting, read_episodes, read_record

Run = Callable[..., Done]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return tmp_path / "runs"


# train


def test_train_prints_its_folder_last_and_finishes_once(run: Run, runs: Path) -> None:
    arguments = ["train", *tiny_arguments("--out", str(runs), "--quiet")]
    first = run(*arguments)
    assert first.code == 0, first.err
    folder = Path(first.out.splitlines()[-1])
    assert folder == runs / "ours" / "ratio1.1_n3_m1_random" / "seed0"
    assert contents(folder) == contents(finished())
    assert [path.name for path in folder.iterdir() if path.is_dir()] == ["tensorboard"]
    again = run(*arguments)
    assert (again.code, again.out, again.err) == (0, f"{folder}\n", "already finished\n")


def test_train_says_how_its_rounds_ended(run: Run, runs: Path) -> None:
    own = summarise_run(read_episodes(finished(), read_record(finished())), "all")
    low, high = own.success_interval
    said = f"success {100 * own.success:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of 8 rounds; "
    said += f"mean length of the successful ones: {own.mean_episode_length:.1f} steps\n"
    arguments = ("train", *tiny_arguments("--out", str(runs), "--no-tensorboard"))
    done = run(*arguments)
    folder = runs / "ours" / "ratio1.1_n3_m1_random" / "seed0"
    assert (done.code, done.out) == (0, f"{folder}\n")
    assert done.err.endswith(said)
    assert run(*arguments).err == f"already finished\n{said}"
    rounds = read_episodes(folder, read_record(folder))
    train.write_episodes(folder, [each._replace(step_all=None, step_pursuers=None) for each in rounds])
    assert re.fullmatch(r"already finished\nsuccess 0\.0 % \[0\.0, [\d.]+\] of 8 rounds\n", run(*arguments).err)


def test_train_as_json_is_one_object(run: Run, runs: Path) -> None:
    arguments = ("train", *tiny_arguments("--out", str(runs), "--quiet", "--no-tensorboard"), "--json")
    done = run(*arguments)
    found = json.loads(done.out)
    folder = runs / "ours" / "ratio1.1_n3_m1_random" / "seed0"
    rounds = json.loads(run("evaluate", folder, "--json").out)
    assert (found["folder"], found["status"], found["world_steps"]) == (str(folder), "finished", 400)
    assert found["success"] == rounds["success"] > 0
    assert found["mean_episode_length"] == rounds["mean_episode_length"]
    assert json.loads(run(*arguments).out) == found
    record = json.loads((folder / "run.json").read_text())
    files.write_json(folder / "run.json", {key: record[key] for key in record if key != "cpu_seconds"})
    assert json.loads(run(*arguments).out) == {**found, "cpu_seconds": None}
    (folder / "episodes.csv").write_text("edited")
    assert run(*arguments).code == 3


def test_train_refuses_a_folder_of_another_configuration_with_the_difference(run: Run, runs: Path) -> None:
    folder = copy_of_finished(runs)
    before = everything_in(runs)
    done = run("train", *tiny_arguments("--out", str(runs), "--set", "algorithm.gamma=0.8"))
    assert (done.code, done.out) == (2, "")
    assert f"{folder} already holds a different run; choose another --seed, --out or reward name:\n" in done.err
    assert "config.algorithm.gamma: 0.8 here, 0.9 there" in done.err
    assert everything_in(runs) == before


def test_a_diverged_training_prints_its_folder_and_fails(run: Run, runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train.DivergenceGuard, "check", lambda _: (_ for _ in ()).throw(train.Diverged("a loss")))
    arguments = ["train", *tiny_arguments("--out", str(runs), "--quiet", "--no-tensorboard")]
    for _ in range(2):
        done = run(*arguments)
        assert done.code == 1
        folder = Path(done.out.splitlines()[-1])
        assert json.loads((folder / "run.json").read_text())["status"] == "diverged"
        assert "diverged" in done.err
    done = run(*arguments, "--json")
    found = json.loads(done.out)
    assert (done.code, found["folder"], found["status"], found["success"]) == (1, str(folder), "diverged", None)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--reward", "our"],
        ["--reward", "absent.yaml"],
        ["--reward", "."],
        ["--reward", "/"],
        ["--reward", "bad.yaml"],
        ["--set", "reward.terms.overal_angle=1"],
        ["--set", "training.world_steps=true"],
        ["--set", 'training.world_steps="3"'],
        ["--set", "algorithm.learning_rate=.nan"],
        ["--set", "reward.name=../../outside"],
        ["--set", "reward.terms.time=" + "9" * 1000],
        ["--set", "scenario.obstacle_radius=1e200"],
        ["--set", "scenario.obstacle_limit=0.1", "--set", "scenario.obstacle_radius=0.3", "--obstacles", "2"],
        ["--set", "algorithm.buffer_world_steps=9999999999", "--set", "training.world_steps=9999999999"],
        ["--obstacles", "30"],
        ["--pursuers", "0"],
        ["--pursuers", "three"],
        ["--pursuers", "3.5"],
        ["--speed-ratio", "0.5"],
        ["--speed-ratio", "nan"],
        ["--scene", "tunel"],
        ["--algorithm", "ppo"],
        ["--algorithm", "matd3", "--set", "algorithm.random_world_steps=1000000"],
        ["--set", "evaluation.seed=2000"],
        ["--seed", "-1"],
        ["--seed", "4000"],
        ["--seed", "2000"],
        ["--seed", "4294967296"],
        ["--engine", "fast"],
        ["--profile", "quick"],
        ["--checkpoint-every", "0"],
        ["--no-such-option"],
        ["surplus"],
    ],
    ids=" ".join,
)
def test_a_bad_configuration_ends_with_2_and_leaves_nothing(run: Run, tmp_path: Path, arguments: list[str]) -> None:
    (tmp_path / "cwd" / "bad.yaml").write_text("base: ours\nname: !!python/name:os.system x\n")
    before = everything_in(tmp_path)
    done = run("train", *arguments)
    assert done.code == 2
    assert done.out == ""
    assert done.err
    assert "Traceback" not in done.err
    assert len(done.err) < 2000
    assert everything_in(tmp_path) == before


def test_a_method_without_its_option_is_told_the_option(run: Run) -> None:
    done = run("train", "ours", "--pursuers", "3")
    assert (done.code, done.out) == (2, "")
    assert done.err == "error: unexpected argument ours; did you mean --reward ours?\n"


def test_a_locked_folder_ends_with_2_naming_pid_and_host(run: Run, runs: Path) -> None:
    with locks.folder_lock(train.run_folder(load_config(profile="smoke"), 0, runs)):
        done = run("train", "--profile", "smoke", "--out", runs)
    assert done.code == 2
    assert f"process {os.getpid()} on host {socket.gethostname()}" in done.err


def test_a_lock_that_leads_elsewhere_ends_with_3_by_name(run: Run, runs: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    folder = train.run_folder(load_config(profile="smoke"), 0, runs)
    folder.mkdir(parents=True)
    (folder / ".lock").symlink_to(victim)
    done = run("train", "--profile", "smoke", "--out", runs)
    assert (done.code, victim.read_text()) == (3, "mine")
    assert str(folder / ".lock") in done.err
    assert "Traceback" not in done.err


def test_a_folder_that_cannot_be_written_ends_with_1_by_name(run: Run, runs: Path) -> None:
    runs.write_text("a file")
    done = run("train", "--profile", "smoke", "--out", runs)
    assert done.code == 1
    assert str(runs) in done.err
    assert "Traceback" not in done.err


def test_a_damaged_checkpoint_ends_with_3(run: Run, runs: Path) -> None:
    folder = train.run_folder(load_config(profile="smoke", overrides=TINY), 0, runs)
    folder.mkdir(parents=True)
    (folder / "checkpoint.safetensors").write_bytes(b"x")
    done = run("train", *tiny_arguments("--out", str(runs)))
    assert done.code == 3
    assert "checkpoint.safetensors: not a valid checkpoint" in done.err


def train_and_stop(out: Path, number: int) -> None:
    """The command, which a signal meets in its midst."""
    step_wait = train.CurriculumVecEnv.step_wait

    def stopping(self: Any) -> Any:
        if self.world_steps == 200:
            os.kill(os.getpid(), number)
        return step_wait(self)

    train.CurriculumVecEnv.step_wait = stopping  # type: ignore[method-assign]
    sys.argv = ["marl-encircle", "train", *tiny_arguments("--out", str(out), "--quiet", "--no-tensorboard")]
    cli.main()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_training_ends_with_the_signals_code_and_goes_on(
    run: Run, runs: Path, number: int, code: int
) -> None:
    process = in_another_process(train_and_stop, runs, number)
    process.join(60)
    assert process.exitcode == code
    done = run("train", *tiny_arguments("--out", str(runs), "--quiet", "--no-tensorboard"))
    assert done.code == 0
    assert contents(Path(done.out.splitlines()[-1])) == contents(finished())


def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARL_ENCIRCLE_DEBUG", "")
    monkeypatch.setattr(sys, "argv", ["marl-encircle", "--debug", "train", "--reward", "our"])
    with pytest.raises(ValueError, match="did you mean ours"):
        cli.main()


# evaluate

KEYS = """method speed_ratio pursuers obstacles scene train_seed eval_seed episodes closure success success_low
success_high mean_episode_length success_all success_pursuers sigma_c policy_sha256""".split()  # noqa: SIM905


def test_evaluate_prints_one_object_and_reads_only(run: Run) -> None:
    folder = finished()
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}
    done = run("evaluate", folder, "--episodes", "200", "--seed", "77", "--json")
    assert done.code == 0
    result = json.loads(done.out)
    assert list(result) == KEYS
    assert [result[key] for key in KEYS[:9]] == ["ours", 1.1, 3, 1, "random", 0, 77, 200, "all"]
    assert result["success"] == result["success_all"] >= result["success_pursuers"]
    assert 0 < result["success"] < 1
    low, high = wilson_interval(result["success"], 200)
    assert (result["success_low"], result["success_high"]) == pytest.approx((low, high))
    assert result["policy_sha256"] == files.sha256_bytes((folder / "policy.safetensors").read_bytes())
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()} == before
    assert run("evaluate", folder, "--episodes", "200", "--seed", "77", "--json") == done
    text = run("evaluate", folder, "--episodes", "200", "--seed", "77").out
    assert [line.split()[0] for line in text.splitlines()] == KEYS


def test_the_help_explains_every_key_that_is_printed(run: Run) -> None:
    page = run("evaluate", "--help").out
    options = ("speed_ratio", "pursuers", "obstacles", "scene")
    assert [key for key in KEYS if key not in options and not re.search(rf"\b{key}\b", page)] == []


def test_rounds_are_episodes(run: Run) -> None:
    assert run("evaluate", finished(), "--rounds", "5") == run("evaluate", finished(), "--episodes", "5")


@pytest.mark.parametrize("name", ["evaluate", "export"])
def test_a_folder_that_is_not_there_ends_with_2_and_how_one_is_named(run: Run, name: str) -> None:
    done = run(name, "shy")
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        "error: shy: no such run folder; give what train printed: results/runs/METHOD/ratio<lambda>_n<n>_m<m>_<scene>/"
        "seed<s>\n"
    )


def test_the_length_is_null_without_success(run: Run) -> None:
    for seed in range(1, 100):  # 0 is the training seed
        result = json.loads(run("evaluate", finished(), "--episodes", "1", "--seed", seed, "--json").out)
        assert (result["mean_episode_length"] is None) == (result["success"] == 0)
        if result["success"] == 0:
            return
    pytest.fail("beginners cannot be that good")


def test_evaluate_plays_the_runs_own_rounds_unless_told_otherwise(run: Run) -> None:
    done = run("evaluate", finished(), "--json")
    assert done == run("evaluate", finished(), "--episodes", "8", "--seed", "4000", "--json")
    result = json.loads(done.out)
    assert (result["episodes"], result["eval_seed"], done.err) == (8, 4000, "")


def test_evaluate_plays_in_another_setting_where_the_policy_can(run: Run) -> None:
    elsewhere = ("--speed-ratio", "1.05", "--scene", "concave")
    done = run("evaluate", finished(), *elsewhere, "--json")
    result = json.loads(done.out)
    assert [result[key] for key in KEYS[1:5]] == [1.05, 3, 1, "concave"]
    policy, config, _ = load_run(finished())
    rounds = play_rounds(policy, config, 8, 4000, Setting(1.05, 3, 1, "concave"))
    assert result["sigma_c"] == summarise_run(rounds, "all").sigma_c
    for option in (("--pursuers", "4"), ("--obstacles", "2")):
        done = run("evaluate", finished(), *option)
        assert (done.code, done.out) == (2, "")
        assert "policies of ours cannot play with other numbers of bodies" in done.err
    done = run("evaluate", finished(), *elsewhere, "--write")
    assert (done.code, done.out) == (2, "")
    assert "--write needs the setting of the run's configuration" in done.err


def test_evaluate_with_write_replaces_the_rounds_and_vouches_for_them(run: Run, runs: Path) -> None:
    folder = copy_of_finished(runs)
    before = (folder / "episodes.csv").read_bytes()
    for arguments in ((), ("--episodes", "8", "--seed", "4000")):
        (folder / "episodes.csv").unlink()
        assert run("evaluate", folder, *arguments, "--write", "--json").code == 0
        assert (folder / "episodes.csv").read_bytes() == before
    record = json.loads((folder / "run.json").read_text())
    assert record["sha256"]["episodes.csv"] == files.sha256_bytes((folder / "episodes.csv").read_bytes())
    assert everything_in(folder) == everything_in(finished())
    assert run("evaluate", folder / "policy.safetensors", "--write").code == 0
    assert everything_in(folder) == everything_in(finished())


@pytest.mark.parametrize("arguments", [["--episodes", "9"], ["--episodes", "7"], ["--seed", "4"]])
def test_other_rounds_than_the_runs_own_are_not_written(run: Run, runs: Path, arguments: list[str]) -> None:
    folder = copy_of_finished(runs)
    before = contents(folder), (folder / "run.json").read_bytes()
    done = run("evaluate", folder, *arguments, "--write")
    assert (done.code, done.out) == (2, "")
    assert "--write needs the rounds of the run's configuration: --episodes 8 --seed 4000" in done.err
    assert (contents(folder), (folder / "run.json").read_bytes()) == before


def test_the_worlds_that_a_run_was_trained_in_are_no_evaluation(run: Run) -> None:
    done = run("evaluate", finished(), "--seed", "0", "--json")
    assert (done.code, done.out) == (2, "")
    assert "--seed 0 is the run's training seed" in done.err


def test_a_diverged_run_is_evaluated_with_a_warning_and_not_written(run: Run, runs: Path) -> None:
    folder = copy_of_finished(runs)
    record = json.loads((folder / "run.json").read_text())
    del record["sha256"]["episodes.csv"]
    (folder / "episodes.csv").unlink()
    files.write_json(folder / "run.json", {**record, "status": "diverged"})
    before = everything_in(folder), (folder / "run.json").read_bytes()
    done = run("evaluate", folder, "--json")
    assert (done.code, list(json.loads(done.out))) == (0, KEYS)
    assert "warning: this run diverged" in done.err
    done = run("evaluate", folder, "--write")
    assert (done.code, done.out) == (2, "")
    assert "is diverged" in done.err
    done = run("export", folder, "--to", "torch-export", "--out", runs / "actors.pt2", "--json")
    assert (done.code, json.loads(done.out)["status"]) == (0, "diverged")
    assert done.err == "warning: this run diverged; its policy is the last one of its training\n"
    assert (everything_in(folder), (folder / "run.json").read_bytes()) == before


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("policy.safetensors", b"x", "policy.safetensors: changed since it was written"),
        ("policy.safetensors", None, "policy.safetensors: the file is missing"),
        ("run.json", b"{", "run.json: not valid JSON"),
        ("run.json", b"{}", "run.json"),
        ("run.json", None, "run.json: the file is missing"),
    ],
)
def test_a_damaged_run_ends_with_3_and_its_reason(
    run: Run, runs: Path, name: str, content: bytes | None, reason: str
) -> None:
    folder = copy_of_finished(runs)
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    done = run("evaluate", folder, "--json")
    assert (done.code, done.out) == (3, "")
    assert reason in done.err
    assert str(folder) in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--episodes", "10000001"], ["--seed", "-1"]])
def test_a_bad_number_of_rounds_ends_with_2(run: Run, arguments: list[str]) -> None:
    assert run("evaluate", finished(), *arguments).code == 2


# scenarios


def test_what_no_option_says_is_the_scenarios(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("speed_ratio: 1.3\npursuers: 4\nobstacles: 2\nscene: concave\n")
    shown = json.loads(run("config", "show", "--scenario", path, "--json").out)["scenario"]
    assert [shown[key] for key in ("speed_ratio", "pursuers", "obstacles", "scene")] == [1.3, 4, 2, "concave"]
    shown = json.loads(run("config", "show", "--scenario", path, "--pursuers", "5", "--json").out)["scenario"]
    assert [shown[key] for key in ("speed_ratio", "pursuers")] == [1.3, 5]
    shown = json.loads(run("config", "show", "--json").out)["scenario"]
    assert [shown[key] for key in ("speed_ratio", "pursuers", "obstacles", "scene")] == [1.1, 3, 1, "random"]


def test_train_takes_the_scenarios_own_setting(run: Run, runs: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("pursuers: 4\nobstacles: 0\n")
    arguments = tiny_arguments("--out", str(runs), "--quiet", "--no-tensorboard", "--scenario", str(path))
    done = run("train", *arguments)
    assert done.out == f"{runs}/ours/ratio1.1_n4_m0_random/seed0\n"


@pytest.mark.parametrize("name", ["train", "config show"])
def test_a_scenario_that_is_wrong_ends_with_2_by_file_and_key(run: Run, tmp_path: Path, name: str) -> None:
    path = tmp_path / "mine.yaml"
    for text, reason in (("speed_ratio: 0.3", "speed_ratio must be between"), ("pursuer: 3", "pursuer: unknown key")):
        path.write_text(text)
        for more in ((), ("--speed-ratio", "1.2")):
            done = run(*name.split(), "--scenario", path, *more)
            assert (done.code, done.out) == (2, "")
            assert done.err.startswith(f"error: {path}: scenario.{reason}")


def test_a_scene_that_is_full_at_the_curriculums_usual_start_can_be_shown(run: Run) -> None:
    done = run("config", "show", "--pursuers", "2", "--obstacles", "4", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["training"]["curriculum"]["obstacle_radius"]["start"] == 0.279


# optional parts


def test_train_without_tensorboard_ends_with_2_and_leaves_nothing(
    run: Run, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logger, "SummaryWriter", None)
    done = run("train", *tiny_arguments("--out", str(runs), "--quiet"))
    assert (done.code, runs.exists()) == (2, False)
    assert "--no-tensorboard" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("name", ["tables", "figures", "report"])
def test_a_folder_without_runs_of_the_grid_is_refused_and_left_as_it_is(run: Run, tmp_path: Path, name: str) -> None:
    def refusal() -> str:
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        done = run(name, "--grid", "smoke", "--out", tmp_path)
        assert (done.code, done.out) == (2, "")
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
        return done.err

    runs = tmp_path / "runs"
    advice = f"train them: marl-encircle sweep smoke --out {runs}"
    assert refusal() == f"error: {runs}: no such folder, so no run of the grid smoke; {advice}\n"
    runs.mkdir()
    for made in ("table2.md", "table_agreement.md", "table_other.csv", "table_scenes.md"):
        files.write_text(tmp_path / "tables" / made, "of another grid")
    assert refusal() == f"error: {runs}: no run of the grid smoke has ended there; {advice}\n"
    (runs / "ours" / "ratio1.1_n3_m1_random" / "seed900").mkdir(parents=True)  # in training
    assert refusal() == f"error: {runs}: no run of the grid smoke has ended there; {advice}\n"
    copy_of_finished(runs)
    assert refusal() == (
        f"error: {runs}: no run of the grid smoke has ended there; {advice}. There are others, such as "
        "ours/ratio1.1_n3_m1_random/seed0: --grid takes the name or the YAML file of their grid\n"
    )
    done = run(name, "--grid", "smoke", "--out", runs)
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        f"error: {runs / 'runs'}: no such folder, so no run of the grid smoke; {runs} holds runs itself: give "
        f"--results {tmp_path}\n"
    )


def test_an_unknown_layer_ends_with_2_and_the_nearest_name(run: Run) -> None:
    done = run("watch", "--hide", "lenses")
    assert (done.code, done.out) == (2, "")
    assert done.err == "error: --hide lenses: unknown layer; did you mean lens?\n"


def test_export_without_its_libraries_ends_with_2_and_the_extra(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    done = run("export", finished())
    assert (done.code, done.out) == (2, "")
    assert done.err == "error: ONNX needs onnx: pip install 'marl-encircle[export]'\n"
    assert everything_in(Path()) == []


def test_actors_that_act_otherwise_end_with_1_and_no_file(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "TOLERANCE", -1.0)
    done = run("export", finished(), "--to", "torchscript")
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("error: ours_ratio1.1_n3_m1_random_seed0.pt: not written: an action differs")
    assert everything_in(Path()) == []


def test_verification_of_nothing_ends_with_3(run: Run, tmp_path: Path) -> None:
    done = run("verify-results", "--grid", "smoke", "--out", tmp_path, "--quiet")
    assert (done.code, done.out) == (3, "")
    assert done.err == f"nothing was verified: {tmp_path}/runs has no finished run of the grid smoke\n"
    done = run("verify-results", "--grid", "smoke", "--out", tmp_path, "--quiet", "--json")
    found = json.loads(done.out)
    assert (done.code, found["passed"], found["rounds"]) == (3, False, 0)


# sweep, tables, reproduce-tables


class Made(Trained):
    """A worker that trains in this process, unless its seed is 7."""

    def __init__(self, job: grids.Job, out: Path) -> None:
        if job.seed != 7:
            super().__init__(job, out)


@pytest.fixture
def _tiny_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grids, "load_config", lambda *a, **k: load_config(*a, **{**k, "overrides": TINY}))
    monkeypatch.setattr(executors, "_start", Made)
    monkeypatch.setattr(sweeps, "POLL_SECONDS", 0.0)


def grid(folder: Path, seeds: list[int]) -> Path:
    path = folder / "grid.yaml"
    path.write_text(
        "profile: smoke\ngroups:\n  - methods: [ours]\n    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]\n"
        f"    seeds: {seeds}\nshared: []\n"
    )
    return path


@pytest.mark.usefixtures("_tiny_workers")
def test_sweep_counts_and_names_what_failed(run: Run, runs: Path, tmp_path: Path) -> None:
    done = run("sweep", grid(tmp_path, [0, 7]), "--out", runs, "--json")
    assert done.code == 1
    assert json.loads(done.out) == {"done": 1, "running": 0, "failed": 1, "diverged": 0, "left": 0}
    assert "failed: ours/ratio1.1_n3_m1_random/seed7" in done.err
    again = run("sweep", grid(tmp_path, [0]), "--out", runs, "--json")
    assert again.code == 0
    assert json.loads(again.out) == {"done": 1, "running": 0, "failed": 0, "diverged": 0, "left": 0}


@pytest.mark.usefixtures("_tiny_workers")
def test_a_second_sweep_ends_with_2_naming_pid_and_host(run: Run, runs: Path, tmp_path: Path) -> None:
    with locks.folder_lock(runs):
        done = run("sweep", grid(tmp_path, [0]), "--out", runs)
    assert done.code == 2
    assert f"process {os.getpid()} on host {socket.gethostname()}" in done.err


@pytest.mark.usefixtures("_tiny_workers")
def test_reproduce_tables_ends_with_its_counts(run: Run, tmp_path: Path) -> None:
    results = tmp_path / "results"
    arguments = ("reproduce-tables", "--grid", "smoke", "--out", results)
    first = run(*arguments)
    assert first.code == 0, first.err
    assert first.out.splitlines()[-1] == "trained=2 evaluated=0 reused=0"
    tables = {path: path.read_bytes() for path in (results / "tables").iterdir()}
    again = run(*arguments)
    assert again.out.splitlines()[-1] == "trained=0 evaluated=0 reused=2"
    assert again.out.splitlines()[:-1] == first.out.splitlines()[:-1]
    folder = results / "runs" / "ma2019" / "ratio1.1_n3_m1_random" / "seed900"
    (folder / "episodes.csv").unlink()
    assert run(*arguments).out.splitlines()[-1] == "trained=0 evaluated=1 reused=1"
    assert {path: path.read_bytes() for path in (results / "tables").iterdir()} == tables
    listed = run("tables", "--grid", "smoke", "--out", results)
    cards = (results / "runs").rglob("README.md")
    assert (listed.code, sorted(map(Path, listed.out.split()))) == (0, sorted([*tables, *cards]))
    assert listed.err == ""
    (folder / "episodes.csv").write_text("edited")
    for damaged in (run("tables", "--grid", "smoke", "--out", results), run(*arguments)):
        assert damaged.code == 3
        assert "episodes.csv: changed since it was written" in damaged.err


@pytest.mark.usefixtures("_tiny_workers")
def test_reproduction_and_verification_as_json_are_one_object_each(run: Run, tmp_path: Path) -> None:
    results = ("--grid", "smoke", "--out", tmp_path / "results")
    done = run("reproduce-tables", *results, "--json")
    expected = {"trained": 2, "evaluated": 0, "reused": 0, "failed": 0, "diverged": 0}
    assert (done.code, json.loads(done.out)) == (0, expected)
    found = json.loads(run("verify-results", *results, "--quiet", "--json").out)
    expected = {
        "passed": True,
        "rounds": 16,
        "equal": 16,
        "rounds_here": 16,
        "equal_here": 16,
        "cells_off": 0,
        "exact": True,
        "changed": [],
    }
    assert found == expected
    table = tmp_path / "results" / "tables" / "table2.md"
    before = table.read_text()
    table.write_text("edited")
    done = run("verify-results", *results, "--quiet", "--json")
    assert (done.code, json.loads(done.out)) == (3, {**expected, "passed": False, "changed": ["tables/table2.md"]})
    done = run("verify-results", *results, "--quiet")
    assert (done.code, done.out.splitlines()) == (
        3,
        [
            "check: every number of every round, tables and figures",
            f"changed: {table}",
            "rounds=16 equal=16 cells_off=0",
        ],
    )
    table.write_text(before)
    record = next((tmp_path / "results" / "runs" / "ours").rglob("run.json"))
    files.write_json(record, {**json.loads(record.read_text()), "cpu": "another"})
    done = run("verify-results", *results, "--quiet")
    assert (done.code, done.out.splitlines()) == (
        0,
        [
            "check: how every round ends, every number of the runs of this processor, all but Figures 1, 3 and 6",
            "rounds=16 equal=16 cells_off=0",
        ],
    )
    done = run("verify-results", *results, "--quiet", "--exact")
    assert (done.code, done.out.splitlines()[0]) == (0, "check: every number of every round, tables and figures")


@pytest.mark.usefixtures("_tiny_workers")
def test_reproduce_tables_fails_if_a_run_does_and_still_renders(run: Run, tmp_path: Path) -> None:
    done = run("reproduce-tables", "--grid", grid(tmp_path, [0, 7]), "--out", tmp_path / "results")
    assert done.code == 1
    assert done.out.splitlines()[-1] == "trained=1 evaluated=0 reused=0"
    assert "failed: ours/ratio1.1_n3_m1_random/seed7" in done.err


@pytest.mark.usefixtures("_tiny_workers")
def test_where_every_run_fails_former_tables_stay(run: Run, tmp_path: Path) -> None:
    former = tmp_path / "results" / "tables" / "table2.md"
    files.write_text(former, "of another grid")
    done = run("reproduce-tables", "--grid", grid(tmp_path, [7]), "--out", tmp_path / "results")
    assert (done.code, done.out) == (1, "trained=0 evaluated=0 reused=0\n")
    assert "failed: ours/ratio1.1_n3_m1_random/seed7" in done.err
    assert (former.read_text(), list(former.parent.iterdir())) == ("of another grid", [former])


@pytest.mark.parametrize("name", ["sweep", "tables", "reproduce-tables"])
def test_an_unknown_grid_ends_with_2_and_leaves_nothing(run: Run, tmp_path: Path, name: str) -> None:
    before = everything_in(tmp_path)
    done = run("sweep", "smok") if name == "sweep" else run(name, "--grid", "smok")
    assert done.code == 2
    assert "did you mean smoke?" in done.err
    assert everything_in(tmp_path) == before


# the command itself


def test_every_command_says_what_it_does(run: Run) -> None:
    names = (
        "train",
        "evaluate",
        "watch",
        "sweep",
        "calibrate",
        "tables",
        "figures",
        "report",
        "reproduce-tables",
        "verify-results",
        "bench",
        "config",
    )
    listing = run("--help")
    assert listing.code == 0
    for name in names:
        assert name in listing.out
        assert run(name, "--help").code == 0


def test_bench_outside_a_checkout_says_so(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(machine, "PACKAGE", tmp_path / "site-packages" / "marl_encircle")
    done = run("bench")
    assert done.code == 2
    assert "bench needs a checkout" in done.err


def test_the_version_is_the_packages(run: Run) -> None:
    assert run("--version") == (0, f"marl-encircle {metadata.version('marl-encircle')}\n", "")


def test_an_interrupt_while_it_starts_ends_with_130_and_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n")
    done = subprocess.run(
        [sys.executable, "-m", "marl_encircle", "--version"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_an_interrupt_in_a_command_ends_with_130(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kinds, "load_config", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    done = run("config", "validate", "ours")
    assert (done.code, done.out) == (130, "")
    assert "Traceback" not in done.err


def test_the_module_is_the_command(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "marl_encircle", "config", "validate", "our"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: 'our': neither a known name nor a .yaml path; did you mean ours?\n"
