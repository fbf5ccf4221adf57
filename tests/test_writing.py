"""Whatever a disk refuses, and whenever: the former state loads, nothing is left over, and the error says so.

What cannot be seen here: a disk that loses what it has confirmed, and a cut of the power.
"""

import ast
import errno
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import (
    ERRNOS,
    fail_everywhere,
    folder_for_reading,
    largest_file,
    temporary_files,
    without_the_right_to_write,
)

from marl_encircle import files
from marl_encircle.experiments import checkpoint

ROOT = Path(__file__).parents[1]


# the ways to save


def tree(number: int) -> dict[str, Any]:
    return {"number": number, "array": np.full(3000, number)}


def save_checkpoint(folder: Path, number: int) -> None:
    checkpoint.save(folder, tree(number))


def load_checkpoint(folder: Path) -> int | None:
    saved = checkpoint.load(folder)
    assert saved is None or (saved["array"] == saved["number"]).all()
    return None if saved is None else int(saved["number"])


def save_bytes(folder: Path, number: int) -> None:
    files.write_bytes(folder / "file", bytes([number]) * 20_000)


def load_bytes(folder: Path) -> int | None:
    try:
        data = (folder / "file").read_bytes()
    except FileNotFoundError:
        return None
    assert data == bytes([data[0]]) * 20_000
    return data[0]


def save_by_a_library(folder: Path, number: int) -> None:
    with files.atomic_path(folder / "file") as temporary, temporary.open("wb") as file:
        file.write(bytes([number]) * 20_000)


Save = Callable[[Path, int], None]
Load = Callable[[Path], int | None]
WAYS = [(save_bytes, load_bytes), (save_by_a_library, load_bytes), (save_checkpoint, load_checkpoint)]


def check_state(folder: Path, load: Load, state: int | None) -> None:
    assert load(folder) == state
    assert temporary_files(folder) == []


@pytest.mark.parametrize("number", ERRNOS, ids=errno.errorcode.get)
@pytest.mark.parametrize("former", [0, 1, 2], ids=["new", "second", "third"])
@pytest.mark.parametrize(("save", "load"), WAYS)
def test_every_call_may_fail(tmp_path: Path, save: Save, load: Load, former: int, number: int) -> None:
    def prepare(folder: Path) -> None:
        for i in range(former):
            save(folder, i)

    def check(folder: Path, error: OSError | None) -> None:
        check_state(folder, load, former if error is None else former - 1 if former else None)
        if error is not None:
            assert error.errno == number
            assert str(error.filename).startswith(str(folder))

    calls = fail_everywhere(tmp_path, prepare, lambda folder: save(folder, former), check, number)
    assert {"mkdir", "scandir", "fsync", "replace"} <= set(calls)
    assert calls.count("fsync") == 2, "of the file and of its folder"


@pytest.mark.parametrize(("save", "load"), WAYS)
def test_a_limit_on_the_size_of_a_file_keeps_the_former_state(tmp_path: Path, save: Save, load: Load) -> None:
    save(tmp_path, 1)
    whole = sum(path.stat().st_size for path in tmp_path.iterdir())
    for n_bytes in range(0, whole, whole // 50):
        with largest_file(n_bytes), pytest.raises(OSError, match=r"not saved|File too large"):
            save(tmp_path, 2)
        check_state(tmp_path, load, 1)
    save(tmp_path, 2)
    assert load(tmp_path) == 2


@pytest.mark.parametrize(("save", "load"), WAYS)
def test_a_folder_for_reading_keeps_the_former_state(save: Save, load: Load) -> None:
    with folder_for_reading() as folder:
        save(folder, 1)
        with without_the_right_to_write(folder), pytest.raises(PermissionError, match="not saved") as caught:
            save(folder, 2)
        assert str(caught.value.filename).startswith(str(folder))
        check_state(folder, load, 1)


FILL = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import test_writing
folder = Path(sys.argv[2])
for save, load in test_writing.WAYS:
    for path in folder.iterdir():
        path.unlink()
    save(folder, 1)
    free = os.statvfs(folder).f_bavail * os.statvfs(folder).f_frsize
    (folder / "filler").write_bytes(bytes(free - 8192))
    try:
        save(folder, 2)
    except OSError as error:
        assert error.errno == 28, error
    else:
        raise AssertionError(f"{save.__name__} was not refused")
    (folder / "filler").unlink()
    test_writing.check_state(folder, load, 1)
    save(folder, 2)
    test_writing.check_state(folder, load, 2)
"""


def in_a_small_file_system(size: str, folder: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command that has a file system of its own, of that size, in a folder; skip where that is not allowed."""
    mount = f'mount -t tmpfs -o size={size} tmpfs "$0"'
    isolated = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    try:
        subprocess.run([*isolated, mount, folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no file system of one's own here: {error}")
    whole = [*isolated, f'{mount} && exec "$@"', folder, *command]
    return subprocess.run(whole, capture_output=True, text=True, check=False)


def test_a_real_full_disk_keeps_the_former_state(tmp_path: Path) -> None:
    done = in_a_small_file_system("200k", tmp_path, sys.executable, "-c", FILL, Path(__file__).parent, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


# nobody else writes

OS = {
    "open", "write", "rename", "replace", "renames", "remove", "unlink", "rmdir", "mkdir", "makedirs", "truncate",
    "ftruncate", "link", "symlink", "mkfifo", "sendfile", "pwrite", "fdopen",
}  # fmt: skip
METHODS = {
    "write_text", "write_bytes", "touch", "rename", "unlink", "rmdir", "mkdir", "symlink_to", "hardlink_to", "tofile",
    "savefig", "imsave", "imwrite", "mimsave", "mimwrite", "get_writer", "save", "savez", "savez_compressed", "savetxt",
    "save_file", "dump", "memmap", "to_csv", "to_parquet", "to_json", "FileHandler", "ZipFile", "SummaryWriter",
}  # fmt: skip
FUNCTIONS = {"save_file", "imsave", "imwrite", "FileHandler", "ZipFile", "SummaryWriter"}
MODULES = {"shutil", "tempfile"}
OURS = {"files", "checkpoint", "film", "self"}  # their own calls are looked at where they stand

# What is allowed outside `files`, and why.
ALLOWED = {
    "locks.py": ["mkdir", "os.ftruncate", "os.open", "os.write", "unlink"],  # a lock is changed in place
    "core/compilation.py": ["mkdir", "tempfile.TemporaryFile", "tempfile.mkdtemp"],  # Numba's cache
    # To read; a path of `atomic_path`; SB3's to it, as is its `save_replay_buffer`
    "maddpg/saving.py": ["ZipFile", "open", "save"],
    "experiments/build.py": ["save"],  # to bytes
    "experiments/checkpoint.py": ["replace"],  # a damaged checkpoint is put aside
    "experiments/export.py": ["save", "save"],  # to bytes
    "experiments/callbacks.py": ["dump"],  # to the logger
    "experiments/tensorboard.py": ["SummaryWriter", "mkdir", "symlink_to", "unlink"],  # what TensorBoard shows
    "experiments/trials.py": ["dump"],  # to a text
    "replays/film.py": ["get_writer", "save", "save"],  # to a path of `atomic_path`, to bytes
    "study/figures/canvas.py": ["save", "savefig"],  # to bytes
    "study/reproduce.py": ["unlink"],  # a table that there is no run for any more
}


def writers(source: str) -> list[str]:
    """Names of the calls in a module that may write."""
    return sorted(name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call) for name in _writer(node))


def _writer(call: ast.Call) -> Iterator[str]:
    match call.func:
        case ast.Name("open") | ast.Attribute(attr="open") if _opens_to_write(call):
            yield "open"
        case ast.Attribute(ast.Name(module), _) if module in OURS:
            return
        case ast.Attribute(ast.Name("os"), name) if name in OS:
            yield f"os.{name}"
        case ast.Attribute(ast.Name(module), name) if module in MODULES:
            yield f"{module}.{name}"
        case ast.Attribute(_, "replace") if len(call.args) == 1 and not call.keywords:  # a string's takes two
            yield "replace"
        case ast.Attribute(_, name) if name in METHODS:
            yield name
        case ast.Name(name) if name in FUNCTIONS:
            yield name


def _opens_to_write(call: ast.Call) -> bool:
    """Whether a mode is not one for reading, or unknown; ``os.open`` has flags and is told apart."""
    if isinstance(call.func, ast.Attribute) and isinstance(call.func.value, ast.Name) and call.func.value.id == "os":
        return False
    given = [
        argument for argument in call.args if isinstance(argument, ast.Constant) and isinstance(argument.value, str)
    ]
    modes = [keyword.value for keyword in call.keywords if keyword.arg == "mode"] or given[-1:]
    return any(not isinstance(mode, ast.Constant) or set("wax+") & set(str(mode.value)) for mode in modes)


def test_only_the_one_writer_writes() -> None:
    package = ROOT / "marl_encircle"
    found = {}
    for path in sorted([*package.rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]):
        name = str(path.relative_to(package if path.is_relative_to(package) else ROOT))
        if name != "files.py":
            found[name] = writers(path.read_text(encoding="utf-8"))
    assert {name: calls for name, calls in found.items() if calls} == ALLOWED


@pytest.mark.parametrize(
    "source",
    [
        "open(path, 'w')", "path.open('xb')", "open(path, mode='a')", "open(path, mode=mode)", "io.open(path, 'r+')",
        "path.write_text('')", "Path(name).write_bytes(b'')", "np.save(path, array)", "torch.save(model, path)",
        "json.dump(value, file)", "pickle.dump(value, file)", "shutil.copy(a, b)", "os.rename(a, b)", "a.replace(b)",
        "figure.savefig(path)", "os.open(path, flags)", "tempfile.NamedTemporaryFile()", "path.touch()",
        "safetensors.numpy.save_file(arrays, path)", "save_file(arrays, path)", "frame.to_csv(path)",
    ],
)  # fmt: skip
def test_every_other_writer_would_be_found(source: str) -> None:
    assert writers(f"def f():\n    {source}") != []


@pytest.mark.parametrize(
    "source", ["open(path)", "path.open('rb')", "'a'.replace('a', 'b')", "files.write_text(path, '')", "json.dumps(1)"]
)
def test_what_only_reads_is_no_writer(source: str) -> None:
    assert writers(source) == []
