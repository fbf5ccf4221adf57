"""The ``marl-encircle`` command: every command in the order of its help, and what errors become.

Exit codes: 0 done, 1 a run failed, 2 wrong configuration or usage, 3 a damaged or unfit file, 128 + n stopped by
signal n.
"""

import os
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from inspect import cleandoc
from typing import Annotated

import typer
from rich.markup import escape

from marl_encircle import files, locks
from marl_encircle.cli import configs, info, machine, playing, results, runs, sweeps, tensorboard, tuning, watching
from marl_encircle.experiments.yaml_files import ConfigError

NAME = "marl-encircle"

app = typer.Typer(
    name=NAME,
    help="Encircle a faster target: train, evaluate and compare, and reproduce Zheng et al. (2023).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
config_app = typer.Typer(no_args_is_help=True, help="Show, compare and check configurations.")

EXAMPLES: dict[str, tuple[str, ...]] = {}
"""What the help of each command teaches by."""


def _add(name: str, command: Callable[..., None], panel: str, *examples: str, surplus: bool = False) -> None:
    """Add a command with its docstring as its help, at whatever width, and its examples below the options.

    :param surplus: whether the command itself refuses what it does not know as an argument
    """
    paragraphs = cleandoc(command.__doc__ or "").split("\n\n")
    group, _, last = name.rpartition(" ")
    EXAMPLES[name] = examples
    (config_app if group else app).command(
        last,
        help="\n\n".join(escape(re.sub(r"\s+", " ", paragraph)) for paragraph in paragraphs),
        epilog="\n".join(["[bold]Examples[/bold]", *(f"  {NAME} {name} {escape(line)}" for line in examples)]),
        rich_help_panel=panel,
        context_settings={"allow_extra_args": surplus},
    )(command)


ONE, MANY, STUDY, ABOUT = "One run", "Many runs", "What runs show", "Settings and surroundings"
RUN = "results/runs/ours/ratio1.1_n3_m1_random/seed0"

_add(
    "train",
    runs.train_command,
    ONE,
    "--pursuers 3 --obstacles 1 --seed 7",
    "--reward model_b --set training.n_worlds=32 --seed 7",
    "--set training.world_steps=20000 --out short/runs",
    surplus=True,
)
_add("evaluate", runs.evaluate, ONE, RUN, f"{RUN} --scene tunnel", f"{RUN} --episodes 1000 --seed 77 --json")
_add("watch", watching.watch, ONE, "ours --pursuers 3 --obstacles 1", "ours --versus model_b --save round.gif")
_add("export", runs.export, ONE, RUN, f"{RUN} --to torchscript --out pursuers.pt --json")
_add(
    "play-with",
    playing.play_with_command,
    ONE,
    "mpe2.simple_spread_v3 --set continuous_actions=true",
    "mpe2.simple_tag_v3 --set continuous_actions=true --pad --algorithm matd3 --save tag",
    "marl_encircle/encirclement-v0 --set pursuers=2 --world-steps 20000 --json",
)
_add("sweep", sweeps.sweep_command, MANY, "study --jobs 2", "smoke --out trial/runs --json")
_add("calibrate", sweeps.calibrate_command, MANY, "--jobs 2")
_add("tune", tuning.tune_command, MANY, "--trials 30 --jobs 2", "my_search.yaml --out trial/search --json")
_add("reproduce-tables", results.reproduce_tables, MANY, "--grid study --jobs 2", "--grid smoke --out trial --json")
_add("tables", results.tables, STUDY, "--grid study")
_add("figures", results.figures, STUDY, "--grid study")
_add("report", results.report_command, STUDY, "--grid study", "--results trial")
_add("tensorboard", tensorboard.tensorboard_command, STUDY, "", "--out trial --port 6010")
_add("verify-results", results.verify_results, STUDY, "--grid study")
_add("config show", configs.show, ABOUT, "--reward ma2019 --pursuers 4", "--scenario paper --json")
_add("config diff", configs.diff, ABOUT, "ours model_b", "centre paper --json")
_add("config validate", configs.validate, ABOUT, "ablations/ours.yaml")
app.add_typer(config_app, name="config", rich_help_panel=ABOUT)
_add("info", info.info, ABOUT, "", "--json")
_add("bench", machine.bench, ABOUT, "")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{NAME} {version(NAME)}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Keep what concerns every command."""
    os.environ["OMP_NUM_THREADS"] = "1"  # torch reads it at its import; results are promised per thread count
    os.environ["MARL_ENCIRCLE_DEBUG"] = "1" if debug else ""


def main() -> None:
    """Run the command; errors become one message and an exit code."""
    try:
        with _one_telling():
            app(prog_name=NAME)  # also where it is run by python -m
    except Exception as error:  # one that has no exit code of its own is a fault of ours and keeps its traceback
        code = _exit_code(error)
        if code is None or os.environ.get("MARL_ENCIRCLE_DEBUG"):
            raise
        typer.echo(_written_out(str(error) if code > 128 else f"error: {error}"), err=True)
        raise SystemExit(code) from None


def _written_out(message: str) -> str:
    """Return a message without what would steer a terminal: part of it may come from a stranger's file."""
    return "".join(each if each.isprintable() or each == "\n" else repr(each)[1:-1] for each in message)


@contextmanager
def _one_telling() -> Iterator[None]:
    """Say nothing of an error in TensorBoard's writing thread, which hands it to the main one."""
    usual = threading.excepthook

    def say(failed: threading.ExceptHookArgs) -> None:
        if not (isinstance(failed.exc_value, OSError) and type(failed.thread).__module__.startswith("tensorboard.")):
            usual(failed)

    threading.excepthook = say
    try:
        yield
    finally:
        threading.excepthook = usual


def _exit_code(error: Exception) -> int | None:
    """Return the exit code for an error that is no fault of the program, else None."""
    if isinstance(error, (ConfigError, locks.FolderLockedError)):
        return 2
    if isinstance(error, (files.DamagedFileError, locks.UnfitLockError)):
        return 3
    if isinstance(error, OSError):
        return 1
    # These modules take seconds to import; what they raise comes from there.
    from marl_encircle.core.simulator import PlacementError
    from marl_encircle.experiments.divergence import Diverged
    from marl_encircle.experiments.export import ParityError
    from marl_encircle.experiments.signals import Stopped
    from marl_encircle.study.calibrate import CalibrationError

    if isinstance(error, PlacementError):
        return 2
    if isinstance(error, (CalibrationError, Diverged, ParityError)):
        return 1
    return 128 + error.signum if isinstance(error, Stopped) else None
