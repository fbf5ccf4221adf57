"""What is made from runs: tables, figures, the report, and the proof that they can be made again.

A grid is read before anything slow is imported: what is wrong with it is told at once.
"""

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from tqdm import tqdm

from marl_encircle.cli.completion import names_of
from marl_encircle.cli.options import Address, AsJson, ExecutorOption, GridOption, Jobs, Quiet, Results, make_executor
from marl_encircle.cli.printing import exit_if_failed
from marl_encircle.experiments.yaml_files import ConfigError

if TYPE_CHECKING:
    from marl_encircle.experiments.grid import Grid


def tables(grid: GridOption = "study", out: Results = Path("results")) -> None:
    """Render the tables from the existing runs."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    _check_runs(grid, wanted, out)
    from marl_encircle.study.reproduce import write_tables

    for path in write_tables(wanted, out):
        typer.echo(str(path))


def figures(grid: GridOption = "study", out: Results = Path("results")) -> None:
    """Draw Figures 1 and 3 to 6 from the runs there are."""
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    _check_runs(grid, wanted, out)
    from marl_encircle.study.figures.write import write_figures

    for path in write_figures(wanted, out):
        typer.echo(str(path))


def report_command(
    grid: Annotated[
        str | None,
        typer.Option(
            metavar="GRID",
            autocompletion=names_of("grid"),
            help="Whose runs: study, smoke, or the path of a YAML file.",
            show_default="study; all runs where it has none",
        ),
    ] = None,
    out: Results = Path("results"),
) -> None:
    """Write report.html: tables, learning curves and a player of rounds, in one file that needs no network."""
    from marl_encircle.experiments.grid import load_grid

    name = grid or "study"
    wanted = load_grid(name)
    asked, others = _ended_runs(wanted, out / "runs")
    shows_all = grid is None and bool(asked or others) and not (asked and _are_as_asked(wanted, out / "runs"))
    if shows_all and asked:
        typer.echo(f"the runs are not those of the grid {name}: all are shown", err=True)
    if not shows_all:
        _check_runs(name, wanted, out)
        if grid is None and others:
            number = f"{len(others)} run{'s' if len(others) > 1 else ''}"
            typer.echo(f"left out: {number} that the grid {name} does not ask for, such as {others[0]}", err=True)
    typer.echo("playing the first rounds of every cell again, about a second each", err=True)
    from marl_encircle.study.report.write import write_report

    typer.echo(str(write_report(None if shows_all else wanted, out)))


def reproduce_tables(
    grid: GridOption = "study",
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
        for number in (2, 3, 4) if done.has_tables else ():
            typer.echo((out / "tables" / f"table{number}.md").read_text(encoding="utf-8"))
        typer.echo(" ".join(f"{name}={count}" for name, count in counts.items()))
    exit_if_failed(done.sweep)


def verify_results(
    grid: GridOption = "study",
    out: Results = Path("results"),
    exact: Annotated[
        bool, typer.Option("--exact", help="Every number must be equal, whatever processor made the run.")
    ] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Play every committed policy's rounds again, make tables and figures again, and compare. Nothing is written.

    On the processor that a run was made on every number must be equal. Elsewhere 99.5 % of the rounds must end alike
    and every cell's S lie within its 99 % binomial interval; Figures 1, 3 and 6, which are computed anew, are left out.
    Exit code 3 where that does not hold, and where there is no finished run.
    """
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid)
    from marl_encircle.study.verify import verify

    with tqdm(unit="run", disable=quiet) as bar:
        found = verify(wanted, out, lambda done, total: _advance(bar, done, total), exact=exact)
    if as_json:
        typer.echo(json.dumps({"passed": found.passed, "exact": found.exact, **found._asdict()}))
    if not found.rounds:
        typer.echo(f"nothing was verified: {out / 'runs'} has no finished run of the grid {grid}", err=True)
        raise typer.Exit(3)
    if not as_json:
        partly = "how every round ends, every number of the runs of this processor, all but Figures 1, 3 and 6"
        typer.echo(f"check: {'every number of every round, tables and figures' if found.exact else partly}")
        for name in found.changed:
            typer.echo(f"changed: {out / name}")
        typer.echo(f"rounds={found.rounds} equal={found.equal} cells_off={found.cells_off}")
    if not found.passed:
        raise typer.Exit(3)


def _check_runs(name: str, grid: "Grid", out: Path) -> None:
    """Refuse a folder without a run of the grid: what is made there would show none, in place of what is there."""
    runs = out / "runs"
    asked, others = _ended_runs(grid, runs)
    if asked:
        return
    fault = f"no run of the grid {name} has ended there"
    if not runs.is_dir():
        fault = f"no such folder, so no run of the grid {name}"
        if any(_ended_runs(grid, out)):
            raise ConfigError(f"{runs}: {fault}; {out} holds runs itself: give --results {out.parent}")
    advice = f"train them: {shlex.join(['marl-encircle', 'sweep', name, '--out', str(runs)])}"
    if others:
        advice += f". There are others, such as {others[0]}: --grid takes the name or the YAML file of their grid"
    raise ConfigError(f"{runs}: {fault}; {advice}")


def _ended_runs(grid: "Grid", runs: Path) -> tuple[list[Path], list[Path]]:
    """Return the runs below a folder that have ended, those that a grid asks for and the others."""
    from marl_encircle.experiments.records import RECORD, run_folders, run_path

    asked = {run_path(job.config.cell, job.seed) for job in grid.jobs}
    ended = {run.relative_to(runs) for run in run_folders(runs) if (run / RECORD).exists()}
    # Asked for one by one: glob passes over what cannot be read.
    return [run for run in asked if (runs / run / RECORD).exists()], sorted(ended - asked)


def _are_as_asked(grid: "Grid", runs: Path) -> bool:
    """Whether those that a grid asks for were made as it asks."""
    from marl_encircle.experiments.records import RECORD
    from marl_encircle.experiments.train import OtherRunError, check_same_run, run_folder

    try:
        for job in grid.jobs:
            folder = run_folder(job.config, job.seed, runs)
            if (folder / RECORD).exists():
                check_same_run(folder, job.config, job.seed)
    except OtherRunError:
        return False
    return True


def _advance(bar: Any, done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)
