"""Show, compare and check configurations."""

import json
import re
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from marl_encircle.cli.completion import names_of
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
from marl_encircle.experiments.library import Kind, files_of
from marl_encircle.experiments.yaml_files import ConfigError

if TYPE_CHECKING:
    from marl_encircle.experiments.config import Config

ANY = names_of("reward", "scenario", "algorithm", "training", "evaluation", "grid", "protocol", "tuning")
KindOption = Annotated[
    Kind | None, typer.Option(metavar="KIND", help="What it is, where that is not clear.", show_default="found out")
]


def show(
    reward: RewardOption = "ours",
    algorithm: Algorithm = "maddpg",
    scenario: ScenarioOption = "default",
    speed_ratio: SpeedRatio = None,
    pursuers: Pursuers = None,
    obstacles: Obstacles = None,
    scene: Scene = None,
    profile: ProfileOption = "full",
    overrides: Set = None,
    as_json: AsJson = False,
) -> None:
    """Print a resolved configuration; the reward as a table of terms and weights."""
    config = read_config(
        reward,
        algorithm=algorithm,
        scenario=scenario,
        profile=profile,
        overrides=overrides,
        speed_ratio=speed_ratio,
        pursuers=pursuers,
        obstacles=obstacles,
        scene=scene,
    )
    if as_json:
        typer.echo(json.dumps(config.to_dict(), indent=2))
        return
    values = config.with_defaults()
    console = Console()
    console.print(_reward_table(config))
    for section in ("scenario", "algorithm", "training", "evaluation"):
        table = _table(section, "key", "value")
        for key, value in values[section].items():
            table.add_row(key, _as_yaml(value))
        console.print(table)
    console.print(f"methods: {', '.join(files_of('reward'))}", highlight=False)


def diff(
    first: Annotated[str, typer.Argument(autocompletion=ANY, help="A name, or the path of a YAML file.")],
    second: Annotated[str, typer.Argument(autocompletion=ANY, help="Another of the same kind.")],
    as_json: AsJson = False,
) -> None:
    """Print in what two methods differ, or two scenarios, algorithms, trainings, evaluations, grids or protocols."""
    from marl_encircle.cli.kinds import check, find_kinds
    from marl_encircle.experiments.config import differing

    of_first, of_second = find_kinds(first), find_kinds(second)
    kinds = [kind for kind in of_first if kind in of_second]
    if not kinds:
        raise ConfigError(
            f"{first} ({of_first[0]}) and {second} ({of_second[0]}) cannot be compared: two of one kind can"
        )
    pairs: dict[str, tuple[Any, Any]] = {}
    for kind in kinds:
        pairs |= differing(check(kind, first), check(kind, second))
    if as_json:
        typer.echo(json.dumps(pairs))
    elif pairs:
        table = _table("", "key", first, second)
        for key, (here, there) in pairs.items():
            table.add_row(key, _as_yaml(here), _as_yaml(there))
        Console().print(table)
    else:
        typer.echo("no difference")


def validate(
    path: Annotated[str, typer.Argument(autocompletion=ANY, help="A name, or the path of a YAML file.")],
    kind: KindOption = None,
) -> None:
    """Check a YAML file of any kind: print 'valid' and its kind, or what is wrong with it (exit code 2).

    It may be a method (reward), a scenario, an algorithm, a training, an evaluation, a grid, a protocol or a search
    (tuning).
    """
    from marl_encircle.cli.kinds import check, find_kinds

    for each in [kind] if kind else find_kinds(path):
        check(each, path)
        typer.echo(f"valid {each}")


def _reward_table(config: "Config") -> Table:
    from marl_encircle.core.rewards import CONTRACTION_STAGE, TERMS

    r = config.reward
    by = "pursuers and obstacles" if r.closure == "all" else "the pursuers alone"
    table = _table(f"reward {r.name}: closed by {by}", "term", "weight", "parameters", "what it rewards")
    table.columns[1].justify = "right"
    for name, (weight, parameters) in r.build().active.items():
        summary = re.split(r"\. (?=[A-Z])|\.?\n", TERMS[name].__doc__ or "")[0]
        waits = " [dim](second stage)[/dim]" if r.two_stage and name in CONTRACTION_STAGE else ""
        settings = ", ".join(f"{key}={value:g}" for key, value in parameters.items())
        table.add_row(name, f"{weight:g}", settings, summary.removesuffix(".").removesuffix(", (B, N)") + waits)
    stages = f"from {config.scenario.stage_threshold:g} of the circle on" if r.two_stage else "none"
    table.caption = f"all of it times {r.scale:g}; second stage: {stages}"
    return table


def _table(title: str, *columns: str) -> Table:
    return Table(*columns, title=title, box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left")


def _as_yaml(value: Any) -> str:
    """Return a value as it would stand in a YAML file, on one line."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_as_yaml(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_as_yaml, value))}]"
    return value if isinstance(value, str) else json.dumps(value)
