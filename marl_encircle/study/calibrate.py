"""The choice of the study's scenario: the protocol in ``configs/protocol/calibration.yaml``, carried out.

The paper leaves fields of the scenario open. The protocol names a centre, its neighbours (each moves one field) and two
settings of one method. Every scenario is trained in both settings with every tuning seed and stands at a distance from
the paper's cells,

    sum over the settings of |S - S of the paper| [percentage points] + |MEL - MEL of the paper| [steps].

First come the centre and its neighbours. Then those neighbours that are nearer than the centre are joined, the nearest
first: each is added to the best scenario so far and stays if that comes nearer. The nearest scenario of all is chosen.
"""

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from marl_encircle import files
from marl_encircle.experiments.metrics import summarise_cell, summarise_run
from marl_encircle.experiments.records import read_runs
from marl_encircle.experiments.sweep import Progress, sweep
from marl_encircle.experiments.trainable import check_trainings
from marl_encircle.study.protocol import Changes, Protocol, SuccessAndLength, cells_with_numbers, jobs_of, name_of
from marl_encircle.study.typeset import Table, Text, markdown


class CalibrationError(Exception):
    """A training of the protocol came to no result."""


class Trial(NamedTuple):
    """One scenario, trained and measured.

    :param changes: what differs from the centre
    :param results: means over the tuning seeds, one per setting
    :param distance: from the paper's cells
    :param seeds: S of each tuning seed [percentage points], one row per setting
    """

    changes: Changes
    results: tuple[SuccessAndLength, ...]
    distance: float
    seeds: tuple[tuple[float, ...], ...]


class Calibration(NamedTuple):
    """The trials in the order in which they were made, and the nearest of them."""

    trials: tuple[Trial, ...]
    chosen: Trial


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
        progress = sweep(jobs_of(protocol, changes), folder, n_workers, report)
        if progress.failed or progress.diverged:
            raise CalibrationError(f"{folder}: {len(progress.failed)} trainings failed, {progress.diverged} diverged")
        return _measure(protocol, changes, folder)

    check_trainings([job.config for changes in planned for job in jobs_of(protocol, changes)], n_workers)
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


def render(protocol: Protocol, calibration: Calibration) -> dict[str, str]:
    """Return the sensitivity table, as Markdown and CSV, and the chosen scenario as YAML: file name -> text."""
    cells, chosen = protocol.cells, calibration.chosen.changes
    columns = [cell.setting.symbols for cell in cells]
    header = ["Scenario", *(f"S % / MEL at {column}" for column in columns), "Distance"]
    seeds = ", ".join(map(str, protocol.seeds))
    notes = [
        f"Chosen: {name_of(chosen)}.",
        f"A row names what differs from the centre, the scenario {protocol.scenario}.",
        (
            f"Each scenario was trained anew, {protocol.reward} with the tuning seeds {seeds}; numbers are their means,"
            " in brackets each seed's S."
        ),
        "Distance: |S - paper| in points + |MEL - paper| in steps, summed over the settings.",
        "MEL without any success: the length of a whole round.",
    ]
    paper = [cells_with_numbers()[cell] for cell in cells]
    rows = [_row(trial) for trial in calibration.trials]
    rows.append(["the paper", *(f"{result.success:.2f} / {result.length:.2f}" for result in paper), ""])
    quantities = ("success_percent", "mean_episode_length", "success_percent of each seed")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["scenario", *(f"{name} ({column})" for column in columns for name in quantities), "distance"])
    for trial in calibration.trials:
        values = (
            value
            for result, each in zip(trial.results, trial.seeds, strict=True)
            for value in (f"{result.success:.4f}", f"{result.length:.4f}", " ".join(f"{s:.4f}" for s in each))
        )
        writer.writerow([name_of(trial.changes), *values, f"{trial.distance:.2f}"])
    writer.writerow(["the paper", *(value for s, mel in paper for value in (f"{s:.4f}", f"{mel:.4f}", "")), ""])
    return {
        "sensitivity.md": markdown(Table("sensitivity", "Calibration: what success depends on", header, rows, notes)),
        "sensitivity.csv": table.getvalue(),
        "scenario.yaml": "".join(f"{key}: {value}\n" for key, value in {"base": protocol.scenario, **chosen}.items()),
    }


def _row(trial: Trial) -> list[Text]:
    """Write a trial in Markdown."""
    shown = [
        f"{result.success:.2f} ({', '.join(f'{success:.1f}' for success in each)}) / {result.length:.2f}"
        for result, each in zip(trial.results, trial.seeds, strict=True)
    ]
    return [name_of(trial.changes), *shown, f"{trial.distance:.2f}"]


def _measure(protocol: Protocol, changes: Changes, folder: Path) -> Trial:
    """Read the trainings of one scenario."""
    jobs, results, distance, shares = jobs_of(protocol, changes), [], 0.0, []
    runs = {(run.cell, run.seed): run for run in read_runs(folder, policies=False)}
    for cell in protocol.cells:
        config = next(job.config for job in jobs if job.setting == cell.setting)
        rounds = {seed: runs[config.cell, seed].episodes for seed in protocol.seeds}
        summary = summarise_cell(rounds, config.reward.closure)
        # Without any success a round takes its whole time
        length = summary.mean_episode_length
        result = SuccessAndLength(100 * summary.success.mean, length.mean if length else config.scenario.max_cycles)
        distance += sum(abs(ours - theirs) for ours, theirs in zip(result, cells_with_numbers()[cell], strict=True))
        results.append(result)
        shares.append(tuple(100 * summarise_run(each, config.reward.closure).success for each in rounds.values()))
    return Trial(changes, tuple(results), distance, tuple(shares))
