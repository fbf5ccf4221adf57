"""Names, files and overrides -> one checked, complete configuration. Nothing is written before it is.

A configuration has five sections. ``reward`` comes from ``ablations/``, ``baselines/`` or a path; the others from the
package's ``configs/<section>/``. A file may name a ``base`` that it changes; ``--set section.key=value`` changes last.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from marl_encircle.core.geometry import Closure
from marl_encircle.core.observations import layout
from marl_encircle.core.rewards import Reward, nearest
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.yaml_files import ConfigError, merge, parse_yaml, read_yaml

PACKAGE = Path(__file__).parent.parent

Profile = Literal["full", "smoke"]
Count = Annotated[int, Field(ge=1, le=10**10)]
Share = Annotated[float, Field(ge=0, le=1)]


def _even(value: int) -> int:
    if value % 2:
        raise ValueError("must be even")
    return value


class Section(BaseModel):
    """What all sections have in common: unknown keys and silent conversions are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class RewardConfig(Section):
    """A method: see :class:`marl_encircle.core.rewards.Reward`; ``name`` is the row of the tables."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
    closure: Closure = "all"
    two_stage: bool = True
    scale: float = 0.05
    terms: dict[str, Any]

    def build(self) -> Reward:
        """Return the reward."""
        return Reward(self.terms, self.closure, self.two_stage, self.scale)


class Schedule(Section):
    """A straight line from ``start`` to ``end`` over ``world_steps``, then ``end``."""

    start: Annotated[float, Field(ge=0, le=10)]
    end: Annotated[float, Field(ge=0, le=10)]
    world_steps: Count


class AlgorithmConfig(Section):
    """MADDPG or MATD3. Counts are world steps, one step of all pursuers of one world."""

    name: Literal["maddpg", "matd3"]
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
    vec_steps_per_training: Count
    updates_per_training: Count
    exploration_noise: Schedule
    exploration_random: Share


class Ramp(Section):
    """A scenario field that moves in a straight line from ``start`` to its final value over ``world_steps``."""

    start: float
    world_steps: Count


Curriculum = dict[Literal["safety_distance", "obstacle_radius", "speed_ratio"], Ramp | None]


class TrainingConfig(Section):
    """How long, in how many worlds, by which curriculum."""

    n_worlds: Annotated[int, Field(ge=1, le=1 << 16)]
    world_steps: Count
    curve_every: Count
    curriculum: Curriculum


class EvaluationConfig(Section):
    """Which rounds are played at the end of a training and for its learning curve."""

    episodes: Count
    seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    curve_episodes: Count
    curve_seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    n_directions: Annotated[int, Field(ge=8, le=4096), AfterValidator(_even)]


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
        scenario = {**asdict(self.scenario), "observe_extras": list(self.scenario.observe_extras)}
        return {"reward": sections.pop("reward"), "scenario": scenario, **sections}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Return the configuration that :meth:`to_dict` wrote.

        :raises ConfigError: naming what is wrong
        """
        sections = {key: value for key, value in values.items() if key != "scenario"}
        return _checked(_build_scenario(values.get("scenario") or {}), sections)

    @property
    def hash(self) -> str:
        """sha256 of the resolved configuration, in hexadecimal."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()

    @property
    def run_folder(self) -> Path:
        """``<method>/ratio<lambda>_n<n>_m<m>_<scene>``."""
        s = self.scenario
        return Path(self.reward.name) / f"ratio{s.speed_ratio:g}_n{s.pursuers}_m{s.obstacles}_{s.scene}"


def load_config(
    reward: str = "ours",
    *,
    algorithm: str = "maddpg",
    profile: Profile = "full",
    scenario: Mapping[str, Any] | None = None,
    overrides: Sequence[str] = (),
) -> Config:
    """Return the checked configuration of a run.

    The training section is ``<profile>.yaml`` where the pursuers alone can close the circle (Eq. 6), else
    ``<profile>_obstacles.yaml``: the curriculum and the budget follow from the setting, for every method alike.

    :param reward: a name in ``ablations/`` or ``baselines/``, or the path of a YAML file
    :param algorithm: a name in ``configs/algorithm/``, or a path
    :param profile: ``full``, or ``smoke`` for a few seconds
    :param scenario: fields of ``Scenario`` that differ from ``configs/scenario/default.yaml``
    :param overrides: ``section.key=value`` each, the value in YAML
    :raises ConfigError: naming file or key, the value, and what is allowed
    """
    changes = _parse_overrides(overrides)
    fields_of_scenario = merge(_section("scenario", "default"), merge(scenario or {}, changes.get("scenario", {})))
    world = _build_scenario(fields_of_scenario)
    budget = profile if world.solvable_without_obstacles else f"{profile}_obstacles"
    sections = {
        "reward": _reward(reward),
        "algorithm": _section("algorithm", algorithm),
        "training": _section("training", budget),
        "evaluation": _section("evaluation", profile),
    }
    merged = {name: merge(section, changes.get(name, {})) for name, section in sections.items()}
    config = _checked(world, merged)
    _check_memory(config)
    return config


def reward_names() -> list[str]:
    """Return the names of the methods that the installation carries."""
    return sorted(path.stem for folder in _reward_folders() for path in folder.glob("*.yaml"))


def difference(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Return one line for each key whose value differs between two resolved configurations."""
    mine, other = dict(_flat(here)), dict(_flat(there))
    return [
        f"{key}: {mine.get(key, 'missing')} here, {other.get(key, 'missing')} there"
        for key in dict.fromkeys([*mine, *other])
        if mine.get(key, "missing") != other.get(key, "missing")
    ]


def _reward_folders() -> list[Path]:
    """``ablations`` and ``baselines``: in the package of a built install, beside it in a checkout."""
    roots = (PACKAGE, PACKAGE.parent)
    return [root / name for name in ("ablations", "baselines") for root in roots if (root / name).is_dir()]


def _is_path(name: str) -> bool:
    return name.endswith((".yaml", ".yml")) or os.sep in name


def _reward(name: str) -> dict[str, Any]:
    section = _load(name, _reward_folders(), "reward")
    return {"name": Path(name).stem, **section}


def _section(section: str, name: str) -> dict[str, Any]:
    return _load(name, [PACKAGE / "configs" / section], section)


def _load(name: str, folders: Iterable[Path], kind: str, seen: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Read the file of that name or path, on top of its base's."""
    path = find_file(name, folders, kind)
    if path.resolve() in seen:
        raise ConfigError(f"{path}: its base leads back to itself")
    values = read_yaml(path)
    base = values.pop("base", None)
    if base is None:
        return values
    if not isinstance(base, str):
        raise ConfigError(f"{path}: base must be a name or a path; got {base!r:.80}")
    base = str(path.parent / base) if _is_path(base) else base
    return merge(_load(base, folders, kind, (*seen, path.resolve())), values)


def find_file(name: str, folders: Iterable[Path], kind: str) -> Path:
    """Return the file of that name in one of the folders, or of that path.

    :raises ConfigError: naming the nearest name
    """
    if _is_path(name):
        return Path(name)
    known = {path.stem: path for folder in folders for path in folder.glob("*.yaml")}
    if name not in known:
        raise ConfigError(f"{kind} {name!r:.80}: no such name, and no path of a .yaml file{nearest(name, known)}")
    return known[name]


def _parse_overrides(overrides: Sequence[str]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for override in overrides:
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            raise ConfigError(f"--set {override:.80}: must be section.key=value")
        if keys[0] not in Config.model_fields:
            raise ConfigError(f"--set {override:.80}: unknown section {keys[0]}{nearest(keys[0], Config.model_fields)}")
        try:
            value = parse_yaml(text)
        except ConfigError as error:
            raise ConfigError(f"--set {override:.80}: {error}") from error
        for key in reversed(keys):
            value = {key: value}
        changes = merge(changes, value)
    return changes


def _checked(scenario: Scenario, sections: Mapping[str, Any]) -> Config:
    """Return the configuration of a scenario and the plain values of the other sections."""
    try:
        config = Config(scenario=scenario, **sections)
        config.reward.build()
    except ValidationError as error:
        raise ConfigError(_explain(error)) from error
    except ValueError as error:
        raise ConfigError(f"reward.{error}") from error
    _check_curriculum(config)
    return config


def _build_scenario(values: Mapping[str, Any]) -> Scenario:
    known = [f.name for f in fields(Scenario)]
    for key in values:
        if key not in known:
            raise ConfigError(f"scenario.{key:.80}: unknown key{nearest(key, known)}")
    extras = values.get("observe_extras", ())
    try:
        return Scenario(**{**values, "observe_extras": tuple(extras) if isinstance(extras, list) else extras})
    except ValueError as error:
        raise ConfigError(f"scenario.{error}") from error


def _explain(error: ValidationError) -> str:
    """Return one line for each thing that is wrong, with its key path, value and what is allowed."""
    lines = []
    for item in error.errors():
        path = ".".join(str(part) for part in item["loc"] if part != "[key]")
        if item["type"] == "extra_forbidden":
            siblings = _known_keys(item["loc"][:-1])
            lines.append(f"{path:.200}: unknown key{nearest(str(item['loc'][-1]), siblings)}")
        elif item["type"] == "missing":
            lines.append(f"{path}: missing")
        else:
            reason = item["msg"].removeprefix("Value error, ")
            lines.append(f"{path:.200}: {reason[:1].lower()}{reason[1:]}; got {item['input']!r:.80}")
    return "\n".join(lines)


def _known_keys(path: tuple[int | str, ...]) -> list[str]:
    model: Any = Config
    for part in path:
        annotation = model.model_fields[part].annotation if part in getattr(model, "model_fields", {}) else Ramp
        model = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else Ramp
    return list(model.model_fields)


def _check_curriculum(config: Config) -> None:
    for name, ramp in config.training.curriculum.items():
        if ramp is not None:
            try:
                _build_scenario({**config.to_dict()["scenario"], name: ramp.start})
            except ValueError as error:
                raise ConfigError(f"training.curriculum.{name}.start: {error}") from error


def _check_memory(config: Config) -> None:
    """Refuse what cannot fit into this machine's memory: the replay buffer and the worlds."""
    size = list(layout(config.scenario).values())[-1].stop
    n = config.scenario.pursuers
    steps = min(config.algorithm.buffer_world_steps, config.training.world_steps + config.training.n_worlds)
    needed = 4 * steps * n * (2 * size + 5) + 40 * config.training.n_worlds * config.scenario.n_directions
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > installed:
        raise ConfigError(
            f"algorithm.buffer_world_steps, training.n_worlds: {needed / 1e9:.1f} GB would be needed, "
            f"this machine has {installed / 1e9:.1f} GB"
        )


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
