"""What is made from runs: tables, figures, the report, and the proof that they can be made again.

A grid is read before anything slow is imported: what is wrong with it is told at once.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from tqdm import tqdm

from marl_encircle.cli.options import Address, AsJson, ExecutorOption, GridOption, Jobs, Quiet, Results, make_executor
from marl_encircle.cli.printing import exit_if_failed

if TYPE_CHECKING:
    from marl_encircle.experiments.grid import Grid


def tables(grid: GridOption = "committed", out: Results = Path("results")) -> None:
    """Render the tables from the existing runs."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.study.reproduce import write_tables

    _warn_of_no_runs(wanted, out)
    for path in write_tables(wanted, out):
        typer.echo(str(path))


def figures(grid: GridOption = "committed", out: Results = Path("results")) -> None:
    """Draw Figures 1 and 3 to 6 from the runs there are."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.study.figures.write import write_figures

    _warn_of_no_runs(wanted, out)
    for path in write_figures(wanted, out):
        typer.echo(str(path))


def report_command(grid: GridOption = "committed", out: Results = Path("results")) -> None:
    """Write report.html: tables, learning curves and a player of rounds, in one file that needs no network."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.study.report.write import write_report

    _warn_of_no_runs(wanted, out)
    typer.echo(str(write_report(wanted, out)))


def reproduce_tables(
    grid: GridOption = "committed",
    jobs: Jobs = 1,
    executor: ExecutorOption = "local",
    address: Address = None,
    out: Results = Path("results"),
    as_json: AsJson = False,
) -> None:
    """Train and evaluate what is missing of a grid, and render Tables 1-4 beside the paper's numbers."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.experiments.live import LiveReport
    from marl_encircle.study.reproduce import reproduce

    workers = make_executor(executor, address)
    with LiveReport() as report:
        done = reproduce(wanted, out, jobs, report, workers)
    counts = {"trained": done.trained, "evaluated": done.evaluated, "reused": done.reused}
    if as_json:
        typer.echo(json.dumps({**counts, "failed": len(done.sweep.failed), "diverged": done.sweep.diverged}))
    else:
        for number in (2, 3, 4):
            typer.echo((out / "tables" / f"table{number}.md").read_text(encoding="utf-8"))
        typer.echo(" ".join(f"{name}={count}" for name, count in counts.items()))
    exit_if_failed(done.sweep)


def verify_results(
    grid: GridOption = "committed", out: Results = Path("results"), quiet: Quiet = False, as_json: AsJson = False
) -> None:
    """Play every committed policy's rounds again, make tables and figures again, and compare. Nothing is written.

    On the processor that a run was made on every round must be equal; elsewhere 99.5 % of the rounds, and every cell's
    S must lie within its 99 % binomial interval. Exit code 3 where that does not hold, and where there is no finished
    run.
    """
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.study.verify import verify

    with tqdm(unit="run", disable=quiet) as bar:
        found = verify(wanted, out, lambda done, total: _advance(bar, done, total))
    if not found.rounds:
        typer.echo(f"nothing was verified: {out / 'runs'} has no finished run of the grid {grid}", err=True)
        raise typer.Exit(3)
    if as_json:
        typer.echo(json.dumps({"passed": found.passed, **found._asdict()}))
    else:
        check = "every figure of every round" if found.exact else "how the rounds end: another processor than the runs'"
        typer.echo(f"check: {check}")
        for name in found.changed:
            typer.echo(f"changed: {out / name}")
        typer.echo(f"rounds={found.rounds} equal={found.equal} cells_off={found.cells_off}")
    if not found.passed:
        raise typer.Exit(3)


def _warn_of_no_runs(grid: "Grid", out: Path) -> None:
    from marl_encircle.experiments.records import run_path

    runs = out / "runs"
    if not any((runs / run_path(job.config.cell, job.seed)).is_dir() for job in grid.jobs):
        typer.echo(f"warning: {runs} has no run of this grid; what is made shows none", err=True)


def _advance(bar: Any, done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)
