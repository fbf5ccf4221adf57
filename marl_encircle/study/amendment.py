"""What an amendment of the study changed: the results before it beside those after it."""

from collections.abc import Iterable, Mapping

from marl_encircle.experiments.records import Cell, Run
from marl_encircle.study.cells import CellRuns, Result, gather, result_of
from marl_encircle.study.differences import paired_success
from marl_encircle.study.paper import by_method, label
from marl_encircle.study.paper_layout import notes_on, success_and_length
from marl_encircle.study.tables import record_of
from marl_encircle.study.typeset import Table, Text, markdown, to_csv, with_interval

AMENDMENT_TABLES = ("table_amendment.md", "table_amendment.csv")

FORMER = "former"
"""Folder beside ``runs/`` that keeps the rounds of trainings from before an amendment, without their policies."""

_TITLE = "Before and after the amendment"
_HEADER = ["Method", "λ", "n", "m", "Before", "After", "After minus before: S, points"]
_NOTES: list[Text] = [
    "Cells: S [95 % interval] / MEL, each method under its own closure rule.",
    "After minus before: paired by training seed and evaluation round, with its 95 % interval.",
]


def render_amendment(
    former: Iterable[Run], runs: Mapping[Cell, CellRuns], notes: Iterable[Text] = ()
) -> dict[str, str]:
    """Return ``table_amendment.md`` and ``.csv`` -> text; nothing where nothing was amended.

    :param former: runs of before the amendment
    :param runs: those of each cell since
    :param notes: further ones
    """
    before = gather(former, {})
    if not before:
        return {}
    cells = by_method(before)
    pairs = [(result_of(cell, before[cell]), result_of(cell, runs.get(cell))) for cell in cells]
    results = [result for pair in pairs for result in pair]
    records = [
        {"amendment": when, **record_of(result, None)}
        for pair in pairs
        for when, result in zip(("before", "after"), pair, strict=True)
    ]
    rows = [_row(*pair) for pair in pairs]
    table = Table("table_amendment", _TITLE, _HEADER, rows, [*_NOTES, *notes_on(results), *notes])
    return dict(zip(AMENDMENT_TABLES, (markdown(table), to_csv(records)), strict=True))


def _row(before: Result, after: Result) -> list[Text]:
    """Write a cell's results in Markdown."""
    method, setting = before.cell
    difference = paired_success(after, before)
    shown = "".join(with_interval(difference, 100, "+.1f")) if difference else ""
    return [label(method), *setting.numbers, success_and_length(before), success_and_length(after), shown]
