"""A grid file -> the runs it asks for: methods x settings x seeds."""

from functools import lru_cache
from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from marl_encircle.experiments.config import (
    Config,
    Profile,
    Section,
    check_seed,
    explain,
    load_config,
)
from marl_encircle.experiments.library import PACKAGE, find_file, is_path
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml


class SettingConfig(Section):
    """One column of a table."""

    speed_ratio: float
    pursuers: int
    obstacles: int
    scene: str = "random"


class Group(Section):
    """Every method in every setting with every seed."""

    methods: list[str]
    settings: list[SettingConfig]
    seeds: list[Annotated[int, Field(ge=0, lt=1 << 32)]]


class Shared(Section):
    """A method that has the runs of another where there are so many obstacles."""

    method: str
    runs_of: str
    obstacles: int


class GridConfig(Section):
    """A grid file."""

    profile: Profile
    groups: list[Group]
    shared: list[Shared]


class Job(NamedTuple):
    """One run that a grid asks for."""

    reward: str
    setting: Setting
    seed: int
    profile: Profile

    @property
    def config(self) -> Config:
        """The run's configuration."""
        return _config(self.reward, self.setting, self.profile)


@lru_cache(maxsize=1024)
def _config(reward: str, setting: Setting, profile: Profile) -> Config:
    return load_config(reward, profile=profile, scenario=setting._asdict())


class Grid(NamedTuple):
    """The runs of a grid and the cells that share another's runs."""

    jobs: tuple[Job, ...]
    aliases: dict[Cell, Cell]


def load_grid(name: str) -> Grid:
    """Return the runs of a grid in the file's order, each once, none of a cell that shares another's.

    :param name: a name in ``configs/paper/`` or the path of a YAML file; paths of methods in it are relative to it
    :raises ConfigError: naming file and key; all configurations are checked too
    """
    _config.cache_clear()
    path = find_file(name, [PACKAGE / "configs" / "paper"], "grid")
    try:
        grid = GridConfig(**read_yaml(path))
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in explain(error, GridConfig))) from error
    jobs: dict[Job, None] = {}
    aliases: dict[Cell, Cell] = {}
    for group in grid.groups:
        for method in (str(path.parent / name) if is_path(name) else name for name in group.methods):
            for setting in (Setting(**column.model_dump()) for column in group.settings):
                config = _config(method, setting, grid.profile)
                try:
                    for seed in group.seeds:
                        check_seed(config, seed)
                except ConfigError as error:
                    raise ConfigError(f"{path}: {error}") from error
                cell = config.cell
                owner = _owner(cell, grid.shared)
                if owner is not None:
                    aliases[cell] = Cell(owner, setting)
                    continue
                jobs |= dict.fromkeys(Job(method, setting, seed, grid.profile) for seed in group.seeds)
    owners: dict[Cell, str] = {}
    for job in jobs:
        reward = owners.setdefault(job.config.cell, job.reward)
        if reward != job.reward:
            raise ConfigError(f"{path}: the methods {reward} and {job.reward} have one name, {job.config.reward.name}")
    for cell, shared in aliases.items():
        if shared not in owners:
            raise ConfigError(f"{path}: shared: {cell.method} has the runs of {shared.method}, which the grid lacks")
    return Grid(tuple(jobs), aliases)


def _owner(cell: Cell, shared: list[Shared]) -> str | None:
    for entry in shared:
        if entry.method == cell.method and entry.obstacles == cell.setting.obstacles:
            return entry.runs_of
    return None


def arguments(job: Job) -> list[str]:
    """Return the command-line arguments of ``marl-encircle train`` for a job."""
    flags: dict[str, Any] = {"reward": job.reward, **job.setting._asdict(), "seed": job.seed, "profile": job.profile}
    return [part for name, value in flags.items() for part in (f"--{name.replace('_', '-')}", str(value))]
