"""Notebooks are run when the site is built, and become pages with what they print and draw."""

import logging
import tempfile
from pathlib import Path, PurePosixPath

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter
from traitlets.config import Config

_log = logging.getLogger("mkdocs.hooks.notebook")


class NotebookPage(File):
    """A notebook in the place of a Markdown file."""

    def is_documentation_page(self) -> bool:
        """Whether it becomes a page."""
        return True


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Replace every notebook by its page, and add the pictures that it draws."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text, pictures = run(Path(config.docs_dir, file.src_uri))
        page = NotebookPage(file.src_uri, None, config.site_dir, config.use_directory_urls)
        page.content_string = text
        files.remove(file)
        files.append(page)
        for name, data in pictures.items():
            files.append(File.generated(config, str(PurePosixPath(file.src_uri).parent / name), content=data))


def run(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, run from its first cell to its last, and its pictures by name.

    :raises PluginError: with the traceback of a cell that fails
    """
    _log.info("Running %s", path.name)
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        # No socket that others could reach
        config = Config(KernelManager={"transport": "ipc", "ip": f"{folder}/kernel"})
        where = {"metadata": {"path": path.parent}}
        client = NotebookClient(notebook, config=config, startup_timeout=300, timeout=300, resources=where)
        try:
            client.execute()
        except CellExecutionError as error:
            raise PluginError(f"{path}: {error}") from error
    text, resources = MarkdownExporter().from_notebook_node(notebook, {"unique_key": path.stem})
    return text, resources["outputs"]
