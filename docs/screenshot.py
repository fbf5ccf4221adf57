"""Take the README's picture of the report, ``docs/images/report.png``: ``marl-encircle report``, then this."""

import os
import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).parents[1]
REPORT, PICTURE = ROOT / "results" / "report.html", ROOT / "docs" / "images" / "report.png"
SIZE = {"width": 1060, "height": 1200}
CHOICES = {"setting": "2 pursuers, 1 obstacle, λ = 1.1", "method": "Ours", "other": "Model B"}


def main() -> None:
    """Choose two methods, go to the end of the round, and take the picture of the player."""
    chromium = shutil.which(os.environ.get("CHROMIUM", "chromium"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE, device_scale_factor=1.25, color_scheme="light")
        page.goto(REPORT.as_uri())
        for part, label in CHOICES.items():
            page.locator(f'[data-part="{part}"]').select_option(label=label)
        page.locator('[data-part="stage"]').press("End")
        page.locator("h1").click()
        page.locator("#player").screenshot(path=str(PICTURE))
        browser.close()


if __name__ == "__main__":
    main()
