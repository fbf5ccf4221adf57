"""Many runs; whatever stops a sweep, the next one goes on from there."""

import heapq
import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

from marl_encircle import files, locks
from marl_encircle.experiments.executors import Executor, LocalExecutor, Worker
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.learning_curve import read_curve
from marl_encircle.experiments.records import RECORD, run_path
from marl_encircle.experiments.signals import Stopped, stop_signals
from marl_encircle.experiments.train import ended_run, run_folder
from marl_encircle.experiments.trainable import check_trainings

POLL_SECONDS = 0.2
MAX_RETRIES = 2

logger = logging.getLogger(__name__)


class Running(NamedTuple):
    """A run that a worker trains.

    :param total: world steps of its whole training
    """

    name: str
    folder: Path
    total: int

    @property
    def world_steps(self) -> int:
        """World steps at the latest point of its learning curve; 0 without one, or where it is not this training's."""
        try:
            steps = read_curve(self.folder).world_steps
        except files.DamagedFileError:
            return 0
        return min(int(steps[-1]), self.total) if len(steps) else 0


@dataclass
class Progress:
    """Where a sweep stands; counts of runs.

    :param total: runs asked for
    :param n_workers: runs at a time
    :param cpu_seconds: processor time of each run that finished in this sweep
    """

    total: int
    n_workers: int = 1
    done: int = 0
    reused: int = 0
    diverged: int = 0
    failed: list[str] = field(default_factory=list)
    running: list[Running] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)

    @property
    def counts(self) -> dict[str, int]:
        """Runs by what has become of them; they add up to ``total``."""
        return {
            "done": self.done,
            "running": len(self.running),
            "failed": len(self.failed),
            "diverged": self.diverged,
            "left": self.left,
        }

    @property
    def left(self) -> int:
        """Runs that are neither done, diverged, failed nor running."""
        return self.total - self.done - self.diverged - len(self.failed) - len(self.running)

    @property
    def seconds_left(self) -> float | None:
        """Time [s] to the end if each run takes the mean processor time of those finished; None before the first."""
        shares = [1 - run.world_steps / run.total for run in self.running] + [1.0] * self.left
        if not shares:
            return 0.0
        if not self.cpu_seconds:
            return None
        free = [0.0] * self.n_workers  # when each worker has done its part
        for share in shares:
            heapq.heapreplace(free, free[0] + share)
        return max(free) * mean(self.cpu_seconds)


def sweep(
    jobs: Sequence[Job],
    out: str | Path,
    n_workers: int,
    report: Callable[[Progress], None] | None = None,
    executor: Executor | None = None,
) -> Progress:
    """Train what is missing of ``jobs``; the run folders are the only journal.

    A run whose worker was killed goes on from its checkpoint, at most ``MAX_RETRIES`` times.

    :param out: folder of runs; a second sweep on it is refused
    :param n_workers: runs at a time
    :param report: called whenever a run starts or ends, and several times a second in between
    :param executor: how they run; by default as processes of this machine
    :return: how it ended; ``failed`` names the runs that did not finish
    :raises ConfigError: for a run that cannot be trained, or too many at a time for this machine's memory, before
        anything is written; other executors' machines are not known
    :raises FolderLockedError: if another sweep works in ``out``
    :raises OtherRunError: if a finished run there has another configuration
    :raises DamagedFileError: if a record there is not what a run writes
    :raises Stopped: after SIGINT or SIGTERM, when all workers have written their checkpoints
    """
    executor = executor or LocalExecutor()
    if isinstance(executor, LocalExecutor):
        missing = [job for job in jobs if not (run_folder(job.config, job.seed, out) / RECORD).exists()]
        check_trainings([job.config for job in missing], n_workers)
    with locks.folder_lock(out):
        progress = Progress(len(jobs), n_workers)
        waiting = []
        for job in jobs:
            record = _record_of(job, out)
            if record is None:
                waiting.append(job)
            else:
                progress.reused += 1
                _count(record, progress)
        report = report or (lambda _: None)
        if waiting:
            with executor as workers:
                _train(waiting, out, workers, progress, report)
        report(progress)
        return progress


def name_of(job: Job) -> str:
    """Return the run folder below the folder of runs."""
    return run_path(job.config.cell, job.seed).as_posix()


def _train(
    waiting: list[Job], out: str | Path, executor: Executor, progress: Progress, report: Callable[[Progress], None]
) -> None:
    """Keep as many workers busy as are allowed until nothing waits any more."""
    running: dict[Worker, Job] = {}
    retries: Counter[Job] = Counter()
    with stop_signals() as caught:
        while waiting or running:
            while waiting and len(running) < progress.n_workers and not caught:
                job = waiting.pop(0)
                running[executor.start(job, out)] = job
            progress.running = [_running(job, out) for job in running.values()]
            report(progress)
            time.sleep(POLL_SECONDS)
            if caught:
                raise Stopped(caught[0])
            for worker in [worker for worker in running if worker.poll() is not None]:
                job = running.pop(worker)
                record = _record_of(job, out)
                if record is not None:
                    _count(record, progress)
                    if record["status"] == "finished":
                        progress.cpu_seconds.append(record["cpu_seconds"])
                elif _was_killed(worker) and retries[job] < MAX_RETRIES:
                    retries[job] += 1
                    logger.warning(
                        "%s: its process was killed; retry %d of %d", name_of(job), retries[job], MAX_RETRIES
                    )
                    waiting.append(job)
                else:
                    progress.failed.append(name_of(job))
    progress.running = []


def _was_killed(worker: Worker) -> bool:
    """Whether it ended by a signal: somebody's, or the kernel's for want of memory."""
    code = worker.poll()
    return code is not None and code < 0


def _running(job: Job, out: str | Path) -> Running:
    config = job.config
    return Running(name_of(job), run_folder(config, job.seed, out), config.training.world_steps)


def _record_of(job: Job, out: str | Path) -> dict[str, Any] | None:
    """Return the record of a job's run, if it has ended and is the job's."""
    return ended_run(run_folder(job.config, job.seed, out), job.config, job.seed)


def _count(record: dict[str, Any], progress: Progress) -> None:
    if record["status"] == "diverged":
        progress.diverged += 1
    else:
        progress.done += 1
