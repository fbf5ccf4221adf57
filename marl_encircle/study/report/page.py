"""Tables, curves and rounds -> the page; whatever comes from a file's name is escaped."""

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from html import escape
from importlib import resources
from typing import Any, NamedTuple

from marl_encircle.drawing import palette
from marl_encircle.drawing.palette import Colour
from marl_encircle.study.typeset import Table, Text, is_italic, parts_of

PAIRED = ("table2", "table3", "table4")
"""Tables whose cells are ``S [interval] / MEL``: two columns here."""

_SCRIPTS = ("decode.js", "drawing.js", "player.js")
_NEUTRALS = ("INK", "FAINT", "LINE", "PAPER", "BACKGROUND", "GROOVE", "OBSTACLE", "OBSTACLE_EDGE", "GOOD", "GAP")
_INTERVAL = re.compile(r" (\[[^\]]*\])")
_MINUS = re.compile(r"(?<![\w.)])-(?=\d)")


class Page(NamedTuple):
    """What the page is made of."""

    facts: Sequence[tuple[str, str]]
    """Name and value of what is said at the top."""
    tables: Sequence[Table]
    charts: str
    """HTML."""
    player: dict[str, Any]
    """See :func:`~marl_encircle.study.report.replays.player_data`."""


def render_page(page: Page) -> str:
    """Return the whole file."""
    style = palette_css() + _source("style.css")
    script = "".join(map(_source, _SCRIPTS))
    # No address is allowed, and only this one style and this one script are: nothing can be fetched or slipped in.
    sources = {"default": "'none'", "style": _hash(style), "script": _hash(script)}
    policy = [*(f"{kind}-src {source}" for kind, source in sources.items()), "base-uri 'none'", "form-action 'none'"]
    parts = {
        "policy": "; ".join(policy),
        "style": style,
        "facts": "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in page.facts),
        "tables": "\n".join(map(html_table, page.tables)),
        "charts": page.charts,
        "data": json_in_html(page.player),
        "script": script,
    }
    # In one pass: what is put in is not searched for further places.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _source("template.html"))


def json_in_html(value: object) -> str:
    """Return JSON that no text in it can end the surrounding element of."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c")


def palette_css() -> str:
    """Return the colours of all drawings as CSS variables, those of thin lines and letters lighter on dark ground."""
    names = {f"pursuer-{i}": colour for i, colour in enumerate(palette.PURSUERS)}
    names |= {f"on-pursuer-{i}": palette.readable_on(colour) for i, colour in enumerate(palette.PURSUERS)}
    names |= {name.lower().replace("_", "-"): getattr(palette, name) for name in _NEUTRALS}
    series = {f"series-{i}": series.colour for i, series in enumerate(palette.SERIES)}
    series["good"] = palette.GOOD
    lighter = {name: _lighter(colour) for name, colour in series.items()}
    classes = "".join(f".{name}{{color:var(--{name})}}" for name in series)
    return (
        f":root{{{_variables(names | series)}}}\n"
        f"@media (prefers-color-scheme:dark){{:root{{{_variables(lighter)}}}}}\n{classes}\n"
    )


def _variables(colours: dict[str, Colour]) -> str:
    return "".join(f"--{name}:#{red:02x}{green:02x}{blue:02x};" for name, (red, green, blue) in colours.items())


def _lighter(colour: Colour) -> Colour:
    """Mix a colour with white, a third."""
    red, green, blue = (round(value + (255 - value) / 3) for value in colour)
    return red, green, blue


def html_table(table: Table) -> str:
    """Return a table in a section of its own, its notes folded away."""
    paired = table.name in PAIRED
    rows = "".join(_row(row, paired) for row in table.rows)
    notes = "".join(f"<li>{_inline(note)}</li>" for note in table.notes)
    folded = f"<details><summary>How to read it</summary><ul>{notes}</ul></details>" if notes else ""
    return (
        f'<section class="table" aria-labelledby="{table.name}"><h3 id="{table.name}">{_escaped(table.heading)}</h3>'
        f'<div class="scroll" tabindex="0" role="region" aria-labelledby="{table.name}">'
        f'<table class="{"paired" if paired else "plain"}"><thead>{_head(table.header, paired)}</thead>'
        f"<tbody>{rows}</tbody></table></div>{folded}</section>"
    )


def _head(header: Sequence[str], paired: bool) -> str:
    first, *others = header
    if not paired:
        cells = "".join(f'<th scope="col">{escape(text)}</th>' for text in header)
        return f"<tr>{cells}</tr>"
    settings = "".join(f'<th scope="colgroup" colspan="2">{escape(text)}</th>' for text in others)
    halves = '<th scope="col">S</th><th scope="col">MEL</th>' * len(others)
    return f'<tr><th scope="col" rowspan="2">{escape(first)}</th>{settings}</tr><tr>{halves}</tr>'


def _row(row: Sequence[Text], paired: bool) -> str:
    first, *cells = row
    body = "".join(map(_pair if paired else _cell, cells))
    kind = ' class="paper"' if is_italic(first) else ""
    return f'<tr{kind}><th scope="row">{_plain(first)}</th>{body}</tr>'


def _cell(cell: Text) -> str:
    return f"<td>{_inline(cell)}</td>"


def _pair(cell: Text) -> str:
    """Split ``S [interval] / MEL`` into two cells; another text takes the place of both."""
    success, slash, length = _inline(cell).partition(" / ")
    if not slash:
        return f'<td colspan="2" class="none">{success}</td>'
    if success.startswith("<em>"):  # the paper's numbers are set apart by their row
        success, length = success.removeprefix("<em>"), length.removesuffix("</em>")
    return f'<td>{success}</td><td class="mel">{length}</td>'


def _inline(text: Text) -> str:
    """Return escaped HTML, intervals set apart."""
    tags = {"bold": "strong", "italic": "em"}
    marked = "".join(
        _escaped(part) if isinstance(part, str) else f"<{tags[part.style]}>{_escaped(part.text)}</{tags[part.style]}>"
        for part in parts_of(text)
    )
    return _INTERVAL.sub(r' <span class="ci">\1</span>', marked)


def _plain(text: Text) -> str:
    return "".join(_escaped(part if isinstance(part, str) else part.text) for part in parts_of(text))


def _escaped(text: str) -> str:
    return _MINUS.sub("\N{MINUS SIGN}", escape(text)).replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")


def _hash(text: str) -> str:
    """Name a style or script for the content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _source(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")
