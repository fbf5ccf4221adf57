"""A grid file -> the runs it asks for: methods x settings x seeds."""

from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from marl_encircle.experiments.config import PACKAGE, Config, Profile, Section, find_file, load_config
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
        return load_config(self.reward, profile=self.profile, scenario=self.setting._asdict())


class Grid(NamedTuple):
    """The runs of a grid and the cells that share another's runs."""

    jobs: tuple[Job, ...]
    aliases: dict[Cell, Cell]


def load_grid(name: str) -> Grid:
    """Return the runs of a grid in the file's order, each once, none of a cell that shares another's.

    :param name: a name in ``configs/paper/`` or the path of a YAML file
    :raises ConfigError: naming file and key; all configurations are checked too
    """
    path = find_file(name, [PACKAGE / "configs" / "paper"], "grid")
    try:
        grid = GridConfig(**read_yaml(path))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{path}: {where}: {first['msg'].lower()}; got {first['input']!r:.80}") from error
    except TypeError as error:
        raise ConfigError(f"{path}: {error}") from error
    jobs: dict[Job, None] = {}
    aliases: dict[Cell, Cell] = {}
    for group in grid.groups:
        for method in group.methods:
            for setting in (Setting(**column.model_dump()) for column in group.settings):
                owner = _owner(method, setting, grid.shared)
                if owner is not None:
                    aliases[Cell(method, setting)] = Cell(owner, setting)
                    continue
                jobs |= dict.fromkeys(Job(method, setting, seed, grid.profile) for seed in group.seeds)
    for job in {(job.reward, job.setting): job for job in jobs}.values():
        job.config  # noqa: B018 - raises where it is not allowed
    return Grid(tuple(jobs), aliases)


def _owner(method: str, setting: Setting, shared: list[Shared]) -> str | None:
    for entry in shared:
        if entry.method == method and entry.obstacles == setting.obstacles:
            return entry.runs_of
    return None


def arguments(job: Job) -> list[str]:
    """Return the command-line arguments of ``marl-encircle train`` for a job."""
    flags: dict[str, Any] = {"reward": job.reward, **job.setting._asdict(), "seed": job.seed, "profile": job.profile}
    return [part for name, value in flags.items() for part in (f"--{name.replace('_', '-')}", str(value))]
