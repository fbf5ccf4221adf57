"""A real browser for ``make test-browser``.

Chromium is the one that ``CHROMIUM=`` names, or one on the path; Playwright drives it and is asked to fetch nothing.
Without either the exit code is 1.
"""

import os
import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


def chromium() -> str:
    """The browser's path; the tests end without one."""
    wanted = os.environ.get("CHROMIUM")
    found = shutil.which(wanted) if wanted else next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        where = f"CHROMIUM={wanted} is no program" if wanted else f"none of {', '.join(NAMES)} is on the path"
        pytest.exit(f"no Chromium: {where}; apt-get install chromium, or set CHROMIUM=/path/to/it", returncode=1)
    return found


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        pytest.exit("no Playwright: pip install 'marl-encircle[dev]'", returncode=1)
    path = chromium()
    arguments = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()
