"""How commands print and how they end."""

from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from marl_encircle.experiments.sweep import Progress


def print_pairs(values: dict[str, Any]) -> None:
    """Print one ``key  value`` a line."""
    width = max(map(len, values))
    for key, value in values.items():
        typer.echo(f"{key:<{width}}  {value:.4f}" if isinstance(value, float) else f"{key:<{width}}  {value}")


def exit_if_failed(progress: "Progress") -> None:
    """Name the runs that failed and exit with 1; return where none did."""
    for name in progress.failed:
        typer.echo(f"failed: {name}", err=True)
    if progress.failed:
        raise typer.Exit(1)
