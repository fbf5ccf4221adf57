"""Names, files and overrides -> one checked, complete configuration. Nothing is written before it is.

A configuration has five sections, each read from the file that :mod:`marl_encircle.experiments.library` finds;
``--set section.key=value`` changes last.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import ConfigDict

from marl_encircle.core.scenario import MAX_COVER, Scenario
from marl_encircle.experiments import library
from marl_encircle.experiments.choices import Profile
from marl_encircle.experiments.faults import naming_files, section_of
from marl_encircle.experiments.overrides import parse_overrides
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.sections import (
    METHOD_NAME,
    AlgorithmConfig,
    EvaluationConfig,
    RewardConfig,
    Section,
    TrainingConfig,
)
from marl_encircle.experiments.sizes import count_weights
from marl_encircle.experiments.yaml_files import ConfigError, merge
from marl_encircle.spelling import nearest

MAX_POLICY_BYTES = 1 << 26
"""Largest ``policy.safetensors`` that is read back."""

MAX_CRITIC_BYTES = 1 << 29


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
        for name, section in ("algorithm", self.algorithm), ("training", self.training):
            values[name] = {**values[name], **(section.defaults() | values[name])}
        return values

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

    def in_setting(self, setting: Setting) -> "Config":
        """Return the configuration in another setting.

        :raises ConfigError: if the scenario does not allow it
        """
        scenario = build_scenario({**fields_of(self.scenario), **setting._asdict()})
        return self.model_copy(update={"scenario": scenario})

    def to_play_in(self, setting: Setting) -> "Config":
        """Return the configuration in another setting, in which its trained policies can play.

        :raises ConfigError: if the scenario does not allow it, or has other bodies than their networks can read
        """
        config = self.in_setting(setting)
        here, there = self.scenario, config.scenario
        same = (here.pursuers, here.units) == (there.pursuers, there.units)
        if not same and self.algorithm.features != "set":
            raise ConfigError(
                f"policies of {self.reward.name} cannot play with other numbers of bodies than they were trained with, "
                f"{there.pursuers} pursuers and {there.units} obstacles (each disc is one unless composite_unit) in "
                f"place of {here.pursuers} and {here.units}; that needs algorithm.features set"
            )
        return config

    @property
    def settings(self) -> list[Setting]:
        """The settings that are trained in, each with the same share of the worlds; what stands twice has two."""
        return [setting.build() for setting in self.training.settings] or [self.cell.setting]


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
    config = section_of(Config, {"scenario": scenario, **sections})
    try:
        reward = config.reward.build()
    except ValueError as error:
        raise ConfigError(f"reward.{error}") from error
    if not reward.active:
        raise ConfigError("reward.terms: all are off; at least one needs a weight")
    _check_networks(config)
    _check_settings(config)
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


def _check_settings(config: Config) -> None:
    """Refuse settings that one network cannot read, that the scenario has no room for, or no equal share of worlds."""
    where, settings = "training.settings", config.training.settings
    if not settings:
        return
    if config.algorithm.features != "set":
        raise ConfigError(f"{where}: needs algorithm.features set; got {config.algorithm.features}")
    if config.training.n_worlds % len(settings):
        raise ConfigError(
            f"training.n_worlds: must be a multiple of the {len(settings)} settings; got {config.training.n_worlds}"
        )
    for i, setting in enumerate(settings):
        try:
            config.in_setting(config.settings[i])
        except ConfigError as error:
            raise ConfigError(f"{where}.{i}: {error}") from error
        for name in ("speed_ratio", "pursuers", "obstacles"):
            value, most = getattr(setting, name), getattr(config.scenario, name)
            if value > most:
                raise ConfigError(f"{where}.{i}.{name}: must be at most scenario.{name}, {most}; got {value}")
        if setting.scene != config.scenario.scene:
            raise ConfigError(
                f"{where}.{i}.scene: must be scenario.scene, {config.scenario.scene}; got {setting.scene!r:.80}"
            )


def _check_networks(config: Config) -> None:
    """Refuse networks so large that the policy could not be read back, or that nobody wants to allocate."""
    limits = {"actors": MAX_POLICY_BYTES // 2, "critics": MAX_CRITIC_BYTES}
    for role, weights in count_weights(config.scenario, config.algorithm).items():
        if 4 * weights > limits[role]:
            raise ConfigError(
                f"algorithm.net_arch: the {role} would have {4 * weights / 1e6:.0f} MB of weights; "
                f"at most {limits[role] / 1e6:.0f} MB"
            )


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
