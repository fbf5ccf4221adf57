"""The whole road for a grid: train what is missing, evaluate what is missing, render the tables."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from marl_encircle import files
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.executors import Executor
from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.grid_runs import read_grid_runs
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.records import RECORD, Setting, episodes_name, read_record, read_runs
from marl_encircle.experiments.sweep import Progress, sweep
from marl_encircle.experiments.train import run_folder, write_episodes
from marl_encircle.study.agreement import AGREEMENT_TABLES, render_agreement
from marl_encircle.study.amendment import AMENDMENT_TABLES, FORMER, render_amendment
from marl_encircle.study.cards import render_cards
from marl_encircle.study.cells import gather
from marl_encircle.study.paper import reported_cells
from marl_encircle.study.protocol import calibrated_cells
from marl_encircle.study.scenes import SCENE_TABLES, render_scenes
from marl_encircle.study.tables import OTHER_TABLES, MethodOptions, freeze_notes, render_table1, render_tables

TABLE1_METHODS = ("model_a", "model_b", "model_c", "ours")


class Reproduction(NamedTuple):
    """What had to be done, in runs."""

    trained: int
    evaluated: int
    reused: int
    sweep: Progress

    @property
    def has_tables(self) -> bool:
        """Whether any run has ended; where none has, former tables stay as they are."""
        return self.sweep.done + self.sweep.diverged > 0


def reproduce(
    grid: Grid,
    results: str | Path,
    n_workers: int,
    report: Callable[[Progress], None] | None = None,
    executor: Executor | None = None,
) -> Reproduction:
    """Fill ``results/runs`` with the runs of a grid and ``results/tables`` with its tables.

    A run whose own rounds had to be played again counts as evaluated, not as reused. Where every run failed no table
    is written.

    :param results: gets ``runs``, ``tables`` and the policies' cards
    :param n_workers: runs at a time; this, ``report`` and ``executor`` are those of ``sweep``
    :raises DamagedFileError: if a run there is not what its record says
    """
    runs = Path(results) / "runs"
    progress = sweep(grid.jobs, runs, n_workers, report, executor)
    evaluated = 0
    for job in grid.jobs:
        folder = run_folder(job.config, job.seed, runs)
        missing = _missing_rounds(folder, grid.elsewhere.get(job.config.cell, ()))
        if missing:
            policy, config, _ = load_run(folder)
            rounds, seed = config.evaluation.episodes, config.evaluation.seed
            for setting in missing:
                write_episodes(folder, play_rounds(policy, config, rounds, seed, setting), setting)
            evaluated += missing[0] is None
    trained = progress.done + progress.diverged - progress.reused
    done = Reproduction(trained, evaluated, progress.reused - evaluated, progress)
    if done.has_tables:
        write_tables(grid, results)
    return done


def _missing_rounds(folder: Path, elsewhere: Iterable[Setting]) -> list[Setting | None]:
    """Return where a finished run has not been evaluated: elsewhere, or, None, in its own setting."""
    if not (folder / RECORD).exists():
        return []
    record = read_record(folder)
    if record["status"] != "finished":
        return []
    names = {setting: episodes_name(setting) for setting in (None, *elsewhere)}
    # Whatever is stopped between the rounds and their record leaves rounds without a hash.
    kept = {name for name in names.values() if name in record["sha256"] and files.is_kept(folder / name)}
    return [setting for setting, name in names.items() if name not in kept]


def write_tables(grid: Grid, results: str | Path) -> list[Path]:
    """Write the tables and the policies' cards from the runs of a grid; a former table that it does not have goes.

    :return: the files written
    :raises OtherRunError: if a run has another configuration than the grid asks for, with the difference
    :raises DamagedFileError: if a run there is not what its record says
    """
    texts = render(grid, results)
    for name in (*OTHER_TABLES, *SCENE_TABLES, *AGREEMENT_TABLES, *AMENDMENT_TABLES):
        if f"tables/{name}" not in texts:
            (Path(results) / "tables" / name).unlink(missing_ok=True)
    for name, text in texts.items():
        files.write_text(Path(results) / name, text)
    return [Path(results) / name for name in texts]


def render(grid: Grid, results: str | Path) -> dict[str, str]:
    """Return the tables of a grid and the cards of its first policies: path below ``results`` -> text.

    Nothing is written.

    :raises OtherRunError: if a run has another configuration than the grid asks for, with the difference
    :raises DamagedFileError: if a run there is not what its record says
    """
    notes = freeze_notes(grid.frozen, grid.amended)
    texts = render_table1({method: options_of(method) for method in TABLE1_METHODS}, notes)
    folder = Path(results) / "runs"
    runs, cells = read_grid_runs(grid, folder), grid.cells
    texts |= render_tables(runs, grid.aliases, cells, notes)
    texts |= render_scenes(runs, notes)
    by_cell = gather(runs, grid.aliases)
    former = [run for run in read_runs(Path(results) / FORMER, policies=False) if run.cell in cells]
    texts |= render_amendment(former, by_cell, notes)
    if grid.frozen:
        texts |= render_agreement(by_cell, reported_cells(), calibrated_cells(), notes)
    cards = {f"runs/{name}": text for name, text in render_cards(grid, runs, folder).items()}
    return {f"tables/{name}": text for name, text in texts.items()} | cards


def options_of(method: str) -> MethodOptions:
    """Return the row of Table 1 that a method's reward configuration amounts to."""
    reward = load_config(method).reward
    active = reward.build().active
    return MethodOptions(
        two_stage=reward.two_stage,
        obstacle_assisted=reward.closure == "all" and "obstacle_angle" in active,
        individual_contributing_angle="contributing_angle" in active,
    )
