"""Print the numbers of reproduction.md and protocol.md that no table shows: python docs/findings.py.

They come from what lies in results/: nothing is trained or played. Left out is what other commands of these pages
print, and what was not kept. Shares are in %, their differences in points, lengths in steps; brackets hold 95 %
intervals, Student's t over the training seeds unless another is named.
"""

import csv
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations, permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trained_again
from numpy.typing import NDArray
from scipy import stats

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments import metrics
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.learning_curve import read_curve
from marl_encircle.experiments.records import Cell, Run, Setting, read_record, read_runs, run_path
from marl_encircle.study.agreement import PAPER_ROUNDS, gaps_of, pairs_of
from marl_encircle.study.cells import CellRuns, gather, pursuers_suffice, run_elsewhere
from marl_encircle.study.paper import TABLE_METHODS, label, reported_cells
from marl_encircle.study.protocol import calibrated_cells

Array = NDArray[np.float64]

RESULTS = Path(__file__).parents[1] / "results"
STUDY = (*TABLE_METHODS, "model_c")
CHOSEN = RESULTS / "calibration" / "runs" / "turn_order=simultaneous,acceleration=3"
FORMER_ROUNDS = RESULTS / "former" / "rounds_of_seed_1000.csv"


class Results(NamedTuple):
    """What the sections are made from.

    :param runs: the runs of the study
    :param former: those of half the budget that they replaced
    :param cells: the runs of each cell
    """

    runs: Sequence[Run]
    former: Sequence[Run]
    cells: Mapping[Cell, CellRuns]


def main() -> None:
    """Print every section."""
    for title, lines in findings(read_results()).items():
        sys.stdout.write("\n".join([title, "", *(f"  {line}" for line in lines), "\n"]))


def read_results() -> Results:
    """Read the runs of the study."""
    grid = load_grid("study")
    runs = [run for run in read_runs(RESULTS / "runs") if run.cell in grid.cells]
    return Results(runs, read_runs(RESULTS / "former", policies=False), gather(runs, grid.aliases))


def findings(results: Results) -> dict[str, Iterator[str]]:
    """Return the title of each section, and its lines, which are found when they are asked for."""
    return {title: section(results) for title, section in _SECTIONS.items()}


def _seeds(results: Results) -> Iterator[str]:
    for cell, runs in _own(results):
        successes, lengths = _successes(runs), _lengths(runs)
        yield f"{_named(cell)}: {successes.mean():.2f} of {_listed(successes)}; {_listed(lengths)}"


def _former_seeds(results: Results) -> Iterator[str]:
    for cell, runs in gather(results.former, {}).items():
        yield f"{_named(cell)}: {_listed(_successes(runs))}"


def _losses(results: Results) -> Iterator[str]:
    for method in TABLE_METHODS:
        none, three = (results.cells[Cell(method, Setting(1.1, 3, m))] for m in (0, 3))
        lengths = np.array([np.nanmean(_lengths(runs)) for runs in (none, three)])
        yield f"{label(method)}: {_success_difference(none, three)}; {_listed(lengths)}"


def _counting(results: Results) -> Iterator[str]:
    for method in ("ma2019", "model_a"):
        for m in (1, 2, 3):
            runs = results.cells[Cell(method, Setting(1.1, 3, m))]
            yield f"{label(method)}, m={m}: {(_successes(runs, 'all') - _successes(runs)).mean():+.2f}"


def _help(results: Results) -> Iterator[str]:
    for n in (2, 3, 4, 5):
        seeds = results.cells[Cell("ours", Setting(1.1, n, 1))].finished.values()
        won = [episode for rounds in seeds for episode in rounds if episode.step_all is not None]
        first = sum(episode.step_pursuers != episode.step_all for episode in won)
        never = sum(episode.step_pursuers is None for episode in won)
        yield f"n={n}: {100 * first / len(won):.1f} %, {100 * never / len(won):.1f} % of {len(won)}"


def _slowness(results: Results) -> Iterator[str]:
    for setting in sorted({cell.setting for cell in results.cells if not pursuers_suffice(cell.setting)}):
        ours, other = (_lengths(results.cells[Cell(method, setting)]) for method in ("ours", "model_b"))
        yield f"{setting.symbols}: {_paired(ours, other)}; {_welch(ours, other)}"


def _rises(results: Results) -> Iterator[str]:
    amended = {run.cell for run in results.former}
    for cell, runs in _own(results):
        if len(runs.finished) > 1:
            mean = _curves(cell, runs).mean(axis=0)
            before = f"; {_rise(mean[: len(mean) // 2], 5):.1f}" if cell in amended else ""
            yield f"{_named(cell)}: {_rise(mean, 5):+.1f}, {_rise(mean, 10):+.1f}{before}"


def _calibration(_: Results) -> Iterator[str]:
    for cell in calibrated_cells():
        curves = [
            read_curve(path.parent).success for path in sorted((CHOSEN / run_path(cell, 0)).parent.glob("*/run.json"))
        ]
        yield f"{_named(cell)}: {', '.join(f'{_rise(100 * np.asarray(curve), 5):.1f}' for curve in curves)}"


def _former_rounds(results: Results) -> Iterator[str]:
    former = gather(results.former, {})
    seeds: dict[Cell, dict[int, float]] = defaultdict(dict)
    with FORMER_ROUNDS.open(newline="") as file:
        for row in csv.DictReader(file):
            if (row["folder"], row["scene"]) == ("runs", "random"):
                cell = Cell(row["method"], Setting(float(row["ratio"]), int(row["n"]), int(row["m"])))
                seeds[cell][int(row["seed"])] = float(row["success_percent"])
    changes = []
    for cell, successes in seeds.items():
        runs = former.get(cell, results.cells[cell])
        now = dict(zip(runs.finished, _successes(runs), strict=True))
        changes.append(np.mean([now[seed] - successes[seed] for seed in successes]))
    amounts = np.abs(changes)
    largest = _named(list(seeds)[amounts.argmax()])
    yield f"{amounts.mean():.2f}, {np.mean(changes):+.2f} of {len(changes)}; {amounts.max():.1f}, {largest}"


def _speed(results: Results) -> Iterator[str]:
    for m in (0, 1):
        for method in ("model_b", "ma2019", "ours"):
            cell = Cell(method, Setting(1.1, 3, m))
            seeds = _curves(cell, results.cells[cell])
            latest = np.argmax([_first_at_80(seed) for seed in seeds])
            others = np.delete(seeds, latest, axis=0).mean(axis=0)
            yield f"{_named(cell)}: {_first_at_80(seeds.mean(axis=0)):.2f}; {_first_at_80(others):.2f}"


def _scenes(results: Results) -> Iterator[str]:
    for scene in ("concave", "tunnel"):
        then, now = (gather(_played_in(scene, runs), {}) for runs in (results.former, results.runs))
        for cell in (cell for cell in now if cell.method == "ours"):
            b, ours, plus = (now[cell._replace(method=name)] for name in ("model_b", "ours", "ours_plus"))
            means = ", ".join(f"{_successes(runs).mean():.1f}" for runs in (b, ours, plus))
            half = then.get(cell)
            since = f"; {_successes(half).mean():.1f}, {_success_difference(ours, half)}" if half else ""
            yield f"{scene}, {cell.setting.symbols}: {means}; {_success_difference(plus, ours)}{since}"


def _nearness(results: Results) -> Iterator[str]:
    gaps = gaps_of(results.cells, reported_cells())
    chose = [gap for gap in gaps if gap.cell in calibrated_cells()]
    held_out = [gap for gap in gaps if gap not in chose and not results.cells[gap.cell].runs_of]
    alone = [gap for gap in held_out if pursuers_suffice(gap.cell.setting)]
    groups = {
        "the two cells that chose the scenario": chose,
        "all": held_out,
        "three pursuers, Eq. 6 holds": [gap for gap in alone if gap.cell.setting.pursuers == 3],
        "four and five pursuers": [gap for gap in alone if gap.cell.setting.pursuers > 3],
        "Eq. 6 fails": [gap for gap in held_out if gap not in alone],
    }
    for name, group in groups.items():
        gap = np.array([gap.success for gap in group])
        yield f"{name}: {np.abs(gap).mean():.2f}, {gap.mean():+.2f} of {len(gap)}"


def _distances(results: Results) -> Iterator[str]:
    paper = reported_cells()
    for pair in pairs_of(results.cells, paper):
        if pair.ours.interval is None or not pursuers_suffice(pair.first.setting):
            continue
        shares = [paper[cell].success_percent or 0.0 for cell in (pair.first, pair.second)]
        noise = 1.96 * math.sqrt(sum(share * (100 - share) for share in shares) / PAPER_ROUNDS)
        half = 50 * (pair.ours.interval.high - pair.ours.interval.low)
        distance = 100 * pair.ours.mean - pair.paper
        verdict = "no" if abs(distance) > math.hypot(noise, half) else "yes"
        yield f"{_named(pair.first)} minus {label(pair.second.method)}: {distance:+.1f}, {verdict}"


def _pairings(results: Results) -> Iterator[str]:
    for setting in sorted({cell.setting for cell in results.cells}):
        cells = [Cell(method, setting) for method in reversed(STUDY)]
        whole = [cell for cell, runs in _own(results) if cell in cells and len(runs.finished) == 5]
        for first, second in combinations(sorted(whole, key=cells.index), 2):
            one, other = results.cells[first], results.cells[second]
            shown = [_is_shown(one, other, order) for order in permutations(other.finished)]
            if 0 < sum(shown) < len(shown):
                tables = "shown" if shown[0] else "not shown"
                welch = _welch(_successes(one), _successes(other))
                yield f"{_named(first)} minus {label(second.method)}: {tables}, {sum(shown)}; {welch}"


def _hours(_: Results) -> Iterator[str]:
    groups = {"the study": STUDY, "Ours+": ("ours_plus",), "the one policy": ("generalist",)}
    for folder in ("runs", "former"):
        records = [read_record(path.parent) for path in sorted((RESULTS / folder).glob("*/*/*/run.json"))]
        for name, methods in groups.items():
            hours = [record["cpu_seconds"] / 3600 for record in records if record["method"] in methods]
            yield f"{folder}, {name}: {sum(hours):.2f} hours, {len(hours)} runs"


def _again(_: Results) -> Iterator[str]:
    rows = trained_again.found()
    yield f"of {len(rows)} runs {sum(row['same'] == 'True' for row in rows)} came out the same"
    study = [row for row in rows if row["run"].split("/")[0] in STUDY]
    again, first = _cpu_hours(study)
    yield f"{len(study)} of the study: {again:.3f} hours, the first time {first:.3f} hours"
    for commit in sorted({row["git_commit"] for row in study}):
        batch = [row for row in study if row["git_commit"] == commit]
        again, first = _cpu_hours(batch)
        yield f"{len(batch)} with {commit[:7]}: {again / first:.2f} times the first"


def _cpu_hours(rows: Sequence[Mapping[str, str]]) -> tuple[float, float]:
    """Processor time of runs that were trained again, and of the first time."""
    again, first = (sum(float(row[name]) for row in rows) for name in ("cpu_seconds", "recorded_cpu_seconds"))
    return again / 3600, first / 3600


def _own(results: Results) -> Iterator[tuple[Cell, CellRuns]]:
    """Return the cells that show no other cell's runs."""
    return ((cell, runs) for cell, runs in results.cells.items() if not runs.runs_of)


def _played_in(scene: str, runs: Sequence[Run]) -> list[Run]:
    """Return what policies played in another scene, as runs of that."""
    return [run_elsewhere(run, setting) for run in runs for setting in run.elsewhere if setting.scene == scene]


def _successes(runs: CellRuns, closure: Closure | None = None) -> Array:
    """S of every training seed, by the method's own rule unless another is asked for."""
    rule = closure or runs.closure or "all"
    return 100 * np.array([metrics.summarise_run(rounds, rule).success for rounds in runs.finished.values()])


def _lengths(runs: CellRuns) -> Array:
    """MEL of every training seed; nan where nothing was won."""
    found = (metrics.summarise_run(rounds, runs.closure or "all") for rounds in runs.finished.values())
    return np.array([run.mean_episode_length or math.nan for run in found])


def _curves(cell: Cell, runs: CellRuns) -> Array:
    """Learning curves, a row each."""
    return 100 * np.stack([read_curve(RESULTS / "runs" / run_path(cell, seed)).success for seed in runs.finished])


def _rise(curve: Array, parts: int) -> float:
    """How much more a curve has over the last of so many parts than over the one before."""
    points = len(curve) // parts
    return float(curve[-points:].mean() - curve[-2 * points : -points].mean())


def _first_at_80(curve: Array) -> float:
    """When a curve with a point every 50,000 world-steps is first at 80 % or above, in millions; inf if never."""
    there = np.flatnonzero(curve >= 80)
    return 0.05 * float(there[0] + 1) if len(there) else math.inf


def _is_shown(one: CellRuns, other: CellRuns, order: Sequence[int]) -> bool:
    """Whether a difference in S is shown if the first cell's seeds meet the second's in this order."""
    paired = dict(zip(one.finished, (other.finished[seed] for seed in order), strict=True))
    found = metrics.success_difference(one.finished, paired, one.closure or "all", other.closure or "all")
    return found is not None and found.shown


def _success_difference(first: CellRuns, second: CellRuns) -> str:
    """Mean and interval of the difference in S as in the tables, never narrower than the noise of the rounds."""
    closures = first.closure or "all", second.closure or "all"
    found = metrics.success_difference(first.finished, second.finished, *closures)
    if found is None or found.interval is None:
        return "no seeds in common"
    mean, low, high = 100 * found.mean, 100 * found.interval.low, 100 * found.interval.high
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def _paired(first: Array, second: Array) -> str:
    """Mean and interval of the difference over the training seeds."""
    difference = first - second
    low, high = metrics.student_interval(difference.tolist()) or (math.nan, math.nan)
    return f"{difference.mean():.1f} [{low:.1f}, {high:.1f}]"


def _welch(first: Array, second: Array) -> str:
    """Welch's interval of the difference: no seed is paired with another."""
    low, high = stats.ttest_ind(first, second, equal_var=False).confidence_interval(0.95)
    return f"[{low:.2f}, {high:.2f}]"


def _named(cell: Cell) -> str:
    return f"{label(cell.method)}, {cell.setting.symbols}"


def _listed(values: Array) -> str:
    return ", ".join(f"{value:.1f}" for value in values)


_SECTIONS: dict[str, Callable[[Results], Iterator[str]]] = {
    "S and MEL of every training seed": _seeds,
    "S of every training seed after half the budget, where it was amended": _former_seeds,
    "From none to three obstacles, paired by training seed: loss in S; MEL with none and with three": _losses,
    "What counting the obstacles adds to S of Ma and Model A, three pursuers at ratio 1.1": _counting,
    "Wins of Ours at ratio 1.1, m=1, in which the circle closed first with the obstacle; never without": _help,
    "Where Eq. 6 fails: MEL of Ours minus that of Model B, each over its own wins; Welch's interval": _slowness,
    "Rise of the learning curves over the last two fifths, over the last two tenths; before the amendment": _rises,
    "Rise of the calibration's curves in the chosen scenario over the last two fifths, each seed's": _calibration,
    "S on the rounds of seed 4000 minus that on those of seed 1000: mean of the amounts, mean; largest": _former_rounds,
    "Million world-steps until the mean curve has 80 %; the same without the latest seed": _speed,
    "Other shapes of obstacles: S of Model B, Ours, Ours+; Ours+ minus Ours; Ours with half the budget, since": _scenes,
    "S minus the paper's, held-out cells unless said: mean of the amounts, mean": _nearness,
    "Where Eq. 6 holds: how far a difference is from the paper's; can the noise of both be why": _distances,
    "Differences in S that some of the 120 pairings of seeds show: do the tables, how many do; Welch": _pairings,
    "Processor time": _hours,
    "Runs that were trained again: processor time now and the first time": _again,
}

if __name__ == "__main__":
    main()
