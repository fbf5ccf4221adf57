"""Search hyper-parameters."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from marl_encircle.cli.completion import names_of
from marl_encircle.cli.options import OUTPUT, AsJson, Jobs

if TYPE_CHECKING:
    from marl_encircle.experiments.trials import Outcome, Row

SHOWN = 10
"""How many trials are printed; all of them are in ``trials.csv``."""


def tune_command(
    space: Annotated[
        str, typer.Argument(metavar="SEARCH", autocompletion=names_of("tuning"), help="default, or a YAML file.")
    ] = "default",
    trials: Annotated[
        int, typer.Option(min=1, metavar="N", help="In all: those of earlier calls and those given up included.")
    ] = 50,
    jobs: Jobs = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", rich_help_panel=OUTPUT, help="Folder of the search.", show_default="results/tuning/<name>"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Search hyper-parameters with Optuna: trials that do worse than the others are given up early.

    The search file says what is tried and by which trainings a trial is judged: tuning seeds, selection rounds. To
    search something else, copy marl_encircle/configs/tuning/default.yaml. It may be stopped and started again. The best
    trial becomes best.yaml, and best_reward.yaml if reward weights were searched: 'train' takes them by --algorithm and
    --reward.
    """
    from marl_encircle.experiments.search_space import load_space

    plan = load_space(space)
    from marl_encircle.experiments.tuning import tune

    folder = out or Path("results/tuning") / Path(space).stem
    outcome = tune(plan, folder, trials, jobs, lambda row: typer.echo(_line(row), err=True))
    if as_json:
        typer.echo(json.dumps(_as_json(outcome)))
    else:
        _print(outcome, folder)
    if outcome.failed:
        typer.echo(f"failed: {outcome.failed} of the trials; what their trainings say stands above", err=True)
        raise typer.Exit(1)


def _line(row: "Row") -> str:
    worth = "" if row.success is None else f", success {row.success:.3f}"
    return f"trial {row.number}: {row.state} after {row.points} points{worth}"


def _as_json(outcome: "Outcome") -> dict[str, Any]:
    states = [row.state for row in outcome.rows]
    return {
        "trials": {state: states.count(state) for state in ("complete", "pruned", "fail")},
        "best": outcome.best and outcome.best._asdict(),
        "files": {section: str(path) for section, path in outcome.written.items()},
    }


def _print(outcome: "Outcome", folder: Path) -> None:
    """Print the best trials, and what to do with the best."""
    names = list(dict.fromkeys(key for row in outcome.rows for key in row.values))
    heads = [name.removeprefix("algorithm.").removeprefix("reward.").removeprefix("terms.") for name in names]
    table = Table("trial", "success", "points", *heads, box=box.SIMPLE_HEAD)
    rows = sorted(outcome.rows, key=lambda row: (row.state == "complete", row.success or 0.0), reverse=True)
    for row in rows[:SHOWN]:
        state = "" if row.state == "complete" else f" ({row.state})"
        success = "" if row.success is None else f"{row.success:.3f}"
        values = [_in_short(row.values.get(name)) for name in names]
        table.add_row(str(row.number), success + state, str(row.points), *values)
    Console().print(table)
    typer.echo(f"all of them: {folder / 'trials.csv'}")
    if outcome.written:
        options = " ".join(f"--{section} {path}" for section, path in outcome.written.items())
        typer.echo(f"marl-encircle train {options}")


def _in_short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
