"""Tables 1-4 beside the paper's numbers, from run folders; no clocks, so the same runs give the same bytes.

All functions are pure: they take the records of runs and give texts by file name.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from typing import NamedTuple

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments import metrics
from marl_encircle.experiments.metrics import Difference, Estimate
from marl_encircle.experiments.records import Cell, Episode, Run, Setting, Status

LABELS = {"ma2019": "Ma", "model_a": "Model A", "model_b": "Model B", "model_c": "Model C", "ours": "Ours"}
TABLE_METHODS = ("ma2019", "model_a", "model_b", "ours")
"""Methods of Tables 2-4 in the paper's order; others follow by name."""

TITLES = {
    "table2": "Table 2: The performance under different speed ratios",
    "table3": "Table 3: The performance under different numbers of pursuers",
    "table4": "Table 4: The performance under different numbers of obstacles",
    "table_common_rule": "All methods under the common closure rule: pursuers and obstacles",
}
OTHER_TABLES = ("table_other.md", "table_other.csv")
"""Of the cells that Tables 2-4 have no row for; only where there are such."""
DASH = "–"  # noqa: RUF001 - the paper's own sign
OTHER_STATUSES: tuple[Status, ...] = ("diverged", "unfinished", "not evaluated")
_INTERVAL_NOTE = (
    "Brackets: 95 % interval of the mean over training seeds (Student's t, at least as wide as the noise of the"
    " evaluation rounds). One seed has no interval."
)
_SHARE_NOTE = "S %: share of the evaluation rounds that end enclosed."
_LENGTH_NOTE = "MEL: mean length of the successful rounds, in steps."
_COUNTED_NOTE = "Diverged, unfinished and not evaluated runs are counted, and are not in the means."
_RESULT_HEADER = ["Method", "λ", "n", "m", "S %", "MEL", "Paper S % / MEL", "Seeds"]
_RESULT_NOTES = [
    _SHARE_NOTE,
    "Closure: Tables 2-4 take each method's own rule (Ma and Model A: pursuers alone; others: pursuers and obstacles).",
    _LENGTH_NOTE,
    _INTERVAL_NOTE,
    f"{DASH}: the paper says that the method cannot enclose the target there. Not run: there is no such run here.",
    _COUNTED_NOTE,
]
_OTHER_HEADER = [*_RESULT_HEADER[:4], "Scene", *_RESULT_HEADER[4:]]
_OTHER_NOTES = [_SHARE_NOTE, "Closure: each method's own rule.", _LENGTH_NOTE, _INTERVAL_NOTE, _COUNTED_NOTE]
_DIFFERENCE_HEADER = ["Other method", "λ", "n", "m", "Closure ours / other", "S, points", "MEL, steps", "Seeds"]
_DIFFERENCE_NOTES = [
    "Ours minus the other method, paired by training seed and evaluation round; MEL over the rounds that both solve.",
    _INTERVAL_NOTE,
    "No difference shown: the interval covers zero.",
]


class PaperResult(NamedTuple):
    """What the paper reports for a cell; both None where it has a dash: the method cannot enclose the target there."""

    success_percent: float | None
    mean_episode_length: float | None


class MethodOptions(NamedTuple):
    """Row of Table 1.

    :param two_stage: the lion's strategy: contraction only once the target is nearly enclosed
    :param obstacle_assisted: obstacles count for the enclosure and are rewarded
    :param individual_contributing_angle: each pursuer is rewarded for its own contributing angle
    """

    two_stage: bool
    obstacle_assisted: bool
    individual_contributing_angle: bool


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


def render_tables(runs: Iterable[Run], aliases: Mapping[Cell, Cell] | None = None) -> dict[str, str]:
    """Tables 2-4, the same results under the common closure rule, the paired differences, and other settings' results.

    :param runs: all runs to show; seeds of one cell are averaged, so give tuning and study seeds apart
    :param aliases: cell -> the cell whose runs it shares when it has none of its own
    :return: file name -> text, each table as Markdown and CSV
    :raises ValueError: when a cell has a duplicate training seed or its runs have different closure rules
    """
    results = _by_cell(runs, aliases or {})
    paper = paper_results()
    every = {cell: result for table in paper.values() for cell, result in table.items()}
    rendered = {}
    for name, title in TITLES.items():
        cells = paper.get(name, every)
        closure: Closure | None = "all" if name == "table_common_rule" else None
        rows = [_result_row(cell, results.get(cell), cells.get(cell), closure) for cell in _ordered(cells, results)]
        rendered[f"{name}.md"] = markdown(title, _RESULT_HEADER, [_result_cells(row) for row in rows], _RESULT_NOTES)
        rendered[f"{name}.csv"] = _csv([_result_record(row) for row in rows])
    others = _by_method(results.keys() - set(_ordered(every, results)))
    if others:
        rows = [_result_row(cell, results[cell], None, None) for cell in others]
        title = "Settings that Tables 2-4 do not have"
        rendered["table_other.md"] = markdown(title, _OTHER_HEADER, [_other_cells(row) for row in rows], _OTHER_NOTES)
        rendered["table_other.csv"] = _csv([_result_record(row) for row in rows])
    differences = list(_difference_rows(every, results))
    rendered["table_differences.md"] = markdown(
        "Ours minus the others", _DIFFERENCE_HEADER, [_difference_cells(row) for row in differences], _DIFFERENCE_NOTES
    )
    rendered["table_differences.csv"] = _csv([_difference_record(row) for row in differences])
    return rendered


def render_table1(options: Mapping[str, MethodOptions]) -> dict[str, str]:
    """Table 1: what each model has, from its resolved reward config.

    :param options: method -> its options, in the order of the rows
    :return: ``table1.md`` -> text
    """
    rows = [[label(method), *("✓" if has else "" for has in row)] for method, row in options.items()]
    header = ["Model", "Lion encirclement", "Obstacle-assisted", "Individual contributing angle"]
    return {"table1.md": markdown("Table 1: Experimental model options", header, rows, [])}


def label(method: str) -> str:
    """Name of a method as the paper writes it; others keep their own."""
    return LABELS.get(method, method)


class _CellRuns(NamedTuple):
    """The runs of one cell: the finished ones' rounds by training seed, the others' seeds by what became of them."""

    closure: Closure | None
    finished: dict[int, Sequence[Episode]]
    others: dict[Status, list[int]]
    runs_of: str | None = None

    @property
    def in_words(self) -> str:
        """What is there when there is no number to show."""
        return ", ".join(status for status in OTHER_STATUSES if self.others[status])


class _ResultRow(NamedTuple):
    """One cell of Tables 2-4."""

    cell: Cell
    runs: _CellRuns | None
    closure: Closure | None
    summary: metrics.CellSummary | None
    paper: PaperResult | None


class _DifferenceRow(NamedTuple):
    """Ours minus another method in one setting, or why there is nothing to compare."""

    cell: Cell
    closure_ours: Closure | None
    closure_other: Closure | None
    success: Difference | None
    length: Difference | None
    nothing: str | None


def _by_cell(runs: Iterable[Run], aliases: Mapping[Cell, Cell]) -> dict[Cell, _CellRuns]:
    """Gather the runs of each cell, in the order of the training seeds."""
    results: dict[Cell, _CellRuns] = {}
    seen = set()
    for run in sorted(runs, key=lambda run: (run.cell, run.seed)):
        if (run.cell, run.seed) in seen:
            raise ValueError(f"{_in_words(run.cell)}: duplicate training seed {run.seed}")
        seen.add((run.cell, run.seed))
        entry = results.get(run.cell, _CellRuns(None, {}, {status: [] for status in OTHER_STATUSES}))
        if None not in (run.closure, entry.closure) and run.closure != entry.closure:
            raise ValueError(f"{_in_words(run.cell)}: its runs have different closure rules")
        if run.status == "finished":
            entry.finished[run.seed] = run.episodes
        else:
            entry.others[run.status].append(run.seed)
        results[run.cell] = entry._replace(closure=run.closure or entry.closure)
    shared = {cell: target for cell, target in aliases.items() if cell not in results and target in results}
    return results | {cell: results[target]._replace(runs_of=target.method) for cell, target in shared.items()}


def _in_words(cell: Cell) -> str:
    setting = cell.setting
    return (
        f"{cell.method} at ratio {setting.speed_ratio:g}, n={setting.pursuers}, m={setting.obstacles}, {setting.scene}"
    )


def _ordered(paper: Iterable[Cell], results: Iterable[Cell]) -> list[Cell]:
    """Sort the paper's cells, then those of other methods that have runs in the same settings."""
    paper = list(paper)
    settings = {cell.setting for cell in paper}
    others = [cell for cell in results if cell.method not in TABLE_METHODS and cell.setting in settings]
    return _by_method({*paper, *others})


def _by_method(cells: Iterable[Cell]) -> list[Cell]:
    """Sort cells by method, the paper's first, then by setting."""
    rank = {method: place for place, method in enumerate(TABLE_METHODS)}
    return sorted(cells, key=lambda cell: (rank.get(cell.method, len(rank)), cell))


def _result_row(cell: Cell, runs: _CellRuns | None, paper: PaperResult | None, closure: Closure | None) -> _ResultRow:
    """One row, under the method's own rule where ``closure`` is None."""
    if runs is None:
        return _ResultRow(cell, None, closure, None, paper)
    closure = closure or runs.closure
    summary = metrics.summarise_cell(runs.finished, closure) if runs.finished and closure else None
    return _ResultRow(cell, runs, closure, summary, paper)


def _result_cells(row: _ResultRow) -> list[str]:
    """Write a row in Markdown."""
    setting = row.cell.setting
    name = label(row.cell.method)
    if row.runs is None:
        success = length = "not run"
    elif row.summary is None:
        success = length = row.runs.in_words
    else:
        success = _with_interval(row.summary.success, 100)
        length = _with_interval(row.summary.mean_episode_length, 1) if row.summary.mean_episode_length else "no success"
    if row.runs is not None and row.runs.runs_of is not None:
        name += f" (runs of {label(row.runs.runs_of)})"
    return [
        name,
        *(f"{value:g}" for value in setting[:3]),
        success,
        length,
        "not reported" if row.paper is None else _slashed(row.paper),
        "" if row.runs is None else _seeds(row.runs),
    ]


def _other_cells(row: _ResultRow) -> list[str]:
    """Write a row in Markdown with its scene, which the paper's settings have in common."""
    cells = _result_cells(row)
    return [*cells[:4], row.cell.setting.scene, *cells[4:]]


def _with_interval(estimate: Estimate | Difference, scale: float, sign: str = "") -> str:
    """``mean [low, high]`` with two digits; no brackets without an interval."""
    text = f"{scale * estimate.mean:{sign}.2f}"
    if estimate.interval is None:
        return text
    return f"{text} [{scale * estimate.interval.low:{sign}.2f}, {scale * estimate.interval.high:{sign}.2f}]"


def _slashed(paper: PaperResult) -> str:
    """``S / MEL`` as the paper has it."""
    if paper.success_percent is None or paper.mean_episode_length is None:
        return DASH
    return f"{paper.success_percent:.2f} / {paper.mean_episode_length:.2f}"


def _seeds(runs: _CellRuns) -> str:
    """How many seeds the numbers are from, which ones, and what became of the others."""
    parts = [f"{len(runs.finished)} ({_listed(runs.finished)})" if runs.finished else "0"]
    parts += [f"{len(seeds)} {status} ({_listed(seeds)})" for status, seeds in runs.others.items() if seeds]
    return ", ".join(parts)


def _listed(seeds: Iterable[int]) -> str:
    return " ".join(map(str, seeds))


def _result_record(row: _ResultRow) -> dict[str, str]:
    """Write a row in CSV: empty where there is nothing."""
    summary, runs = row.summary, row.runs
    # sigma_c is recorded under the method's own rule, up to its own success: the other rule has none.
    own = summary if runs and row.closure == runs.closure else None
    return {
        "method": row.cell.method,
        **_setting_record(row.cell.setting),
        "closure": row.closure or "",
        "result": "not run" if runs is None else "run" if summary else runs.in_words,
        **_estimate_record("success_percent", summary and summary.success, 100),
        **_estimate_record("mean_episode_length", summary and summary.mean_episode_length, 1),
        **_estimate_record("sigma_c", own and own.sigma_c, 1),
        **_estimate_record("sigma_c_solved", own and own.sigma_c_solved, 1),
        "seeds": str(len(runs.finished) if runs else 0),
        "training_seeds": _listed(runs.finished) if runs else "",
        **{status.replace(" ", "_"): str(len(runs.others[status]) if runs else 0) for status in OTHER_STATUSES},
        "runs_of": (runs and runs.runs_of) or "",
        "paper_success_percent": _paper_number(row.paper, row.paper and row.paper.success_percent),
        "paper_mean_episode_length": _paper_number(row.paper, row.paper and row.paper.mean_episode_length),
    }


def _setting_record(setting: Setting) -> dict[str, str]:
    return {name: f"{value:g}" if isinstance(value, float) else str(value) for name, value in setting._asdict().items()}


def _estimate_record(name: str, estimate: Estimate | Difference | None, scale: float) -> dict[str, str]:
    """Mean and interval of a quantity as three columns."""
    values = [None, None, None] if estimate is None else [estimate.mean, *(estimate.interval or (None, None))]
    columns = (name, f"{name}_low", f"{name}_high")
    return {key: "" if value is None else f"{scale * value:.4f}" for key, value in zip(columns, values, strict=True)}


def _paper_number(paper: PaperResult | None, value: float | None) -> str:
    """Write the paper's number, its dash, or nothing where it does not have the cell."""
    if paper is None:
        return ""
    return DASH if value is None else f"{value:.2f}"


def _difference_rows(paper: Iterable[Cell], results: Mapping[Cell, _CellRuns]) -> Iterator[_DifferenceRow]:
    """Ours minus every other method, under each one's own rule and, where that differs, under the common one."""
    for cell in _ordered(paper, results):
        if cell.method == "ours":
            continue
        ours, other = results.get(Cell("ours", cell.setting)), results.get(cell)
        nothing = _nothing_to_compare(ours, other)
        if nothing is not None or ours is None or other is None or ours.closure is None or other.closure is None:
            yield _DifferenceRow(cell, None, None, None, None, nothing)
            continue
        rules: list[tuple[Closure, Closure]] = [(ours.closure, other.closure)]
        if rules != [("all", "all")]:
            rules.append(("all", "all"))
        for closures in rules:
            success = metrics.success_difference(ours.finished, other.finished, *closures)
            length = metrics.length_difference(ours.finished, other.finished, *closures)
            yield _DifferenceRow(cell, *closures, success, length, None)


def _nothing_to_compare(ours: _CellRuns | None, other: _CellRuns | None) -> str | None:
    """Why two cells cannot be compared; None if they can."""
    if ours is None or other is None or not ours.finished or not other.finished:
        return "not run"
    if other.runs_of == "ours":
        return "the same runs"
    common = ours.finished.keys() & other.finished.keys()
    if not common:
        return "no common training seed"
    if not all(metrics.same_rounds(ours.finished[seed], other.finished[seed]) for seed in common):
        return "not evaluated on the same rounds"
    return None


def _difference_cells(row: _DifferenceRow) -> list[str]:
    """Write a row in Markdown."""
    cells = [label(row.cell.method), *(f"{value:g}" for value in row.cell.setting[:3])]
    if row.success is None:
        return [*cells, "", row.nothing or "", "", ""]
    return [
        *cells,
        f"{row.closure_ours} / {row.closure_other}",
        f"{_with_interval(row.success, 100, '+')}: {row.success.verdict}",
        f"{_with_interval(row.length, 1, '+')}: {row.length.verdict}" if row.length else "no round both solve",
        str(row.success.seeds),
    ]


def _difference_record(row: _DifferenceRow) -> dict[str, str]:
    """Write a row in CSV: empty where there is nothing."""
    return {
        "method": row.cell.method,
        **_setting_record(row.cell.setting),
        "closure_ours": row.closure_ours or "",
        "closure_other": row.closure_other or "",
        "result": row.nothing or "compared",
        **_estimate_record("success_percent_difference", row.success, 100),
        "success_verdict": row.success.verdict if row.success else "",
        **_estimate_record("length_difference", row.length, 1),
        "length_verdict": row.length.verdict if row.length else "",
        "seeds": str(row.success.seeds if row.success else 0),
    }


def markdown(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
    """Write a table under its title, with notes below."""
    lines = [f"# {title}", "", _markdown_row(header), _markdown_row(["---"] * len(header)), *map(_markdown_row, rows)]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def _markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _csv(records: Sequence[Mapping[str, str]]) -> str:
    out = io.StringIO()
    writer = csv.DictWriter(out, records[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return out.getvalue()
