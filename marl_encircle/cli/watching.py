"""Look at rounds of a trained policy."""

from pathlib import Path
from typing import Annotated

import typer

from marl_encircle.cli.completion import names_of, scenes
from marl_encircle.cli.options import given, setting_option
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.spelling import nearest

FILM, ROUND = "In place of the window", "Which rounds"


def watch(
    method: Annotated[
        str,
        typer.Argument(
            autocompletion=names_of("reward"),
            help="A method's name, a run folder, or with --policy the YAML file of a reward.",
        ),
    ] = "ours",
    versus: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD", autocompletion=names_of("reward"), help="Another METHOD beside it, in the same rounds."
        ),
    ] = None,
    policy: Annotated[
        Path | None, typer.Option(metavar="RUN_DIR", help="A run folder: its policy, under METHOD's reward.")
    ] = None,
    fps: Annotated[float, typer.Option(min=0.5, max=50, metavar="FPS", help="Steps per second.")] = 6.0,
    hide: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LAYER",
            help="Leave out circles, angles, area, trails or lens. May be repeated.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--results", metavar="DIR", help="Folder of runs/.", show_default="results, then the package's own"
        ),
    ] = None,
    speed_ratio: Annotated[float | None, setting_option("LAMBDA", "Target speed / pursuer speed.", "1.1")] = None,
    pursuers: Annotated[int | None, setting_option("N", "Number of pursuers of the run.", "3")] = None,
    obstacles: Annotated[int | None, setting_option("M", "Number of obstacles of the run.", "1")] = None,
    scene: Annotated[
        str | None, setting_option("SCENE", "Play in this scene: random, concave or tunnel.", "the run's", scenes)
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="SEED",
            rich_help_panel=ROUND,
            help="Evaluation seed of the rounds.",
            show_default="7000, not reported ones",
        ),
    ] = None,
    round_number: Annotated[
        int,
        typer.Option("--round", min=0, max=10**6, metavar="R", rich_help_panel=ROUND, help="The (first) round."),
    ] = 0,
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE", rich_help_panel=FILM, help="Write the round as a film, .gif or .mp4."),
    ] = None,
    headless: Annotated[
        Path | None,
        typer.Option(metavar="DIR", rich_help_panel=FILM, help="Write every step as PNG into a folder."),
    ] = None,
) -> None:
    """Play rounds of a trained policy in a window (h: its keys), or write one as a film or as pictures."""
    from marl_encircle.drawing.view import Layers
    from marl_encircle.replays.watch import find_match

    for layer in hide or ():
        if layer not in Layers._fields:
            raise ConfigError(f"--hide {layer:.80}: unknown layer{nearest(layer, Layers._fields)}")
    try:
        from marl_encircle.replays import film, player
    except ImportError as error:
        raise ConfigError(str(error)) from error
    if save is not None:
        film.check_film(save)
    fields = given(speed_ratio=speed_ratio, pursuers=pursuers, obstacles=obstacles)
    match = find_match(method, versus, out, fields, scene, policy, seed)
    if save is None and headless is None:
        player.check_window()
    for note in match.notes():
        typer.echo(note, err=True)
    layers = Layers()._replace(**dict.fromkeys(hide or (), False))
    if save is not None:
        film.save(save, match, round_number, fps, layers)
        typer.echo(str(save))
    if headless is not None:
        film.save_pictures(headless, match, round_number, layers)
        typer.echo(str(headless))
    if save is None and headless is None:
        player.show(player.Player(match, round_number, fps, layers))
