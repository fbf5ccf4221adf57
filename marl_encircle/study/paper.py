"""What the paper reports: its methods' names and the numbers of its Tables 2-4."""

import csv
import io
from collections.abc import Iterable
from importlib import resources
from typing import NamedTuple

from marl_encircle.experiments.records import Cell, Setting

LABELS = {
    "ma2019": "Ma",
    "model_a": "Model A",
    "model_b": "Model B",
    "model_c": "Model C",
    "ours": "Ours",
    "ours_plus": "Ours+",
    "generalist": "Ours+, one policy",
}
TABLE_METHODS = ("ma2019", "model_a", "model_b", "ours")
"""Methods of Tables 2-4 in the paper's order."""
PAPER_METHODS = (*TABLE_METHODS, "model_c")
"""All that the paper compares."""
_ORDER = tuple(dict.fromkeys((*PAPER_METHODS, *LABELS)))


class PaperResult(NamedTuple):
    """What the paper reports for a cell; both None where it has a dash: the method cannot enclose the target there."""

    success_percent: float | None
    mean_episode_length: float | None


def paper_results() -> dict[str, dict[Cell, PaperResult]]:
    """Read what the paper reports: ``table2`` to ``table4`` -> cell -> numbers, in the paper's order."""
    data = resources.files("marl_encircle") / "configs" / "paper" / "reported_results.csv"
    tables: dict[str, dict[Cell, PaperResult]] = {}
    for row in csv.DictReader(io.StringIO(data.read_text(encoding="utf-8"))):
        setting = Setting(float(row["speed_ratio"]), int(row["n_pursuers"]), int(row["n_obstacles"]))
        values = (row["success_percent"], row["mean_episode_length"])
        result = PaperResult(*(float(value) if value else None for value in values))
        tables.setdefault(row["table"], {})[Cell(row["method"], setting)] = result
    return tables


def reported_cells() -> dict[Cell, PaperResult]:
    """Return all cells of Tables 2-4, each once; what several tables have is the same in all."""
    return {cell: result for table in paper_results().values() for cell, result in table.items()}


def label(method: str) -> str:
    """Name of a method as the paper writes it; others keep their own."""
    return LABELS.get(method, method)


def by_method(cells: Iterable[Cell]) -> list[Cell]:
    """Sort cells by the rank of their method, then by setting."""
    return sorted(cells, key=lambda cell: (rank(cell.method), cell))


def rank(method: str) -> tuple[int, str]:
    """Sort key of methods: those of Tables 2-4 in the paper's order, Model C, what goes beyond, then others by name."""
    return (_ORDER.index(method) if method in _ORDER else len(_ORDER), method)
