"""Options that several commands have, and what they become.

Commands import what they need when they run: help and completion wait for no torch, nor does the refusal of a wrong
configuration.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marl_encircle.cli.completion import names_of, scenes
from marl_encircle.experiments.choices import ExecutorName, Profile

if TYPE_CHECKING:
    from marl_encircle.experiments.config import Config
    from marl_encircle.experiments.executors import Executor

SETTING, OUTPUT, CLUSTER = "Setting", "Output", "Cluster"
"""Panels of the help."""


def setting_option(metavar: str, text: str, default: str, autocompletion: Callable[[], list[str]] | None = None) -> Any:
    """Return an option that says a part of the setting.

    :param text: its help
    :param default: what the help says is taken where it is not given
    """
    return typer.Option(
        metavar=metavar, rich_help_panel=SETTING, help=text, show_default=default, autocompletion=autocompletion
    )


RewardOption = Annotated[
    str, typer.Option(metavar="METHOD", autocompletion=names_of("reward"), help="A method's name, or a YAML file.")
]
ScenarioOption = Annotated[
    str,
    typer.Option(
        metavar="RULES",
        autocompletion=names_of("scenario"),
        rich_help_panel=SETTING,
        help="The world's rules: default (those of paper, the study's), centre, or a YAML file.",
    ),
]
SpeedRatio = Annotated[
    float | None, setting_option("LAMBDA", "Target speed / pursuer speed.", "the scenario's; 1.1 in default")
]
Pursuers = Annotated[int | None, setting_option("N", "Number of pursuers.", "the scenario's; 3 in default")]
Obstacles = Annotated[int | None, setting_option("M", "Number of obstacles.", "the scenario's; 1 in default")]
Scene = Annotated[
    str | None,
    setting_option(
        "SCENE", "What an obstacle looks like: random, concave or tunnel.", "the scenario's; random in default", scenes
    ),
]
Algorithm = Annotated[
    str,
    typer.Option(
        metavar="NAME", autocompletion=names_of("algorithm"), help="maddpg, matd3, or the path of a YAML file."
    ),
]
ProfileOption = Annotated[Profile, typer.Option(help="full, or smoke for a few seconds.")]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override section.key=value. May be repeated. Sections: reward, scenario, algorithm, training, "
        "evaluation; keys: marl-encircle config show.",
    ),
]
GridOption = Annotated[
    str,
    typer.Option(
        metavar="GRID",
        autocompletion=names_of("grid"),
        help="Whose runs: study, smoke, or the path of a YAML file.",
    ),
]
Out = Annotated[
    Path, typer.Option(metavar="DIR", rich_help_panel=OUTPUT, help="Folder of runs; its parent is --results elsewhere.")
]
Results = Annotated[
    Path,
    typer.Option("--results", "--out", metavar="DIR", rich_help_panel=OUTPUT, help="Folder of runs/ and tables/."),
]
AsJson = Annotated[bool, typer.Option("--json", rich_help_panel=OUTPUT, help="Print one JSON object.")]
Quiet = Annotated[bool, typer.Option("--quiet", rich_help_panel=OUTPUT, help="Print the result alone.")]
Jobs = Annotated[int, typer.Option(min=1, metavar="N", help="Runs at a time, one processor core each.")]
ExecutorOption = Annotated[
    ExecutorName,
    typer.Option(
        "--executor",
        rich_help_panel=CLUSTER,
        help="local: this machine; ray: a Ray cluster, all of whose nodes see the folder of runs.",
    ),
]
Address = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        rich_help_panel=CLUSTER,
        help="Ray cluster.",
        show_default="one on this machine alone, on loopback",
    ),
]


def read_config(
    reward: str,
    *,
    algorithm: str,
    scenario: str,
    profile: Profile,
    overrides: list[str] | None,
    **setting: float | str | None,
) -> "Config":
    """Return the configuration that the options describe.

    :param setting: its parts; None where an option was not given
    :raises ConfigError: if it is wrong
    """
    from marl_encircle.experiments.config import load_config

    return load_config(
        reward,
        algorithm=algorithm,
        profile=profile,
        scenario=scenario,
        fields=given(**setting),
        overrides=overrides or (),
    )


def given(**options: Any) -> dict[str, Any]:
    """Return the options that were given, those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def make_executor(name: ExecutorName, address: str | None) -> "Executor":
    """Return what runs a sweep's jobs.

    :raises ConfigError: for an address without Ray
    """
    from marl_encircle.experiments.executors import LocalExecutor
    from marl_encircle.experiments.ray_executor import RayExecutor
    from marl_encircle.experiments.yaml_files import ConfigError

    if name == "ray":
        return RayExecutor(address)
    if address is not None:
        raise ConfigError(f"--address {address} needs --executor ray; the executor local has no address")
    return LocalExecutor()
