"""The layout of the paper's Tables 2-4: a row for each method, a column for each setting, the paper's row below."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.study.cells import Result
from marl_encircle.study.differences import outstanding
from marl_encircle.study.paper import PaperResult, label
from marl_encircle.study.typeset import DASH, Styled, Text, with_interval

_LENGTH_NOTE = "MEL: mean length of the successful rounds, in steps. Its intervals are in the CSV file."
_INTERVAL_NOTE = (
    "Interval: of the mean over training seeds (Student's t, at least as wide as the noise of the evaluation rounds)."
    " One seed has no interval."
)
_BOLD_NOTE = (
    "Bold: an S whose paired difference (same training seeds and rounds) to each of the paper's other methods with a"
    " number there has a 95 % interval above zero. These intervals are not corrected for the number of comparisons. MEL"
    " is never bold; table_differences compares it."
)
_IMPOSSIBLE_NOTE = (
    f"{DASH}: the method has to enclose the target with the pursuers alone, who are too few there (Eq. 6). In brackets:"
    " the S that was measured."
)
_PAPERS_DASH_NOTE: Text = (
    f"{DASH} in the rows ",
    Styled("paper", "italic"),
    ": the paper says that the method cannot enclose the target there.",
)
_NOT_RUN_NOTE = "Not run: there is no such run here."
_NOT_ASKED_NOTE = "Empty: the grid does not ask for it."
_OTHERS_NOTE = "Diverged, unfinished and not evaluated runs are counted, and are not in the means."


class Layout(NamedTuple):
    """What a table varies over its columns."""

    title: str
    symbol: str
    field: str

    def head(self, *settings: Setting) -> str:
        """Return the head of a column, or in a note the name of several."""
        return f"{self.symbol} = {', '.join(f'{getattr(setting, self.field):g}' for setting in settings)}"


LAYOUTS = {
    "table2": Layout("The performance under different speed ratios (n = 3, m = 1)", "λ", "speed_ratio"),
    "table3": Layout("The performance under different numbers of pursuers (λ = 1.1, m = 1)", "n", "pursuers"),
    "table4": Layout("The performance under different numbers of obstacles (λ = 1.1, n = 3)", "m", "obstacles"),
}


class Wide(NamedTuple):
    """A table in the paper's layout."""

    header: list[str]
    rows: list[list[Text]]
    notes: list[str]
    """On the runs behind the numbers."""


def wide(layout: Layout, results: Sequence[Result], paper: Mapping[Cell, PaperResult]) -> Wide:
    """Lay out the results of some methods in some settings.

    :param results: in the order of the rows; every setting of any is a column
    :param paper: what the paper reports, below the methods that it has; empty for no such rows
    """
    at = {result.cell: result for result in results}
    settings = sorted({cell.setting for cell in at})
    columns = ([result for result in results if result.cell.setting == setting] for setting in settings)
    bold = set().union(*map(outstanding, columns))
    rows: list[list[Text]] = []
    for method in dict.fromkeys(cell.method for cell in at):
        cells = [Cell(method, setting) for setting in settings]
        texts = [success_and_length(at[cell], cell in bold) if cell in at else "" for cell in cells]
        rows.append([label(method), *texts])
        if any(cell in paper for cell in cells):
            papers = [_papers(paper[cell]) if cell in paper else "" for cell in cells]
            rows.append([Styled(text, "italic") if text else "" for text in ("paper", *papers)])
    notes = _seeds_notes(layout, results)
    if len(at) < len(settings) * len({cell.method for cell in at}):
        notes.append(_NOT_ASKED_NOTE)
    return Wide(["Method", *map(layout.head, settings)], rows, notes)


def success_and_length(result: Result, bold: bool = False) -> Text:
    """``S [low, high] / MEL``, or what stands in their place.

    :param bold: whether S stands out
    """
    if result.summary is None:
        return result.status
    if result.impossible:
        return f"{DASH} (0.0)"
    success, interval = with_interval(result.summary.success, 100, ".1f")
    length = result.summary.mean_episode_length
    rest = f"{interval} / {length.mean:.1f}" if length else f"{interval} / no success"
    return (Styled(success, "bold"), rest) if bold else success + rest


def seeds_of(result: Result) -> str:
    """How many seeds the numbers of a cell are from, which ones, and what became of the others."""
    if result.runs is None:
        return ""
    finished, summary = result.runs.finished, result.summary
    parts = [_counted("seed" if len(finished) == 1 else "seeds", finished) if finished else "no finished run"]
    rounds = sorted({len(episodes) for episodes in finished.values()})
    if rounds:
        parts[0] += f" of {' or '.join(map(str, rounds))} rounds"
    parts += [_counted(status, seeds) for status, seeds in result.runs.others.items() if seeds]
    if summary and summary.mean_episode_length and summary.mean_episode_length.seeds < summary.success.seeds:
        parts.append(f"MEL from the {summary.mean_episode_length.seeds} with a success")
    return ", ".join(parts)


def notes_on(
    results: Iterable[Result], paper: Mapping[Cell, PaperResult] | None = None, *, columns_compete: bool = False
) -> list[Text]:
    """Return the notes that such a table needs whatever its closure rule: on the numbers, and on the signs it has.

    :param paper: what the paper reports, where the table shows it
    :param columns_compete: whether what stands out in a column is bold
    """
    results, paper = list(results), paper or {}
    notes: list[Text] = [_LENGTH_NOTE, _INTERVAL_NOTE, *([_BOLD_NOTE] if columns_compete else [])]
    if any(result.impossible for result in results):
        notes.append(_IMPOSSIBLE_NOTE)
    if any(reported.success_percent is None for reported in paper.values()):
        notes.append(_PAPERS_DASH_NOTE)
    if any(result.runs is None for result in results):
        notes.append(_NOT_RUN_NOTE)
    if any(result.runs and any(result.runs.others.values()) for result in results):
        notes.append(_OTHERS_NOTE)
    return notes


def _papers(reported: PaperResult) -> str:
    """``S / MEL`` as the paper has it."""
    if reported.success_percent is None or reported.mean_episode_length is None:
        return DASH
    return f"{reported.success_percent:.2f} / {reported.mean_episode_length:.2f}"


def _seeds_notes(layout: Layout, results: Sequence[Result]) -> list[str]:
    """Say once what most cells have, then name those that differ, then those whose runs are another's."""
    told = [(result.cell, seeds_of(result)) for result in results if result.runs]
    if not told:
        return []
    usual = Counter(text for _, text in told).most_common(1)[0][0]
    unusual: dict[str, list[Cell]] = {}
    shared: dict[str, list[Cell]] = {}
    for cell, text in told:
        if text != usual:
            unusual.setdefault(text, []).append(cell)
    for result in results:
        if result.runs and result.runs.runs_of:
            shared.setdefault(result.runs.runs_of, []).append(result.cell)
    parts = [usual, *(f"{text} for {_places(layout, cells)}" for text, cells in unusual.items())]
    return [
        f"Behind each number: {'; '.join(parts)}.",
        *(f"The runs of {label(owner)} are shown for {_places(layout, cells)} too." for owner, cells in shared.items()),
    ]


def _places(layout: Layout, cells: Iterable[Cell]) -> str:
    """Name cells by method and columns."""
    columns: dict[str, list[Setting]] = {}
    for cell in cells:
        columns.setdefault(cell.method, []).append(cell.setting)
    return " and ".join(f"{label(method)} at {layout.head(*settings)}" for method, settings in columns.items())


def _counted(what: str, seeds: Iterable[int]) -> str:
    seeds = list(seeds)
    return f"{len(seeds)} {what} ({' '.join(map(str, seeds))})"
