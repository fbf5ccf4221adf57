"""A sweep trains what is missing, once, whatever happens to it or to its workers."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import TINY, in_another_process

from marl_encircle import locks
from marl_encircle.experiments import executors
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.records import Setting, config_hash
from marl_encircle.experiments.sweep import Progress, Running, name_of, sweep
from marl_encircle.experiments.train import OtherRunError, run_folder

POPEN = subprocess.Popen

SETTING = Setting(1.1, 3, 1)
JOBS = [Job("ours", SETTING, seed, "smoke") for seed in (0, 1, 2)]


def made_up_worker(monkeypatch: pytest.MonkeyPatch, behave: str) -> None:
    """Start small scripts instead of trainings; ``folder`` is the run's, ``seed`` its seed."""

    def start(command: list[str], **options: Any) -> Any:
        out, seed = command[command.index("--out") + 1], command[command.index("--seed") + 1]
        folder = Path(out) / "ours" / "ratio1.1_n3_m1_random" / f"seed{seed}"
        script = f"import json, os, pathlib, signal, sys, time; seed = {seed}; folder = pathlib.Path({str(folder)!r})\n"
        return POPEN([sys.executable, "-I", "-S", "-c", script + behave], **options)

    monkeypatch.setattr(executors.subprocess, "Popen", start)


def record_text(status: str = "finished") -> str:
    """A record that is right for every job of ``JOBS``, but for its seed."""
    config = JOBS[0].config
    return json.dumps(
        {
            "schema": 1,
            "status": status,
            "method": "ours",
            "config": config.to_dict(),
            "config_hash": config_hash(config.to_dict()),
            "engine": "native",
            "cpu_seconds": 40.0,
            "sha256": {"policy.safetensors": "0" * 64},
        }
    )


def finish(status: str = "finished") -> str:
    return (
        "folder.mkdir(parents=True)\n"
        f"record = {{**json.loads({record_text(status)!r}), 'seed': seed}}\n"
        "(folder / 'run.json').write_text(json.dumps(record))\n"
    )


def counts(progress: Progress) -> tuple[int, int, int, int, int, int]:
    p = progress
    return p.done, p.reused, p.diverged, len(p.failed), len(p.running), p.left


def test_runs_are_trained_once_and_then_reused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_up_worker(monkeypatch, finish())
    assert counts(sweep(JOBS[:2], tmp_path, 2)) == (2, 0, 0, 0, 0, 0)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("run.json")}
    assert counts(sweep(JOBS, tmp_path, 1)) == (3, 2, 0, 0, 0, 0)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    made_up_worker(monkeypatch, "sys.exit('nothing is left to do')")
    assert counts(sweep(JOBS, tmp_path, 1)) == (3, 3, 0, 0, 0, 0)


def test_a_failed_run_is_counted_and_named_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_up_worker(monkeypatch, "seed == 1 and sys.exit(1)\n" + finish())
    progress = sweep(JOBS, tmp_path, 1)
    assert counts(progress) == (2, 0, 0, 1, 0, 0)
    assert progress.failed == [name_of(JOBS[1])] == ["ours/ratio1.1_n3_m1_random/seed1"]
    made_up_worker(monkeypatch, finish())
    assert counts(sweep(JOBS, tmp_path, 1)) == (3, 2, 0, 0, 0, 0)


DIE = """
tries = folder / "tries"
folder.mkdir(parents=True, exist_ok=True)
tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
if seed == 1 and len(tries.read_text()) <= DEATHS:
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("deaths", [1, 2, 3])
def test_a_killed_worker_is_followed_by_another_at_most_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, deaths: int
) -> None:
    finishing = finish().replace("folder.mkdir(parents=True)\n", "")
    made_up_worker(monkeypatch, DIE.replace("DEATHS", str(deaths)) + finishing)
    seen: list[int] = []
    progress = sweep(JOBS, tmp_path, 2, lambda p: seen.append(p.done + len(p.failed) + len(p.running) + p.left))
    assert counts(progress) == ((3, 0, 0, 0, 0, 0) if deaths <= 2 else (2, 0, 0, 1, 0, 0))
    assert set(seen) == {3}
    tries = (run_folder(JOBS[1].config, 1, tmp_path) / "tries").read_text()
    assert len(tries) == min(deaths + 1, 3)
    assert [record.getMessage() for record in caplog.records] == [
        f"{name_of(JOBS[1])}: its process was killed; retry {i} of 2" for i in range(1, min(deaths, 2) + 1)
    ]


def test_a_diverged_run_is_counted_apart_and_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_up_worker(monkeypatch, finish("diverged") + "sys.exit(1)")
    assert counts(sweep(JOBS[:2], tmp_path, 2)) == (0, 0, 2, 0, 0, 0)
    made_up_worker(monkeypatch, "sys.exit('it was repeated')")
    assert counts(sweep(JOBS[:2], tmp_path, 2)) == (0, 2, 2, 0, 0, 0)


def test_as_many_run_as_there_are_workers_and_every_change_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_up_worker(monkeypatch, "time.sleep(0.3)\n" + finish())
    seen: list[tuple[int, int, int]] = []
    sweep(JOBS, tmp_path, 2, lambda p: seen.append((p.done, len(p.running), p.left)))
    assert max(running for _, running, _ in seen) == 2
    assert seen[0] == (0, 2, 1)
    assert seen[-1] == (3, 0, 0)
    assert all(done + running + left == 3 for done, running, left in seen)


def test_time_is_left_for_what_the_workers_have_not_done_yet(tmp_path: Path) -> None:
    # runs of 40 s (mean of 30 and 50): a quarter of a run is done, another has no curve yet, three have not begun
    (tmp_path / "progress.csv").write_text("world_steps,success\n50,0.0\n100,0.5\n")
    begun, new = Running("a", tmp_path, 400), Running("b", tmp_path / "none", 400)
    assert (begun.world_steps, new.world_steps) == (100, 0)
    progress = Progress(total=8, n_workers=2, done=3, running=[begun, new], cpu_seconds=[30.0, 50.0])
    # first worker: 0.75 + 1 + 1, second: 1 + 1 runs
    assert progress.seconds_left == 2.75 * 40
    assert Progress(total=8, n_workers=9, done=4, running=[begun], cpu_seconds=[40.0]).seconds_left == 40.0
    assert Progress(total=8, n_workers=2, done=4).seconds_left is None
    assert Progress(total=8, done=4, diverged=1, failed=["a", "b", "c"]).seconds_left == 0.0


def test_runs_of_this_sweep_alone_say_how_long_one_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_up_worker(monkeypatch, finish())
    sweep(JOBS[:1], tmp_path, 1)
    seen: list[tuple[int, float | None]] = []
    made_up_worker(monkeypatch, finish())
    sweep(JOBS, tmp_path, 5, lambda p: seen.append((p.done, p.seconds_left)))
    assert seen[0] == (1, None)
    assert seen[-1] == (3, 0.0)
    seen.clear()
    sweep(JOBS, tmp_path, 1, lambda p: seen.append((p.done, p.seconds_left)))
    assert seen == [(3, 0.0)]


def test_every_run_is_counted_once_whatever_becomes_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status = "status = ['finished', 'diverged'][seed == 1]\nseed == 2 and sys.exit(1)\n"
    made_up_worker(monkeypatch, status + finish().replace("'seed': seed}", "'seed': seed, 'status': status}"))
    seen: list[tuple[int, ...]] = []
    progress = sweep(JOBS, tmp_path, 7, lambda p: seen.append(counts(p)))
    assert counts(progress) == (1, 0, 1, 1, 0, 0)
    assert all(done + diverged + failed + running + left == 3 for done, _, diverged, failed, running, left in seen)
    assert all(n >= 0 for state in seen for n in state)
    assert progress.cpu_seconds == [40.0]


def test_a_run_of_another_configuration_is_refused_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_up_worker(monkeypatch, finish())
    sweep(JOBS[:1], tmp_path, 1)
    path = run_folder(JOBS[0].config, 0, tmp_path) / "run.json"
    record = json.loads(path.read_text())
    record["config"]["reward"]["scale"] = 0.5
    path.write_text(json.dumps({**record, "config_hash": config_hash(record["config"])}))
    made_up_worker(monkeypatch, "sys.exit('it was started')")
    with pytest.raises(OtherRunError, match=r"reward\.scale: 0\.05 here, 0\.5 there"):
        sweep(JOBS, tmp_path, 1)
    assert not (tmp_path / ".lock").exists()


def test_a_run_of_the_other_engine_is_as_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_up_worker(monkeypatch, finish().replace('"engine": "native"', '"engine": "supersuit"'))
    assert counts(sweep(JOBS[:1], tmp_path, 1)) == (1, 0, 0, 0, 0, 0)
    made_up_worker(monkeypatch, "sys.exit('it was started')")
    assert counts(sweep(JOBS[:1], tmp_path, 1)) == (1, 1, 0, 0, 0, 0)


def test_a_second_sweep_on_the_folder_is_refused_by_pid(tmp_path: Path) -> None:
    with locks.folder_lock(tmp_path), pytest.raises(locks.FolderLockedError, match=f"process {os.getpid()} on host"):
        sweep(JOBS, tmp_path, 1)


SLEEPER = """
import os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
def stop(*_):
    (folder / "stopped").touch()
    sys.exit(143)
signal.signal(signal.SIGTERM, stop)
(folder / "pid.tmp").write_text(str(os.getpid()))
(folder / "pid.tmp").rename(folder / "pid")
time.sleep(60)
"""


def sweep_of_sleepers(folder: Path) -> None:
    """A sweep whose workers do nothing until they are asked to stop."""

    def start(command: list[str], **options: Any) -> Any:
        return POPEN([sys.executable, "-I", "-S", "-c", SLEEPER, str(folder)], **options)

    subprocess.Popen = start  # type: ignore[misc,assignment]
    sweep(JOBS, folder, 1)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition: Callable[[], bool], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_ends_leaves_no_worker_behind(tmp_path: Path, number: int) -> None:
    process = in_another_process(sweep_of_sleepers, tmp_path)
    wait_for((tmp_path / "pid").exists)
    worker = int((tmp_path / "pid").read_text())
    assert alive(worker)
    os.kill(process.pid or 0, number)
    process.join(10)
    wait_for(lambda: not alive(worker), 5)
    if number == signal.SIGKILL:
        assert process.exitcode == -number
    else:
        assert process.exitcode == 1, "an uncaught Stopped ends a process with 1"
        assert (tmp_path / "stopped").exists(), "the worker was not asked, so it wrote no checkpoint"
    with locks.folder_lock(tmp_path):
        pass


def test_a_worker_trains_the_job_it_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def start(command: list[str], **options: Any) -> Any:
        changes = [part for text in TINY for part in ("--set", text)]
        return POPEN([*command, *changes], **options)

    monkeypatch.setattr(executors.subprocess, "Popen", start)
    # tiny as its worker makes it, it is not the job's run any more, and that is noticed too
    with pytest.raises(OtherRunError, match=r"training\.n_worlds: 16 here, 4 there"):
        sweep(JOBS[:1], tmp_path, 1)
    assert (run_folder(JOBS[0].config, 0, tmp_path) / "episodes.csv").exists()
