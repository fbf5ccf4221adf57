"""Many runs, each a single-threaded process of its own; whatever stops a sweep, the next one goes on from there."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from marl_encircle import locks
from marl_encircle.experiments.callbacks import Stopped, stop_signals
from marl_encircle.experiments.grid import Job, arguments
from marl_encircle.experiments.records import read_record
from marl_encircle.experiments.train import check_same_run, run_folder

POLL_SECONDS = 0.2
GRACE_SECONDS = 10.0


@dataclass
class Progress:
    """Where a sweep stands; counts of runs.

    :param total: runs asked for
    """

    total: int
    done: int = 0
    reused: int = 0
    diverged: int = 0
    failed: list[str] = field(default_factory=list)
    running: list[str] = field(default_factory=list)

    @property
    def left(self) -> int:
        """Runs that are neither done, diverged, failed nor running."""
        return self.total - self.done - self.diverged - len(self.failed) - len(self.running)


def sweep(
    jobs: Sequence[Job], out: str | Path, n_workers: int, report: Callable[[Progress], None] | None = None
) -> Progress:
    """Train what is missing of ``jobs``.

    :param out: folder of runs; a second sweep on it is refused
    :param n_workers: processes at a time
    :param report: called whenever a run starts or ends
    :return: how it ended; ``failed`` names the runs that did not finish
    :raises FolderLockedError: if another sweep works in ``out``
    :raises OtherRunError: if a finished run there has another configuration
    :raises Stopped: after SIGINT or SIGTERM, when all workers have written their checkpoints
    """
    with locks.folder_lock(out), stop_signals() as caught:
        progress = Progress(total=len(jobs))
        waiting = []
        for job in jobs:
            if _finished(job, out):
                progress.reused += 1
                _count(job, out, progress)
            else:
                waiting.append(job)
        running: dict[subprocess.Popen[bytes], Job] = {}
        try:
            while waiting or running:
                while waiting and len(running) < n_workers and not caught:
                    job = waiting.pop(0)
                    running[_start(job, out)] = job
                _report(progress, running, report)
                time.sleep(POLL_SECONDS)
                if caught:
                    raise Stopped(caught[0])
                for process in [process for process in running if process.poll() is not None]:
                    job = running.pop(process)
                    if _finished(job, out):
                        _count(job, out, progress)
                    else:
                        progress.failed.append(name_of(job))
        finally:
            _stop(list(running))
        _report(progress, running, report)
        return progress


def name_of(job: Job) -> str:
    """Return a short name: method, setting and seed."""
    s = job.setting
    return f"{job.reward} ratio{s.speed_ratio:g}_n{s.pursuers}_m{s.obstacles}_{s.scene} seed{job.seed}"


def _finished(job: Job, out: str | Path) -> bool:
    folder = run_folder(job.config, job.seed, out)
    if not (folder / "run.json").exists():
        return False
    # Both engines train the same policy, so that a run of either will do.
    check_same_run(folder, job.config, job.seed, read_record(folder).get("engine", "native"))
    return True


def _count(job: Job, out: str | Path, progress: Progress) -> None:
    if read_record(run_folder(job.config, job.seed, out))["status"] == "diverged":
        progress.diverged += 1
    else:
        progress.done += 1


def _start(job: Job, out: str | Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "marl_encircle", "train", *arguments(job), "--out", str(out), "--quiet"]
    # A group of its own: Ctrl-C reaches the sweep alone, which then stops its workers in order.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, start_new_session=True, preexec_fn=_die_with_parent
    )


def _die_with_parent() -> None:
    """Have the kernel kill this process when the sweep is killed, so that the next sweep finds the folder free."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _stop(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ask workers to write their checkpoints and end; kill those that do not."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + GRACE_SECONDS
    try:
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))
    finally:  # also after a second Ctrl-C
        for process in processes:
            process.kill()
            process.wait()


def _report(
    progress: Progress, running: dict[subprocess.Popen[bytes], Job], report: Callable[[Progress], None] | None
) -> None:
    progress.running = [name_of(job) for job in running.values()]
    if report is not None:
        report(progress)
