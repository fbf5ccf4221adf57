"""Whole files, written atomically: the only module of the package that writes any, save the lock files of ``locks``.

A file is never appended to and never changed in place. The new content goes to a temporary file in the same folder, is
flushed to the disk, takes the name of the old file in one step, and the folder is flushed. Whatever kills the process
at whatever moment, a reader finds the old file or the new one, each whole. When a step fails the old file is back, the
temporary file is gone, and the error names the file.

A temporary file which a killed process left behind is removed by the next save of the same file.
"""

import errno
import gzip
import hashlib
import itertools
import json
import os
import shutil
import socket
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

TEMPORARY_PREFIX = ".tmp"

COMPRESSED = ".gz"
"""Ends the name of a file that is kept compressed, in place of the one that it holds."""

# What the kernel says on opening a folder, a loop of links, a socket, a device without a driver.
_NOT_REGULAR = (errno.EISDIR, errno.ELOOP, errno.ENXIO, errno.ENODEV)

_counter = itertools.count()


class DamagedFileError(ValueError):
    """A file that cannot be trusted: cut off, changed, missing or not what its name promises.

    :param path: the file
    :param reason: what is wrong with it, in words
    """

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = Path(path)
        self.reason = reason


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8, line ends as given) as a whole.

    :param path: the file; missing folders are made
    :param text: its new content
    :raises OSError: with the file's name; the old file is unchanged
    """
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | Path, value: object) -> None:
    """Write a value as indented JSON, keys in the order given.

    :param path: the file; missing folders are made
    :param value: dicts, lists, strings, finite numbers, booleans, None
    :raises ValueError: for nan and infinity, which are not JSON
    :raises TypeError: for values that JSON does not know
    :raises OSError: with the file's name; the old file is unchanged
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def write_bytes(path: str | Path, *pieces: bytes | memoryview, former: Path | None = None) -> None:
    """Write a file as a whole.

    :param path: the file; missing folders are made
    :param pieces: its new content, one after the other
    :param former: see :func:`atomic_path`
    :raises OSError: with the file's name; the old file is unchanged
    """
    with atomic_path(path, former) as temporary:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            for piece in pieces:
                rest = memoryview(piece)
                while rest:
                    rest = rest[os.write(descriptor, rest) :]
        finally:
            os.close(descriptor)


@contextmanager
def atomic_path(path: str | Path, former: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path that becomes ``path`` when the block ends without an error.

    For libraries that insist on writing themselves. The temporary path has the suffix of ``path``, by which many choose
    the format.

    :param path: the file to be written; missing folders are made
    :param former: name in the same folder that the old file, if there is one, takes. A process killed at the wrong
        moment leaves the old file under this name and none under ``path``
    :raises OSError: with the file's name, also for errors of the block; the old file is unchanged
    """
    path = Path(path)
    temporary = path.with_name(f"{_temporary_stem()}-{next(_counter)}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        yield temporary
        _sync(temporary)
        if former is not None and path.exists():
            _rotate(temporary, path, former)
        else:
            _replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise OSError(error.errno or errno.EIO, f"not saved: {reason}", str(path)) from error
    finally:
        with suppress(OSError):  # the error under way says more than this one
            temporary.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file if there is one.

    :raises OSError: with the file's name
    """
    if path.exists():  # on a file system that is read-only, removing nothing would be an error too
        path.unlink(missing_ok=True)


def remove_temporary(folder: Path) -> None:
    """Remove what killed processes of any host left in a folder, where nobody else writes now: under its lock."""
    for path in folder.glob(f"{TEMPORARY_PREFIX}-*"):
        path.unlink(missing_ok=True)


def _temporary_stem() -> str:
    """Start of this process's temporary names: whose they are, so that only a dead process's are swept away."""
    return f"{TEMPORARY_PREFIX}-{socket.gethostname()}-{os.getpid()}"


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files of ``path`` whose process on this host has died."""
    start = f"{TEMPORARY_PREFIX}-{socket.gethostname()}-"
    with os.scandir(path.parent) as entries:
        names = [
            entry.name for entry in entries if entry.name.startswith(start) and entry.name.endswith(f"-{path.name}")
        ]
    for name in names:
        pid, _, rest = name.removeprefix(start).partition("-")
        number, _, owner = rest.partition("-")
        if owner == path.name and pid.isdigit() and number.isdigit() and not _alive(int(pid)):
            path.with_name(name).unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    """Whether a process of this number runs on this host."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _replace(temporary: Path, path: Path) -> None:
    """Give ``temporary`` the name ``path``, for good or not at all."""
    with _former(path) as former:
        temporary.replace(path)
        try:
            _sync(path.parent)
        except OSError as error:
            try:
                _restore(former, temporary, path)
            except OSError as second:
                reason = f"{second.strerror}; nor could the disk confirm the new content, which is in place"
                raise OSError(second.errno, f"the former content cannot be put back: {reason}") from error
            raise


def _rotate(temporary: Path, path: Path, former: Path) -> None:
    """Give ``path`` the name ``former`` and ``temporary`` the name ``path``, for good or not at all."""
    path.replace(former)
    try:
        temporary.replace(path)
        _sync(path.parent)
    except OSError:
        with suppress(OSError):  # the old file is then still whole, under the other name
            former.replace(path)
        raise


@contextmanager
def _former(path: Path) -> Iterator[BinaryIO | None]:
    """Open the file of that name; the handle outlives the name. None where there is no file."""
    try:
        handle = open_regular(path)
    except (FileNotFoundError, DamagedFileError):
        yield None
        return
    with handle:
        yield handle


def _restore(former: BinaryIO | None, temporary: Path, path: Path) -> None:
    """Undo a replacement that the disk did not confirm."""
    if former is None:
        path.unlink(missing_ok=True)
        return
    with temporary.open("wb") as copy:
        shutil.copyfileobj(former, copy)
    with suppress(OSError):  # a disk that flushes nothing any more still takes the name back
        _sync(temporary)
    temporary.replace(path)


def open_regular(path: str | Path) -> BinaryIO:
    """Open a file for reading that somebody else may have put there; reading a pipe or a device might never end.

    :raises DamagedFileError: if it is no regular file
    :raises OSError: if it cannot be opened, FileNotFoundError if there is none
    """
    try:
        file = open(path, "rb", opener=_open_at_once)  # noqa: SIM115 - Path.open takes no opener
    except OSError as error:
        if error.errno in _NOT_REGULAR:
            raise DamagedFileError(path, "not a regular file") from error
        raise
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise DamagedFileError(path, "not a regular file")
    return file


def _open_at_once(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NONBLOCK)  # nobody may ever come to the other end of a pipe


def read_bytes(path: str | Path, *, sha256: str | None = None, max_bytes: int | None = None) -> bytes:
    """Read a file that somebody else may have changed, or may keep compressed under its name with ``.gz``.

    :param path: the file
    :param sha256: what it must hash to, in hexadecimal, uncompressed
    :param max_bytes: size above which it is refused unread
    :return: its content
    :raises DamagedFileError: when it is missing, no regular file, too large or not what was written
    """
    path = Path(path)
    limit = -1 if max_bytes is None else max_bytes + 1
    try:
        if not path.exists() and compressed(path).exists():
            path = compressed(path)
            data = _decompress(path, limit)
        else:
            with open_regular(path) as file:
                data = file.read(limit)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DamagedFileError(path, "the file is missing") from error
    if max_bytes is not None and len(data) > max_bytes:
        raise DamagedFileError(path, f"larger than the {max_bytes} bytes allowed")
    if sha256 is not None and sha256_bytes(data) != sha256:
        raise DamagedFileError(
            path, f"changed since it was written: sha256 is {sha256_bytes(data)}, expected {sha256[:80]}"
        )
    return data


def compressed(path: Path) -> Path:
    """Return the name under which a file would be kept compressed."""
    return path.with_name(path.name + COMPRESSED)


def is_kept(path: Path) -> bool:
    """Whether there is such a file, compressed or not."""
    return path.exists() or compressed(path).exists()


def _decompress(path: Path, limit: int) -> bytes:
    """Return what a compressed file holds, no more than ``limit`` bytes of it unless that is -1."""
    try:
        with open_regular(path) as file, gzip.GzipFile(fileobj=file) as content:
            return content.read(limit)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise DamagedFileError(path, f"not a whole gzip file: {error}") from error


def sha256_bytes(data: bytes) -> str:
    """SHA-256 of bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()
