"""What is made from runs: tables, figures, the report, and the proof that they can be made again."""

from pathlib import Path
from typing import Annotated, Any

import typer
from tqdm import tqdm

from marl_encircle.cli.options import Address, ExecutorOption, Jobs, Quiet, Results, make_executor
from marl_encircle.cli.printing import exit_if_failed
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.live import LiveReport
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.reproduce import reproduce, write_tables
from marl_encircle.study.verify import verify


def tables(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Render the tables from the existing runs."""
    for path in write_tables(load_grid(grid), out):
        typer.echo(str(path))


def figures(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Draw Figures 1 and 3 to 6 from the runs there are."""
    try:
        from marl_encircle.study.figures.write import write_figures
    except ImportError as error:
        raise ConfigError(str(error)) from error
    for path in write_figures(load_grid(grid), out):
        typer.echo(str(path))


def report_command(
    grid: Annotated[str, typer.Option(help="The grid whose runs are shown.")] = "committed",
    out: Results = Path("results"),
) -> None:
    """Write report.html: tables, learning curves and a player of rounds, in one file that needs no network."""
    from marl_encircle.study.report.write import write_report

    typer.echo(str(write_report(load_grid(grid), out)))


def reproduce_tables(
    grid: Annotated[str, typer.Option(help="committed, smoke, all, or the path of a YAML file.")] = "committed",
    out: Results = Path("results"),
    jobs: Jobs = 1,
    executor: ExecutorOption = "local",
    address: Address = None,
) -> None:
    """Train and evaluate what is missing of a grid, and render Tables 1-4 beside the paper's numbers."""
    workers = make_executor(executor, address)
    with LiveReport() as report:
        done = reproduce(grid, out, jobs, report, workers)
    for number in (2, 3, 4):
        typer.echo((out / "tables" / f"table{number}.md").read_text(encoding="utf-8"))
    typer.echo(f"trained={done.trained} evaluated={done.evaluated} reused={done.reused}")
    exit_if_failed(done.sweep)


def verify_results(
    grid: Annotated[str, typer.Option(help="The grid whose runs are verified.")] = "committed",
    out: Results = Path("results"),
    quiet: Quiet = False,
) -> None:
    """Play every committed policy's rounds again, render its tables again, and compare. Nothing is written.

    On the processor that a run was made on every round must be equal; elsewhere 99.5 % of the rounds, and every cell's
    S must lie within its 99 % binomial interval. Exit code 3 where that does not hold, and where there is no finished
    run.
    """
    with tqdm(unit="run", disable=quiet) as bar:
        found = verify(load_grid(grid), out, lambda done, total: _advance(bar, done, total))
    check = "every figure of every round" if found.exact else "how the rounds end: another processor than the runs'"
    if not found.rounds:
        typer.echo(f"nothing was verified: {out / 'runs'} has no finished run of the grid {grid}", err=True)
        raise typer.Exit(3)
    typer.echo(f"check: {check}")
    for name in found.changed:
        typer.echo(f"changed: {out / name}")
    typer.echo(f"rounds={found.rounds} equal={found.equal} cells_off={found.cells_off}")
    if not found.passed:
        raise typer.Exit(3)


def _advance(bar: Any, done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)
