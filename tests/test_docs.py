"""What the README and the pages of docs/ say is so: their code runs, their commands and links lead somewhere."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from documents import NOT_RUN, PAGES, ROOT, Session, blocks_of, lines_of, small
from filelock import FileLock
from PIL import Image

__all__ = ["small"]

DOCS = ROOT / "docs"
NOTEBOOKS = sorted(DOCS.glob("*.ipynb"))
WITH_CODE = [page for page in PAGES if any(block.language for block in blocks_of(page))]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


# Code and commands


# What SB3 and SuperSuit say of themselves
@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning", "ignore:The `render_mode` attribute:UserWarning")
@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE, ids=name)
@pytest.mark.usefixtures("small")
def test_a_page_runs_from_top_to_bottom(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(page, capsys, monkeypatch)
    for block in blocks_of(page):
        if not block.not_run:
            session.run(block)
    session.finish()
    for drawn in Path().glob("*.png"):
        with Image.open(drawn) as now, Image.open(DOCS / "images" / drawn.name) as shown:
            difference = np.abs(np.asarray(now, float) - np.asarray(shown, float))
        assert difference.mean() < 0.1, f"the page shows another {drawn.name} than it draws"


def test_every_command_that_is_not_run_stands_on_a_page() -> None:
    lines = [
        line for page in WITH_CODE for block in blocks_of(page) if block.language == "bash" for line in lines_of(block)
    ]
    assert [start for start in NOT_RUN if not any(line.startswith(start) for line in lines)] == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_that_are_named_in_a_line_are_there(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for line in re.findall(r"`(marl-encircle [^`\n]+)`", page.read_text(encoding="utf-8")):
        Session(page, capsys, monkeypatch).know(line)


# Links, pictures, formulas


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files_of_the_repository(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    links = [urlsplit(link) for link in re.findall(r"\]\(([^)\s]+)\)", text)]
    missing = [link.path for link in links if not link.scheme and not (page.parent / unquote(link.path)).exists()]
    assert missing == []


class Page(HTMLParser):
    """Where a built page leads, what it loads and which places it has."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.places: set[str] = set()
        self.tags: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.tags.add(tag)
        self.places |= {values[key] for key in ("id", "name") if key in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            self.loaded.append(values["href"])
        elif "src" in values:
            self.loaded.append(values["src"])


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    """The built site, page by page; built once, whichever of pytest's workers comes first."""
    pytest.importorskip("mkdocs", reason="MkDocs is not installed; it is in the extra 'docs'")
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, log = shared / "site", shared / "site.log"
    with FileLock(shared / "site.lock"):
        if not log.exists():
            build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
            environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
            done = subprocess.run(
                build, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280, check=False
            )
            log.write_text(f"exit code {done.returncode}\n{done.stderr}", encoding="utf-8")
    said = log.read_text(encoding="utf-8")
    assert said.startswith("exit code 0\n"), said
    assert "WARNING" not in said
    return {path: Page(path) for path in folder.rglob("*.html")}


@pytest.mark.slow
def test_every_page_is_built(site: dict[Path, Page]) -> None:
    built = {path.stem for path in site}
    assert {page.stem for page in PAGES if page.is_relative_to(DOCS)} | {page.stem for page in NOTEBOOKS} <= built


@pytest.mark.slow
def test_links_within_the_site_lead_to_a_page_and_a_place(site: dict[Path, Page]) -> None:
    broken = []
    for path, page in site.items():
        for link in map(urlsplit, page.links):
            target = (path.parent / unquote(link.path)).resolve() if link.path else path
            if link.scheme or (path.stem == "404" and link.path.startswith("/")):
                continue
            there = site.get(target)
            if not target.exists() or (link.fragment and there and unquote(link.fragment) not in there.places):
                broken.append((path.name, link.geturl()))
    assert broken == []


@pytest.mark.slow
def test_nothing_that_a_page_loads_comes_from_elsewhere(site: dict[Path, Page]) -> None:
    for path, page in site.items():
        for link in page.loaded:
            assert not urlsplit(link).netloc, (path, link)
            if path.stem != "404":
                assert (path.parent / unquote(urlsplit(link).path)).exists(), (path, link)
    folder = next(path for path in site if path.stem == "index").parent
    for sheet in folder.rglob("*.css"):
        for link in re.findall(r"url\([\"']?([^)\"']+)", sheet.read_text(encoding="utf-8")):
            assert link.startswith("data:") or (sheet.parent / link).exists(), (sheet, link)


@pytest.mark.slow
def test_formulas_are_mathml(site: dict[Path, Page]) -> None:
    path = next(path for path in site if path.stem == "mathematics")
    assert "math" in site[path].tags
    for path in site:
        assert not re.search(r"\\[()\[\]]|\$\$|arithmatex", path.read_text(encoding="utf-8")), path


@pytest.mark.slow
def test_the_notebook_shows_its_pictures(site: dict[Path, Page]) -> None:
    path = next(path for path in site if path.stem == "story")
    shown = [link for link in site[path].loaded if link.startswith("story_")]
    code = "".join(line for cell in json.loads((DOCS / "story.ipynb").read_text())["cells"] for line in cell["source"])
    assert len(shown) == len(re.findall(r"plt\.subplots|^draw_figure3\(\)", code, re.MULTILINE)) > 0


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name)
def test_notebooks_are_kept_without_outputs(notebook: Path) -> None:
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert [cell["id"] for cell in cells if cell["outputs"] or cell["execution_count"] is not None] == []


def test_the_drawings_are_those_that_the_script_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(DOCS)
    import drawings

    for file, data in drawings.drawings().items():
        assert (DOCS / "images" / file).read_bytes() == data, f"python docs/drawings.py draws another {file}"


@pytest.mark.parametrize(
    ("page", "title", "pattern", "n_numbers"),
    [
        ("reproduction.md", "From none to three obstacles", r"-?[\d.]+ \[-?[\d.]+, -?[\d.]+\](?=;)", 4),
        ("reproduction.md", "Where Eq. 6 fails", r"-?[\d.]+ \[-?[\d.]+, -?[\d.]+\](?=;)", 4),
        ("reproduction.md", "S minus the paper's", r"(?<=: )[\d.]+", 5),
        ("reproduction.md", "Processor time", r"[\d.]+(?= hours, [1-9])", 4),
        ("reproduction.md", "Runs that were trained again", r"[\d.]+(?= hours| times)", 5),
        ("protocol.md", "Rise of the learning curves", r"(?<=; )(?:[4-9]|\d\d)\.\d", 10),
        ("protocol.md", "Rise of the calibration's curves", r"[\d.]+(?=, \d+\.)|[\d.]+$", 4),
    ],
)
def test_the_pages_of_the_study_have_the_numbers_that_the_script_finds(
    page: str, title: str, pattern: str, n_numbers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(DOCS)
    import findings

    [lines] = [lines for name, lines in findings.findings(findings.read_results()).items() if name.startswith(title)]
    numbers = [number for line in lines for number in re.findall(pattern, line)]
    assert len(numbers) == n_numbers
    text = " ".join((DOCS / page).read_text(encoding="utf-8").split())
    for number in numbers:
        shown = number if "[" in number else f"{float(number):.1f}"
        assert re.search(rf"(?<![\d.]){re.escape(shown)}(?!\.?\d)", text), shown
