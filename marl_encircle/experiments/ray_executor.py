"""Workers on the nodes of a Ray cluster, which share the folder of runs; needs the extra ``cluster``."""

import logging
import os
import re
import socket
import sys
import time
from contextlib import ExitStack, redirect_stdout
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from marl_encircle import locks
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.executors import GRACE_SECONDS
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.provenance import source_hash
from marl_encircle.experiments.train import run_folder, train
from marl_encircle.experiments.yaml_files import ConfigError

MAX_RETRIES = 3
CONNECT_SECONDS = 5.0
LOCK_SECONDS = 120.0
"""How long a dead node's lock on a run may stand: a network file system keeps it until its lease ends."""

logger = logging.getLogger(__name__)


class RayExecutor:
    """Each run is a task of one processor; if its node dies, another node goes on from the run's checkpoint.

    :param address: HOST:PORT of a cluster; by default one is started on this machine, on loopback, and ends with the
        sweep
    :param checkpoint_every: seconds between checkpoints, see :func:`marl_encircle.experiments.train.train`
    :raises ConfigError: if Ray is not installed, or the address is none
    """

    def __init__(self, address: str | None = None, checkpoint_every: float | None = None) -> None:
        if address is not None and not re.fullmatch(r"[^:/]+:[0-9]{1,5}", address):
            raise ConfigError(f"--address {address[:80]} is not HOST:PORT, such as 192.168.0.10:6379")
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        if address is None:
            # Ray's name for "this machine only": it then binds to 127.0.0.1, on Linux too. Read at its import.
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        try:
            self._ray: Any = import_module("ray")
        except ImportError as error:
            raise ConfigError(
                "the executor ray needs Ray, which is not installed: pip install 'marl-encircle[cluster]'"
            ) from error
        self.address, self.checkpoint_every = address, checkpoint_every
        self._workers: list[_RayWorker] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        where = {"address": "local", "include_dashboard": False} if self.address is None else {"address": self.address}
        if self.address is not None:
            _check_reachable(self.address)
        try:
            self._ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:  # another version of Ray there, for one
            raise ConfigError(f"Ray at {self.address or 'this machine'}: {str(error)[:400]}") from error
        # Ray prints what it hears of dead nodes, and standard output is for results.
        self._stack.enter_context(redirect_stdout(sys.stderr))
        return self

    def start(self, job: Job, out: str | Path) -> "_RayWorker":
        """Train a job as soon as a node has a free processor."""
        worker = _RayWorker(self._ray, job, Path(out).resolve(), self.checkpoint_every)
        self._workers.append(worker)
        return worker

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks = [worker.task for worker in self._workers if not worker.ended]
        self._workers = []
        try:
            for task in tasks:
                self._ray.cancel(task)  # to the worker it is a SIGINT
            if tasks:
                self._ray.wait(tasks, num_returns=len(tasks), timeout=GRACE_SECONDS)
        finally:
            self._ray.shutdown()  # kills what has not ended
            self._stack.close()


def _check_reachable(address: str) -> None:
    """Raise a ConfigError if nothing listens there; Ray itself would try for minutes."""
    host, _, port = address.partition(":")
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(f"--address {address}: no Ray cluster answers there ({error})") from error


class _RayWorker:
    """A task, and those that follow it when its node dies."""

    def __init__(self, ray: Any, job: Job, out: Path, checkpoint_every: float | None) -> None:
        self._ray, self._folder = ray, run_folder(job.config, job.seed, out)
        one_thread = {"env_vars": {"OMP_NUM_THREADS": "1"}}
        self._remote = ray.remote(num_cpus=1, max_retries=0, runtime_env=one_thread)(_train_on_node)
        self._arguments = job.config, job.seed, out, checkpoint_every, source_hash()
        self.task, self.retries, self.ended = self._remote.remote(*self._arguments), 0, False

    def poll(self) -> int | None:
        """Return None while a task works or waits for a processor."""
        if not self.ended and self._ray.wait([self.task], timeout=0)[0]:
            self.ended = self._check()
        return 0 if self.ended else None

    def _check(self) -> bool:
        """Whether the task that has ended was the last one; else start the next."""
        try:
            failure = self._ray.get(self.task)
        except self._ray.exceptions.RayError as error:  # the task raises nothing, so its process is gone
            failure = f"its process or its node died ({type(error).__name__})"
            if self.retries < MAX_RETRIES:
                self.retries += 1
                logger.warning("%s: %s; retry %d of %d", self._folder, failure, self.retries, MAX_RETRIES)
                self.task = self._remote.remote(*self._arguments)
                return False
        if failure is not None:
            logger.error("%s: %s", self._folder, failure)
        if self._folder.is_dir():
            list(self._folder.iterdir())  # NFS: an opened folder shows what another node has just written into it
        return True


def _train_on_node(config: Config, seed: int, out: Path, checkpoint_every: float | None, sources: str) -> str | None:
    """Train one run on the node that this process runs on.

    :param sources: hash of the sweep's sources
    :return: why there is no finished run, else None
    """
    try:
        if not (out / locks.LOCK_NAME).exists():
            raise ConfigError(f"the sweep's folder {out} is not there; the nodes must share its file system")
        if source_hash() != sources:
            raise ConfigError("marl-encircle is another version there than the sweep's")
        deadline = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                train(config, seed, "native", out, checkpoint_every=checkpoint_every, tensorboard=True)
            except locks.FolderLockedError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(1.0)
            else:
                return None
    except Exception as error:  # as text: not every exception can be sent to another process
        return f"node {socket.gethostname()}: {type(error).__name__}: {error}"
