"""Many runs: a grid's, the calibration's."""

import json
from pathlib import Path
from typing import Annotated

import typer

from marl_encircle.cli.completion import names_of
from marl_encircle.cli.options import OUTPUT, Address, AsJson, ExecutorOption, Jobs, Out, make_executor
from marl_encircle.cli.printing import exit_if_failed, print_pairs


def sweep_command(
    grid: Annotated[
        str,
        typer.Argument(autocompletion=names_of("grid"), help="study, smoke, or the path of a YAML file."),
    ],
    jobs: Jobs = 1,
    executor: ExecutorOption = "local",
    address: Address = None,
    out: Out = Path("results/runs"),
    as_json: AsJson = False,
) -> None:
    """Train the missing runs of a grid.

    It may be stopped and started again; what is trained already is not trained twice.
    """
    from marl_encircle.experiments.grid import load_grid

    wanted = load_grid(grid).jobs
    from marl_encircle.experiments.live import LiveReport
    from marl_encircle.experiments.sweep import sweep

    workers = make_executor(executor, address)
    with LiveReport() as report:
        progress = sweep(wanted, out, jobs, report, workers)
    if as_json:
        typer.echo(json.dumps(progress.counts))
    else:
        print_pairs(progress.counts)
    exit_if_failed(progress)


def calibrate_command(
    protocol: Annotated[
        str,
        typer.Argument(autocompletion=names_of("protocol"), help="calibration, or the path of a YAML file."),
    ] = "calibration",
    jobs: Jobs = 1,
    out: Annotated[Path, typer.Option(metavar="DIR", rich_help_panel=OUTPUT, help="Folder of the calibration.")] = Path(
        "results/calibration"
    ),
) -> None:
    """Train the scenarios of a protocol and choose the one that comes nearest to the paper's cells.

    What is missing is trained, so that it can be stopped and started again. OUT gets the runs, the sensitivity table
    and the chosen scenario.
    """
    from marl_encircle.study.protocol import load_protocol

    plan = load_protocol(protocol)
    from marl_encircle.experiments.live import LiveReport
    from marl_encircle.study.calibrate import calibrate

    with LiveReport() as report:
        calibrate(plan, out, jobs, report)
    typer.echo((out / "sensitivity.md").read_text(encoding="utf-8"))
    typer.echo(str(out / "scenario.yaml"))
