"""A grid file -> the runs it asks for: methods x settings x seeds."""

from functools import lru_cache
from typing import Annotated, NamedTuple

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
    algorithm: str = "maddpg"
    settings: list[SettingConfig]
    seeds: list[Annotated[int, Field(ge=0, lt=1 << 32)]]


class Shared(Section):
    """A method that has the runs of another where there are so many obstacles."""

    method: str
    runs_of: str
    obstacles: int


class GridConfig(Section):
    """A grid file.

    :param frozen: the commit in which scenario and recipe were frozen, 40 hexadecimal digits; the tables name it
    """

    profile: Profile
    scenario: str = "default"
    frozen: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None = None
    groups: list[Group]
    shared: list[Shared]


class Job(NamedTuple):
    """One run that a grid asks for."""

    reward: str
    setting: Setting
    seed: int
    profile: Profile
    scenario: str = "default"
    algorithm: str = "maddpg"
    overrides: tuple[str, ...] = ()

    @property
    def config(self) -> Config:
        """The run's configuration."""
        return _config(self._replace(seed=0))


@lru_cache(maxsize=1024)
def _config(job: Job) -> Config:
    """Return the configuration that the runs of all seeds have in common."""
    return load_config(
        job.reward,
        algorithm=job.algorithm,
        profile=job.profile,
        scenario=job.scenario,
        fields=job.setting._asdict(),
        overrides=job.overrides,
    )


class Grid(NamedTuple):
    """The runs of a grid, the cells that share another's runs, and the commit in which its recipe was frozen."""

    jobs: tuple[Job, ...]
    aliases: dict[Cell, Cell]
    frozen: str | None = None

    @property
    def cells(self) -> set[Cell]:
        """Cells that have or share runs."""
        return {job.config.cell for job in self.jobs} | self.aliases.keys()


def load_grid(name: str) -> Grid:
    """Return the runs of a grid in the file's order, each once, none of a cell that shares another's.

    :param name: a name in ``configs/paper/`` or the path of a YAML file; paths in it are relative to it
    :raises ConfigError: naming file and key; all configurations are checked too
    """
    _config.cache_clear()
    path = find_file(name, [PACKAGE / "configs" / "paper"], "grid")
    try:
        grid = GridConfig(**read_yaml(path))
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in explain(error, GridConfig))) from error

    def beside(name: str) -> str:
        return str(path.parent / name) if is_path(name) else name

    jobs: dict[Job, None] = {}
    aliases: dict[Cell, Cell] = {}
    for group in grid.groups:
        for method in map(beside, group.methods):
            for setting in (Setting(**column.model_dump()) for column in group.settings):
                first = Job(method, setting, 0, grid.profile, beside(grid.scenario), beside(group.algorithm))
                config = first.config
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
                jobs |= dict.fromkeys(first._replace(seed=seed) for seed in group.seeds)
    owners: dict[Cell, str] = {}
    for job in jobs:
        reward = owners.setdefault(job.config.cell, job.reward)
        if reward != job.reward:
            raise ConfigError(f"{path}: {reward} and {job.reward} have the same method name, {job.config.reward.name}")
    for cell, shared in aliases.items():
        if shared not in owners:
            raise ConfigError(f"{path}: shared: {cell.method} takes runs of {shared.method}, which is not in the grid")
    return Grid(tuple(jobs), aliases, grid.frozen)


def _owner(cell: Cell, shared: list[Shared]) -> str | None:
    for entry in shared:
        if entry.method == cell.method and entry.obstacles == cell.setting.obstacles:
            return entry.runs_of
    return None


def arguments(job: Job) -> list[str]:
    """Return the command-line arguments of ``marl-encircle train`` for a job."""
    setting = job.setting._asdict()
    options = {name: value for name, value in job._asdict().items() if name not in ("setting", "overrides")}
    flags = [(name.replace("_", "-"), str(value)) for name, value in (options | setting).items()]
    flags += [("set", override) for override in job.overrides]
    return [part for name, value in flags for part in (f"--{name}", value)]
