"""Tables as text: Markdown, LaTeX (booktabs) and CSV."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from marl_encircle.experiments.metrics import Difference, Estimate
from marl_encircle.experiments.records import Setting

DASH = "–"  # noqa: RUF001 - the paper's own sign


@dataclass(frozen=True)
class Styled:
    """A part of a text that stands out."""

    text: str
    style: Literal["bold", "italic"]


Part = str | Styled
Text = Part | tuple[Part, ...]
"""What a cell or a note holds: one part, or several that follow each other."""


class Table(NamedTuple):
    """A table as it is before it is written in any of the languages."""

    name: str
    """Of its files, without suffix."""
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Text]]
    """Rows that start in italics belong to the row above."""
    notes: Sequence[Text]

    @property
    def heading(self) -> str:
        """The title, after the number of the paper's table if it is one."""
        number = re.fullmatch(r"table(\d)", self.name)
        return f"Table {number[1]}: {self.title}" if number else self.title


_MARKS = {"bold": "**", "italic": "*"}
_COMMANDS = {"bold": "textbf", "italic": "textit"}
# A symbol, alone or with its value, is mathematics; λ = 1.1 becomes $\lambda = 1.1$.
_MATHEMATICS = re.compile(r"\b[nm] = \d+|λ(?: = [\d.]*\d)?")
_ESCAPES = {
    **{sign: f"\\{sign}" for sign in "#$%&_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    DASH: "--",
    "✓": r"\checkmark",
}


def markdown(table: Table, level: int = 1) -> str:
    """Write a table under its heading, with notes below.

    :param level: of the heading
    """
    rows = table.header, ["---"] * len(table.header), *table.rows
    lines = [f"{'#' * level} {table.heading}", ""]
    lines += [f"| {' | '.join(map(_markdown_text, row))} |" for row in rows]
    if table.notes:
        lines += ["", *(f"- {_markdown_text(note)}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """Write a table to be put into a paper, with notes below; its label is ``tab:<name>``."""
    body: list[str] = []
    grouped = any(is_italic(row[0]) for row in table.rows)
    for row in table.rows:
        if grouped and body and not is_italic(row[0]):
            body.append(r"\addlinespace")
        body.append(_latex_row(row))
    tabular = [
        rf"\begin{{tabular}}{{@{{}}l{'c' * (len(table.header) - 1)}@{{}}}}",
        *_indented([r"\toprule", _latex_row(table.header), r"\midrule", *body, r"\bottomrule"]),
        r"\end{tabular}",
    ]
    small = [r"\begin{minipage}{\linewidth}", *_indented([rf"{_latex_text(note)}\par" for note in table.notes])]
    lines = [
        r"\centering",
        rf"\caption{{{_latex_text(table.title)}}}",
        rf"\label{{tab:{table.name}}}",
        r"\footnotesize",
        r"\setlength{\tabcolsep}{3pt}",
        *tabular,
        *([r"\par\medskip", *small, r"\end{minipage}"] if table.notes else []),
    ]
    packages = "booktabs,amssymb" if any(r"\checkmark" in line for line in body) else "booktabs"
    return "\n".join([rf"% \usepackage{{{packages}}}", r"\begin{table}", *_indented(lines), r"\end{table}"]) + "\n"


def to_csv(records: Sequence[Mapping[str, str]]) -> str:
    """Write records that have the same keys, which become the header."""
    out = io.StringIO()
    writer = csv.DictWriter(out, records[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return out.getvalue()


def with_interval(estimate: Estimate | Difference, scale: float, form: str) -> tuple[str, str]:
    """Return the mean and, in brackets after a space, its interval; that is empty where there is none.

    :param form: of each number, ``.1f`` or ``+.2f``
    """
    mean, interval = f"{scale * estimate.mean:{form}}", estimate.interval
    if interval is None:
        return mean, ""
    return mean, f" [{scale * interval.low:{form}}, {scale * interval.high:{form}}]"


def setting_columns(setting: Setting) -> dict[str, str]:
    """Return a setting as columns of a CSV file."""
    return {name: f"{value:g}" if isinstance(value, float) else str(value) for name, value in setting._asdict().items()}


def estimate_columns(name: str, estimate: Estimate | Difference | None, scale: float) -> dict[str, str]:
    """Return mean and interval as three columns of a CSV file, empty where there is nothing."""
    values = [None, None, None] if estimate is None else [estimate.mean, *(estimate.interval or (None, None))]
    columns = (name, f"{name}_low", f"{name}_high")
    return {key: "" if value is None else f"{scale * value:.4f}" for key, value in zip(columns, values, strict=True)}


def parts_of(cell: Text) -> tuple[Part, ...]:
    """Return the pieces of a cell, each of one style."""
    return cell if isinstance(cell, tuple) else (cell,)


def is_italic(cell: Text) -> bool:
    """Whether a cell starts in italics, as all of the paper's do."""
    first = parts_of(cell)[0]
    return isinstance(first, Styled) and first.style == "italic"


def _markdown_text(cell: Text) -> str:
    marked = (
        part if isinstance(part, str) else f"{_MARKS[part.style]}{part.text}{_MARKS[part.style]}"
        for part in parts_of(cell)
    )
    return "".join(marked)


def _latex_row(cells: Sequence[Text]) -> str:
    return rf"{' & '.join(map(_latex_text, cells))} \\"


def _latex_text(cell: Text) -> str:
    escaped = (
        _escape(part) if isinstance(part, str) else rf"\{_COMMANDS[part.style]}{{{_escape(part.text)}}}"
        for part in parts_of(cell)
    )
    return "".join(escaped)


def _escape(text: str) -> str:
    """Put mathematics between dollars and escape everything else that LaTeX would not print."""
    pieces, end = [], 0
    for match in _MATHEMATICS.finditer(text):
        pieces += [_escape_signs(text[end : match.start()]), "$", match[0].replace("λ", r"\lambda"), "$"]
        end = match.end()
    return "".join([*pieces, _escape_signs(text[end:])])


def _escape_signs(text: str) -> str:
    return "".join(_ESCAPES.get(sign, sign) for sign in text)


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"  {line}" for line in lines]
