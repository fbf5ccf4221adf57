"""Which method is better: paired differences over the training seeds and evaluation rounds that two methods share."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments import metrics
from marl_encircle.experiments.metrics import Difference
from marl_encircle.experiments.records import Cell
from marl_encircle.study.cells import NOT_RUN, CellRuns, Result
from marl_encircle.study.paper import PAPER_METHODS, label
from marl_encircle.study.typeset import Table, estimate_columns, markdown, setting_columns, to_csv, with_interval

_HEADER = ["Other method", "λ", "n", "m", "Closure ours / other", "S, points", "MEL, steps", "sigma_c, rad", "Seeds"]
_NOTES = [
    (
        "Ours minus the other method, paired by training seed and evaluation round; MEL over the rounds that both"
        " solve, sigma_c over all rounds, each up to the method's own success."
    ),
    "In brackets: 95 % interval of the mean over the common training seeds; one seed has none.",
    "No difference shown: the interval covers zero. The intervals are each for itself.",
]


class _Row(NamedTuple):
    """Ours minus another method in one setting.

    :param own_rules: whether each method is under its own closure rule; only then there is a sigma_c
    :param reason: why there is nothing to compare
    """

    cell: Cell
    own_rules: bool
    closure_ours: Closure | None
    closure_other: Closure | None
    success: Difference | None
    length: Difference | None
    sigma: Difference | None
    reason: str | None


def render_differences(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns], notes: Sequence[str]) -> dict[str, str]:
    """Ours minus every other method, under each one's own rule and, where that differs, under the common one.

    :param cells: the cells to compare, in the order of the rows; those of Ours are passed over
    :param notes: further ones
    :return: ``table_differences.md`` and ``.csv`` -> text
    """
    rows = _all_rows(cells, runs)
    table = _table(rows, notes)
    return {
        "table_differences.md": markdown(table),
        "table_differences.csv": to_csv([_record(row) for row in rows]),
    }


def difference_table(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns], notes: Sequence[str]) -> Table:
    """Return as a table the rows of :func:`render_differences` in which both methods have runs; others are counted."""
    rows = _all_rows(cells, runs)
    there = [row for row in rows if row.reason != NOT_RUN]
    missing = len(rows) - len(there)
    left_out = [f"Rows left out in which one of the two is not run: {missing}."] if missing else []
    return _table(there, [*notes, *left_out])


def _table(rows: Sequence[_Row], notes: Sequence[str]) -> Table:
    shown = [_shown(row) for row in rows]
    return Table("table_differences", "Ours minus the others", _HEADER, shown, [*_NOTES, _corrected(rows), *notes])


def outstanding(column: Iterable[Result]) -> set[Cell]:
    """Return the cells whose S is shown to be higher than that of each of the paper's other methods.

    Cells without a result, and those in which success is impossible, are passed over.

    :param column: cells of one setting
    """
    results = [result for result in column if result.summary and not result.impossible]
    papers = [result for result in results if result.cell.method in PAPER_METHODS]
    found = set()
    for result in results:
        others = [other for other in papers if other.cell != result.cell]
        if others and all(_is_higher(result, other) for other in others):
            found.add(result.cell)
    return found


def _is_higher(first: Result, second: Result) -> bool:
    """Whether the paired difference in S, each under its rule, has an interval above zero."""
    difference = paired_success(first, second)
    return difference is not None and difference.verdict == "higher"


def _all_rows(cells: Iterable[Cell], runs: Mapping[Cell, CellRuns]) -> list[_Row]:
    return [row for cell in cells if cell.method != "ours" for row in _rows(cell, runs)]


def _rows(cell: Cell, runs: Mapping[Cell, CellRuns]) -> Iterator[_Row]:
    ours, other = runs.get(Cell("ours", cell.setting)), runs.get(cell)
    reason = why_incomparable(ours, other)
    if reason is not None or ours is None or other is None or ours.closure is None or other.closure is None:
        yield _Row(cell, True, None, None, None, None, None, reason)
        return
    sigma = metrics.sigma_difference(ours.finished, other.finished)
    rules: list[tuple[Closure, Closure]] = [(ours.closure, other.closure)]
    if rules != [("all", "all")]:
        rules.append(("all", "all"))
    for closures in rules:
        success = metrics.success_difference(ours.finished, other.finished, *closures)
        length = metrics.length_difference(ours.finished, other.finished, *closures)
        own = closures == rules[0]
        yield _Row(cell, own, *closures, success, length, sigma if own else None, None)


def paired_success(first: Result, second: Result) -> Difference | None:
    """Return S of the first minus S of the second, each under its result's rule; None where nothing is common."""
    if first.runs is None or second.runs is None or first.closure is None or second.closure is None:
        return None
    if why_incomparable(first.runs, second.runs) is not None:
        return None
    return metrics.success_difference(first.runs.finished, second.runs.finished, first.closure, second.closure)


def why_incomparable(first: CellRuns | None, second: CellRuns | None) -> str | None:
    """Return why two cells cannot be compared, None if they can."""
    if first is None or second is None:
        return NOT_RUN
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
        return [*cells, "", row.reason or "", "", "", ""]
    return [
        *cells,
        f"{row.closure_ours} / {row.closure_other}",
        _with_verdict(row.success, 100),
        _with_verdict(row.length, 1) if row.length else "no round both solve",
        _with_verdict(row.sigma, 1, "+.3f") if row.sigma else "",
        str(row.success.seeds),
    ]


def _with_verdict(difference: Difference, scale: float, form: str = "+.2f") -> str:
    return f"{''.join(with_interval(difference, scale, form))}: {difference.verdict}"


def _corrected(rows: Iterable[_Row]) -> str:
    """Name the differences in S that are shown if all comparisons under the methods' own rules are taken together."""
    compared = [(row, p) for row in rows if row.own_rules and row.success and (p := row.success.p_value) is not None]
    rejected = metrics.holm([p for _, p in compared])
    shown: dict[str, list[str]] = {}
    for (row, _), is_shown in zip(compared, rejected, strict=True):
        if is_shown:
            shown.setdefault(label(row.cell.method), []).append(row.cell.setting.symbols)
    names = ", ".join(f"{method} ({'; '.join(settings)})" for method, settings in shown.items())
    return (
        f"Corrected for all {len(compared)} comparisons of S with an interval, each under the methods' own rules, by"
        f" Holm's procedure, a difference stays shown from {names or 'none'}."
    )


def _record(row: _Row) -> dict[str, str]:
    """Write a row in CSV: empty where there is nothing."""
    return {
        "method": row.cell.method,
        **setting_columns(row.cell.setting),
        "closure_ours": row.closure_ours or "",
        "closure_other": row.closure_other or "",
        "result": row.reason or "compared",
        **estimate_columns("success_percent_difference", row.success, 100),
        "success_verdict": row.success.verdict if row.success else "",
        **estimate_columns("length_difference", row.length, 1),
        "length_verdict": row.length.verdict if row.length else "",
        **estimate_columns("sigma_c_difference", row.sigma, 1),
        "sigma_c_verdict": row.sigma.verdict if row.sigma else "",
        "seeds": str(row.success.seeds if row.success else 0),
    }
