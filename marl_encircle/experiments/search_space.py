"""A search file -> what a hyper-parameter search tries, with which trainings; all of it checked before any is started.

A dimension has the dotted name of the configuration key that it moves, ``algorithm.learning_rate`` or
``reward.terms.contraction``.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from marl_encircle.experiments.choices import Profile
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.faults import section_of
from marl_encircle.experiments.grid import Job, forget_configs, naming_file
from marl_encircle.experiments.learning_curve import count_points
from marl_encircle.experiments.library import find_file, is_path
from marl_encircle.experiments.memory import memory_needed
from marl_encircle.experiments.sections import Section, SettingConfig
from marl_encircle.experiments.trainable import check_seed, check_training
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml

TUNING_SEEDS = range(900, 1000)
"""Training seeds that no table reports."""

NO_REPORTED_ROUNDS = ("evaluation.seed=3000", "evaluation.episodes=1")
"""A trial is judged by its selection rounds; the round that ends its training is not one that is reported either."""

NOT_SEARCHED = {
    "reward.name": "it names the method",
    "reward.closure": "it says what success is, by which trials are judged",
}


class Range(Section):
    """Numbers from ``low`` to ``high``, both included; whole ones if both are."""

    low: int | float
    high: int | float
    log: bool = False
    step: int | float | None = None

    @model_validator(mode="after")
    def _can_be_searched(self) -> "Range":
        if self.low >= self.high:
            raise ValueError(f"low must be less than high, {self.high}")
        if self.log and self.low <= 0:
            raise ValueError("log needs a low above 0")
        if self.step is not None and (self.log or self.step <= 0):
            raise ValueError("step must be above 0, and goes without log")
        if self.step is not None and self.is_whole and not isinstance(self.step, int):
            raise ValueError("step must be a whole number, as low and high are")
        return self

    @property
    def is_whole(self) -> bool:
        """Whether only whole numbers are tried."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values by which all of them are checked."""
        return self.low, self.high


class Choices(Section):
    """Some values of whatever kind."""

    choices: Annotated[list[Any], Field(min_length=2)]

    @field_validator("choices")
    @classmethod
    def _distinct(cls, choices: list[Any]) -> list[Any]:
        texts = [json.dumps(choice) for choice in choices]
        for i, text in enumerate(texts):
            if text in texts[:i]:
                raise ValueError(f"{text} stands there twice")
        return choices

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values by which all of them are checked."""
        return tuple(self.choices)


Dimension = Range | Choices


class Pruning(Section):
    """When a trial is given up.

    :param rule: ``median``: it is worse than half of the others were at that point; ``halving``: it is not among the
        best of its rung, of which each has ``reduction`` times as many points as the one before
    :param startup_trials: ended before any is given up by the median
    :param warmup_points: it is not given up before this point of the learning curve, the first rung of ``halving``
    """

    rule: Literal["median", "halving"]
    startup_trials: Annotated[int, Field(ge=0)] = 5
    warmup_points: Annotated[int, Field(ge=1)] = 1
    reduction: Annotated[int, Field(ge=2)] = 3


class Search(Section):
    """The dimensions, where they stand in their section of the configuration."""

    algorithm: Annotated[dict[str, Any], Field(default_factory=dict)]
    reward: Annotated[dict[str, Any], Field(default_factory=dict)]


class SearchFile(Section):
    """A search file; see ``configs/tuning/default.yaml``."""

    profile: Profile
    scenario: str = "default"
    reward: str = "ours"
    algorithm: str = "maddpg"
    setting: SettingConfig
    overrides: Annotated[list[str], Field(default_factory=list)]
    seeds: Annotated[list[int], Field(min_length=1)]
    last_points: Annotated[int, Field(ge=1)]
    random_trials: Annotated[int, Field(ge=1)] = 10
    pruning: Pruning | None = None
    search: Search

    @field_validator("seeds")
    @classmethod
    def _tuning_seeds(cls, seeds: list[int]) -> list[int]:
        for i, seed in enumerate(seeds):
            if seed not in TUNING_SEEDS:
                raise ValueError(
                    f"seed {seed!r:.80} is no tuning seed: those are {TUNING_SEEDS[0]} to {TUNING_SEEDS[-1]}"
                )
            if seed in seeds[:i]:
                raise ValueError(f"seed {seed} stands there twice")
        return seeds


class Space(NamedTuple):
    """What is searched.

    :param file: the search file's values; names of files in it as paths
    :param dimensions: by the key that each moves
    """

    file: SearchFile
    dimensions: dict[str, Dimension]

    def jobs(self, values: Mapping[str, Any]) -> list[Job]:
        """Return the trainings of a trial, one for each seed.

        :param values: by the key of the dimension
        """
        f = self.file
        changes = [f"{key}={json.dumps(value)}" for key, value in values.items()]
        overrides = (*f.overrides, *NO_REPORTED_ROUNDS, *changes)
        setting = f.setting.build()
        return [Job(f.reward, setting, seed, f.profile, f.scenario, f.algorithm, overrides) for seed in f.seeds]

    @property
    def largest(self) -> Config:
        """The training that asks for most memory: each dimension at the end that does, whatever the others are."""
        values: dict[str, Any] = {}
        for key, dimension in self.dimensions.items():
            configs = {end: self.jobs({**values, key: value})[0].config for end, value in enumerate(dimension.ends)}
            values[key] = dimension.ends[max(configs, key=lambda end: sum(memory_needed(configs[end]).values()))]
        return self.jobs(values)[0].config

    @property
    def base(self) -> dict[str, Any]:
        """The values of the dimensions in the files that are searched from, as far as they are among those tried."""
        config = self.jobs({})[0].config.with_defaults()
        values = {key: _value_at(config, key) for key in self.dimensions}
        return {key: value for key, value in values.items() if _is_tried(self.dimensions[key], value)}

    def to_dict(self) -> dict[str, Any]:
        """Return all that decides the worth of a trial and which ones are tried, as plain data."""
        values = self.file.model_dump(include={"seeds", "last_points", "random_trials", "pruning", "search"})
        return {**values, "config": self.jobs({})[0].config.to_dict()}


def load_space(name: str | Path) -> Space:
    """Return what a search file asks for.

    :param name: a name in ``configs/tuning/`` or the path of a YAML file; paths in it are relative to it
    :raises ConfigError: naming file and key; every value that may be tried is checked too
    """
    forget_configs()
    path = find_file(name, "tuning")
    values = read_yaml(path)
    for key in ("scenario", "reward", "algorithm"):
        if isinstance(values.get(key), str) and is_path(values[key]):
            values[key] = str(path.parent / values[key])
    with naming_file(path):
        file = section_of(SearchFile, values)
        space = Space(file, dict(_dimensions(file.search.model_dump(), "")))
        _check(space)
    return space


def _dimensions(values: Mapping[str, Any], path: str) -> Iterator[tuple[str, Dimension]]:
    for key, value in values.items():
        if not isinstance(value, dict):
            raise ConfigError(f"search.{path}{key}: must be {{low, high}} or {{choices}}; got {value!r:.80}")
        within = f"search.{path}{key}"
        if "choices" in value:
            yield f"{path}{key}", section_of(Choices, value, within)
        elif {"low", "high"} & value.keys():
            yield f"{path}{key}", section_of(Range, value, within)
        else:
            yield from _dimensions(value, f"{path}{key}.")


def _check(space: Space) -> None:
    """Refuse what could not be trained or searched."""
    if not space.dimensions:
        raise ConfigError("search: nothing to search; give ranges or choices of keys of algorithm or reward")
    for job in space.jobs({}):
        check_seed(job.config, job.seed)
    _check_points(space, {})
    for key, dimension in space.dimensions.items():
        if key in NOT_SEARCHED:
            raise ConfigError(f"search.{key}: cannot be searched: {NOT_SEARCHED[key]}")
        for value in dimension.ends:
            try:
                check_training(space.jobs({key: value})[0].config)
                _check_points(space, {key: value})
            except ConfigError as error:
                raise ConfigError(f"search.{key}: {error}") from error


def _check_points(space: Space, values: Mapping[str, Any]) -> None:
    """Refuse to judge a trial by more points than its learning curves have."""
    points = count_points(space.jobs(values)[0].config)
    if space.file.last_points > points:
        raise ConfigError(f"last_points: a learning curve has {points} points; got {space.file.last_points}")


def _value_at(config: Mapping[str, Any], key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _is_tried(dimension: Dimension, value: Any) -> bool:
    if isinstance(dimension, Choices):
        return json.dumps(value) in map(json.dumps, dimension.choices)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not dimension.low <= value <= dimension.high:
        return False
    steps = (value - dimension.low) / (dimension.step or 1)
    return (dimension.step is None and not dimension.is_whole) or abs(steps - round(steps)) < 1e-8  # as Optuna does
