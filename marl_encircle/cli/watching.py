"""Look at rounds of a trained policy."""

from pathlib import Path
from typing import Annotated

import typer

from marl_encircle.envs.view import Layer, Layers
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays.watch import find_match


def watch(
    method: Annotated[
        str, typer.Argument(help="A method's name, a run folder, or with --policy the YAML file of a reward.")
    ] = "ours",
    speed_ratio: Annotated[
        float | None, typer.Option(help="Target speed / pursuer speed of the run.", show_default="1.1")
    ] = None,
    pursuers: Annotated[int | None, typer.Option(help="Number of pursuers of the run.", show_default="3")] = None,
    obstacles: Annotated[int | None, typer.Option(help="Number of obstacles of the run.", show_default="1")] = None,
    scene: Annotated[
        str | None, typer.Option(help="Play in this scene: random, concave or tunnel.", show_default="the run's")
    ] = None,
    policy: Annotated[Path | None, typer.Option(help="A run folder: its policy, under METHOD's reward.")] = None,
    versus: Annotated[str | None, typer.Option(help="Another METHOD beside it, in the same rounds.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Evaluation seed of the rounds.", show_default="7000, not reported ones")
    ] = None,
    round_number: Annotated[int, typer.Option("--round", min=0, max=10**6, help="The (first) round.")] = 0,
    save: Annotated[Path | None, typer.Option(help="Write the round as a film, .gif or .mp4; no window.")] = None,
    headless: Annotated[Path | None, typer.Option(help="Write every step as PNG into a folder; no window.")] = None,
    fps: Annotated[float, typer.Option(min=0.5, max=50, help="Steps per second.")] = 6.0,
    hide: Annotated[list[Layer] | None, typer.Option(help="A layer to leave out. May be repeated.")] = None,
    out: Annotated[Path, typer.Option("--results", help="Folder of runs/.")] = Path("results"),
) -> None:
    """Play rounds of a trained policy in a window (h: its keys), or write one as a film or as pictures.

    Example: marl-encircle watch ours --pursuers 3 --obstacles 1 --versus model_b --save round.gif
    """
    try:
        from marl_encircle.replays import film, player
    except ImportError as error:
        raise ConfigError(str(error)) from error
    if save is not None:
        film.check_film(save)
    if save is None and headless is None:
        player.check_window()
    given = {"speed_ratio": speed_ratio, "pursuers": pursuers, "obstacles": obstacles}
    fields = {name: value for name, value in given.items() if value is not None}
    match = find_match(method, versus, out, fields, scene, policy, seed)
    for note in match.notes():
        typer.echo(note, err=True)
    layers = Layers()._replace(**{layer.value: False for layer in hide or ()})
    if save is not None:
        film.save(save, match, round_number, fps, layers)
        typer.echo(str(save))
    if headless is not None:
        film.save_pictures(headless, match, round_number, layers)
        typer.echo(str(headless))
    if save is None and headless is None:
        player.show(player.Player(match, round_number, fps, layers))
