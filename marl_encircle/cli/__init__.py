"""The ``marl-encircle`` command: every command in the order of its help, and what errors become.

Exit codes: 0 done, 1 a run failed, 2 wrong configuration or usage, 3 a damaged or unfit file, 128 + n stopped by
signal n.
"""

import os
from importlib.metadata import version
from typing import Annotated

import torch as th
import typer

from marl_encircle import files, locks
from marl_encircle.cli import configs, machine, results, runs, sweeps, watching
from marl_encircle.core.simulator import PlacementError
from marl_encircle.experiments.callbacks import Stopped
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.calibrate import CalibrationError

app = typer.Typer(
    name="marl-encircle",
    help="Encircle a faster target: train, evaluate and compare, and reproduce Zheng et al. (2023).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("train")(runs.train_command)
app.command("evaluate")(runs.evaluate)
app.command("watch")(watching.watch)
app.command("sweep")(sweeps.sweep_command)
app.command("calibrate")(sweeps.calibrate_command)
app.command("tables")(results.tables)
app.command("figures")(results.figures)
app.command("report")(results.report_command)
app.command("reproduce-tables")(results.reproduce_tables)
app.command("verify-results")(results.verify_results)
app.command("bench")(machine.bench)

config_app = typer.Typer(no_args_is_help=True, help="Show, compare and check configurations.")
config_app.command("show")(configs.show)
config_app.command("diff")(configs.diff)
config_app.command("validate")(configs.validate)
app.add_typer(config_app, name="config")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"marl-encircle {version('marl-encircle')}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Keep what concerns every command."""
    th.set_num_threads(1)  # results are promised per thread count
    os.environ["MARL_ENCIRCLE_DEBUG"] = "1" if debug else ""


def main() -> None:
    """Run the command; errors become one message and an exit code."""
    try:
        app()
    except (ConfigError, PlacementError, locks.FolderLockedError) as error:
        _fail(error, 2)
    except (files.DamagedFileError, locks.UnfitLockError) as error:
        _fail(error, 3)
    except Stopped as stopped:
        _fail(stopped, 128 + stopped.signum)
    except (CalibrationError, OSError) as error:
        _fail(error, 1)


def _fail(error: Exception, code: int) -> None:
    if os.environ.get("MARL_ENCIRCLE_DEBUG"):
        raise error
    typer.echo(f"error: {error}" if not isinstance(error, Stopped) else str(error), err=True)
    raise SystemExit(code)
