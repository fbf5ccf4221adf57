"""A grid file -> the runs it asks for: methods x settings x seeds."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, NamedTuple

from pydantic import Field

from marl_encircle.core.scenes import SCENES
from marl_encircle.experiments.choices import Profile
from marl_encircle.experiments.config import Config, difference, load_config
from marl_encircle.experiments.faults import section_of
from marl_encircle.experiments.library import find_file, is_path
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.sections import Section, SettingConfig
from marl_encircle.experiments.trainable import check_seed
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml
from marl_encircle.spelling import nearest


class Group(Section):
    """Every method in every setting with every seed.

    :param overrides: changes of their configurations, ``section.key=value`` each
    :param elsewhere: other settings in which the policies are played too, in any number of bodies if their features
        are sets
    """

    methods: Annotated[list[str], Field(min_length=1)]
    algorithm: str = "maddpg"
    overrides: Annotated[list[str], Field(default_factory=list)]
    settings: Annotated[list[SettingConfig], Field(min_length=1)]
    seeds: Annotated[list[Annotated[int, Field(ge=0, lt=1 << 32)]], Field(min_length=1)]
    elsewhere: Annotated[list[SettingConfig], Field(default_factory=list)]


class Shared(Section):
    """A method that has the runs of another where there are so many obstacles."""

    method: str
    runs_of: str
    obstacles: int


class Elsewhere(Section):
    """Trained policies are played in another scene too: those of all settings with so many obstacles."""

    scene: str
    obstacles: int


class GridConfig(Section):
    """A grid file.

    :param elsewhere: scenes that no run was trained in
    :param frozen: the commit in which scenario and recipe were frozen, 40 hexadecimal digits; the tables name it
    :param amended: what has changed in them since, and where both results are
    """

    profile: Profile
    scenario: str = "default"
    frozen: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None = None
    amended: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    groups: Annotated[list[Group], Field(min_length=1)]
    shared: Annotated[list[Shared], Field(default_factory=list)]
    elsewhere: Annotated[list[Elsewhere], Field(default_factory=list)]


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


def forget_configs() -> None:
    """Forget the configurations of all jobs: the files that they came from may have changed."""
    _config.cache_clear()


class Grid(NamedTuple):
    """The runs of a grid and what is made of them.

    :param aliases: cell -> the cell whose runs it shares
    :param frozen: the commit in which scenario and recipe were frozen
    :param amended: what has changed in them since, and where both results are
    :param elsewhere: cell of a training -> other settings in which its policies are played too
    """

    jobs: tuple[Job, ...]
    aliases: dict[Cell, Cell]
    frozen: str | None = None
    amended: str | None = None
    elsewhere: Mapping[Cell, tuple[Setting, ...]] = MappingProxyType({})

    @property
    def cells(self) -> set[Cell]:
        """Cells that have or share runs."""
        return {job.config.cell for job in self.jobs} | self.aliases.keys()


def load_grid(name: str | Path) -> Grid:
    """Return the runs of a grid, each once, none of a cell that shares another's.

    They come in the order of the seeds, else in the file's: a sweep that is stopped leaves every cell alike.

    :param name: a name in ``configs/paper/`` or the path of a YAML file; paths in it are relative to it
    :raises ConfigError: naming file and key; all configurations are checked too
    """
    forget_configs()
    path = find_file(name, "grid")
    values = read_yaml(path)
    jobs: dict[Job, None] = {}
    asked: dict[Cell, dict[Setting, None]] = {}
    first_jobs: dict[Cell, Job] = {}
    aliases: dict[Cell, Cell] = {}
    with naming_file(path):
        grid = section_of(GridConfig, values)
        for group, first in _cells_asked(grid, path.parent):
            cell = first.config.cell
            runs_of = _runs_of(cell, grid.shared)
            if runs_of is not None:
                aliases[cell] = Cell(runs_of, cell.setting)
                continue
            earlier = first_jobs.setdefault(cell, first)
            _check_same(earlier, first)
            jobs |= dict.fromkeys(earlier._replace(seed=seed) for seed in group.seeds)
            asked.setdefault(cell, {}).update(dict.fromkeys(other.build() for other in group.elsewhere))
        for cell, shared in aliases.items():
            if shared not in first_jobs:
                raise ConfigError(f"shared: {cell.method} takes runs of {shared.method}, which is not in the grid")
        _check_shared(grid.shared, aliases, first_jobs)
        in_order = tuple(sorted(jobs, key=lambda job: job.seed))
        elsewhere = _elsewhere(in_order, grid.elsewhere, asked)
    return Grid(in_order, aliases, grid.frozen, grid.amended, elsewhere)


def _cells_asked(grid: GridConfig, folder: Path) -> Iterator[tuple[Group, Job]]:
    """Yield each cell that a group asks for, as the job of seed 0; its configuration and its seeds are checked.

    :param folder: that paths in the grid are relative to
    """

    def beside(name: str) -> str:
        return str(folder / name) if is_path(name) else name

    for group in grid.groups:
        names = beside(grid.scenario), beside(group.algorithm)
        for method, column in product(map(beside, group.methods), group.settings):
            setting = column.build()
            first = Job(method, setting, 0, grid.profile, *names, tuple(group.overrides))
            if first.config.cell.setting != setting:
                given = ", ".join(group.overrides)
                raise ConfigError(f"overrides: the setting belongs to settings; got {given!r:.80}")
            for seed in group.seeds:
                check_seed(first.config, seed)
            yield group, first


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Put the file that asks for a configuration in front of what is wrong with it."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in str(error).splitlines())) from error


def _check_same(earlier: Job, later: Job) -> None:
    """Refuse two jobs of one cell that are not one training: their runs would have one folder and one mean.

    :raises ConfigError: with the first key that differs
    """
    method, setting = earlier.config.cell
    if earlier.reward != later.reward:
        raise ConfigError(f"{earlier.reward} and {later.reward} have the same method name, {method}")
    lines = difference(earlier.config.to_dict(), later.config.to_dict(), ("first", "then"))
    if lines:
        raise ConfigError(
            f"{method} at {_in_words(setting)} is asked for with two configurations: {lines[0]}; the method of one "
            "of them needs another name"
        )


def _elsewhere(
    jobs: Iterable[Job], entries: Iterable[Elsewhere], asked: Mapping[Cell, Iterable[Setting]]
) -> dict[Cell, tuple[Setting, ...]]:
    """Return the settings in which the policies of each cell are played too.

    :param asked: those that groups ask for, by the cell of their training
    :raises ConfigError: for a scene that there is not, bodies that the policies cannot observe, or a cell that would
        have rounds of two trainings
    """
    jobs = list(jobs)
    trained = {job.config.cell for job in jobs}
    played = {cell: list(others) for cell, others in asked.items()}
    for job in jobs:
        for other in asked[job.config.cell]:
            _check_playable(job, other, "elsewhere")
    for i, entry in enumerate(entries):
        if entry.scene not in SCENES:
            raise ConfigError(f"elsewhere.{i}.scene: unknown scene {entry.scene!r:.80}{nearest(entry.scene, SCENES)}")
        if all(job.setting.obstacles != entry.obstacles for job in jobs):
            raise ConfigError(f"elsewhere.{i}.obstacles: no setting has {entry.obstacles}")
        for job in jobs:
            other = job.setting._replace(scene=entry.scene)
            others = played[job.config.cell]
            if job.setting.obstacles != entry.obstacles or other in others:
                continue
            if job.config.cell._replace(setting=other) in trained:
                continue
            _check_playable(job, other, f"elsewhere.{i}.scene")
            others.append(other)
    _check_distinct(played)
    return {cell: tuple(others) for cell, others in played.items() if others}


def _check_distinct(played: Mapping[Cell, Iterable[Setting]]) -> None:
    """Refuse rounds elsewhere that would stand in a cell beside those of another training: neither would be its mean.

    :param played: cell of a training -> other settings
    """
    trained_at = {cell: cell for cell in played}
    for cell, others in played.items():
        for other in others:
            training = trained_at.setdefault(Cell(cell.method, other), cell)
            if training != cell or other == cell.setting:
                raise ConfigError(
                    f"elsewhere: {cell.method} at {_in_words(other)} has the runs of its training at "
                    f"{_in_words(training.setting)} already"
                )


def _check_playable(job: Job, other: Setting, key: str) -> None:
    """Refuse a setting in which a job's policies cannot play; ``key`` asks for it."""
    try:
        job.config.to_play_in(other)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from error


def _in_words(setting: Setting) -> str:
    return f"{setting.symbols}, {setting.scene}"


def _check_shared(shared: Sequence[Shared], aliases: Iterable[Cell], trained: Iterable[Cell]) -> None:
    """Refuse an entry that means no cell of the grid."""
    aliases = list(aliases)
    methods = {cell.method for cell in (*aliases, *trained)}
    for i, entry in enumerate(shared):
        if entry.method not in methods:
            raise ConfigError(f"shared.{i}.method: {entry.method!r:.80} is not here{nearest(entry.method, methods)}")
        if not any((cell.method, cell.setting.obstacles) == (entry.method, entry.obstacles) for cell in aliases):
            raise ConfigError(f"shared.{i}.obstacles: no setting of {entry.method} has {entry.obstacles}")
        if any((other.method, other.obstacles) == (entry.method, entry.obstacles) for other in shared[:i]):
            raise ConfigError(f"shared.{i}: {entry.method} is there for obstacles {entry.obstacles} already")


def _runs_of(cell: Cell, shared: Iterable[Shared]) -> str | None:
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
