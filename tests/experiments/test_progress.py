"""Where a training stands, as people see it."""

import io
import re
from types import SimpleNamespace

import pytest
from rich.console import Console

from marl_encircle.experiments import progress
from marl_encircle.experiments.progress import ProgressBar


def shown(monkeypatch: pytest.MonkeyPatch, terminal: bool, first: int = 0) -> list[str]:
    """What is printed about a training of 2,000 world steps, 100 a second, in which every other round succeeds."""
    out, clock = io.StringIO(), SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now))
    console = Console(file=out, force_terminal=terminal, width=80)
    steps = SimpleNamespace(done=first)
    bar = ProgressBar(2000, lambda: steps.done, lambda _: [steps.done % 100 == 0], "success {:.0%}", console)
    bar.model = SimpleNamespace(num_timesteps=0)  # type: ignore[assignment]  # all that SB3 reads of it here
    bar.on_training_start({}, {})
    while steps.done < 2000:
        steps.done, clock.now = steps.done + 50, clock.now + 0.5
        bar.on_step()
    bar.close()
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", out.getvalue())
    return [line for line in re.split(r"[\r\n]+", text) if line]


def test_elsewhere_than_on_a_terminal_there_is_a_line_for_each_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, terminal=False)
    assert len(lines) == 10
    assert lines[0] == "200 of 2,000 world steps, 100/s, 0:00:18 left, success 50%"
    assert lines[-1] == "2,000 of 2,000 world steps, 100/s, 0:00:00 left, success 50%"


def test_a_terminal_has_one_line_with_a_bar_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, terminal=True)
    assert "━ 0 of 2,000 world steps, 0/s, unknown time left" in lines[0]
    assert any(re.fullmatch(r"━+╸━+ 1,000 of 2,000 world steps, 100/s, 0:00:10 left, success 50%", x) for x in lines)
    assert lines[-1].endswith("━ 2,000 of 2,000 world steps, 100/s, 0:00:00 left, success 50%")
    assert max(map(len, lines)) == 80


def test_a_training_that_goes_on_counts_the_speed_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, terminal=False, first=1500)
    assert lines[0] == "1,600 of 2,000 world steps, 100/s, 0:00:04 left, success 50%"
    assert len(lines) == 3  # 80, 90 and 100 %


def test_the_time_left_follows_from_the_speed_of_late(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, steps = SimpleNamespace(now=0.0), SimpleNamespace(done=0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now))
    bar = ProgressBar(100_000, lambda: steps.done, lambda _: [], "", Console(file=io.StringIO()))
    bar.model = SimpleNamespace(num_timesteps=0)  # type: ignore[assignment]  # all that SB3 reads of it here
    bar.on_training_start({}, {})
    for speed in [1000] * 20 + [100] * 40:
        steps.done, clock.now = steps.done + speed, clock.now + 1.0
        bar.on_step()
    assert bar.in_words() == "24,000 of 100,000 world steps, 100/s, 0:12:40 left"


def test_nothing_is_said_of_rounds_before_one_has_ended() -> None:
    bar = ProgressBar(2000, lambda: 0, lambda _: [], "success {:.0%}", Console(file=io.StringIO()))
    bar.model = SimpleNamespace(num_timesteps=0)  # type: ignore[assignment]  # all that SB3 reads of it here
    bar.on_training_start({}, {})
    assert bar.in_words() == "0 of 2,000 world steps, 0/s, unknown time left"


def test_a_bar_that_was_never_shown_can_be_closed() -> None:
    ProgressBar(2000, lambda: 0, lambda _: [], "").close()
