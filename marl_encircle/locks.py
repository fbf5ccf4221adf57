"""A folder for one process at a time, by the kernel's lock on a file in it."""

import errno
import fcntl
import json
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK_NAME = ".lock"

# The folder may be a stranger's: its lock must not lead to another file, which would be overwritten.
_FLAGS = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_UNFIT = (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV)  # a link, a folder, a socket, no device behind it

_held_locks: set[int] = set()


class FolderLockedError(RuntimeError):
    """Another process works in the folder.

    :param folder: the folder
    :param pid: process which holds the lock; None in the instant before it has written it down
    :param host: the machine that process runs on
    """

    def __init__(self, folder: str | Path, pid: int | None, host: str | None) -> None:
        holder = "another process" if pid is None else f"process {pid} on host {host}"
        super().__init__(f"{folder}: {holder} is using this folder; wait for it to finish or choose another folder")
        self.folder = Path(folder)
        self.pid = pid
        self.host = host


class UnfitLockError(OSError):
    """What has the name of the lock is no lock file; it is left as it is."""


@contextmanager
def folder_lock(folder: str | Path) -> Iterator[None]:
    """Keep a folder to this process while the block runs.

    The lock is the kernel's, on the file ``.lock``: it falls when the process dies in whatever way, so a dead one's is
    taken over without guessing from process numbers. The file only says who holds it. Forked children do not hold it.

    :param folder: the folder; made if missing
    :raises FolderLockedError: another process (or another block of this one) holds it, with its pid and host
    :raises UnfitLockError: if the lock file is a link or no regular file
    :raises OSError: with the name of the lock file
    """
    path = Path(folder) / LOCK_NAME
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _acquire(path)
    except OSError as error:
        unfit = isinstance(error, UnfitLockError) or error.errno in _UNFIT
        kind, reason = (UnfitLockError, "not a file of its own") if unfit else (OSError, error.strerror or error)
        raise kind(error.errno, f"the folder cannot be locked: {reason}", str(path)) from error
    try:
        yield
    finally:
        if descriptor in _held_locks:  # not so in a forked child that leaves the block
            with suppress(OSError):  # a folder that has vanished takes its lock along
                path.unlink(missing_ok=True)
            _held_locks.discard(descriptor)
            with suppress(OSError):  # it is closed then too, and nothing of worth was in it
                os.close(descriptor)


def _acquire(path: Path) -> int:
    """Lock the file of that name and write down who holds it; returns the open descriptor."""
    while True:
        descriptor = os.open(path, _FLAGS, 0o666)
        try:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
                raise UnfitLockError(errno.EINVAL, "not a file of its own")
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _still_named(descriptor, path):  # else its former holder removed it between our open and our lock
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
                _held_locks.add(descriptor)
                return descriptor
        except BlockingIOError:
            raise FolderLockedError(path.parent, *_parse_holder(os.pread(descriptor, 1024, 0))) from None
        finally:
            if descriptor not in _held_locks:
                os.close(descriptor)


def _still_named(descriptor: int, path: Path) -> bool:
    """Whether the open file is the one that has the name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _parse_holder(data: bytes) -> tuple[int | None, str | None]:
    """Pid and host from a lock file; None for both while its holder has not written them yet."""
    try:
        holder = json.loads(data)
        return int(holder["pid"]), str(holder["host"])[:80]
    except (ValueError, TypeError, KeyError):
        return None, None


def _let_go_in_child() -> None:
    """Close inherited locks after a fork; the parent keeps them, and its death alone frees them."""
    for descriptor in _held_locks:
        os.close(descriptor)
    _held_locks.clear()


os.register_at_fork(after_in_child=_let_go_in_child)
