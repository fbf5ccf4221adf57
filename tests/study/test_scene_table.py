"""What the table of unseen scenes shows, from made-up runs."""

import csv
import io

from made_up import finished, markdown_row, markdown_rows, rounds

from marl_encircle.experiments.records import Run, Setting
from marl_encircle.study.scenes import render_scenes

ONE = Setting(1.1, 3, 1)


def played(method: str, seed: int, own: int, **elsewhere: int) -> Run:
    """A run of 100 rounds in its own scene and in each other one, with so many successes."""
    run = finished(method, ONE, seed, own)
    others = {ONE._replace(scene=scene): rounds(n, 100, step=30) for scene, n in elsewhere.items()}
    return Run(run.cell, seed, "finished", run.closure, run.episodes, others)


def test_the_same_policies_stand_side_by_side_in_all_scenes() -> None:
    runs = [played("ours", 0, 90, concave=80, tunnel=70), played("ours", 1, 94, concave=84, tunnel=70)]
    text = render_scenes(runs)["table_scenes.md"]
    own, concave, tunnel = markdown_row(text, "Ours", "1.1", "3", "1")
    assert own.startswith("92.0 [")
    assert own.endswith("/ 20.0")
    assert concave.startswith("82.0 [")
    assert concave.endswith("/ 30.0")
    assert tunnel.startswith("70.0 [")
    assert "Bold" not in text


def test_methods_stand_in_the_papers_order_and_a_scene_not_played_is_empty() -> None:
    runs = [played("ours", 0, 90, concave=80), played("ma2019", 0, 50, concave=40, tunnel=0)]
    rows = markdown_rows(render_scenes(runs)["table_scenes.md"])
    assert [row[0] for row in rows] == ["Ma", "Ours"]
    assert rows[0][4:] == ["50.0 / 20.0", "40.0 / 30.0", "0.0 / no success"]
    assert rows[1][4:] == ["90.0 / 20.0", "80.0 / 30.0", ""]


def test_another_setting_of_the_same_scene_is_no_other_scene() -> None:
    two = ONE._replace(pursuers=2)
    home = finished("ours", ONE, 0, 90)
    run = Run(home.cell, 0, "finished", home.closure, home.episodes, {two: rounds(10, 100, step=30)})
    assert render_scenes([run]) == {}


def test_runs_that_stayed_at_home_have_no_place_in_it() -> None:
    assert render_scenes([finished("ours", ONE, 0, 90)]) == {}
    text = render_scenes([finished("model_b", ONE, 0, 90), played("ours", 0, 90, tunnel=80)])["table_scenes.md"]
    assert [row[0] for row in markdown_rows(text)] == ["Ours"]


def test_the_csv_has_a_line_for_each_scene_and_further_notes_stand_below() -> None:
    texts = render_scenes([played("ours", 0, 90, concave=80)], ["Frozen in commit 0123456789ab."])
    rows = list(csv.DictReader(io.StringIO(texts["table_scenes.csv"])))
    assert {(row["scene"], row["success_percent"]) for row in rows} == {("random", "90.0000"), ("concave", "80.0000")}
    assert texts["table_scenes.md"].endswith("- Frozen in commit 0123456789ab.\n")
