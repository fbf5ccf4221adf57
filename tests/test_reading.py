"""Files that a stranger may have put there are opened in one place, which waits for none that may never end."""

import ast
import json
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from marl_encircle import files, load_policy
from marl_encircle.experiments import checkpoint
from marl_encircle.experiments.divergence import NAME, load_moment
from marl_encircle.experiments.play_with import DESCRIPTION, WEIGHTS, load_played
from marl_encircle.experiments.sweep import Running
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.timeout(20)  # what waits for the other end of a pipe waits for ever


def listen(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))


TRAPS: dict[str, Callable[[Path], None]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a socket": listen,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a loop of links": lambda path: path.symlink_to(path.name),
}


def load_weights(path: Path) -> None:
    """As those of a policy whose description is fine."""
    about = {
        "action_low": [-1.0], "action_high": [1.0], "observation_shape": [2], "agents": ["a"], "net_arch": [4],
        "sha256": "",
    }  # fmt: skip
    (path.parent / DESCRIPTION).write_text(json.dumps(about))
    load_played(path.parent)


DOORS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "read_bytes": ("file", files.read_bytes),
    "read_bytes, with a limit": ("file", lambda path: files.read_bytes(path, max_bytes=10)),
    "load_tree": ("file", checkpoint.load_tree),
    "the newest checkpoint": (checkpoint.NAME, lambda path: checkpoint.load(path.parent)),
    "load_moment": (NAME, lambda path: load_moment(path.parent)),
    "load_policy, of a record": ("run.json", lambda path: load_policy(path.parent)),
    "load_policy, trusted": ("model.zip", lambda path: load_policy(path, trusted=True)),
    "load_played": (DESCRIPTION, lambda path: load_played(path.parent)),
    "load_played, the weights": (WEIGHTS, load_weights),
}


@pytest.mark.parametrize(("door", "trap"), [(door, trap) for door in DOORS for trap in TRAPS])
def test_no_door_waits_for_what_is_no_file(tmp_path: Path, door: str, trap: str) -> None:
    name, read = DOORS[door]
    TRAPS[trap](tmp_path / name)
    if (door, trap) == ("the newest checkpoint", "a loop of links"):
        assert read(tmp_path / name) is None  # there is none
        return
    with pytest.raises(files.DamagedFileError) as caught:
        read(tmp_path / name)
    assert caught.value.path in (tmp_path / name, tmp_path / name / "run.json")  # a folder may be a run's
    assert str(caught.value).count(str(tmp_path)) == 1


@pytest.mark.parametrize("trap", TRAPS)
def test_no_configuration_is_waited_for(tmp_path: Path, trap: str) -> None:
    TRAPS[trap](tmp_path / "my.yaml")
    with pytest.raises(ConfigError, match=r"my\.yaml: not a regular file$"):
        read_yaml(tmp_path / "my.yaml")


@pytest.mark.parametrize("trap", ["a pipe", "a socket", "a device", "a loop of links"])
def test_what_is_no_file_gives_way_to_the_one_that_is_written(tmp_path: Path, trap: str) -> None:
    TRAPS[trap](tmp_path / "file")
    files.write_text(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("trap", TRAPS)
def test_a_sweep_shows_no_progress_of_what_is_no_learning_curve(tmp_path: Path, trap: str) -> None:
    run = Running("run", tmp_path, 1000)
    TRAPS[trap](tmp_path / "progress.csv")
    assert run.world_steps == 0


@pytest.mark.parametrize(
    ("text", "steps"),
    [("", 0), ("x", 0), ("400,0.5\n", 400), ("2000,0.5\n", 1000), ("-3,0.5\n", 0), ("1e9,0.5\n", 0), ("400,nan\n", 0),
     (f"{'9' * 400},0.5\n", 0), (f"{'9' * 5000},0.5\n", 0), ("\xff\n", 0)],
)  # fmt: skip
def test_a_sweep_shows_no_more_progress_than_there_can_be(tmp_path: Path, text: str, steps: int) -> None:
    (tmp_path / "progress.csv").write_bytes(f"world_steps,success\n{text}".encode("latin-1"))
    assert Running("run", tmp_path, 1000).world_steps == steps


# nobody else reads

READERS = {
    "open", "read_text", "read_bytes", "safe_open", "load_file", "loadtxt", "genfromtxt", "fromfile", "memmap",
    "is_zipfile", "ZipFile", "open_zip",
}  # fmt: skip

# What is allowed outside `files`, and why.
ALLOWED = {
    "locks.py": ["open"],  # without waiting, and never to be read as a file
    "core/compilation.py": ["read_bytes"],  # the package's own sources
    "maddpg/saving.py": ["ZipFile", "open"],  # what SB3 has opened and reads next; to write
    "experiments/checkpoint.py": ["safe_open"],  # once it has been opened as a regular file
    "experiments/loading.py": ["is_zipfile", "is_zipfile"],  # of what is a file
    "experiments/memory.py": ["read_text"],  # the kernel's limit
    "experiments/provenance.py": ["read_bytes", "read_text"],  # the package's own sources, the kernel's list
    "experiments/train.py": ["read_bytes"],  # what this process has just written,
    "cli/results.py": ["read_text"],  # too
    "cli/sweeps.py": ["read_text"],  # too
    "study/paper.py": ["read_text"],  # the package's own data
    "study/report/page.py": ["read_text"],  # too
    "study/figures/canvas.py": ["open"],  # a picture in memory
}


def readers(source: str) -> list[str]:
    """Names of the calls in a module that may read a file."""
    return sorted(name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call) for name in _reader(node))


def _reader(call: ast.Call) -> Iterator[str]:
    match call.func:
        case ast.Attribute(ast.Name("files"), _):
            return
        case ast.Name(name) | ast.Attribute(_, name) if name in READERS:
            yield name


def test_only_the_one_reader_reads() -> None:
    package = ROOT / "marl_encircle"
    found = {
        str(path.relative_to(package)): readers(path.read_text(encoding="utf-8")) for path in package.rglob("*.py")
    }
    assert {name: calls for name, calls in found.items() if calls and name != "files.py"} == ALLOWED


@pytest.mark.parametrize(
    "source",
    ["open(path)", "path.open('rb')", "path.read_text()", "Path(name).read_bytes()", "np.fromfile(path)",
     "safetensors.safe_open(path)", "safetensors.torch.load_file(path)", "zipfile.ZipFile(path)"],
)  # fmt: skip
def test_every_other_reader_would_be_found(source: str) -> None:
    assert readers(f"def f():\n    {source}") != []
