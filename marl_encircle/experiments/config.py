"""Names, files and overrides -> one checked, complete configuration. Nothing is written before it is.

A configuration has five sections, each read from the file that :mod:`marl_encircle.experiments.library` finds;
``--set section.key=value`` changes last.
"""

import dataclasses
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, cast, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from marl_encircle.core.geometry import Closure
from marl_encircle.core.observations import layout
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import MAX_COVER, Scenario
from marl_encircle.experiments import library
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.yaml_files import ConfigError, holds, merge, parse_yaml
from marl_encircle.maddpg import ALGORITHMS
from marl_encircle.spelling import nearest

Profile = Literal["full", "smoke"]
Count = Annotated[int, Field(ge=1, le=10**10)]
Share = Annotated[float, Field(ge=0, le=1)]
Episodes = Annotated[int, Field(ge=1, le=10**6)]

MAX_POLICY_BYTES = 1 << 26
"""Largest ``policy.safetensors`` that is read back."""

METHOD_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
"""It names a folder and a row of the tables."""


def _even(value: int) -> int:
    if value % 2:
        raise ValueError("must be even")
    return value


def _known_algorithm(name: str) -> str:
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm{nearest(name, ALGORITHMS)}")
    return name


def _off_as_empty(value: Any) -> Any:
    return {} if value is None else value


def _as_floats(value: Any) -> Any:
    """1 and 1.0 are one weight, and one hash."""
    if isinstance(value, dict):
        return {key: _as_floats(inner) for key, inner in value.items()}
    if isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError as error:
            raise ValueError("number too large for a float") from error
    return value


class Section(BaseModel):
    """What all sections have in common: unknown keys and silent conversions are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class RewardConfig(Section):
    """A method: see :class:`marl_encircle.core.rewards.Reward`; ``name`` is the row of the tables."""

    name: Annotated[str, Field(pattern=METHOD_NAME)]
    closure: Closure = "all"
    two_stage: bool = True
    scale: float = 0.05
    terms: Annotated[dict[str, Any], AfterValidator(_as_floats)]

    def build(self) -> Reward:
        """Return the reward."""
        return Reward(self.terms, self.closure, self.two_stage, self.scale)


class Schedule(Section):
    """A straight line from ``start`` to ``end`` over ``world_steps``, then ``end``."""

    start: Annotated[float, Field(ge=0, le=10)]
    end: Annotated[float, Field(ge=0, le=10)]
    world_steps: Count


class AlgorithmConfig(Section):
    """One of ``ALGORITHMS``. ``*_world_steps`` count steps of all pursuers of one world, ``train_freq`` vec steps."""

    name: Annotated[str, AfterValidator(_known_algorithm)]
    critic: Literal["per_agent", "shared"]
    net_arch: Annotated[list[Annotated[int, Field(ge=1, le=4096)]], Field(max_length=8)]
    learning_rate: Annotated[float, Field(gt=0, le=1)]
    batch_size: Annotated[int, Field(ge=1, le=1 << 20)]
    gamma: Share
    tau: Annotated[float, Field(gt=0, le=1)]
    policy_delay: Count
    actor_regularization: Annotated[float, Field(ge=0)]
    max_grad_norm: Annotated[float, Field(gt=0)] | None
    buffer_world_steps: Count
    random_world_steps: Annotated[int, Field(ge=0)]
    train_freq: Count
    gradient_steps: Count
    exploration_noise: Schedule
    exploration_random: Share


class Ramp(Section):
    """A scenario field that moves in a straight line from ``start`` to its final value over ``world_steps``."""

    start: float
    world_steps: Count


Curriculum = Annotated[
    dict[Literal["safety_distance", "obstacle_radius", "speed_ratio"], Ramp | None], BeforeValidator(_off_as_empty)
]
"""null switches all of it off."""


class TrainingConfig(Section):
    """How long, in how many worlds, by which curriculum."""

    n_worlds: Annotated[int, Field(ge=1, le=1 << 16)]
    world_steps: Count
    curve_every: Count
    curriculum: Curriculum


class EvaluationConfig(Section):
    """Which rounds are played at the end of a training and for its learning curve."""

    episodes: Episodes
    seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    curve_episodes: Episodes
    curve_seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    n_directions: Annotated[int, Field(ge=8, le=4096), AfterValidator(_even)]

    @field_validator("curve_seed")
    @classmethod
    def _other_rounds(cls, curve_seed: int, info: ValidationInfo) -> int:
        if curve_seed == info.data.get("seed"):
            raise ValueError("must differ from evaluation.seed, whose rounds are reported")
        return curve_seed


class Config(Section):
    """Everything that decides a run, save its seed and engine."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    reward: RewardConfig
    scenario: Scenario
    algorithm: AlgorithmConfig
    training: TrainingConfig
    evaluation: EvaluationConfig

    def to_dict(self) -> dict[str, Any]:
        """Return the resolved configuration as plain data."""
        sections = self.model_dump(exclude={"scenario"})
        return {"reward": sections.pop("reward"), "scenario": _fields_of(self.scenario), **sections}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Return the configuration that :meth:`to_dict` wrote.

        :raises ConfigError: naming what is wrong
        """
        scenario = values.get("scenario", {}) if isinstance(values, Mapping) else None
        if not isinstance(scenario, Mapping):
            raise ConfigError(f"a configuration and its scenario must be mappings; got {values!r:.80}")
        return _checked(_build_scenario(scenario), {key: value for key, value in values.items() if key != "scenario"})

    @property
    def cell(self) -> Cell:
        """Method and setting: which cell of the tables a run belongs to."""
        s = self.scenario
        return Cell(self.reward.name, Setting(s.speed_ratio, s.pursuers, s.obstacles, s.scene))


def load_config(
    reward: str | Path = "ours",
    *,
    algorithm: str | Path = "maddpg",
    profile: Profile = "full",
    scenario: str | Path | Scenario = "default",
    fields: Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
) -> Config:
    """Return the checked configuration of a run.

    The training section is ``<profile>.yaml`` where the pursuers alone can close the circle (Eq. 6), else
    ``<profile>_obstacles.yaml``: the curriculum and the budget follow from the setting, for every method alike. A
    first obstacle radius of that file at which the bodies would cover more than half of the scene, the most that can be
    placed, becomes the one at which they cover a quarter, or the final one where that is larger.

    :param reward: a name in ``ablations/`` or ``baselines/``, or the path of a YAML file
    :param algorithm: a name in ``configs/algorithm/``, or a path
    :param profile: ``full``, or ``smoke`` for a few seconds
    :param scenario: a name in ``configs/scenario/``, a path, or a ``Scenario``
    :param fields: fields of ``Scenario`` that differ from it
    :param overrides: ``section.key=value`` each, the value in YAML
    :raises ConfigError: naming file or key, the value, and what is allowed
    """
    reward, algorithm = _name_of(reward, "reward"), _name_of(algorithm, "algorithm")
    if profile not in get_args(Profile):
        raise ConfigError(f"profile {profile!r:.80}: unknown profile{nearest(str(profile), get_args(Profile))}")
    changes = _parse_overrides(overrides)
    changes["scenario"] = merge(fields or {}, changes.get("scenario", {}))
    names = {"reward": reward, "algorithm": algorithm, "evaluation": profile}
    if isinstance(scenario, Scenario):
        own_fields = _fields_of(scenario)
    else:
        names["scenario"] = _name_of(scenario, "scenario")
        own_fields = library.load_section("scenario", names["scenario"])
    with _naming_files(names, {}):
        _check_fields(own_fields)  # also those that a change would hide
    with _naming_files(names, changes):
        world = _build_scenario(merge(own_fields, changes["scenario"]))
    names["training"] = profile if world.solvable_without_obstacles else f"{profile}_obstacles"
    sections = {
        "reward": library.load_reward(reward),
        "algorithm": library.load_section("algorithm", algorithm),
        "training": _fitted(library.load_section("training", names["training"]), world),
        "evaluation": library.load_section("evaluation", profile),
    }
    merged = {name: merge(section, changes.get(name, {})) for name, section in sections.items()}
    named = merged["reward"].get("name")
    if named == Path(reward).stem and not re.match(METHOD_NAME, named):
        raise ConfigError(f"{reward}: {named!r:.80} is not a method name; add 'name:' with letters, digits, _ . or -")
    with _naming_files(names, changes):
        return _checked(world, merged)


def check_seed(config: Config, seed: int) -> None:
    """Refuse a training seed whose worlds are those of the evaluation.

    :raises ConfigError: also if it is no integer from 0 to 2**32 - 1
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 1 << 32:
        raise ConfigError(f"seed must be an integer from 0 to {(1 << 32) - 1}; got {seed!r:.80}")
    for name in ("seed", "curve_seed"):
        if seed == getattr(config.evaluation, name):
            raise ConfigError(
                f"seed must differ from evaluation.{name}: the training would see the evaluation's rounds; got {seed}"
            )


def check_training(config: Config) -> None:
    """Refuse a training that would learn nothing or not fit into this machine's memory; an environment may do both.

    :raises ConfigError: naming the keys
    """
    check_curriculum(config)
    random, total = config.algorithm.random_world_steps, config.training.world_steps
    if random >= total:
        raise ConfigError(
            f"algorithm.random_world_steps: must be less than training.world_steps, {total}, or nothing is "
            f"learnt; got {random}"
        )
    _check_memory(config)


def check_curriculum(config: Config) -> None:
    """Refuse a curriculum that starts where the scene is not allowed; only who trains by it needs one.

    :raises ConfigError: naming the key and how to change it
    """
    for name, ramp in config.training.curriculum.items():
        if ramp is not None:
            key = f"training.curriculum.{name}"
            try:
                _build_scenario({**_fields_of(config.scenario), name: ramp.start})
            except ConfigError as error:
                remedy = f"--set {key}.start=... to another value, or --set {key}=null for none"
                raise ConfigError(f"{key}.start: {error}; {remedy}") from error


def difference(
    here: Mapping[str, Any], there: Mapping[str, Any], where: tuple[str, str] = ("here", "there")
) -> list[str]:
    """Return one line for each key whose value differs between two resolved configurations.

    :param where: what to call the two
    """
    mine, other = dict(_flat(here)), dict(_flat(there))
    return [
        f"{key}: {mine.get(key, 'missing')} {where[0]}, {other.get(key, 'missing')} {where[1]}"
        for key in dict.fromkeys([*mine, *other])
        if mine.get(key, "missing") != other.get(key, "missing")
    ]


def _parse_overrides(overrides: Sequence[str]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if isinstance(overrides, str) or not isinstance(overrides, Sequence):
        raise ConfigError(f"overrides must be a list of section.key=value; got {overrides!r:.80}")
    for override in overrides:
        if not isinstance(override, str):
            raise ConfigError(f"overrides must be a list of section.key=value; one is {override!r:.80}")
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            raise ConfigError(f"--set {override:.80}: must be section.key=value")
        if keys[0] not in Config.model_fields:
            raise ConfigError(f"--set {override:.80}: unknown section{nearest(keys[0], Config.model_fields)}")
        try:
            value = parse_yaml(text)
        except ConfigError as error:
            raise ConfigError(f"--set {override:.80}: {error}") from error
        if value == {}:
            raise ConfigError(f"--set {override:.80}: mappings are merged, so an empty one changes nothing; use null")
        for key in reversed(keys):
            value = {key: value}
        changes = merge(changes, value)
    return changes


def _checked(scenario: Scenario, sections: Mapping[str, Any]) -> Config:
    """Return the configuration of a scenario and the plain values of the other sections."""
    try:
        config = Config(scenario=scenario, **sections)
        reward = config.reward.build()
    except ValidationError as error:
        raise ConfigError("\n".join(explain(error, Config))) from error
    except ValueError as error:
        raise ConfigError(f"reward.{error}") from error
    if not reward.active:
        raise ConfigError("reward.terms: all are off; at least one needs a weight")
    _check_networks(config)
    return config


def _build_scenario(values: Mapping[str, Any]) -> Scenario:
    known = [f.name for f in dataclasses.fields(Scenario)]
    for key in values:
        if key not in known:
            raise ConfigError(f"scenario.{key:.80}: unknown key{nearest(key, known)}")
    extras = values.get("observe_extras", ())
    try:
        return Scenario(**{**values, "observe_extras": tuple(extras) if isinstance(extras, list) else extras})
    except ValueError as error:
        about_a_field = str(error).split()[0] in known
        raise ConfigError(f"scenario{'.' if about_a_field else ': '}{error}") from error


def _check_fields(values: Mapping[str, Any]) -> None:
    """Refuse a field that is wrong whatever the others are."""
    try:
        _build_scenario(values)
    except ConfigError as error:
        if str(error).startswith("scenario."):
            raise


def _fields_of(scenario: Scenario) -> dict[str, Any]:
    return {**dataclasses.asdict(scenario), "observe_extras": list(scenario.observe_extras)}


def _fitted(training: Mapping[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Return the values of a training section of the package, its obstacles small enough at first for this scene."""
    ramp = training["curriculum"].get("obstacle_radius")
    if ramp is None or not scenario.obstacles or ramp["start"] <= scenario.obstacle_radius_at(MAX_COVER):
        return dict(training)
    start = max(round(scenario.obstacle_radius_at(MAX_COVER / 2), 3), scenario.obstacle_radius)
    return merge(training, {"curriculum": {"obstacle_radius": {"start": start}}})


def _name_of(given: object, kind: str) -> str:
    """Return the name or path of a file."""
    if not isinstance(given, (str, Path)):
        raise ConfigError(f"{kind} must be a name or the path of a YAML file; got {given!r:.80}")
    return str(given)


@contextmanager
def _naming_files(names: Mapping[str, str], changes: Mapping[str, Any]) -> Iterator[None]:
    """Put the file in front of every line of a ConfigError that is about a key which stands in one.

    :param names: of the sections' files
    :param changes: values by section that stand in none
    """
    try:
        yield
    except ConfigError as error:
        raise ConfigError("\n".join(_with_file(line, names, changes) for line in str(error).splitlines())) from error


def _with_file(line: str, names: Mapping[str, str], changes: Mapping[str, Any]) -> str:
    section, *keys = line.split(":")[0].split(" ")[0].split(".")
    if section not in names:
        return line
    for length in range(len(keys), -1, -1):  # a key that is missing stands where its mapping does
        changed = changes.get(section, {})
        if changed and holds(changed, keys[:length]):
            return line
        path = library.file_of(cast(library.Kind, section), names[section], keys[:length])
        if path is not None:
            return f"{path}: {line}"
    return line


def explain(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Return one line for each thing that is wrong, with its key path, value and what is allowed.

    :param model: what was to be built
    """
    lines = []
    for item in error.errors():
        path = ".".join(f"{part!s:.80}" for part in item["loc"] if part != "[key]")
        if item["type"] == "extra_forbidden":
            siblings = _known_keys(model, item["loc"][:-1])
            lines.append(f"{path:.200}: unknown key{nearest(str(item['loc'][-1]), siblings)}")
        elif item["type"] == "missing":
            lines.append(f"{path}: missing")
        else:
            reason = item["msg"].removeprefix("Value error, ")
            lines.append(f"{path:.200}: {reason[:1].lower()}{reason[1:]}; got {item['input']!r:.80}")
    return lines


def _known_keys(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the section at a path."""
    annotation: Any = model
    for part in path:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel) and isinstance(part, str):
            annotation = annotation.model_fields[part].annotation
        else:  # an entry of a list or dictionary of sections, or None
            inner = [each for each in get_args(annotation) if each not in (str, NoneType)]
            annotation = inner[-1]
    sections = [each for each in (annotation, *get_args(annotation)) if isinstance(each, type)]
    return [name for each in sections if issubclass(each, BaseModel) for name in each.model_fields]


def _check_networks(config: Config) -> None:
    """Refuse networks so large that the policy could not be read back, or that nobody wants to allocate."""
    a, n = config.algorithm, config.scenario.pursuers
    joint = n * (_observation_size(config) + 2)
    actor = n * _weights([_observation_size(config), *a.net_arch, 2])
    critics = n * _weights([joint, *a.net_arch, 1]) if a.critic == "per_agent" else _weights([joint, *a.net_arch, n])
    for role, weights, limit in (("actors", actor, MAX_POLICY_BYTES // 2), ("critics", critics, 1 << 29)):
        if 4 * weights > limit:
            raise ConfigError(
                f"algorithm.net_arch: the {role} would have {4 * weights / 1e6:.0f} MB of weights; "
                f"at most {limit / 1e6:.0f} MB"
            )


def _weights(sizes: list[int]) -> int:
    return sum((a + 1) * b for a, b in pairwise(sizes))


def _observation_size(config: Config) -> int:
    return int(list(layout(config.scenario).values())[-1].stop)


def _check_memory(config: Config) -> None:
    """Refuse what cannot fit into this machine's memory: the replay buffer and the worlds."""
    n, size = config.scenario.pursuers, _observation_size(config)
    steps = min(config.algorithm.buffer_world_steps, config.training.world_steps + config.training.n_worlds)
    needed = 4 * steps * n * (2 * size + 5) + 40 * config.training.n_worlds * config.scenario.n_directions
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > installed:
        raise ConfigError(
            f"algorithm.buffer_world_steps, training.n_worlds: {needed / 1e9:.1f} GB of memory needed, "
            f"but this machine has {installed / 1e9:.1f} GB"
        )


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
