"""Show, compare and check configurations."""

import json
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from marl_encircle.cli.options import (
    Algorithm,
    AsJson,
    Obstacles,
    ProfileOption,
    Pursuers,
    RewardOption,
    ScenarioOption,
    Scene,
    Set,
    SpeedRatio,
    read_config,
)
from marl_encircle.experiments.config import Config, difference, load_config
from marl_encircle.experiments.library import reward_names


def show(
    reward: RewardOption = "ours",
    speed_ratio: SpeedRatio = None,
    pursuers: Pursuers = None,
    obstacles: Obstacles = None,
    scene: Scene = None,
    scenario: ScenarioOption = "default",
    algorithm: Algorithm = "maddpg",
    profile: ProfileOption = "full",
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Print a resolved configuration; the reward as a table of terms and weights."""
    config = read_config(reward, speed_ratio, pursuers, obstacles, scene, scenario, algorithm, profile, overrides)
    values = config.to_dict()
    if as_json:
        typer.echo(json.dumps(values, indent=2))
        return
    console = Console()
    r = config.reward
    console.print(f"{r.name}: closure {r.closure}, {'two stages' if r.two_stage else 'one stage'}, scale {r.scale:g}")
    console.print(_reward_table(config))
    for section in ("scenario", "algorithm", "training", "evaluation"):
        table = Table("key", "value", title=section)
        for key, value in values[section].items():
            table.add_row(key, str(value))
        console.print(table)
    console.print(f"methods: {', '.join(reward_names())}")


def diff(first: str, second: str, profile: ProfileOption = "full") -> None:
    """Print what differs between two methods."""
    here, there = (load_config(name, profile=profile).to_dict() for name in (first, second))
    for line in difference(here, there, (f"in {first}", f"in {second}")):
        typer.echo(line)


def validate(path: Annotated[str, typer.Argument(help="A method's name or the path of a YAML file.")]) -> None:
    """Check a method's file: print 'valid', or what is wrong with it (exit code 2)."""
    load_config(path)
    typer.echo("valid")


def _reward_table(config: Config) -> Table:
    table = Table("term", "weight", "parameters", title="reward")
    for name, (weight, parameters) in config.reward.build().active.items():
        table.add_row(name, f"{weight:g}", ", ".join(f"{key}={value:g}" for key, value in parameters.items()))
    return table
