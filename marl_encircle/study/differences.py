"""Which method is better: paired differences over the training seeds and evaluation rounds that two methods share."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments import metrics
from marl_encircle.experiments.metrics import Difference
from marl_encircle.experiments.records import Cell
from marl_encircle.study.cells import CellRuns, Result
from marl_encircle.study.paper import label
from marl_encircle.study.typeset import Table, estimate_columns, markdown, setting_columns, to_csv, with_interval

_HEADER = ["Other method", "λ", "n", "m", "Closure ours / other", "S, points", "MEL, steps", "Seeds"]
_NOTES = [
    "Ours minus the other method, paired by training seed and evaluation round; MEL over the rounds that both solve.",
    "In brackets: 95 % interval of the mean over the common training seeds; one seed has none.",
    "No difference shown: the interval covers zero. The intervals are not corrected for the number of comparisons.",
]


class _Row(NamedTuple):
    """Ours minus another method in one setting, or why there is nothing to compare."""

    cell: Cell
    closure_ours: Closure | None
    closure_other: Closure | None
    success: Difference | None
    length: Difference | None
    nothing: str | None


def render_differences(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns], notes: Sequence[str]) -> dict[str, str]:
    """Ours minus every other method, under each one's own rule and, where that differs, under the common one.

    :param cells: the cells to compare, in the order of the rows; those of Ours are passed over
    :param notes: further ones
    :return: ``table_differences.md`` and ``.csv`` -> text
    """
    cells = list(cells)
    table = difference_table(cells, runs, notes)
    return {
        "table_differences.md": markdown(table.title, table.header, table.rows, table.notes),
        "table_differences.csv": to_csv([_record(row) for row in _all_rows(cells, runs)]),
    }


def difference_table(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns], notes: Sequence[str]) -> Table:
    """Return the paired differences of Ours to every other method as a table; see :func:`render_differences`."""
    shown = [_shown(row) for row in _all_rows(cells, runs)]
    return Table("table_differences", "Ours minus the others", _HEADER, shown, [*_NOTES, *notes])


def best(column: Iterable[Result]) -> Result | None:
    """Return the cell with the highest S if it is shown to be higher than each of the others, else None.

    Cells without a result, and those in which success is impossible, do not compete.

    :param column: cells of one setting
    """
    rivals = [result for result in column if result.summary and not result.impossible]
    if len(rivals) < 2:
        return None
    first, *others = sorted(rivals, key=_success, reverse=True)
    return first if all(_is_higher(first, other) for other in others) else None


def _success(result: Result) -> float:
    return result.summary.success.mean if result.summary else 0.0


def _is_higher(first: Result, second: Result) -> bool:
    """Whether the paired difference in S, each under its rule, has an interval above zero."""
    difference = paired_success(first, second)
    return difference is not None and difference.verdict == "higher"


def _all_rows(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns]) -> list[_Row]:
    return [row for cell in cells if cell.method != "ours" for row in _rows(cell, runs)]


def _rows(cell: Cell, runs: Mapping[Cell, CellRuns]) -> Iterator[_Row]:
    ours, other = runs.get(Cell("ours", cell.setting)), runs.get(cell)
    nothing = nothing_to_compare(ours, other)
    if nothing is not None or ours is None or other is None or ours.closure is None or other.closure is None:
        yield _Row(cell, None, None, None, None, nothing)
        return
    rules: list[tuple[Closure, Closure]] = [(ours.closure, other.closure)]
    if rules != [("all", "all")]:
        rules.append(("all", "all"))
    for closures in rules:
        success = metrics.success_difference(ours.finished, other.finished, *closures)
        length = metrics.length_difference(ours.finished, other.finished, *closures)
        yield _Row(cell, *closures, success, length, None)


def paired_success(first: Result, second: Result) -> Difference | None:
    """Return S of the first minus S of the second, each under its result's rule; None where nothing is common."""
    if first.runs is None or second.runs is None or first.closure is None or second.closure is None:
        return None
    if nothing_to_compare(first.runs, second.runs) is not None:
        return None
    return metrics.success_difference(first.runs.finished, second.runs.finished, first.closure, second.closure)


def nothing_to_compare(first: CellRuns | None, second: CellRuns | None) -> str | None:
    """Why two cells cannot be compared; None if they can."""
    if first is None or second is None:
        return "not run"
    if not first.finished or not second.finished:
        return "no finished run"
    if first.finished is second.finished:
        return "the same runs"
    common = first.finished.keys() & second.finished.keys()
    if not common:
        return "no common training seed"
    if not all(metrics.same_rounds(first.finished[seed], second.finished[seed]) for seed in common):
        return "not evaluated on the same rounds"
    return None


def _shown(row: _Row) -> list[str]:
    """Write a row in Markdown."""
    cells = [label(row.cell.method), *row.cell.setting.numbers]
    if row.success is None:
        return [*cells, "", row.nothing or "", "", ""]
    return [
        *cells,
        f"{row.closure_ours} / {row.closure_other}",
        _with_verdict(row.success, 100),
        _with_verdict(row.length, 1) if row.length else "no round both solve",
        str(row.success.seeds),
    ]


def _with_verdict(difference: Difference, scale: float) -> str:
    return f"{''.join(with_interval(difference, scale, '+.2f'))}: {difference.verdict}"


def _record(row: _Row) -> dict[str, str]:
    """Write a row in CSV: empty where there is nothing."""
    return {
        "method": row.cell.method,
        **setting_columns(row.cell.setting),
        "closure_ours": row.closure_ours or "",
        "closure_other": row.closure_other or "",
        "result": row.nothing or "compared",
        **estimate_columns("success_percent_difference", row.success, 100),
        "success_verdict": row.success.verdict if row.success else "",
        **estimate_columns("length_difference", row.length, 1),
        "length_verdict": row.length.verdict if row.length else "",
        "seeds": str(row.success.seeds if row.success else 0),
    }
