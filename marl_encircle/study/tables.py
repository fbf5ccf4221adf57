"""Tables 1-4 beside the paper's numbers, from run folders; no clocks, so the same runs give the same bytes.

All functions are pure: they take the records of runs and give texts by file name. Markdown and LaTeX have the paper's
layout; CSV has one line for each cell, with all numbers.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments.records import Cell, Run
from marl_encircle.study.cells import OTHER_STATUSES, CellRuns, Result, gather, result_of, with_settings_elsewhere
from marl_encircle.study.differences import difference_table, render_differences
from marl_encircle.study.paper import PaperResult, by_method, label, paper_results, reported_cells
from marl_encircle.study.paper_layout import LAYOUTS, notes_on, seeds_of, success_and_length, wide
from marl_encircle.study.typeset import (
    DASH,
    Styled,
    Table,
    Text,
    estimate_columns,
    latex,
    markdown,
    setting_columns,
    to_csv,
)

OTHER_TABLES = ("table_other.md", "table_other.csv")
"""Of the cells whose settings Tables 2-4 do not have; only where there are such."""

_TABLE1 = "Experimental model options"
_COMMON = "All methods under the common closure rule: pursuers and obstacles"
_OTHER = "Settings that Tables 2-4 do not have"
_OTHER_HEADER = ["Method", "λ", "n", "m", "Scene", "S [95 % interval] / MEL", "Training seeds"]
_CELL_NOTE: Text = (
    "Cells: S [95 % interval] / MEL of this study. Rows ",
    Styled("paper", "italic"),
    ": S / MEL as the paper reports them.",
)
_COMMON_CELL_NOTE = "Cells: S [95 % interval] / MEL of this study; the paper has no such table."
_RULES: dict[Closure, str] = {"pursuers": "pursuers alone", "all": "pursuers and obstacles"}
_COMMON_RULE_NOTE = (
    "S: share of the evaluation rounds in which pursuers and obstacles together enclose the target, in %. Ma and Model"
    " A are trained to enclose it with the pursuers alone."
)


class MethodOptions(NamedTuple):
    """Row of Table 1.

    :param two_stage: the lion's strategy: contraction only once the target is nearly enclosed
    :param obstacle_assisted: obstacles count for the enclosure and are rewarded
    :param individual_contributing_angle: each pursuer is rewarded for its own contributing angle
    """

    two_stage: bool
    obstacle_assisted: bool
    individual_contributing_angle: bool


def render_tables(
    runs: Iterable[Run],
    aliases: Mapping[Cell, Cell] | None = None,
    asked: Iterable[Cell] = (),
    notes: Sequence[str] = (),
) -> dict[str, str]:
    """Tables 2-4, the same results under the common closure rule, the paired differences, and other settings' results.

    :param runs: all runs to show; seeds of one cell are averaged, so give tuning and study seeds apart. A policy that
        has played in other settings of its scene is shown in these too
    :param aliases: cell -> the cell whose runs it shares when it has none of its own
    :param asked: cells that are shown in the paper's settings even if they have no runs
    :param notes: further ones, below those that a table needs
    :return: file name -> text
    :raises ValueError: when a cell has a duplicate training seed or its runs have different closure rules
    """
    shown = _gather(runs, aliases or {}, asked)
    rendered: dict[str, str] = {}
    for name, results in shown.main.items():
        paper = shown.paper[name]
        rendered |= _texts(_main_table(name, results, paper, notes))
        rendered[f"{name}.csv"] = to_csv([record_of(result, paper.get(result.cell)) for result in results])
    rendered |= _common_table(shown.cells, shown.runs, shown.paper, notes)
    if shown.other:
        records = [record_of(result, None) for result in shown.other]
        rendered |= zip(OTHER_TABLES, (markdown(_other_table(shown.other, notes)), to_csv(records)), strict=True)
    return rendered | render_differences(shown.cells, shown.runs, notes)


def render_table1(options: Mapping[str, MethodOptions], notes: Sequence[str] = ()) -> dict[str, str]:
    """Table 1: what each model has, from its resolved reward config.

    :param options: method -> its options, in the order of the rows
    :param notes: further ones
    :return: file name -> text
    """
    records = [
        {"method": method, **{name: "yes" if has else "no" for name, has in row._asdict().items()}}
        for method, row in options.items()
    ]
    return {**_texts(table1(options, notes)), "table1.csv": to_csv(records)}


def table1(options: Mapping[str, MethodOptions], notes: Sequence[str] = ()) -> Table:
    """Table 1 as a table; see :func:`render_table1`."""
    rows = [[label(method), *("✓" if has else "" for has in row)] for method, row in options.items()]
    header = ["Model", "Lion encirclement", "Obstacle-assisted", "Individual contributing angle"]
    return Table("table1", _TABLE1, header, rows, notes)


def main_tables(
    runs: Iterable[Run], aliases: Mapping[Cell, Cell], asked: Iterable[Cell], notes: Sequence[str] = ()
) -> list[Table]:
    """Tables 2-4 and, where there are any, the results of other settings; then the paired differences.

    What is in them is what :func:`render_tables` writes, whose parameters these are.
    """
    shown = _gather(runs, aliases, asked)
    tables = [_main_table(name, results, shown.paper[name], notes) for name, results in shown.main.items()]
    if shown.other:
        tables.append(_other_table(shown.other, notes))
    return [*tables, difference_table(shown.cells, shown.runs, notes)]


class _Shown(NamedTuple):
    """What the tables show.

    :param runs: the runs of each cell
    :param paper: what the paper reports, by table
    :param cells: all cells in the paper's settings, in the order of the rows
    :param main: those of each of the paper's tables, under each method's own closure rule
    :param other: cells of other settings
    """

    runs: dict[Cell, CellRuns]
    paper: dict[str, dict[Cell, PaperResult]]
    cells: list[Cell]
    main: dict[str, list[Result]]
    other: list[Result]


def _gather(runs: Iterable[Run], aliases: Mapping[Cell, Cell], asked: Iterable[Cell]) -> _Shown:
    by_cell, paper = gather(with_settings_elsewhere(runs), aliases), paper_results()
    cells = _ordered({cell for table in paper.values() for cell in table}, {*by_cell, *asked})
    main = {
        name: [result_of(cell, by_cell.get(cell)) for cell in _ordered(table, cells)] for name, table in paper.items()
    }
    other = [result_of(cell, by_cell[cell]) for cell in by_method(by_cell.keys() - set(cells))]
    return _Shown(by_cell, paper, cells, main, other)


def _texts(table: Table) -> dict[str, str]:
    """Write one of the paper's tables in Markdown and LaTeX."""
    return {f"{table.name}.md": markdown(table), f"{table.name}.tex": latex(table)}


def freeze_notes(frozen: str | None, amended: str | None = None) -> list[str]:
    """Return the notes on the commit in which scenario and recipe were frozen, and on what has changed since, if any.

    :param amended: what has changed, and where both results are
    """
    notes = [] if frozen is None else [f"Scenario and recipe frozen in commit {frozen[:12]}."]
    return notes if amended is None else [*notes, f"Amended since: {amended}"]


def _ordered(paper: Iterable[Cell], others: Iterable[Cell]) -> list[Cell]:
    """Sort the paper's cells and the other ones that are in the same settings."""
    paper = set(paper)
    settings = {cell.setting for cell in paper}
    return by_method(paper | {cell for cell in others if cell.setting in settings})


def _main_table(name: str, results: Sequence[Result], paper: Mapping[Cell, PaperResult], more: Sequence[str]) -> Table:
    """One of Tables 2-4, each method under its own closure rule."""
    layout = LAYOUTS[name]
    header, rows, behind = wide(layout, results, paper)
    notes = [_CELL_NOTE, _own_rule_note(results), *notes_on(results, paper, columns_compete=True), *behind, *more]
    return Table(name, layout.title, header, rows, notes)


def _common_table(
    cells: Sequence[Cell],
    runs: Mapping[Cell, CellRuns],
    reported: Mapping[str, Mapping[Cell, PaperResult]],
    more: Sequence[str],
) -> dict[str, str]:
    """All cells of Tables 2-4 under the common closure rule."""
    results = [result_of(cell, runs.get(cell), "all") for cell in cells]
    notes = [_COMMON_CELL_NOTE, _COMMON_RULE_NOTE, *notes_on(results, columns_compete=True), *more]
    sections = [f"# {_COMMON}\n\n" + "".join(f"- {note}\n" for note in notes)]
    for name, paper in reported.items():
        settings = {cell.setting for cell in paper}
        layout = LAYOUTS[name]
        header, rows, behind = wide(layout, [result for result in results if result.cell.setting in settings], {})
        sections.append(markdown(Table("table_common_rule", layout.title, header, rows, behind), level=2))
    every = reported_cells()
    return {
        "table_common_rule.md": "\n".join(sections),
        "table_common_rule.csv": to_csv([record_of(result, every.get(result.cell)) for result in results]),
    }


def _other_table(results: Sequence[Result], more: Sequence[str]) -> Table:
    """Cells of other settings, a line for each."""
    rows = [
        [
            label(result.cell.method) + (f" (runs of {label(owner)})" if (owner := _owner(result)) else ""),
            *result.cell.setting.numbers,
            result.cell.setting.scene,
            success_and_length(result),
            seeds_of(result),
        ]
        for result in results
    ]
    notes = [_own_rule_note(results), *notes_on(results), *more]
    return Table("table_other", _OTHER, _OTHER_HEADER, rows, notes)


def _own_rule_note(results: Sequence[Result]) -> str:
    """Say what S is, and whose rule is which."""
    own = [result for result in results if _owner(result) is None]
    parts = []
    for closure, rule in _RULES.items():
        names = list(dict.fromkeys(label(result.cell.method) for result in own if result.closure == closure))
        if names:
            parts.append(f"{rule}: {' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)}")
    rules = f" ({'; '.join(parts)})" if parts else ""
    return f"S: share of the evaluation rounds that end enclosed, in %, each method under its own closure rule{rules}."


def _owner(result: Result) -> str | None:
    """Name the method whose runs these are, if not the cell's own."""
    return result.runs.runs_of if result.runs else None


def record_of(result: Result, paper: PaperResult | None) -> dict[str, str]:
    """Write a cell in CSV: empty where there is nothing."""
    summary, runs = result.summary, result.runs
    # sigma_c is recorded under the method's own rule, up to its own success: the other rule has none.
    own = summary if runs and result.closure == runs.closure else None
    return {
        "method": result.cell.method,
        **setting_columns(result.cell.setting),
        "closure": result.closure or "",
        "result": result.status,
        **estimate_columns("success_percent", summary and summary.success, 100),
        **estimate_columns("mean_episode_length", summary and summary.mean_episode_length, 1),
        **estimate_columns("sigma_c", own and own.sigma_c, 1),
        **estimate_columns("sigma_c_solved", own and own.sigma_c_solved, 1),
        "seeds": str(len(runs.finished) if runs else 0),
        "training_seeds": " ".join(map(str, runs.finished)) if runs else "",
        **{status.replace(" ", "_"): str(len(runs.others[status]) if runs else 0) for status in OTHER_STATUSES},
        "runs_of": _owner(result) or "",
        "paper_success_percent": _paper_number(paper, paper and paper.success_percent),
        "paper_mean_episode_length": _paper_number(paper, paper and paper.mean_episode_length),
    }


def _paper_number(paper: PaperResult | None, value: float | None) -> str:
    """Write the paper's number, its dash, or nothing where it does not have the cell."""
    if paper is None:
        return ""
    return DASH if value is None else f"{value:.2f}"
