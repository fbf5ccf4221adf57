"""Watch learning curves."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from marl_encircle.cli.options import Results
from marl_encircle.experiments.yaml_files import ConfigError


def tensorboard_command(
    out: Results = Path("results"),
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, metavar="PORT", help="Where to serve.", show_default="6006 or above")
    ] = None,
) -> None:
    """Show the learning curves of all runs in TensorBoard, on this machine alone; Ctrl-C ends it.

    Runs that were trained here appear as they were logged, also while they train. Those of a fresh checkout have only
    their learning curves, which are turned into event files in a temporary folder.
    """
    from marl_encircle.experiments.tensorboard import check_tensorboard, lay_out

    check_tensorboard()
    with TemporaryDirectory(prefix="marl-encircle-") as folder:
        runs = out / "runs"
        found = lay_out(runs, Path(folder))
        if not any(found):
            advice = f"train one with --out {runs}, or give the folder that holds runs/ by --results"
            raise ConfigError(f"{runs}: no runs to show; {advice}")
        typer.echo(f"runs: {found.recorded} from learning curves, {found.own} from their own event files", err=True)
        raise typer.Exit(_serve(folder, port))


def _serve(folder: str, port: int | None) -> int:
    """Run TensorBoard until it is stopped; return its exit code."""
    from tensorboard import default, program

    board = program.TensorBoard(default.get_plugins())
    board.configure(logdir=folder, host="127.0.0.1", port=port, window_title="marl-encircle")
    return int(board.main() != 0)
