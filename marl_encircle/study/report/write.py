"""From the runs of a grid to ``report.html``."""

from collections.abc import Sequence
from pathlib import Path

from marl_encircle import files
from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.grid_runs import runs_of
from marl_encircle.experiments.records import Run
from marl_encircle.study.figures.write import read_bands
from marl_encircle.study.report.charts import charts
from marl_encircle.study.report.page import Page, render_page
from marl_encircle.study.report.replays import player_data, shown_cells
from marl_encircle.study.reproduce import TABLE1_METHODS, options_of
from marl_encircle.study.tables import freeze_notes, main_tables, table1
from marl_encircle.study.typeset import Table


def write_report(grid: Grid, results: str | Path) -> Path:
    """Write ``results/report.html``: the same runs give the same bytes.

    What the grid asks for and is not there, is "not run".

    :return: the file
    :raises OtherRunError: if a run has another configuration than the grid asks for, with the difference
    :raises DamagedFileError: if a run there is not what its record says
    """
    path = Path(results) / "report.html"
    files.write_text(path, report(grid, Path(results) / "runs"))
    return path


def report(grid: Grid, folder: Path) -> str:
    """Return the report of a grid.

    :param folder: of all runs
    """
    runs = runs_of(grid, folder)
    notes = freeze_notes(grid.frozen, grid.amended)
    options = {method: options_of(method) for method in TABLE1_METHODS}
    *tables, differences = main_tables(runs, grid.aliases, grid.cells, notes)
    page = Page(
        facts=_facts(grid, runs),
        tables=[table1(options, notes), *tables, without_missing(differences)],
        charts=charts(read_bands(runs, folder), sorted(grid.cells), grid.aliases),
        player=player_data(shown_cells(runs, folder, grid.aliases, grid.cells)),
    )
    return render_page(page)


def without_missing(differences: Table) -> Table:
    """Return the differences without the rows that have nothing to compare, which are counted in a note."""
    rows = [row for row in differences.rows if _NOT_RUN not in row]
    missing = len(differences.rows) - len(rows)
    notes = [*differences.notes, f"Left out: {missing} rows in which one of the two is not run."]
    return differences._replace(rows=rows, notes=notes) if missing else differences


_NOT_RUN = "not run"


def _facts(grid: Grid, runs: Sequence[Run]) -> list[tuple[str, str]]:
    """Say what the report is made of."""
    finished = [run for run in runs if run.status == "finished"]
    rounds = sorted({len(run.episodes) for run in finished})
    seeds = sorted({job.seed for job in grid.jobs})
    facts = [
        ("runs", f"{len(finished)} of {len(grid.jobs)} finished"),
        ("training seeds", " ".join(map(str, seeds)) if len(seeds) > 1 else f"one, number {seeds[0]}"),
        ("evaluation", f"{' or '.join(map(str, rounds))} rounds per run" if rounds else "not run"),
    ]
    return facts if grid.frozen is None else [*facts, ("recipe frozen in", grid.frozen[:12])]
