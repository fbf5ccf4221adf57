"""How near the study comes to the paper: its numbers, and the order in which it puts the methods."""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import stats

from marl_encircle.experiments.metrics import CONFIDENCE, Difference
from marl_encircle.experiments.records import Cell
from marl_encircle.study.cells import CellRuns, pursuers_suffice, result_of
from marl_encircle.study.differences import paired_success
from marl_encircle.study.paper import LABELS, TABLE_METHODS, PaperResult, label
from marl_encircle.study.typeset import DASH, Styled, Table, Text, markdown, setting_columns, to_csv, with_interval

AGREEMENT_TABLES = ("table_agreement.md", "table_agreement.csv")
PAPER_ROUNDS = 1000
"""Rounds behind each of the paper's numbers: 200 for each of 5 seeds."""

_NUMBERS_HEADER = ["Cells", "Number", "Mean absolute ΔS", "Mean ΔS", "Mean absolute ΔMEL", "Mean ΔMEL"]
_NUMBERS_NOTES: list[Text] = [
    "Δ: this study's number minus the paper's, each method under its own closure rule; S in points, MEL in steps.",
    (
        "Calibrated on: the cells by which the scenario was chosen, and those that show their runs, so that their"
        " nearness shows nothing. Held out: all others for which the paper has a number; the lines below are of these."
    ),
    "ΔMEL is over the cells in which this study has a success.",
]
_ORDER_HEADER = ["λ", "n", "m", "Pair", "Paper", "This study", "Order", "Paper's difference"]
_ORDER_NOTES: list[Text] = [
    (
        "Pairs of methods whose S differs in the paper by more than the noise of its evaluation rounds: 1.96 standard"
        f" errors of the difference of two shares of {PAPER_ROUNDS:,} rounds each. The spread over its training seeds"
        " is not known, so that some of these differences may be chance."
    ),
    (
        "Difference: S of the first minus S of the second, in points; of this study paired by seed and round, with its"
        " 95 % interval. Shown: the interval leaves out zero. Paper's difference: whether it lies within that interval."
    ),
    "A method that shows another's runs is not compared.",
]


class Gap(NamedTuple):
    """What this study's number in a cell is above the paper's.

    :param success: in points
    :param length: in steps; None without a success
    """

    cell: Cell
    success: float
    length: float | None


class Pair(NamedTuple):
    """Two methods in one setting.

    :param paper: S of the first minus S of the second in the paper, in points
    :param ours: the same in this study, shares
    """

    first: Cell
    second: Cell
    paper: float
    ours: Difference

    @property
    def verdict(self) -> str:
        """Whether this study puts them in the paper's order."""
        order = "same" if self.ours.mean * self.paper > 0 else "opposite" if self.ours.mean else "none"
        return order + ("" if self.ours.shown else ", not shown")

    @property
    def place(self) -> str:
        """Where the paper's difference lies; empty where this study's has no interval."""
        if self.ours.interval is None:
            return ""
        low, high = (100 * bound for bound in self.ours.interval)
        return "within" if low <= self.paper <= high else "outside"


def render_agreement(
    runs: Mapping[Cell, CellRuns],
    paper: Mapping[Cell, PaperResult],
    calibrated: Collection[Cell],
    notes: Iterable[Text] = (),
) -> dict[str, str]:
    """Return ``table_agreement.md`` and ``.csv`` -> text; nothing where no cell of the paper has a result.

    :param runs: the runs of each cell
    :param paper: what the paper reports
    :param calibrated: cells by which the scenario was chosen
    :param notes: further ones
    """
    gaps = gaps_of(runs, paper)
    if not gaps:
        return {}
    chosen_by = {gap.cell for gap in gaps if _trained_as(gap.cell, runs) in calibrated}
    numbers = numbers_table(gaps, chosen_by)
    sections = (
        "# How near the study comes to the paper\n",
        markdown(numbers._replace(notes=[*numbers.notes, *notes]), level=2),
        markdown(order_table(pairs_of(runs, paper)), level=2),
    )
    records = [
        {
            "method": gap.cell.method,
            **setting_columns(gap.cell.setting),
            "cell": "calibrated on" if gap.cell in chosen_by else "held out",
            "success_percent_difference": f"{gap.success:.4f}",
            "mean_episode_length_difference": "" if gap.length is None else f"{gap.length:.4f}",
        }
        for gap in gaps
    ]
    return dict(zip(AGREEMENT_TABLES, ("\n".join(sections), to_csv(records)), strict=True))


def gaps_of(runs: Mapping[Cell, CellRuns], paper: Mapping[Cell, PaperResult]) -> list[Gap]:
    """Return the gaps of the cells for which both have a number, in the paper's order."""
    gaps = []
    for cell, (success, length) in paper.items():
        summary = result_of(cell, runs.get(cell)).summary
        if summary is None or success is None or length is None:
            continue
        ours = summary.mean_episode_length
        gaps.append(Gap(cell, 100 * summary.success.mean - success, ours and ours.mean - length))
    return gaps


def pairs_of(runs: Mapping[Cell, CellRuns], paper: Mapping[Cell, PaperResult]) -> Iterator[Pair]:
    """Yield the pairs that differ in the paper by more than its noise and can be compared here, by setting.

    None of them shows another method's runs: that pair is the other method's too.
    """
    settings = dict.fromkeys(cell.setting for cell in paper)
    for setting in sorted(settings):
        for methods in combinations(reversed(TABLE_METHODS), 2):
            first, second = (Cell(method, setting) for method in methods)
            if any(_trained_as(cell, runs) != cell for cell in (first, second)):
                continue
            difference = _papers_difference(paper.get(first), paper.get(second))
            ours = paired_success(*(result_of(cell, runs.get(cell)) for cell in (first, second)))
            if difference is not None and ours is not None:
                yield Pair(first, second, difference, ours)


def numbers_table(gaps: Iterable[Gap], calibrated: Collection[Cell]) -> Table:
    """Return the mean differences to the paper: of the calibrated cells, and of the others, by Eq. 6, by method."""
    gaps = list(gaps)
    held_out = [gap for gap in gaps if gap.cell not in calibrated]
    groups = {
        "calibrated on": [gap for gap in gaps if gap.cell in calibrated],
        "held out": held_out,
        "Eq. 6 holds": [gap for gap in held_out if pursuers_suffice(gap.cell.setting)],
        "Eq. 6 fails": [gap for gap in held_out if not pursuers_suffice(gap.cell.setting)],
        **{LABELS[name]: [gap for gap in held_out if gap.cell.method == name] for name in TABLE_METHODS},
    }
    rows: list[list[Text]] = []
    for name, group in groups.items():
        success = [gap.success for gap in group]
        length = [gap.length for gap in group if gap.length is not None]
        rows.append([name, str(len(group)), *_means(success), *_means(length)])
    return Table("table_agreement", "Numbers", _NUMBERS_HEADER, rows, _NUMBERS_NOTES)


def order_table(pairs: Iterable[Pair]) -> Table:
    """Return the pairs of methods, each with the paper's difference and this study's."""
    pairs = list(pairs)
    rows: list[list[Text]] = [
        [
            *pair.first.setting.numbers,
            f"{label(pair.first.method)} - {label(pair.second.method)}",
            Styled(f"{pair.paper:+.1f}", "italic"),
            "".join(with_interval(pair.ours, 100, "+.1f")),
            pair.verdict,
            pair.place,
        ]
        for pair in pairs
    ]
    counts = "; ".join(f"{n} {verdict}" for verdict, n in sorted(Counter(pair.verdict for pair in pairs).items()))
    outside = sum(pair.place == "outside" for pair in pairs)
    said = (
        f"Order of {len(pairs)} pairs: {counts}. The paper's difference lies outside this study's interval in {outside}"
    )
    summary: list[Text] = [f"{said}." if pairs else "No pair can be compared."]
    return Table("table_order", "Order of the methods", _ORDER_HEADER, rows, [*summary, *_ORDER_NOTES])


def _trained_as(cell: Cell, runs: Mapping[Cell, CellRuns]) -> Cell:
    """Return the cell whose runs a cell shows: its own, or those of a method that it shares them with."""
    found = runs.get(cell)
    return cell._replace(method=found.runs_of) if found and found.runs_of else cell


def _papers_difference(first: PaperResult | None, second: PaperResult | None) -> float | None:
    """Return the paper's difference in S, in points, where it exceeds the noise of its rounds."""
    if first is None or second is None or first.success_percent is None or second.success_percent is None:
        return None
    difference = first.success_percent - second.success_percent
    shares = (first.success_percent / 100, second.success_percent / 100)
    error = math.sqrt(sum(share * (1 - share) for share in shares) / PAPER_ROUNDS)
    return difference if abs(difference) > 100 * stats.norm.ppf(0.5 + CONFIDENCE / 2) * error else None


def _means(values: list[float]) -> tuple[str, str]:
    """Write the mean of the amounts, and the mean."""
    if not values:
        return DASH, DASH
    return f"{np.abs(values).mean():.2f}", f"{np.mean(values):+.2f}"
