"""A protocol file -> which scenarios the calibration tries; all of it checked before anything is trained."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from marl_encircle.experiments.choices import Profile
from marl_encircle.experiments.faults import section_of
from marl_encircle.experiments.grid import Job, forget_configs, naming_file
from marl_encircle.experiments.library import find_file
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.sections import Section, SettingConfig
from marl_encircle.experiments.trainable import check_seed
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml
from marl_encircle.study.paper import reported_cells

MAX_SCENARIOS = 16

Changes = Mapping[str, Any]
"""Fields of the scenario that differ from the centre."""


class Protocol(Section):
    """A protocol file.

    :param seeds: training seeds
    :param evaluation_seed: of the rounds that judge the scenarios, which are not the study's
    """

    reward: str
    profile: Profile
    scenario: str
    settings: Annotated[list[SettingConfig], Field(min_length=1)]
    seeds: Annotated[list[Annotated[int, Field(ge=0, lt=1 << 32)]], Field(min_length=1)]
    evaluation_seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    neighbours: list[Annotated[dict[str, Any], Field(min_length=1, max_length=1)]]
    combinations: Annotated[int, Field(ge=0, le=MAX_SCENARIOS)]

    @property
    def cells(self) -> list[Cell]:
        """The cells of the paper that the scenarios are held against."""
        return [Cell(self.reward, setting.build()) for setting in self.settings]


class SuccessAndLength(NamedTuple):
    """S [percentage points] and MEL [steps] of a cell."""

    success: float
    length: float


def load_protocol(name: str | Path) -> Protocol:
    """Return a protocol, all its scenarios' configurations checked.

    :param name: a name in ``configs/protocol/`` or the path of a YAML file
    :raises ConfigError: naming file and key
    """
    forget_configs()
    path = find_file(name, "protocol")
    protocol = _read(path)
    scenarios = 1 + len(protocol.neighbours) + protocol.combinations
    if scenarios > MAX_SCENARIOS:
        raise ConfigError(f"{path}: {scenarios} scenarios; at most {MAX_SCENARIOS} may be tried")
    for cell in protocol.cells:
        if cell not in cells_with_numbers():
            raise ConfigError(f"{path}: the paper has no numbers of {cell.method} in {cell.setting}")
    with naming_file(path):
        _check_distinct(protocol)
    return protocol


def calibrated_cells() -> list[Cell]:
    """Return the cells of the paper by which the study's scenario was chosen."""
    return _read(find_file("calibration", "protocol")).cells


def _read(path: Path) -> Protocol:
    values = read_yaml(path)
    with naming_file(path):
        return section_of(Protocol, values)


def _check_distinct(protocol: Protocol) -> None:
    """Refuse what would be trained or counted twice, and a neighbour that is in another cell of the paper.

    :raises ConfigError: naming the key
    """
    for key, values in (("seeds", protocol.seeds), ("settings", protocol.cells)):
        for i, value in enumerate(values):
            if value in values[:i]:
                raise ConfigError(f"{key}.{i}: stands there twice; got {getattr(protocol, key)[i]!r:.80}")
    configs = [[job.config for job in jobs_of(protocol, {})]]
    for i, changes in enumerate(protocol.neighbours):
        for name in changes:
            if name in Setting._fields:
                raise ConfigError(f"neighbours.{i}.{name}: belongs to the settings; a neighbour moves another field")
        configs.append([job.config for job in jobs_of(protocol, changes)])
        same = configs.index(configs[-1])
        if same <= i:
            other = f"neighbours.{same - 1}" if same else "the centre"
            raise ConfigError(f"neighbours.{i}: {name_of(changes)} is the same scenario as {other}")


def jobs_of(protocol: Protocol, changes: Changes) -> list[Job]:
    """Return the trainings of one scenario.

    :raises ConfigError: where it is not allowed
    """
    jobs = [
        Job(
            protocol.reward,
            cell.setting,
            seed,
            protocol.profile,
            protocol.scenario,
            overrides=(
                f"evaluation.seed={protocol.evaluation_seed}",
                *(f"scenario.{field}={value}" for field, value in changes.items()),
            ),
        )
        for cell in protocol.cells
        for seed in protocol.seeds
    ]
    for job in jobs:
        check_seed(job.config, job.seed)
    return jobs


def name_of(changes: Changes) -> str:
    """Name of a scenario in tables and folders."""
    return ",".join(f"{field}={value}" for field, value in changes.items()) or "centre"


@cache
def cells_with_numbers() -> dict[Cell, SuccessAndLength]:
    """Return the cells for which the paper has both numbers."""
    return {
        cell: SuccessAndLength(result.success_percent, result.mean_episode_length)
        for cell, result in reported_cells().items()
        if result.success_percent is not None and result.mean_episode_length is not None
    }
