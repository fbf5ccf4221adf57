"""The choice of the study's scenario: the protocol in ``configs/paper/calibration.yaml``, carried out.

The paper leaves fields of the scenario open. The protocol names a centre, its neighbours (each moves one field) and two
settings of one method. Every scenario is trained in both settings with every tuning seed and stands at a distance from
the paper's cells,

    sum over the settings of |S - S of the paper| [percentage points] + |MEL - MEL of the paper| [steps].

First come the centre and its neighbours. Then those neighbours that are nearer than the centre are joined, the nearest
first: each is added to the best scenario so far and stays if that comes nearer. The nearest scenario of all is chosen.
"""

import csv
import io
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, ValidationError

from marl_encircle import files
from marl_encircle.experiments.config import Profile, Section
from marl_encircle.experiments.faults import explain
from marl_encircle.experiments.grid import Job, SettingConfig, naming_file
from marl_encircle.experiments.library import find_file
from marl_encircle.experiments.metrics import summarise_cell
from marl_encircle.experiments.records import Cell, Setting, read_runs
from marl_encircle.experiments.sweep import Progress, sweep
from marl_encircle.experiments.trainable import check_seed, check_trainings
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml
from marl_encircle.study.paper import reported_cells
from marl_encircle.study.typeset import markdown

MAX_SCENARIOS = 16

Changes = Mapping[str, Any]
"""Fields of the scenario that differ from the centre."""


class CalibrationError(Exception):
    """A training of the protocol came to no result."""


class Protocol(Section):
    """A protocol file."""

    reward: str
    profile: Profile
    scenario: str
    settings: Annotated[list[SettingConfig], Field(min_length=1)]
    seeds: Annotated[list[Annotated[int, Field(ge=0, lt=1 << 32)]], Field(min_length=1)]
    neighbours: list[Annotated[dict[str, Any], Field(min_length=1, max_length=1)]]
    combinations: Annotated[int, Field(ge=0, le=MAX_SCENARIOS)]

    @property
    def cells(self) -> list[Cell]:
        """The cells of the paper that the scenarios are held against."""
        return [Cell(self.reward, Setting(**setting.model_dump())) for setting in self.settings]


class Result(NamedTuple):
    """S [percentage points] and MEL [steps] of a cell."""

    success: float
    length: float


class Trial(NamedTuple):
    """One scenario, trained and measured.

    :param changes: what differs from the centre
    :param results: means over the tuning seeds, one per setting
    :param distance: from the paper's cells
    """

    changes: Changes
    results: tuple[Result, ...]
    distance: float


class Calibration(NamedTuple):
    """The trials in the order in which they were made, and the nearest of them."""

    trials: tuple[Trial, ...]
    chosen: Trial


def load_protocol(name: str) -> Protocol:
    """Return a protocol, all its scenarios' configurations checked.

    :param name: a name in ``configs/paper/`` or the path of a YAML file
    :raises ConfigError: naming file and key
    """
    path = find_file(name, "protocol")
    protocol = _read(path)
    scenarios = 1 + len(protocol.neighbours) + protocol.combinations
    if scenarios > MAX_SCENARIOS:
        raise ConfigError(f"{path}: {scenarios} scenarios; at most {MAX_SCENARIOS} may be tried")
    for cell in protocol.cells:
        if cell not in paper_cells():
            raise ConfigError(f"{path}: the paper has no numbers of {cell.method} in {cell.setting}")
    with naming_file(path):
        _check_distinct(protocol)
    return protocol


def calibrated_cells() -> list[Cell]:
    """Return the cells of the paper by which the study's scenario was chosen."""
    return _read(find_file("calibration", "protocol")).cells


def _read(path: Path) -> Protocol:
    try:
        return Protocol(**read_yaml(path))
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in explain(error, Protocol))) from error


def _check_distinct(protocol: Protocol) -> None:
    """Refuse what would be trained or counted twice, and a neighbour that is in another cell of the paper.

    :raises ConfigError: naming the key
    """
    for key, values in (("seeds", protocol.seeds), ("settings", protocol.cells)):
        for i, value in enumerate(values):
            if value in values[:i]:
                raise ConfigError(f"{key}.{i}: stands there twice; got {getattr(protocol, key)[i]!r:.80}")
    configs = [[job.config for job in _jobs(protocol, {})]]
    for i, changes in enumerate(protocol.neighbours):
        for name in changes:
            if name in Setting._fields:
                raise ConfigError(f"neighbours.{i}.{name}: belongs to the settings; a neighbour moves another field")
        configs.append([job.config for job in _jobs(protocol, changes)])
        same = configs.index(configs[-1])
        if same <= i:
            other = f"neighbours.{same - 1}" if same else "the centre"
            raise ConfigError(f"neighbours.{i}: {name_of(changes)} is the same scenario as {other}")


def calibrate(
    protocol: Protocol, out: str | Path, n_workers: int, report: Callable[[Progress], None] | None = None
) -> Calibration:
    """Train what is missing and choose; ``out`` gets the runs, ``sensitivity.{md,csv}`` and ``scenario.yaml``.

    :param out: folder of the calibration; a second call goes on where the first one stopped
    :param n_workers: processes at a time
    :param report: called whenever a run starts or ends
    :raises ConfigError: if one cannot be trained, or too many at a time for this machine's memory, before anything is
        written
    :raises CalibrationError: if a training failed or diverged
    """
    planned: list[Changes] = [{}, *protocol.neighbours]

    def trial(changes: Changes) -> Trial:
        folder = Path(out) / "runs" / name_of(changes)
        progress = sweep(_jobs(protocol, changes), folder, n_workers, report)
        if progress.failed or progress.diverged:
            raise CalibrationError(f"{folder}: {len(progress.failed)} trainings failed, {progress.diverged} diverged")
        return _measure(protocol, changes, folder)

    check_trainings([job.config for changes in planned for job in _jobs(protocol, changes)], n_workers)
    centre, *neighbours = (trial(changes) for changes in planned)
    trials, best = [centre, *neighbours], centre
    for neighbour in sorted(neighbours, key=lambda trial: trial.distance):
        if neighbour.distance >= centre.distance:
            break
        changes = {**best.changes, **neighbour.changes}
        joined = next((known for known in trials if known.changes == changes), None)
        if joined is None:
            if len(trials) == 1 + len(neighbours) + protocol.combinations:
                break
            joined = trial(changes)
            trials.append(joined)
        if joined.distance < best.distance:
            best = joined
    calibration = Calibration(tuple(trials), best)
    for name, text in render(protocol, calibration).items():
        files.write_text(Path(out) / name, text)
    return calibration


def name_of(changes: Changes) -> str:
    """Name of a scenario in tables and folders."""
    return ",".join(f"{field}={value}" for field, value in changes.items()) or "centre"


def render(protocol: Protocol, calibration: Calibration) -> dict[str, str]:
    """Return the sensitivity table, as Markdown and CSV, and the chosen scenario as YAML: file name -> text."""
    cells, chosen = protocol.cells, calibration.chosen.changes
    rows = [(name_of(trial.changes), trial.results, f"{trial.distance:.2f}") for trial in calibration.trials]
    rows.append(("the paper", tuple(paper_cells()[cell] for cell in cells), ""))
    columns = [f"ratio {s.speed_ratio:g}, n={s.pursuers}, m={s.obstacles}" for _, s in cells]
    header = ["Scenario", *(f"S % / MEL at {column}" for column in columns), "Distance"]
    seeds = ", ".join(map(str, protocol.seeds))
    notes = [
        f"Chosen: {name_of(chosen)}.",
        f"A row names what differs from the centre, the scenario {protocol.scenario}.",
        f"Each scenario was trained anew, {protocol.reward} with the tuning seeds {seeds}; numbers are their means.",
        "Distance: |S - paper| in points + |MEL - paper| in steps, summed over the settings.",
    ]
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    quantities = ("success_percent", "mean_episode_length")
    writer.writerow(["scenario", *(f"{name} ({column})" for column in columns for name in quantities), "distance"])
    for name, results, distance in rows:
        writer.writerow([name, *(f"{value:.4f}" for result in results for value in result), distance])
    return {
        "sensitivity.md": markdown(
            "Calibration: what success depends on",
            header,
            [
                [name, *(f"{r.success:.2f} / {r.length:.2f}" for r in results), distance]
                for name, results, distance in rows
            ],
            notes,
        ),
        "sensitivity.csv": table.getvalue(),
        "scenario.yaml": "".join(f"{key}: {value}\n" for key, value in {"base": protocol.scenario, **chosen}.items()),
    }


@cache
def paper_cells() -> dict[Cell, Result]:
    """Return the cells for which the paper has numbers."""
    return {
        cell: Result(result.success_percent, result.mean_episode_length)
        for cell, result in reported_cells().items()
        if result.success_percent is not None and result.mean_episode_length is not None
    }


def _jobs(protocol: Protocol, changes: Changes) -> list[Job]:
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
            overrides=tuple(f"scenario.{field}={value}" for field, value in changes.items()),
        )
        for cell in protocol.cells
        for seed in protocol.seeds
    ]
    for job in jobs:
        check_seed(job.config, job.seed)
    return jobs


def _measure(protocol: Protocol, changes: Changes, folder: Path) -> Trial:
    """Read the trainings of one scenario."""
    jobs, results, distance = _jobs(protocol, changes), [], 0.0
    runs = {(run.cell.setting, run.seed): run for run in read_runs(folder)}
    for cell in protocol.cells:
        config = next(job.config for job in jobs if job.setting == cell.setting)
        summary = summarise_cell(
            {seed: runs[cell.setting, seed].episodes for seed in protocol.seeds}, config.reward.closure
        )
        # Without any success a round takes its whole time
        length = summary.mean_episode_length
        result = Result(100 * summary.success.mean, length.mean if length else config.scenario.max_cycles)
        distance += sum(abs(ours - theirs) for ours, theirs in zip(result, paper_cells()[cell], strict=True))
        results.append(result)
    return Trial(changes, tuple(results), distance)
