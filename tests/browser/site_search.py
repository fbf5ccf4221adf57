"""The pages of ``make docs``, opened as files in a real browser: one of the tests of ``make test-browser``."""

from __future__ import annotations  # Playwright may be missing, which the fixture 'browser' tells

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="MkDocs is not installed; it is in the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    subprocess.run(build, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=True, timeout=280)
    return folder


def test_the_search_finds_a_page_without_a_server_or_a_request(browser: Browser, site: Path) -> None:
    page = browser.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto((site / "index.html").as_uri())
    # Key by key: the search does not hear of a text that is there at once
    page.get_by_role("textbox", name="Search").press_sequentially("Apollonius circle")
    found = page.locator(".md-search-result__link").first
    found.wait_for()
    assert "mathematics.html" in [
        str(link).partition("?")[0]
        for link in page.locator(".md-search-result__link").evaluate_all(
            "links => links.map((link) => link.href.split('/').pop())"
        )
    ]
    assert complaints == []
    assert [url for url in requests if not url.startswith("file:")] == []
    page.close()
