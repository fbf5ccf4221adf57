"""A sweep on a Ray cluster makes the same runs as one on this machine, each once, whichever node dies."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny_runs import TINY, command, contents, everything_in, in_another_process, train_in_this_process

from marl_encircle import locks
from marl_encircle.experiments import checkpoint, ray_executor
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.provenance import source_hash
from marl_encircle.experiments.ray_executor import RayExecutor
from marl_encircle.experiments.records import Setting
from marl_encircle.experiments.sweep import Progress, sweep
from marl_encircle.experiments.train import run_folder


def jobs(world_steps: int) -> list[Job]:
    overrides = (*TINY, f"training.world_steps={world_steps}")
    return [Job("ours", Setting(1.1, 3, 1), seed, "smoke", overrides=overrides) for seed in (0, 1, 2)]


LONG = jobs(1500)  # long enough to lose a node in the midst
ENDLESS = jobs(1_000_000)


def wait_for(condition: Callable[[], bool], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of one processor each, on loopback."""
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"):
        monkeypatch.setenv(name, "0")
    pytest.importorskip("ray", reason="Ray is not installed; it is the extra 'cluster'")
    from ray.cluster_utils import Cluster

    handler = signal.getsignal(signal.SIGTERM)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()
    signal.signal(signal.SIGTERM, handler)


def trainer_of(folder: Path) -> int:
    """The process that trains a run, else 0."""
    try:
        return int(json.loads((folder / locks.LOCK_NAME).read_text())["pid"])
    except (FileNotFoundError, ValueError):  # not begun, or the lock is not written yet
        return 0


def parent_of(pid: int) -> int | None:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return None


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_when_a_node_dies_another_goes_on_and_every_run_is_made_once(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    [raylet] = next(iter(cluster.worker_nodes)).all_processes["raylet"]
    started: list[int] = []

    def train_there(self: RayExecutor, job: Job, out: Path) -> Any:
        started.append(job.seed)
        return start(self, job, out)

    def kill_a_node_in_the_midst(p: Progress) -> None:
        assert p.done + len(p.failed) + len(p.running) + p.left == p.total == 3
        for run in p.running:
            trainer = trainer_of(run.folder)
            if (run.folder / checkpoint.NAME).exists() and parent_of(trainer) == raylet.process.pid:
                raylet.process.send_signal(signal.SIGKILL)
                os.kill(trainer, signal.SIGKILL)  # a machine that is lost takes all its processes along

    start = RayExecutor.start
    monkeypatch.setattr(RayExecutor, "start", train_there)
    executor = RayExecutor(cluster.address, checkpoint_every=0.2)
    progress = sweep(LONG, there, 2, kill_a_node_in_the_midst, executor)
    assert (progress.done, progress.reused, progress.failed) == (3, 0, [])
    assert started == [0, 1, 2]
    [retry] = caplog.messages
    assert "died" in retry
    assert retry.endswith("retry 1 of 3")

    train_in_this_process(monkeypatch)
    assert sweep(LONG, here, 1).done == 3
    for job in LONG:
        assert contents(run_folder(job.config, job.seed, there)) == contents(run_folder(job.config, job.seed, here))
    assert sweep(LONG, there, 2, executor=RayExecutor(cluster.address)).reused == 3
    assert started == [0, 1, 2], "a finished run was repeated"


def sweep_without_end(out: Path) -> None:
    os.setsid()
    sweep(ENDLESS, out, 2, executor=RayExecutor(checkpoint_every=600))


def session_of(pid: int) -> list[int]:
    """The living processes of the session that ``pid`` leads."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _parent, _group, session = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(session) == pid and state != "Z":
            found.append(int(path.parent.name))
    return found


def listening(pids: list[int]) -> list[str]:
    """The addresses on which processes listen, as the kernel writes them: hexadecimal, lowest byte first."""
    addresses = {}
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            parts = line.split()
            if parts[3] == "0A":
                addresses[f"socket:[{parts[9]}]"] = parts[1].partition(":")[0]
    links = [str(link.readlink()) for pid in pids for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    return [addresses[link] for link in links if link in addresses]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_without_an_address_all_is_on_loopback_and_ends_with_the_sweep(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed; it is the extra 'cluster'")
    process = in_another_process(sweep_without_end, tmp_path)
    assert process.pid is not None
    try:
        first = run_folder(ENDLESS[0].config, ENDLESS[0].seed, tmp_path)
        wait_for((first / "progress.csv").exists, 600)
        addresses = listening(session_of(process.pid))
        assert addresses
        assert set(addresses) <= {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
        with pytest.raises(locks.FolderLockedError, match=f"process {process.pid} on host"):
            sweep(ENDLESS, tmp_path, 1)
        assert not (first / checkpoint.NAME).exists()
        os.kill(process.pid, signal.SIGTERM)
        process.join(12)
        assert process.exitcode == 1, "an uncaught Stopped ends a process with 1"
        assert (first / checkpoint.NAME).exists()
        wait_for(lambda: session_of(process.pid) == [], 60)
    finally:
        for pid in session_of(process.pid):
            os.kill(pid, signal.SIGKILL)


# without a cluster


def train_here(job: Job, out: Path, sources: str) -> str | None:
    return ray_executor._train_on_node(job.config, job.seed, out, 120.0, sources)


def test_a_node_that_does_not_share_the_folder_or_the_sources_trains_nothing(tmp_path: Path) -> None:
    assert "must share its file system" in str(train_here(ENDLESS[0], tmp_path, source_hash()))
    with locks.folder_lock(tmp_path):
        assert "another version" in str(train_here(ENDLESS[0], tmp_path, "0" * 64))
    assert everything_in(tmp_path) == []


def test_a_dead_nodes_lock_on_a_run_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = jobs(400)[0]
    folder = run_folder(job.config, job.seed, tmp_path)
    monkeypatch.setattr(ray_executor.time, "sleep", lambda _: None)
    with locks.folder_lock(tmp_path), locks.folder_lock(folder):
        monkeypatch.setattr(ray_executor, "LOCK_SECONDS", 0.05)
        assert f"FolderLockedError: {folder}" in str(train_here(job, tmp_path, source_hash()))
    lock = locks.folder_lock(folder)
    lock.__enter__()
    monkeypatch.setattr(ray_executor.time, "sleep", lambda _: lock.__exit__(None, None, None))
    monkeypatch.setattr(ray_executor, "LOCK_SECONDS", 60.0)
    with locks.folder_lock(tmp_path):
        assert train_here(job, tmp_path, source_hash()) is None
    assert (folder / "run.json").exists()


class DyingRay:
    """A cluster whose nodes die of every task."""

    exceptions = SimpleNamespace(RayError=RuntimeError)

    def __init__(self) -> None:
        self.tasks = 0

    def init(self, **_: Any) -> None: ...

    shutdown = init

    def remote(self, **_: Any) -> Callable[[Any], Any]:
        return lambda _: SimpleNamespace(remote=self.submit)

    def submit(self, *_: Any) -> int:
        self.tasks += 1
        return self.tasks

    def wait(self, tasks: list[int], **_: Any) -> tuple[list[int], list[int]]:
        return tasks, []

    def get(self, _: int) -> None:
        raise RuntimeError("the node died")


def test_a_run_whose_nodes_all_die_fails_after_so_many_retries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ray = DyingRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    progress = sweep(ENDLESS, tmp_path, 2, executor=RayExecutor())
    assert (len(progress.failed), progress.left, progress.running) == (3, 0, [])
    assert ray.tasks == 3 * (1 + ray_executor.MAX_RETRIES)
    last = [message for message in caplog.messages if "retry" not in message]
    assert len(last) == 3
    assert all("its process or its node died (RuntimeError)" in message for message in last)


def test_what_cannot_be_ends_with_2_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*arguments: str) -> str:
        done = command(capsys, monkeypatch, "sweep", "smoke", "--out", tmp_path, *arguments)
        assert (done.code, done.out) == (2, "")
        return done.err

    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        monkeypatch.setitem(sys.modules, "ray", DyingRay())
        address = f"127.0.0.1:{nobody.getsockname()[1]}"
        assert f"--address {address}: no Ray cluster answers there" in refused(
            "--executor", "ray", "--address", address
        )
    assert "not HOST:PORT" in refused("--executor", "ray", "--address", "auto")
    assert "needs --executor ray" in refused("--address", "127.0.0.1:6379")
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'marl-encircle[cluster]'" in refused("--executor", "ray")
    assert everything_in(tmp_path) == []
