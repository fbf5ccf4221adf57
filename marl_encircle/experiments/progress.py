"""How far a training is, on standard error: a bar on a terminal, elsewhere a line for each tenth of it."""

import time
from collections import deque
from collections.abc import Callable, Iterable
from datetime import timedelta

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from stable_baselines3.common.callbacks import BaseCallback

REFRESH_SECONDS = 0.2
LATEST = 200
"""Rounds over which the figure is averaged."""

WINDOW = 30
"""Seconds over which the speed is measured: it changes when learning starts."""


class ProgressBar(BaseCallback):
    """World steps done, their speed, the time left, and a figure of the latest rounds.

    :param total: world steps of the whole training
    :param done: returns those so far; one that is resumed does not start at 0
    :param figures: returns the figure of each round that ended in this step
    :param label: how its mean is shown, for example ``"success {:.0%}"``
    :param console: where to; by default standard error
    """

    def __init__(
        self,
        total: int,
        done: Callable[[], int],
        figures: Callable[[BaseCallback], Iterable[float]],
        label: str,
        console: Console | None = None,
    ) -> None:
        super().__init__()
        self.total, self.done, self.figures, self.label = total, done, figures, label
        self.console = console or Console(stderr=True)
        self.latest: deque[float] = deque(maxlen=LATEST)
        self._bar: Progress | None = None

    def _on_training_start(self) -> None:
        self._moments = deque([(time.monotonic(), self.done())], maxlen=WINDOW)
        self._tenth, self._next = 10 * self.done() // self.total, 0.0
        if self.console.is_terminal:
            columns = BarColumn(bar_width=None), TextColumn("{task.description}")
            self._bar = Progress(*columns, console=self.console, expand=True, auto_refresh=False)
            self._task = self._bar.add_task(self.in_words(), total=self.total, completed=self.done())
            self._bar.start()

    def _on_step(self) -> bool:
        self.latest.extend(self.figures(self))
        now = time.monotonic()
        if now >= self._moments[-1][0] + 1.0:
            self._moments.append((now, self.done()))
        if self._bar is not None and now >= self._next:
            self._show(self._bar)
            self._next = now + REFRESH_SECONDS
        elif self._bar is None and 10 * self.done() // self.total > self._tenth:
            self._tenth = 10 * self.done() // self.total
            self.console.print(self.in_words(), highlight=False, soft_wrap=True)
        return True

    def _show(self, bar: Progress) -> None:
        bar.update(self._task, completed=self.done(), description=self.in_words(), refresh=True)

    def in_words(self) -> str:
        """Return where the training stands."""
        done, (since, before) = min(self.done(), self.total), self._moments[0]
        speed = (done - before) / max(time.monotonic() - since, 1e-9)
        left = str(timedelta(seconds=round((self.total - done) / speed))) if speed else "unknown time"
        figure = [self.label.format(np.mean(self.latest))] if self.latest else []
        return ", ".join([f"{done:,} of {self.total:,} world steps", f"{speed:,.0f}/s", f"{left} left", *figure])

    def close(self) -> None:
        """Leave the terminal as it was, however the training ended."""
        if self._bar is not None:
            self._show(self._bar)
            self._bar.stop()
            self._bar = None
