"""MADDPG and MATD3 on somebody else's environment."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from marl_encircle.cli.options import OUTPUT, AsJson, Quiet
from marl_encircle.experiments.choices import AlgorithmName


def play_with_command(
    env: Annotated[
        str,
        typer.Argument(help="An id of PettingZoo, such as sisl/multiwalker-v9, or an import path, whose code is run."),
    ],
    algorithm: Annotated[AlgorithmName, typer.Option(help="What is trained.")] = "maddpg",
    world_steps: Annotated[
        int, typer.Option(min=100, metavar="N", help="Steps of all agents of one world to train on.")
    ] = 60_000,
    arguments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="An argument of the environment. May be repeated."),
    ] = None,
    pad: Annotated[
        bool, typer.Option("--pad", help="Make unequal spaces of the agents equal, by SuperSuit, with zeros.")
    ] = False,
    n_worlds: Annotated[int, typer.Option(min=1, max=1024, metavar="N", help="Worlds that are stepped in turn.")] = 8,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, metavar="SEED", help="Training seed.")] = 0,
    episodes: Annotated[
        int,
        typer.Option("--episodes", "--rounds", min=2, max=10**5, metavar="N", help="Rounds of the evaluation."),
    ] = 100,
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            rich_help_panel=OUTPUT,
            help="Write the policy: policy.safetensors and policy.json.",
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Train on any PettingZoo ParallelEnv, evaluate, and compare with random actions in the same rounds.

    Its agents must have equal, continuous (Box) spaces and end together. Import paths are modules with a parallel_env,
    also of the working folder, or module:function; naming one runs its code. A training that is stopped starts anew.
    """
    from marl_encircle.experiments.play_with import play_with, save_policy
    from marl_encircle.experiments.worlds import find_world, parse_arguments

    given = parse_arguments(arguments or ())
    world = find_world(env, given, pad)
    started = time.monotonic()
    played = play_with(
        env, world, algorithm, world_steps, n_worlds=n_worlds, seed=seed, rounds=episodes, progress_bar=not quiet
    )
    about = {"environment": env, "arguments": given, "pad": pad, "algorithm": algorithm, "seed": seed}
    if save is not None:
        save_policy(save, played, about)
    summary = played.summary()
    if as_json:
        results = {name: {"mean": mean, "interval": interval} for name, (mean, interval) in summary.items()}
        typer.echo(json.dumps({**about, "world_steps": played.world_steps, "rounds": episodes, **results}))
        return
    seconds = time.monotonic() - started
    typer.echo(f"{env}: {len(played.agents)} agents, {played.world_steps:,} world steps, {seconds:.0f} s")
    typer.echo(f"mean return of {episodes} rounds, mean of the agents [95 % interval over the rounds]")
    for name, (mean, interval) in summary.items():
        label = algorithm if name == "trained" else name
        typer.echo(f"  {label:<10}  {mean:10.2f}  [{interval.low:.2f}, {interval.high:.2f}]" if interval else label)
    if save is not None:
        typer.echo(str(save))
