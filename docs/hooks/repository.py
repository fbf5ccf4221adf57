"""What leads out of docs/, right where the repository is read: figures come along to the site, links name a file."""

import logging
import re
from pathlib import Path
from posixpath import dirname, normpath, relpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

_log = logging.getLogger("mkdocs.hooks.repository")
_FIGURES = Path("results") / "figures"
_PICTURE = re.compile(rf"(!\[[^\]]+\])\((?:\.\./)+{_FIGURES.as_posix()}/([^)\s]+)\)")
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(((?:\.\./)+[^)\s#]+)(?:#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the study's figures to the site's files."""
    for picture in sorted((Path(config.docs_dir).parent / _FIGURES).glob("*.png")):
        files.append(File.generated(config, f"figures/{picture.name}", abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Return a page whose figures are the site's and whose links to other files of the repository are their names."""
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

    figures = relpath("figures", dirname(page.file.src_uri) or ".")
    return _LINK.sub(name, _PICTURE.sub(rf"\1({figures}/\2)", markdown))
