"""An amendment shows both results, paired by seed and round."""

import csv
import io
from pathlib import Path

from made_up import finished, markdown_row, markdown_rows
from tiny_runs import TINY, copy_of_finished

from marl_encircle.experiments.grid import Grid, Job
from marl_encircle.experiments.records import Setting
from marl_encircle.study.amendment import AMENDMENT_TABLES, FORMER, render_amendment
from marl_encircle.study.cells import gather
from marl_encircle.study.reproduce import write_tables

HARD = Setting(1.4, 3, 1)
RESULTS = Path(__file__).parents[2] / "results"


def test_what_was_before_stands_beside_what_is_since() -> None:
    former = [finished("ours", HARD, seed, won) for seed, won in ((0, 40), (1, 44))]
    since = [finished("ours", HARD, seed, won, step=30) for seed, won in ((0, 60), (1, 64))]
    since += [finished("ours", Setting(1.1, 3, 1), 0, 90)]
    texts = render_amendment(former, gather(since, {}), ["Both are shown."])
    before, after, difference = markdown_row(texts["table_amendment.md"], "Ours", "1.4", "3", "1")
    assert (before.split()[0], before.split()[-1]) == ("42.0", "20.0")
    assert (after.split()[0], after.split()[-1]) == ("62.0", "30.0")
    assert difference.startswith("+20.0 [")
    assert len(markdown_rows(texts["table_amendment.md"])) == 1, "what was not amended has no row"
    assert texts["table_amendment.md"].endswith("- Both are shown.\n")
    rows = list(csv.DictReader(io.StringIO(texts["table_amendment.csv"])))
    assert [(row["amendment"], row["success_percent"]) for row in rows] == [("before", "42.0000"), ("after", "62.0000")]


def test_without_former_runs_there_is_no_table() -> None:
    assert render_amendment([], gather([finished("ours", HARD, 0, 60)], {})) == {}


def test_what_has_not_been_trained_again_is_said() -> None:
    text = render_amendment([finished("model_b", HARD, 0, 9), finished("ours", HARD, 0, 40)], {})["table_amendment.md"]
    assert [row[0] for row in markdown_rows(text)] == ["Model B", "Ours"]
    assert markdown_row(text, "Ours", "1.4", "3", "1")[1:] == ["not run", ""]


def test_an_amended_training_goes_through_the_shorter_one() -> None:
    former = list((RESULTS / FORMER).glob("*/*/*/progress.csv"))
    assert former
    for path in former:
        longer = (RESULTS / "runs" / path.relative_to(RESULTS / FORMER)).read_text()
        assert longer.startswith(path.read_text()), path
        assert len(longer) > len(path.read_text()), path


def test_former_rounds_need_no_policy_and_their_table_goes_with_them(tmp_path: Path) -> None:
    grid = Grid((Job("ours", Setting(1.1, 3, 1), 0, "smoke", overrides=TINY),), {})
    copy_of_finished(tmp_path / "runs")
    former = copy_of_finished(tmp_path / FORMER)
    (former / "policy.safetensors").unlink()
    write_tables(grid, tmp_path)
    tables = [tmp_path / "tables" / name for name in AMENDMENT_TABLES]
    assert markdown_row(tables[0].read_text(), "Ours", "1.1", "3", "1")[-1] == "+0.0"
    for path in former.iterdir():
        path.unlink()
    former.rmdir()
    write_tables(grid, tmp_path)
    assert not any(table.exists() for table in tables)
