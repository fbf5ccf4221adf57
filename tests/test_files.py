import errno
import gzip
import json
import os
import random
import resource
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from marl_encircle import files

OLD = b"the old content"
NEW = b"the new content, longer than the old one"

# Every call of os that a save makes, in the order of the calls; fsync and open come twice: the file, then its folder.
STEPS = ["mkdir", "scandir", "open", "write", "close", "fsync", "replace"]
ERRNOS = [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EACCES]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def fail_at(monkeypatch: pytest.MonkeyPatch, step: str, call: int, number: int, forever: bool = False) -> None:
    """Make the ``call``-th call of ``os.<step>`` fail, and with ``forever`` all later ones."""
    real, calls = getattr(os, step), iter(range(1_000))

    def failing(*args: object, **kwargs: object) -> object:
        at = next(calls)
        if at == call or (forever and at > call):
            if step == "close":
                real(*args, **kwargs)
            raise OSError(number, os.strerror(number))
        return real(*args, **kwargs)

    monkeypatch.setattr(os, step, failing)


def test_writers_write_exactly_what_they_are_given(tmp_path: Path) -> None:
    files.write_bytes(tmp_path / "b", b"\x00\r\n\xff")
    files.write_text(tmp_path / "t", "λ\r\n1\n")
    files.write_json(tmp_path / "new" / "j.json", {"b": 1, "a": [None, 0.1, "λ"]})
    assert (tmp_path / "b").read_bytes() == b"\x00\r\n\xff"
    assert (tmp_path / "t").read_bytes() == "λ\r\n1\n".encode()
    text = (tmp_path / "new" / "j.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"b": 1, "a": [None, 0.1, "λ"]}
    assert text.index('"b"') < text.index('"a"')
    assert '"λ"' in text
    assert text.endswith("}\n")
    assert names(tmp_path) == ["b", "new", "t"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object()])
def test_what_json_does_not_know_is_refused_before_the_disk_is_touched(tmp_path: Path, value: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        files.write_json(tmp_path / "new" / "j.json", {"x": value})
    assert names(tmp_path) == []


def test_a_new_file_has_the_permissions_of_an_ordinary_one(tmp_path: Path) -> None:
    (tmp_path / "ordinary").write_bytes(b"")
    files.write_bytes(tmp_path / "ours", b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "ordinary").stat().st_mode


def test_a_short_write_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: real(descriptor, data[:3]))
    files.write_bytes(tmp_path / "f", NEW)
    assert (tmp_path / "f").read_bytes() == NEW


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("number", ERRNOS, ids=lambda number: errno.errorcode[number])
@pytest.mark.parametrize(("step", "call"), [(step, call) for step in STEPS for call in range(3)])
def test_a_failing_step_keeps_the_old_state_and_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, call: int, number: int, exists: bool
) -> None:
    folder = tmp_path / "new" if step == "mkdir" else tmp_path
    path = folder / "f.json"
    if exists and step != "mkdir":
        path.write_bytes(OLD)
    error = None
    with monkeypatch.context() as patch:
        fail_at(patch, step, call, number)
        try:
            files.write_bytes(path, NEW)
        except OSError as caught:
            error = caught
    reached = {"mkdir": 1, "scandir": 1, "write": 1, "replace": 1, "fsync": 2, "open": 3, "close": 3}[step]
    if call < reached:
        assert error is not None
        assert (error.errno, error.filename) == (number, str(path))
        assert str(path) in str(error)
        assert not folder.exists() or {name: (folder / name).read_bytes() for name in names(folder)} == (
            {"f.json": OLD} if exists else {}
        )
    else:
        assert error is None
        assert path.read_bytes() == NEW
        assert names(folder) == ["f.json"]


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("call", [0, 1])
def test_a_disk_that_never_flushes_again_keeps_the_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int, exists: bool
) -> None:
    path = tmp_path / "f"
    if exists:
        path.write_bytes(OLD)
    with monkeypatch.context() as patch:
        fail_at(patch, "fsync", call, errno.EIO, forever=True)
        with pytest.raises(OSError, match="not saved"):
            files.write_bytes(path, NEW)
    assert names(tmp_path) == (["f"] if exists else [])
    assert not exists or path.read_bytes() == OLD


def test_when_the_old_content_cannot_be_put_back_the_error_says_which_one_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "f"
    path.write_bytes(OLD)
    with monkeypatch.context() as patch:
        fail_at(patch, "fsync", 1, errno.EIO)
        fail_at(patch, "replace", 1, errno.EROFS)
        with pytest.raises(OSError, match="cannot be put back") as caught:
            files.write_bytes(path, NEW)
    assert caught.value.filename == str(path)
    assert path.read_bytes() == NEW
    assert names(tmp_path) == ["f"]


def test_a_real_limit_on_the_file_size_keeps_the_old_state(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(OLD)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match="not saved") as caught:
            files.write_bytes(path, bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.errno == errno.EFBIG
    assert path.read_bytes() == OLD
    assert names(tmp_path) == ["f"]


def test_a_folder_in_the_place_of_the_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "f").mkdir()
    with pytest.raises(IsADirectoryError, match=r"not saved.*/f'"):
        files.write_bytes(tmp_path / "f", NEW)
    assert names(tmp_path) == ["f"]


def test_a_link_is_replaced_and_what_it_points_to_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_bytes(OLD)
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    files.write_bytes(tmp_path / "link", NEW)
    assert (tmp_path / "elsewhere").read_bytes() == OLD
    assert (tmp_path / "link").read_bytes() == NEW


def test_atomic_path_keeps_folder_and_suffix_and_takes_the_name_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "figure.svg"
    path.write_bytes(OLD)
    with files.atomic_path(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".svg"
        temporary.write_bytes(NEW)
        assert path.read_bytes() == OLD
    assert path.read_bytes() == NEW
    assert names(tmp_path) == ["figure.svg"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_error_in_the_block_of_atomic_path_keeps_the_old_state(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "f"
    path.write_bytes(OLD)

    def save() -> None:
        with files.atomic_path(path) as temporary:
            temporary.write_bytes(NEW)
            raise error

    with pytest.raises(error):
        save()
    assert path.read_bytes() == OLD
    assert names(tmp_path) == ["f"]


def test_an_error_of_a_library_without_a_number_keeps_its_words(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="not saved: the encoder broke") as caught, files.atomic_path(tmp_path / "f"):
        raise OSError("the encoder broke")
    assert caught.value.filename == str(tmp_path / "f")


def test_a_block_of_atomic_path_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="not saved"), files.atomic_path(tmp_path / "f"):
        pass
    assert names(tmp_path) == []


def run_module(code: str, *args: object) -> list[str]:
    """Command that runs ``code`` with ``files`` as a dict of the module's names, without importing the package."""
    start = "import runpy, sys; files = runpy.run_path(sys.argv[1]); "
    return [sys.executable, "-I", "-S", "-c", start + code, str(files.__file__), *map(str, args)]


SAVE_LOOP = """
import hashlib, itertools
for i in itertools.count():
    body = str(i).encode() * 20_000
    files["write_bytes"](sys.argv[2], hashlib.sha256(body).digest() + body)
    print(i, flush=True)
"""


def test_sigkill_in_a_save_loop_leaves_the_last_save_or_a_newer_one_whole(tmp_path: Path) -> None:
    path, rng = tmp_path / "f", random.Random(7)
    for _ in range(30):
        with subprocess.Popen(run_module(SAVE_LOOP, path), stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0, 0.02))
            process.kill()
            confirmed = [int(line) for line in process.stdout.read().split("\n")[:-1]]
        data = path.read_bytes()
        digest, body = data[:32], data[32:]
        assert bytes.fromhex(files.sha256_bytes(body)) == digest
        number = int(body[: len(body) // 20_000])
        assert body == str(number).encode() * 20_000
        assert not confirmed or number >= confirmed[-1]
    files.write_bytes(path, NEW)
    assert names(tmp_path) == ["f"], "the next save sweeps up what killed ones left"


def test_only_a_dead_process_of_this_host_is_swept_up_after(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-S", "-c", ""]) as process:
        process.wait()
    dead = f".tmp-{socket.gethostname()}-{process.pid}-0-f"
    kept = [
        f".tmp-{socket.gethostname()}-{os.getppid()}-0-f",
        f".tmp-otherhost-{process.pid}-0-f",
        dead + ".json",
        "f-f",
    ]
    for name in [dead, *kept]:
        (tmp_path / name).write_bytes(b"")
    files.write_bytes(tmp_path / "f", NEW)
    assert names(tmp_path) == sorted([*kept, "f"])


def test_hashes_are_those_of_the_standard() -> None:
    # FIPS 180-2, appendix B.1: the message "abc"
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert files.sha256_bytes(b"abc") == expected


def test_reading_refuses_what_is_missing_large_or_changed(tmp_path: Path) -> None:
    path = tmp_path / "f"
    with pytest.raises(files.DamagedFileError, match="missing"):
        files.read_bytes(path)
    path.write_bytes(OLD)
    assert files.read_bytes(path, sha256=files.sha256_bytes(OLD), max_bytes=len(OLD)) == OLD
    assert files.read_bytes(path, max_bytes=1000) == OLD
    with pytest.raises(files.DamagedFileError, match="larger than the 3 bytes"):
        files.read_bytes(path, max_bytes=3)
    with pytest.raises(files.DamagedFileError, match="changed since it was written") as caught:
        files.read_bytes(path, sha256=files.sha256_bytes(NEW))
    assert caught.value.path == path
    assert str(path) in str(caught.value)


def test_a_compressed_file_stands_for_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "f"
    assert not files.is_kept(path)
    files.compressed(path).write_bytes(gzip.compress(OLD))
    assert files.is_kept(path)
    assert files.read_bytes(path, sha256=files.sha256_bytes(OLD), max_bytes=len(OLD)) == OLD
    assert files.read_bytes(path) == OLD
    path.write_bytes(NEW)
    assert files.read_bytes(path) == NEW


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (gzip.compress(OLD)[:-9], "not a whole gzip file"),
        (gzip.compress(OLD)[:-4] + b"size", "not a whole gzip file"),
        (OLD, "not a whole gzip file"),
        (gzip.compress(OLD)[:10] + OLD, "not a whole gzip file"),
        (gzip.compress(bytes(1 << 20)), "larger than the 1000 bytes"),
        (gzip.compress(NEW), "changed since it was written"),
    ],
    ids=["cut off", "another size", "not compressed", "no deflate stream", "a bomb", "another content"],
)
def test_a_damaged_compressed_file_is_an_error_that_names_it(tmp_path: Path, data: bytes, reason: str) -> None:
    files.compressed(tmp_path / "f").write_bytes(data)
    with pytest.raises(files.DamagedFileError, match=rf"f\.gz: {reason}"):
        files.read_bytes(tmp_path / "f", sha256=files.sha256_bytes(OLD), max_bytes=1000)


def test_a_pipe_is_refused_at_once_since_nobody_may_ever_write_to_it(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(OLD)
    with files.open_regular(tmp_path / "f") as file:
        assert not os.get_blocking(file.fileno())
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(files.DamagedFileError, match="not a regular file"):
        files.read_bytes(tmp_path / "pipe")


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    def count() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = count()
    for _ in range(20):
        files.write_bytes(tmp_path / "f", NEW)
        with pytest.raises(ZeroDivisionError), files.atomic_path(tmp_path / "f"):
            _ = 1 / 0
    assert count() == before
