"""Links that lead out of docs/, right where the repository is read, name their file where only the site is."""

import logging
import re
from pathlib import Path
from posixpath import normpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.pages import Page

_log = logging.getLogger("mkdocs.hooks.repository")
_LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)\s#]+)(?:#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Return a page whose links to other files of the repository are names of files."""
    docs = Path(config.docs_dir)

    def name(match: re.Match[str]) -> str:
        text, link = match[1], match[2]
        path = Path(normpath(docs / Path(page.file.src_uri).parent / link))
        if path.is_relative_to(docs):
            return match[0]
        if not path.exists():
            _log.warning("%s links to %s, which is not in the repository", page.file.src_uri, link)
        file = str(path.relative_to(docs.parent))
        return f"`{file}`" if text.strip("`") == file else f"{text} (`{file}`)"

    return _LINK.sub(name, markdown)
