"""Options that several commands have, and what they become."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from marl_encircle.experiments.config import Config, Profile, load_config
from marl_encircle.experiments.executors import Executor, LocalExecutor
from marl_encircle.experiments.ray_executor import RayExecutor
from marl_encircle.experiments.yaml_files import ConfigError

RewardOption = Annotated[str, typer.Option(help="A method's name, or the path of a YAML file. See 'config show'.")]
ScenarioOption = Annotated[
    str, typer.Option(help="The world's rules: default, paper (the study's), or the path of a YAML file.")
]
# Those that are not given are the scenario's own.
SpeedRatio = Annotated[
    float | None, typer.Option(help="Target speed / pursuer speed.", show_default="the scenario's; 1.1 in default")
]
Pursuers = Annotated[int | None, typer.Option(help="Number of pursuers.", show_default="the scenario's; 3 in default")]
Obstacles = Annotated[
    int | None, typer.Option(help="Number of obstacles.", show_default="the scenario's; 1 in default")
]
Scene = Annotated[
    str | None,
    typer.Option(
        help="What an obstacle looks like: random, concave or tunnel.",
        show_default="the scenario's; random in default",
    ),
]
Algorithm = Annotated[str, typer.Option(help="maddpg, matd3, or the path of a YAML file.")]
ProfileOption = Annotated[Profile, typer.Option(help="full, or smoke for a few seconds.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override: section.key=value. May be repeated.")]
Out = Annotated[Path, typer.Option(help="Folder of runs.")]
Results = Annotated[Path, typer.Option(help="Folder of runs/ and tables/.")]
Jobs = Annotated[int, typer.Option(min=1, help="Runs at a time, one processor core each.")]
ExecutorName = Literal["local", "ray"]
ExecutorOption = Annotated[
    ExecutorName,
    typer.Option(
        "--executor", help="local: this machine; ray: a Ray cluster, all of whose nodes see the folder of runs."
    ),
]
Address = Annotated[
    str | None, typer.Option(help="Ray cluster, HOST:PORT. Default: one on this machine alone, on loopback.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar.")]


def read_config(
    reward: str,
    speed_ratio: float | None,
    pursuers: int | None,
    obstacles: int | None,
    scene: str | None,
    scenario: str,
    algorithm: str,
    profile: Profile,
    overrides: list[str] | None,
) -> Config:
    """Return the configuration that the options describe.

    Raises:
        ConfigError: It is wrong.
    """
    given = {"speed_ratio": speed_ratio, "pursuers": pursuers, "obstacles": obstacles, "scene": scene}
    fields = {name: value for name, value in given.items() if value is not None}
    return load_config(
        reward, algorithm=algorithm, profile=profile, scenario=scenario, fields=fields, overrides=overrides or ()
    )


def make_executor(name: ExecutorName, address: str | None) -> Executor:
    """Return what runs a sweep's jobs.

    Raises:
        ConfigError: An address without Ray.
    """
    if name == "ray":
        return RayExecutor(address)
    if address is not None:
        raise ConfigError(f"--address {address} needs --executor ray; the executor local has no address")
    return LocalExecutor()
