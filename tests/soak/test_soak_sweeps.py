"""Sweeps that are killed, run twice at once, or fill the disk: the tables are those of a quiet one."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import FILES

KILLS = 10
GRID = """
profile: smoke
groups:
  - methods: [ours, model_a, model_b, ma2019]
    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]
    seeds: [900, 901, 902]
shared: []
"""
SWEEP = [sys.executable, str(Path(__file__).with_name("sweep_often.py")), "reproduce-tables", "--jobs", "2"]


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grid") / "grid.yaml"
    path.write_text(GRID)
    return path


@pytest.fixture(scope="module")
def quiet(grid: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], float]:
    """What an undisturbed sweep leaves, and the seconds that it took."""
    out, started = tmp_path_factory.mktemp("quiet") / "out", time.monotonic()
    out.mkdir()
    assert start(grid, out).wait() == 0
    return results(out), time.monotonic() - started


def start(grid: Path, out: Path) -> subprocess.Popen[bytes]:
    with (out.parent / "said.txt").open("ab") as said:
        return subprocess.Popen(
            [*SWEEP, "--grid", str(grid), "--out", str(out)],
            env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=said,
        )  # fmt: skip


def results(out: Path) -> dict[str, bytes]:
    """Tables and runs, but for what times and versions are in."""
    paths = [path for path in out.rglob("*") if path.parent.name == "tables" or path.name in FILES]
    return {str(path.relative_to(out)): path.read_bytes() for path in paths}


def records(out: Path) -> dict[Path, tuple[int, bytes]]:
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.rglob("run.json")}


def workers_of(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_kills_of_parent_and_workers_change_no_table_and_repeat_no_run(
    grid: Path, quiet: tuple[dict[str, bytes], float], tmp_path: Path, promise: Any
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    wanted, seconds = quiet
    rng = random.Random(5)
    kills = {"parent": 0, "worker": 0}
    sweep, seen, refused = start(grid, out), {}, None
    while sum(kills.values()) < KILLS:
        deadline = time.monotonic() + 300
        while not workers_of(sweep.pid) and sweep.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(rng.uniform(0.02, 0.2) * seconds)
        workers = workers_of(sweep.pid)
        if sweep.poll() is None and refused is None:
            refused = start(grid, out).wait(), sweep.pid
        seen |= {path: found for path, found in records(out).items() if path not in seen}
        if workers and rng.random() < 0.5:
            os.kill(rng.choice(workers), signal.SIGKILL)
            kills["worker"] += 1
        elif sweep.poll() is None:
            sweep.kill()
            sweep.wait()
            kills["parent"] += 1
            deadline = time.monotonic() + 60
            while any(map(alive, workers)):
                assert time.monotonic() < deadline, "orphans"
                time.sleep(0.02)
            sweep = start(grid, out)
        else:
            assert sweep.returncode == 1, "it was done before it was killed often enough"
            sweep = start(grid, out)
    code = sweep.wait() and start(grid, out).wait()
    found = results(out)
    differ = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    repeated = [str(path) for path, record in seen.items() if records(out)[path] != record]
    how = ", ".join(f"{number} of {who}s" for who, number in kills.items())
    promise(f"tables and files of runs that {how} killed change", len(differ), 0)
    promise("finished runs that a killed sweep repeated", len(repeated), 0)
    assert refused is not None
    second_code, first_pid = refused
    told = f"process {first_pid} on host {socket.gethostname()}" in (tmp_path / "said.txt").read_text()
    promise("second sweeps on one folder that are let in, or not told by whom it is taken", int(not told), 0)
    assert code == 0
    assert differ == []
    assert repeated == []
    assert list(out.rglob("checkpoint*")) == []
    assert second_code == 2
    assert told


FULL = """
set -u
mount -t tmpfs -o size=2500k tmpfs "$0" || exit 99
"$@" 2> "$0/../full.txt"
echo "full: $?"
mount -o remount,size=500m "$0"
"$@" 2> "$0/../wide.txt"
echo "wide: $?"
cp -r "$0" "$0/../copy"
"""


def test_a_disk_that_is_full_in_the_midst_costs_no_result(
    grid: Path, quiet: tuple[dict[str, bytes], float], tmp_path: Path, promise: Any
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    isolated = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", FULL, str(out)]
    try:
        done = subprocess.run(
            [*isolated, *SWEEP, "--grid", str(grid), "--out", str(out)],
            env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        pytest.skip("no unshare here")
    if done.returncode == 99 or "unshare" in done.stderr:
        pytest.skip(f"no file system of one's own here: {done.stderr}")
    said = (tmp_path / "full.txt").read_text()
    codes = [line for line in done.stdout.splitlines() if line[:4] in ("full", "wide")]
    found = results(tmp_path / "copy")
    differ = sorted(name for name in quiet[0].keys() | found.keys() if quiet[0].get(name) != found.get(name))
    promise("tables and files of runs that a full disk changes, once there is room again", len(differ), 0)
    assert codes == ["full: 1", "wide: 0"]
    assert "No space left on device" in said
    assert "Traceback" not in said
    assert differ == []
    assert list((tmp_path / "copy").rglob(".tmp*")) == []
