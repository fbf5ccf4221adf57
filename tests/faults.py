"""Disks that fail: any call of the system in turn, a limit on the size of files, a folder for reading only."""

import errno
import itertools
import os
import resource
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ERRNOS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EACCES)
CALLS = ("mkdir", "scandir", "open", "write", "fsync", "close", "replace", "rename", "unlink", "ftruncate", "link")


class Fault:
    """What a failing disk has done.

    :param call: which of the calls fails, counted from 0
    """

    def __init__(self, call: int) -> None:
        self.call = call
        self.calls: list[str] = []

    @property
    def struck(self) -> bool:
        return len(self.calls) > self.call


@contextmanager
def failing_disk(folder: Path, call: int, number: int) -> Iterator[Fault]:
    """Have one call of ``os`` fail that touches something in a folder; others go through.

    :param number: the error, for example ``errno.ENOSPC``
    """
    fault, descriptors = Fault(call), set[int]()

    def failing(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def wrapper(*arguments: Any, **options: Any) -> Any:
            target = arguments[0]
            if not (target in descriptors if isinstance(target, int) else str(target).startswith(str(folder))):
                return real(*arguments, **options)
            fault.calls.append(name)
            fails = len(fault.calls) == call + 1
            if name == "close":
                descriptors.discard(target)
            if fails and name != "close":
                raise OSError(number, os.strerror(number), *([] if isinstance(target, int) else [str(target)]))
            result = real(*arguments, **options)
            if fails:  # a descriptor is closed even where that fails
                raise OSError(number, os.strerror(number))
            if name == "open":
                descriptors.add(result)
            return result

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, failing(name))
        yield fault


def fail_everywhere(
    above: Path,
    prepare: Callable[[Path], object],
    act: Callable[[Path], object],
    check: Callable[[Path, OSError | None], object],
    number: int,
) -> list[str]:
    """Do something in ever new folders, each time with another of its calls failing, until none is left to fail.

    :param above: where the folders come
    :param check: called after each time with the error, if there was one
    :return: the calls that failed
    """
    for call in itertools.count():
        folder = above / str(call)
        folder.mkdir()
        prepare(folder)
        error = None
        with failing_disk(folder, call, number) as fault:
            try:
                act(folder)
            except OSError as caught:
                error = caught
        check(folder, error)
        if not fault.struck:
            assert error is None
            return fault.calls
    raise AssertionError


@contextmanager
def largest_file(n_bytes: int) -> Iterator[None]:
    """Have the kernel refuse to let a file grow beyond a size, whoever writes it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def folder_for_reading() -> Iterator[Path]:
    """A folder that this process may not write to, also where root runs the tests; its owner fills it before."""
    with tempfile.TemporaryDirectory() as above:
        folder = Path(above) / "folder"
        folder.mkdir()
        for path in (Path(above), folder):
            path.chmod(0o755)
        yield folder
        folder.chmod(0o755)


@contextmanager
def without_the_right_to_write(folder: Path) -> Iterator[None]:
    """Take the right to write to a folder away; root, whom it would not stop, becomes an ordinary user meanwhile."""
    folder.chmod(0o555)
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)
        folder.chmod(0o755)


def temporary_files(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".tmp*")]
