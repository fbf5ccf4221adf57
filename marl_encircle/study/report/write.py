"""From the runs of a grid to ``report.html``."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from marl_encircle import files
from marl_encircle.experiments.config import difference
from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.grid_runs import read_grid_runs
from marl_encircle.experiments.loading import config_of
from marl_encircle.experiments.records import RECORD, Cell, Run, read_record, read_runs, run_path
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.cells import absences, gather
from marl_encircle.study.figures.write import read_bands
from marl_encircle.study.report.charts import charts
from marl_encircle.study.report.page import Page, render_page
from marl_encircle.study.report.replays import player_data, shown_cells
from marl_encircle.study.reproduce import TABLE1_METHODS, options_of
from marl_encircle.study.tables import freeze_notes, main_tables, table1


def write_report(grid: Grid | None, results: str | Path) -> Path:
    """Write ``results/report.html``: the same runs give the same bytes.

    :param grid: whose runs; what it asks for and is not there, is "not run". None: all runs there are
    :return: the file
    :raises ConfigError: if a run has another configuration than the grid asks for or, without one, than the others of
        its cell, with the difference; without a grid also if there are no runs
    :raises DamagedFileError: if a run there is not what its record says
    """
    path = Path(results) / "report.html"
    files.write_text(path, report(grid, Path(results) / "runs"))
    return path


def report(grid: Grid | None, folder: Path) -> str:
    """Return the report of a grid, or of all runs.

    :param folder: of all runs
    """
    shown = _of_grid(grid, folder) if grid is not None else _of_all(folder)
    runs, cells, aliases, notes = shown.runs, shown.cells, shown.aliases, shown.notes
    options = {method: options_of(method) for method in TABLE1_METHODS}
    page = Page(
        facts=shown.facts,
        tables=[table1(options, notes), *main_tables(runs, aliases, cells, notes)],
        charts=charts(read_bands(runs, folder), sorted(cells), absences(gather(runs, aliases))),
        player=player_data(shown_cells(runs, folder, aliases, cells)),
    )
    return render_page(page)


class _Shown(NamedTuple):
    """What a report is of; see :class:`~marl_encircle.experiments.grid.Grid`."""

    runs: Sequence[Run]
    facts: Sequence[tuple[str, str]]
    cells: set[Cell]
    aliases: Mapping[Cell, Cell]
    notes: Sequence[str]


def _of_grid(grid: Grid, folder: Path) -> _Shown:
    runs = read_grid_runs(grid, folder)
    facts = _facts(runs, len(grid.jobs), {job.seed for job in grid.jobs})
    if grid.frozen is not None:
        facts.append(("recipe frozen in", grid.frozen[:12]))
    return _Shown(runs, facts, grid.cells, grid.aliases, freeze_notes(grid.frozen, grid.amended))


def _of_all(folder: Path) -> _Shown:
    """Gather every run there is; raise a ConfigError for two of one cell that were not trained alike."""
    runs = read_runs(folder)
    if not runs:
        raise ConfigError(f"{folder}: no runs")
    first: dict[Cell, Path] = {}
    for run in runs:
        if run.status != "unfinished":
            path = folder / run_path(run.cell, run.seed)
            _check_alike(path, first.setdefault(run.cell, path))
    facts = _facts(runs, len(runs), {run.seed for run in runs})
    return _Shown(runs, facts, {run.cell for run in runs}, {}, [])


def _check_alike(path: Path, first: Path) -> None:
    here, there = (config_of(read_record(each), each / RECORD).to_dict() for each in (path, first))
    lines = difference(here, there)
    if lines:
        raise ConfigError(
            f"{path} and {first} are of one cell and were not trained alike ({lines[0]}): write a grid of those that "
            "are meant and give it by --grid"
        )


def _facts(runs: Sequence[Run], asked: int, seeds: Iterable[int]) -> list[tuple[str, str]]:
    """Say what the report is made of.

    :param asked: number of runs with those that are not there
    :param seeds: of training
    """
    finished = [run for run in runs if run.status == "finished"]
    rounds = sorted({len(run.episodes) for run in finished})
    seeds = sorted(seeds)
    return [
        ("runs", f"{len(finished)} of {asked} finished"),
        ("training seeds", " ".join(map(str, seeds)) if len(seeds) > 1 else f"one, number {seeds[0]}"),
        ("evaluation", f"{' or '.join(map(str, rounds))} rounds per run" if rounds else "not run"),
    ]
