"""Names, files and overrides -> one checked, complete configuration. Nothing is written before it is.

A configuration has five sections, each read from the file that :mod:`marl_encircle.experiments.library` finds;
``--set section.key=value`` changes last.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
)

from marl_encircle.core.geometry import Closure
from marl_encircle.core.observations import layout
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import MAX_COVER, Scenario
from marl_encircle.experiments import library
from marl_encircle.experiments.faults import explain, naming_files
from marl_encircle.experiments.overrides import parse_overrides
from marl_encircle.experiments.records import MAX_ROUNDS, Cell, Setting
from marl_encircle.experiments.yaml_files import ConfigError, merge
from marl_encircle.spelling import nearest

Profile = Literal["full", "smoke"]
Features = Literal["observation", "relative"]
Count = Annotated[int, Field(ge=1, le=10**10)]
Share = Annotated[float, Field(ge=0, le=1)]
Episodes = Annotated[int, Field(ge=1, le=MAX_ROUNDS)]

MAX_POLICY_BYTES = 1 << 26
"""Largest ``policy.safetensors`` that is read back."""

MAX_CRITIC_BYTES = 1 << 29
MAX_LAYERS = 8

METHOD_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
"""It names a folder and a row of the tables."""


def _even(value: int) -> int:
    if value % 2:
        raise ValueError("must be even")
    return value


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
    """One of ``ALGORITHMS``. ``*_world_steps`` count steps of all pursuers of one world, ``train_freq`` vec steps.

    A key with a default came after the first runs; one that has it is left out, so that their hashes stay.
    """

    name: str
    critic: Literal["per_agent", "shared"]
    net_arch: Annotated[list[Annotated[int, Field(ge=1, le=4096)]], Field(max_length=MAX_LAYERS)]
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
    learning_rate_end: Annotated[float, Field(gt=0, le=1)] | None = None
    n_steps: Annotated[int, Field(ge=1, le=1000)] = 1
    features: Features = "observation"

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        defaults = self.defaults()
        return {key: value for key, value in handler(self).items() if key not in defaults or value != defaults[key]}

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the values of the keys that have one by default."""
        return {name: field.default for name, field in cls.model_fields.items() if not field.is_required()}


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
        return {"reward": sections.pop("reward"), "scenario": fields_of(self.scenario), **sections}

    def with_defaults(self) -> dict[str, Any]:
        """Return what :meth:`to_dict` does, with the keys that it leaves out."""
        values = self.to_dict()
        return {**values, "algorithm": {**values["algorithm"], **(self.algorithm.defaults() | values["algorithm"])}}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Return the configuration that :meth:`to_dict` wrote.

        :raises ConfigError: naming what is wrong
        """
        scenario = values.get("scenario", {}) if isinstance(values, Mapping) else None
        if not isinstance(scenario, Mapping):
            raise ConfigError(f"a configuration and its scenario must be mappings; got {values!r:.80}")
        return _checked(build_scenario(scenario), {key: value for key, value in values.items() if key != "scenario"})

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
    changes = parse_overrides(overrides, Config.model_fields)
    changes["scenario"] = merge(fields or {}, changes.get("scenario", {}))
    names = {"reward": reward, "algorithm": algorithm, "evaluation": profile}
    if isinstance(scenario, Scenario):
        own_fields = fields_of(scenario)
    else:
        names["scenario"] = _name_of(scenario, "scenario")
        own_fields = library.load_section("scenario", names["scenario"])
    with naming_files(names, {}):
        _check_fields(own_fields)  # also those that a change would hide
    with naming_files(names, changes):
        world = build_scenario(merge(own_fields, changes["scenario"]))
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
    with naming_files(names, changes):
        return _checked(world, merged)


def difference(
    here: Mapping[str, Any], there: Mapping[str, Any], where: tuple[str, str] = ("here", "there")
) -> list[str]:
    """Return one line for each key whose value differs between two resolved configurations.

    :param where: what to call the two
    """
    return [
        f"{key}: {mine} {where[0]}, {other} {where[1]}"
        for key, (mine, other) in differing(here, there, "missing").items()
    ]


def differing(here: Mapping[str, Any], there: Mapping[str, Any], absent: Any = None) -> dict[str, tuple[Any, Any]]:
    """Return both values of each key, ``section.key``, whose value differs.

    :param absent: what stands for the value of a key that only one of them has
    """
    mine, other = dict(_flat(here)), dict(_flat(there))
    pairs = {key: (mine.get(key, absent), other.get(key, absent)) for key in dict.fromkeys([*mine, *other])}
    return {key: (first, second) for key, (first, second) in pairs.items() if first != second}


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
    _check_algorithm(config.algorithm.name)
    return config


def build_scenario(values: Mapping[str, Any]) -> Scenario:
    """Return the scenario of plain values.

    :raises ConfigError: naming the key
    """
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
        build_scenario(values)
    except ConfigError as error:
        if str(error).startswith("scenario."):
            raise


def fields_of(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as plain values."""
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


def _check_algorithm(name: str) -> None:
    """Refuse an unknown algorithm; last, since PyTorch comes with those that are known, and takes seconds to import."""
    from marl_encircle.maddpg import ALGORITHMS

    if name not in ALGORITHMS:
        raise ConfigError(f"algorithm.name: unknown algorithm{nearest(name, ALGORITHMS)}; got {name!r:.80}")


def _check_networks(config: Config) -> None:
    """Refuse networks so large that the policy could not be read back, or that nobody wants to allocate."""
    limits = {"actors": MAX_POLICY_BYTES // 2, "critics": MAX_CRITIC_BYTES}
    for role, weights in count_weights(config).items():
        if 4 * weights > limits[role]:
            raise ConfigError(
                f"algorithm.net_arch: the {role} would have {4 * weights / 1e6:.0f} MB of weights; "
                f"at most {limits[role] / 1e6:.0f} MB"
            )


def count_weights(config: Config) -> dict[str, int]:
    """Return the number of weights of all actors and of all critics, one a pursuer or a shared one."""
    a, n, size = config.algorithm, config.scenario.pursuers, features_size(config.scenario, config.algorithm.features)
    joint = n * (size + 2)
    shared = a.critic == "shared"
    return {
        "actors": n * weights_between([size, *a.net_arch, 2]),
        "critics": weights_between([joint, *a.net_arch, n]) if shared else n * weights_between([joint, *a.net_arch, 1]),
    }


def weights_between(sizes: list[int]) -> int:
    """Return the number of weights and biases of dense layers between so many values each."""
    return sum((a + 1) * b for a, b in pairwise(sizes))


def observation_size(config: Config) -> int:
    """Return the number of values that a pursuer observes."""
    return features_size(config.scenario, "observation")


def features_size(scenario: Scenario, features: Features) -> int:
    """Return the number of values that the networks read of a pursuer's observation."""
    size = list(layout(scenario).values())[-1].stop
    others = scenario.pursuers - 1 + scenario.units
    return int(size + (4 * others if features == "relative" else 0))


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
