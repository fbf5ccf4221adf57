"""How the workers of a sweep run: each is a single-threaded process that trains one run."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from marl_encircle.experiments.grid import Job, arguments

GRACE_SECONDS = 10.0


class Worker(Protocol):
    """A run that is being trained."""

    def poll(self) -> int | None:
        """Return None while it works, then a number, negative if it was killed: what it did is in the run folder."""


class Executor(Protocol):
    """Starts workers inside its ``with`` block; at its end those still at work write their checkpoints and end."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def start(self, job: Job, out: str | Path) -> Worker:
        """Train a job in a process of its own.

        :param out: folder of runs
        """


class LocalExecutor:
    """Workers are processes of this machine, which never outlive the sweep."""

    def __init__(self) -> None:
        self._workers: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        return self

    def start(self, job: Job, out: str | Path) -> subprocess.Popen[bytes]:
        """Train a job by the ``train`` command."""
        worker = _start(job, out)
        self._workers.append(worker)
        return worker

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        workers = [worker for worker in self._workers if worker.poll() is None]
        self._workers = []
        _stop(workers)


def _start(job: Job, out: str | Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "marl_encircle", "train", *arguments(job), "--out", str(out), "--quiet"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    # A session of its own: Ctrl-C reaches the sweep alone, which then stops its workers in order.
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, start_new_session=True, preexec_fn=_die_with_parent
    )


def _die_with_parent() -> None:
    """Have the kernel kill this process when the sweep is killed, so that the next sweep finds the folder free."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _stop(workers: list[subprocess.Popen[bytes]]) -> None:
    """Ask workers to write their checkpoints and end; kill those that do not."""
    for worker in workers:
        worker.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + GRACE_SECONDS
    try:
        for worker in workers:
            with suppress(subprocess.TimeoutExpired):
                worker.wait(max(0.0, deadline - time.monotonic()))
    finally:  # also after a second Ctrl-C
        for worker in workers:
            worker.kill()
            worker.wait()
