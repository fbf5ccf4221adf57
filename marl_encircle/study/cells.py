"""Cells of the tables: the runs of each over its training seeds, and what they amount to under a closure rule."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from marl_encircle.core.geometry import Closure
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments import metrics
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.records import Cell, Run, Setting, Status
from marl_encircle.study.paper import label

NOT_RUN = "not run"
"""What is said of a cell without any run."""

OTHER_STATUSES: tuple[Status, ...] = ("diverged", "unfinished", "not evaluated")


class CellRuns(NamedTuple):
    """The runs of one cell.

    :param closure: the method's own closure rule; None if all runs are unfinished
    :param finished: training seed -> evaluation rounds
    :param others: status -> training seeds of the runs without rounds
    :param runs_of: method that the runs are shared with, None if they are the cell's own
    """

    closure: Closure | None
    finished: dict[int, Sequence[Episode]]
    others: dict[Status, list[int]]
    runs_of: str | None = None


class Result(NamedTuple):
    """One cell under one closure rule.

    :param runs: None if there are none
    :param closure: the rule that counts as success; None if it is not known
    :param summary: None without a finished run
    """

    cell: Cell
    runs: CellRuns | None
    closure: Closure | None
    summary: metrics.CellSummary | None

    @property
    def status(self) -> str:
        """``run`` where there are numbers, else what is there instead."""
        if self.runs is None:
            return NOT_RUN
        return "run" if self.summary else ", ".join(status for status in OTHER_STATUSES if self.runs.others[status])

    @property
    def impossible(self) -> bool:
        """Whether the pursuers cannot close the circle alone (Eq. 6), have to under the rule, and never did."""
        return (
            self.summary is not None
            and self.summary.success.mean == 0
            and self.closure == "pursuers"
            and not pursuers_suffice(self.cell.setting)
        )


def gather(runs: Iterable[Run], aliases: Mapping[Cell, Cell]) -> dict[Cell, CellRuns]:
    """Gather the runs of each cell, in the order of the training seeds.

    :param aliases: cell -> the cell whose runs it shares when it has none of its own
    :raises ValueError: when a cell has a duplicate training seed or its runs have different closure rules
    """
    cells: dict[Cell, CellRuns] = {}
    seen = set()
    for run in sorted(runs, key=lambda run: (run.cell, run.seed)):
        if (run.cell, run.seed) in seen:
            raise ValueError(f"{_in_words(run.cell)}: duplicate training seed {run.seed}")
        seen.add((run.cell, run.seed))
        entry = cells.get(run.cell, CellRuns(None, {}, {status: [] for status in OTHER_STATUSES}))
        if None not in (run.closure, entry.closure) and run.closure != entry.closure:
            raise ValueError(f"{_in_words(run.cell)}: its runs have different closure rules")
        if run.status == "finished":
            entry.finished[run.seed] = run.episodes
        else:
            entry.others[run.status].append(run.seed)
        cells[run.cell] = entry._replace(closure=run.closure or entry.closure)
    shared = {cell: owner for cell, owner in aliases.items() if cell not in cells and owner in cells}
    return cells | {cell: cells[owner]._replace(runs_of=owner.method) for cell, owner in shared.items()}


def with_settings_elsewhere(runs: Iterable[Run]) -> list[Run]:
    """Return runs, and what their policies played in other settings of the same scene as runs of those settings."""
    runs = list(runs)
    elsewhere = [(run, setting) for run in runs for setting in run.elsewhere]
    return runs + [run_elsewhere(run, other) for run, other in elsewhere if other.scene == run.cell.setting.scene]


def run_elsewhere(run: Run, setting: Setting) -> Run:
    """Return the rounds that a run's policy played in another setting as those of a run of that setting."""
    return Run(Cell(run.cell.method, setting), run.seed, run.status, run.closure, run.elsewhere[setting])


def result_of(cell: Cell, runs: CellRuns | None, closure: Closure | None = None) -> Result:
    """Summarise a cell.

    :param closure: the rule that counts as success; None is the method's own
    """
    closure = closure or (runs.closure if runs else None)
    summary = metrics.summarise_cell(runs.finished, closure) if runs and runs.finished and closure else None
    return Result(cell, runs, closure, summary)


def absences(cells: Mapping[Cell, CellRuns]) -> dict[Cell, str]:
    """Say why there are no numbers of a cell's own to draw, of the cells of which that is so.

    :param cells: all that have or share runs; any other is not run
    """
    absent = {}
    for cell, runs in cells.items():
        result = result_of(cell, runs)
        if result.summary is None:
            absent[cell] = result.status
        elif runs.runs_of is not None:
            absent[cell] = f"runs of {label(runs.runs_of)}"
    return absent


def pursuers_suffice(setting: Setting) -> bool:
    """Whether the pursuers of a setting can close the circle alone (Eq. 6)."""
    return Scenario(pursuers=setting.pursuers, speed_ratio=setting.speed_ratio).solvable_without_obstacles


def _in_words(cell: Cell) -> str:
    return f"{cell.method} at {cell.setting.symbols}, {cell.setting.scene}"
