"""Where a sweep stands, on standard error: a live table on a terminal, elsewhere one line per change."""

import time
from collections.abc import Callable
from datetime import timedelta
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from marl_encircle.experiments.sweep import Progress

REFRESH_SECONDS = 1.0


class LiveReport:
    """Yields what a sweep is to call with its progress.

    :param console: where to; by default standard error
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None
        self._shown, self._next = "", 0.0

    def __enter__(self) -> Callable[[Progress], None]:
        if self._live:
            self._live.start()
        return self.report

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def report(self, progress: Progress) -> None:
        """Show the present state if a run has started or ended, on a terminal every second too."""
        counts = (
            f"done {progress.done}, diverged {progress.diverged}, failed {len(progress.failed)}, left {progress.left}"
        )
        names = f"; running: {', '.join(run.name for run in progress.running)}" if progress.running else ""
        if counts + names == self._shown and (self._live is None or time.monotonic() < self._next):
            return
        self._shown, self._next = counts + names, time.monotonic() + REFRESH_SECONDS
        if self._live:
            self._live.update(as_table(progress), refresh=True)
        else:
            self.console.print(f"{counts}, time left {time_left(progress)}{names}", soft_wrap=True)


def as_table(progress: Progress) -> Group:
    """Return the counts, and below them the runs that are being trained."""
    counts = {**progress.counts, "time left": time_left(progress)}
    head = Table(*counts, box=None)
    head.add_row(*map(str, counts.values()))
    runs = Table("running", "world-steps", "of", box=None)
    runs.columns[1].justify = runs.columns[2].justify = "right"
    for run in progress.running:
        runs.add_row(run.name, f"{run.world_steps:,}", f"{run.total:,}")
    return Group(head, runs) if progress.running else Group(head)


def time_left(progress: Progress) -> str:
    """Return the time to the end, [days,] h:mm:ss, or "unknown" before the first run has finished."""
    seconds = progress.seconds_left
    return "unknown" if seconds is None else str(timedelta(seconds=round(seconds)))
