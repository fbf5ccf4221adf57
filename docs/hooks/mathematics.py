"""Mathematics becomes MathML when the site is built, with a font beside it: showing it takes no script, no network."""

import html
import re
from importlib.util import find_spec
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

# As pymdownx.arithmatex marks it: \( \) in a line, \[ \] on a line of its own.
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)

_FONT = "STIXTwoMath-Regular.ttf"


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Put the font beside the style sheet that asks for it."""
    (package,) = find_spec("ziamath").submodule_search_locations
    files.append(File.generated(config, f"theme/{_FONT}", abs_src_path=f"{package}/fonts/{_FONT}"))


def on_page_content(content: str, **_: Any) -> str:
    """Return a page with its formulas as MathML."""
    return _FORMULA.sub(_as_mathml, content)


def _as_mathml(match: re.Match[str]) -> str:
    latex = html.unescape(match[3]).strip()
    mathml = convert(latex, display="block" if match[2] == "[" else "inline")
    if "\\" in mathml:
        raise ValueError(f"a command that latex2mathml does not know: {latex}")
    return f'<div class="formula">{mathml}</div>' if match[2] == "[" else mathml
