"""What a sweep shows: a table on a terminal, elsewhere one line for each change."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from marl_encircle.experiments import live
from marl_encircle.experiments.live import LiveReport, as_table
from marl_encircle.experiments.sweep import Progress, Running


def begun(folder: Path, world_steps: int) -> Running:
    (folder / "progress.csv").write_text(f"world_steps,success\n{world_steps},0.5\n")
    return Running("ours seed0", folder, 1_000_000)


def test_without_a_terminal_there_is_one_line_for_each_change(tmp_path: Path) -> None:
    out = io.StringIO()
    with LiveReport(Console(file=out, width=40)) as report:
        report(Progress(total=3, running=[begun(tmp_path, 0)]))
        report(Progress(total=3, running=[begun(tmp_path, 250_000)]))
        report(Progress(total=3, done=1, running=[begun(tmp_path, 250_000)], cpu_seconds=[7200.0]))
        report(Progress(total=3, done=1, failed=["x"], diverged=1))
    assert out.getvalue().splitlines() == [
        "done 0, diverged 0, failed 0, left 2, time left unknown; running: ours seed0",
        # 0.75 + 1 runs of two hours
        "done 1, diverged 0, failed 0, left 1, time left 3:30:00; running: ours seed0",
        "done 1, diverged 1, failed 1, left 0, time left 0:00:00",
    ]


def shown(progress: Progress) -> list[list[str]]:
    out = io.StringIO()
    Console(file=out, width=100).print(as_table(progress))
    return [line.split() for line in out.getvalue().splitlines()]


def test_the_table_has_the_counts_and_how_far_each_run_is(tmp_path: Path) -> None:
    assert shown(Progress(total=9, done=4, diverged=2, failed=["x"], running=[begun(tmp_path, 500_000)])) == [
        ["done", "running", "failed", "diverged", "left", "time", "left"],
        ["4", "1", "1", "2", "1", "unknown"],
        ["running", "world-steps", "of"],
        ["ours", "seed0", "500,000", "1,000,000"],
    ]
    assert shown(Progress(total=2, done=2))[1:] == [["2", "0", "0", "0", "0", "0:00:00"]]


def test_a_terminal_is_drawn_anew_for_a_change_and_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = io.StringIO()
    with LiveReport(Console(file=out, width=100, force_terminal=True)) as report:
        report(Progress(total=9, running=[begun(tmp_path, 100_000)]))
        report(Progress(total=9, running=[begun(tmp_path, 200_000)]))
        assert "200,000" not in out.getvalue(), "that is too soon"
        report(Progress(total=9, done=1, running=[begun(tmp_path, 300_000)]))
        assert "300,000" in out.getvalue()
        monkeypatch.setattr(live.time, "monotonic", lambda: float("inf"))
        report(Progress(total=9, done=1, running=[begun(tmp_path, 400_000)]))
    assert "400,000" in out.getvalue()
