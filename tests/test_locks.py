import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faults import fail_everywhere

from marl_encircle import locks


def run_module(code: str, *args: object) -> list[str]:
    """Command that runs ``code`` with ``locks`` as a dict of the module's names, without importing the package."""
    start = "import runpy, sys; locks = runpy.run_path(sys.argv[1]); "
    return [sys.executable, "-I", "-S", "-c", start + code, str(locks.__file__), *map(str, args)]


HOLD_LOCK = """
import time
with locks["folder_lock"](sys.argv[2]):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(run_module(HOLD_LOCK, tmp_path), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_the_second_one_is_refused_by_pid_and_host(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    with pytest.raises(locks.FolderLockedError) as caught, locks.folder_lock(tmp_path):
        pass
    assert (caught.value.pid, caught.value.host) == (holder.pid, socket.gethostname())
    assert f"process {holder.pid} on host {socket.gethostname()}" in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_dead_ones_lock_is_taken_over(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    holder.kill()
    holder.wait()
    assert json.loads((tmp_path / ".lock").read_text())["pid"] == holder.pid
    with locks.folder_lock(tmp_path):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_one_process_cannot_hold_a_folder_twice_and_can_take_it_again(tmp_path: Path) -> None:
    with locks.folder_lock(tmp_path):
        with pytest.raises(locks.FolderLockedError, match=str(os.getpid())), locks.folder_lock(tmp_path):
            pass
        with pytest.raises(locks.FolderLockedError), locks.folder_lock(tmp_path):
            pass
    with locks.folder_lock(tmp_path / "below"), locks.folder_lock(tmp_path):
        pass


HOLD_LOCK_AND_FORK = """
import os, time
with locks["folder_lock"](sys.argv[2]):
    if os.fork() == 0:  # the child tells of itself when it is done with what a fork does
        print(os.getpid(), flush=True)
    time.sleep(60)
"""


def test_a_dead_ones_lock_is_taken_over_while_its_forked_child_lives(tmp_path: Path) -> None:
    with subprocess.Popen(run_module(HOLD_LOCK_AND_FORK, tmp_path), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        try:
            with pytest.raises(locks.FolderLockedError, match=str(process.pid)), locks.folder_lock(tmp_path):
                pass
            process.kill()
            process.wait()
            os.kill(child, 0)
            with locks.folder_lock(tmp_path):
                pass
        finally:
            os.kill(child, signal.SIGKILL)


def test_a_lock_whose_holder_removed_it_just_now_is_not_taken_for_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = fcntl.flock, iter(range(1_000))

    def flock(descriptor: int, operation: int) -> None:
        if next(calls) == 0:
            (tmp_path / ".lock").unlink()
        real(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with locks.folder_lock(tmp_path), pytest.raises(locks.FolderLockedError), locks.folder_lock(tmp_path):
        pass


def test_a_lock_that_says_nothing_readable_still_locks(tmp_path: Path, holder: subprocess.Popen[str]) -> None:
    (tmp_path / ".lock").write_bytes(b"\xff[")
    with (
        pytest.raises(locks.FolderLockedError, match="another process is using this folder"),
        locks.folder_lock(tmp_path),
    ):
        pass


def test_every_call_of_a_lock_may_fail(tmp_path: Path) -> None:
    def check(folder: Path, error: OSError | None) -> None:
        if error is not None:
            assert (error.errno, error.filename) == (errno.EIO, str(folder / ".lock"))
        with locks.folder_lock(folder):
            pass

    def lock(folder: Path) -> None:
        with locks.folder_lock(folder):
            pass

    calls = fail_everywhere(tmp_path, lambda _: None, lock, check, errno.EIO)
    assert calls == ["mkdir", "open", "ftruncate", "write", "unlink", "close"]


def test_a_folder_that_cannot_be_locked_is_an_error_that_names_the_lock(tmp_path: Path) -> None:
    (tmp_path / ".lock").mkdir()
    with pytest.raises(OSError, match=r"cannot be locked.*/\.lock"), locks.folder_lock(tmp_path):
        pass


@pytest.mark.parametrize("make", [Path.symlink_to, Path.hardlink_to])
def test_a_lock_that_is_a_link_leaves_the_other_file_alone(tmp_path: Path, make: Callable[[Path, Path], None]) -> None:
    folder, victim = tmp_path / "folder", tmp_path / "victim.txt"
    folder.mkdir()
    victim.write_text("mine")
    make(folder / ".lock", victim)
    with (
        pytest.raises(locks.UnfitLockError, match=r"cannot be locked: not a file of its own: .*/\.lock"),
        locks.folder_lock(folder),
    ):
        pass
    assert victim.read_text() == "mine"
    assert (folder / ".lock").exists()


def test_a_lock_that_points_nowhere_makes_nothing(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / ".lock").symlink_to(tmp_path / "new.txt")
    with pytest.raises(locks.UnfitLockError), locks.folder_lock(tmp_path / "folder"):
        pass
    assert not (tmp_path / "new.txt").exists()


def test_a_lock_that_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises(locks.UnfitLockError), locks.folder_lock(tmp_path):
        pass
    (tmp_path / ".lock").unlink()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / ".lock"))
        with pytest.raises(locks.UnfitLockError), locks.folder_lock(tmp_path):
            pass


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    def count() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = count()
    for _ in range(20):
        with locks.folder_lock(tmp_path), pytest.raises(locks.FolderLockedError), locks.folder_lock(tmp_path):
            pass
    assert count() == before
