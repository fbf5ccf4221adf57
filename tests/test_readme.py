r"""The tables that the README shows, between two comments, are those of the results.

They are printed by

    for n in 2 3 4; do awk '/^# /{print "\n**" substr($0, 3) "**\n"} /^\|/' results/tables/table$n.md; done; echo
"""

import re
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- tables -->\n", "<!-- /tables -->\n"


def without_notes(text: str) -> str:
    """Title and rows of a rendered table."""
    title, *lines = text.splitlines()
    rows = [line for line in lines if line.startswith("|")]
    return "\n".join([f"**{title.removeprefix('# ')}**", "", *rows, "", ""])


def test_the_readme_shows_tables_2_to_4_as_rendered() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    tables = [(ROOT / "results" / "tables" / f"table{number}.md").read_text(encoding="utf-8") for number in (2, 3, 4)]
    shown = readme.partition(BEGIN)[2].partition(END)[0]
    assert shown == "\n" + "".join(map(without_notes, tables))


def test_a_moving_picture_and_one_of_the_report_are_shown_and_light() -> None:
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert shown == ["docs/images/watch.gif", "docs/images/report.png"]
    moving, report = (ROOT / path for path in shown)
    assert moving.stat().st_size < 1_000_000
    assert report.stat().st_size < 400_000
    with Image.open(moving) as film, Image.open(report) as picture:
        assert getattr(film, "n_frames", 1) > 5
        assert min(picture.size) > 1_000
