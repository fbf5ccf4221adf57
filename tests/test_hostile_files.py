"""A stranger's files: whichever door reads them, nothing in them runs, and each is refused by one error that names it.

Every payload would make a file, the marker, if something ran it. The stranger has edited the record so that the hashes
fit: what is refused here is refused for what it is.
"""

import base64
import gzip
import io
import json
import marshal
import multiprocessing
import os
import pickle
import random
import resource
import shutil
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import safetensors.torch
import torch as th
from ruamel.yaml import YAML
from tiny_runs import TINY, command, copy_of_finished, finished, tiny, tiny_arguments

from marl_encircle import files, load_policy
from marl_encircle.experiments import checkpoint, train
from marl_encircle.experiments import grid as grids
from marl_encircle.experiments.build import policy_bytes
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.episodes import Episode, episodes_from_csv
from marl_encircle.experiments.learning_curve import curve_from_csv
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.pretrained import USUAL_SETTING, find_run
from marl_encircle.experiments.records import read_runs
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.figures.curves import band_of

FILES = ("policy.safetensors", "episodes.csv", "progress.csv")
GRID = """
profile: smoke
groups:
  - {methods: [ours], settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}], seeds: [0]}
shared: []
"""


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.marker), "w")


def torch_file(marker: Path, *, as_zip: bool) -> bytes:
    out = io.BytesIO()
    th.save(Payload(marker), out, _use_new_zipfile_serialization=as_zip)
    return out.getvalue()


def zip_of(name: str, data: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(name, data)
    return out.getvalue()


def sb3_zip(marker: Path) -> bytes:
    pickled = base64.b64encode(pickle.dumps(Payload(marker))).decode()
    return zip_of("data", json.dumps({"policy_class": {":type:": "type", ":serialized:": pickled}}).encode())


def array_of_objects(marker: Path) -> np.ndarray:
    array = np.empty(1, object)
    array[0] = Payload(marker)
    return array


def numpy_file(marker: Path) -> bytes:
    out = io.BytesIO()
    np.save(out, array_of_objects(marker))
    return out.getvalue()


def numpy_archive(marker: Path) -> bytes:
    out = io.BytesIO()
    np.savez(out, a=array_of_objects(marker))
    return out.getvalue()


def program(marker: Path) -> str:
    return f"open({str(marker)!r}, 'w')"


def talking_safetensors(marker: Path) -> bytes:
    """Weights whose metadata hold a pickle and a program."""
    metadata = {
        "tree": program(marker),
        "__reduce__": base64.b64encode(pickle.dumps(Payload(marker))).decode(),
        "format": "pickle",
    }
    return safetensors.torch.save({"mu.weights.0": th.ones(1), program(marker): th.ones(1)}, metadata)


PAYLOADS: dict[str, Callable[[Path], bytes]] = {
    "pickle, protocol 0": lambda marker: pickle.dumps(Payload(marker), 0),
    "pickle, protocol 5": lambda marker: pickle.dumps(Payload(marker), 5),
    "pickle, gzipped": lambda marker: gzip.compress(pickle.dumps(Payload(marker))),
    "PyTorch": lambda marker: torch_file(marker, as_zip=True),
    "PyTorch, before 1.6": lambda marker: torch_file(marker, as_zip=False),
    "zip with a data.pkl": lambda marker: zip_of("archive/data.pkl", pickle.dumps(Payload(marker))),
    "Stable-Baselines3": sb3_zip,
    "npy of objects": numpy_file,
    "npz of objects": numpy_archive,
    "safetensors with metadata": talking_safetensors,
    "byte code": lambda marker: marshal.dumps(compile(program(marker), "x", "exec")),
    "Python": lambda marker: program(marker).encode(),
    "shell": lambda marker: f"#!/bin/sh\ntouch {marker}\n".encode(),
    "YAML tag": lambda marker: f"name: !!python/object/apply:builtins.open ['{marker}', w]\n".encode(),
    "JSON that names a function": lambda marker: json.dumps(
        {"py/reduce": [{"py/function": "builtins.open"}, {"py/tuple": [str(marker), "w"]}], "__reduce__": ["open"]}
    ).encode(),
    "a term's import path": lambda _: b"base: ours\nterms: {os.system: 1.0, 'marl_encircle:main': 1.0}\n",
    "spreadsheet formula": lambda marker: f"round,seed\n=cmd|'/c touch {marker}'!A0,@SUM(1)\n+1,-1\n".encode(),
}

RUNNERS: dict[str, Callable[[bytes], object]] = {
    "pickle, protocol 0": pickle.loads,
    "pickle, protocol 5": pickle.loads,
    "pickle, gzipped": lambda data: pickle.loads(gzip.decompress(data)),
    "PyTorch": lambda data: th.load(io.BytesIO(data), weights_only=False),
    "PyTorch, before 1.6": lambda data: th.load(io.BytesIO(data), weights_only=False),
    "npy of objects": lambda data: np.load(io.BytesIO(data), allow_pickle=True),
    "npz of objects": lambda data: np.load(io.BytesIO(data), allow_pickle=True)["a"],
    "byte code": lambda data: exec(marshal.loads(data)),
    "Python": exec,
    "YAML tag": lambda data: YAML(typ="unsafe", pure=True).load(data),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("payload", RUNNERS)
def test_a_payload_runs_where_it_is_let(tmp_path: Path, payload: str) -> None:
    marker = tmp_path / "marker"
    RUNNERS[payload](PAYLOADS[payload](marker))
    assert marker.exists()


# --- Doors ------------------------------------------------------------------------------------------------------------


class Place(NamedTuple):
    """Where a stranger's files lie."""

    root: Path

    @property
    def marker(self) -> Path:
        return self.root / "marker"

    @property
    def runs(self) -> Path:
        return self.root / "results" / "runs"

    def fresh_run(self) -> Path:
        """A run that nobody has touched."""
        shutil.rmtree(self.runs, ignore_errors=True)
        return copy_of_finished(self.runs)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.setattr(grids, "load_config", lambda *a, **k: load_config(*a, **{**k, "overrides": TINY}))
    (tmp_path / "grid.yaml").write_text(GRID)
    return Place(tmp_path)


def vouch(run: Path, name: str, data: bytes) -> None:
    """Put a file into a run, and its hash into the record."""
    (run / name).write_bytes(data)
    record = json.loads((run / "run.json").read_text())
    record["sha256"][name] = files.sha256_bytes(data)
    (run / "run.json").write_text(json.dumps(record))


def put(run: Path, name: str, data: bytes) -> None:
    """Put a stranger's file where a run has its own."""
    if name in FILES:
        vouch(run, name, data)
        return
    if name == "checkpoint.safetensors":
        (run / "run.json").unlink()
    (run / name).write_bytes(data)


DOORS: dict[str, tuple[list[str], list[str]]] = {
    "evaluate": (["{run}", "--json"], ["run.json", "policy.safetensors"]),
    "watch": (["{run}", "--headless", "{root}/pictures"], ["run.json", "policy.safetensors"]),
    "train": (
        tiny_arguments("--out", "{runs}", "--quiet", "--no-tensorboard"), ["run.json", "checkpoint.safetensors"]),
    "train --json": (tiny_arguments("--out", "{runs}", "--quiet", "--no-tensorboard"), ["episodes.csv"]),
    "export": (["{run}", "--out", "{root}/actors.onnx"], ["run.json", "policy.safetensors"]),
    "sweep": (["{root}/grid.yaml", "--out", "{runs}"], ["run.json"]),
    "tables": (["--grid", "{root}/grid.yaml", "--out", "{root}/results"], ["run.json", "episodes.csv"]),
    "figures": (
        ["--grid", "{root}/grid.yaml", "--out", "{root}/results"], ["run.json", "episodes.csv", "progress.csv"]),
    "report": (["--grid", "{root}/grid.yaml", "--out", "{root}/results"], ["run.json", *FILES]),
    "reproduce-tables": (["--grid", "{root}/grid.yaml", "--out", "{root}/results"], ["run.json", "episodes.csv"]),
    "verify-results": (
        ["--grid", "{root}/grid.yaml", "--out", "{root}/results", "--quiet"],
        ["run.json", "policy.safetensors", "episodes.csv"]),
}  # fmt: skip
"""Command, with flags -> its arguments, and the files of a run that it reads and understands."""

YAML_DOORS = [
    ["config", "show", "--reward", "{file}"],
    ["config", "show", "--scenario", "{file}"],
    ["config", "show", "--algorithm", "{file}"],
    ["config", "validate", "{file}"],
    ["config", "diff", "ours", "{file}"],
    ["train", "--reward", "{file}"],
    ["sweep", "{file}"],
    ["tables", "--grid", "{file}", "--out", "{root}/results"],
    ["calibrate", "{file}"],
    ["tune", "{file}", "--out", "{root}/search"],
    ["watch", "{file}", "--policy", "{run}", "--headless", "{root}/pictures"],
]


def filled(arguments: list[str], place: Place, run: Path, file: Path | None = None) -> list[str]:
    values = {"{run}": run, "{runs}": place.runs, "{root}": place.root, "{file}": file}
    for name, value in values.items():
        arguments = [argument.replace(name, str(value)) for argument in arguments]
    return arguments


@pytest.mark.parametrize(("door", "name"), [(door, name) for door, (_, names) in DOORS.items() for name in names])
def test_what_a_stranger_puts_into_a_run_is_refused_and_does_not_run(
    place: Place, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, door: str, name: str
) -> None:
    for payload, make in PAYLOADS.items():
        run = place.fresh_run()
        put(run, name, make(place.marker))
        done = command(capsys, monkeypatch, *door.split(), *filled(DOORS[door][0], place, run))
        assert (done.code, done.out) == (3, ""), payload
        assert f"error: {run / name}: " in done.err, payload
        assert "Traceback" not in done.err
        assert len(done.err) < 1000, payload
        assert not place.marker.exists(), payload


@pytest.mark.parametrize("name", ["run.json", "policy.safetensors"])
def test_load_policy_refuses_them_too(place: Place, name: str) -> None:
    for payload, make in PAYLOADS.items():
        run = place.fresh_run()
        put(run, name, make(place.marker))
        for trusted in (False, True):  # which is about zip-files of models only
            with pytest.raises(files.DamagedFileError) as caught:
                load_policy(run, trusted=trusted)
            assert caught.value.path == run / name, payload
        assert not place.marker.exists(), payload


@pytest.mark.parametrize("arguments", YAML_DOORS, ids=" ".join)
def test_a_strangers_configuration_is_refused_and_does_not_run(
    place: Place, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    run, file = place.fresh_run(), place.root / "stranger.yaml"
    for payload, make in PAYLOADS.items():
        file.write_bytes(make(place.marker))
        done = command(capsys, monkeypatch, *filled(arguments, place, run, file))
        assert (done.code, done.out) == (2, ""), payload
        assert str(file) in done.err, payload
        assert "Traceback" not in done.err
        assert len(done.err) < 3000, payload
        assert not place.marker.exists(), payload


@pytest.mark.parametrize("name", ["model.zip", "model.pt", "policy.pkl", "ours"])
def test_a_file_in_the_place_of_a_run_is_refused_unread(
    place: Place, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(place.root)
    for payload, make in PAYLOADS.items():
        Path(name).write_bytes(make(place.marker))
        for door in (["evaluate"], ["watch", "--headless", "pictures"]):
            done = command(capsys, monkeypatch, *door, name)
            assert (done.code, done.out) == (3, ""), payload
            assert done.err.startswith(f"error: {name}: a "), payload
        with pytest.raises(files.DamagedFileError, match=f"{name}: a "):
            load_policy(name)
        assert not place.marker.exists(), payload


def test_no_flag_lets_a_command_trust(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for door in (["evaluate"], ["watch"]):
        assert command(capsys, monkeypatch, *door, "model.zip", "--trusted").code == 2


# --- What is no payload but a trap ------------------------------------------------------------------------------------


def refused(run: Path, *doors: Callable[[Path], object]) -> str:
    """Read a run through doors below the commands, by default all; the file that is refused, or ``none``."""
    try:
        for door in doors or (load_run, read_all):
            door(run)
    except files.DamagedFileError as error:
        return error.path.name
    return "none"


def read_all(run: Path) -> object:
    """Read a run as the tables do."""
    return read_runs(run.parents[2])


@pytest.mark.parametrize("name", ["run.json", *FILES])
@pytest.mark.parametrize("trap", ["a pipe", "a folder", "a device", "a loop", "a link to nowhere"])
def test_what_is_no_file_is_not_waited_for(place: Place, name: str, trap: str) -> None:
    path = place.fresh_run() / name
    path.unlink()
    if trap == "a pipe":
        os.mkfifo(path)
    elif trap == "a folder":
        path.mkdir()
    else:
        path.symlink_to({"a device": "/dev/zero", "a loop": name, "a link to nowhere": "nowhere"}[trap])
    assert refused(path.parent) == name


def test_a_link_shows_no_more_than_the_file_would(place: Place) -> None:
    """A link out of the folder is read like a file: what it leads to must be what the record says."""
    run = place.fresh_run()
    for name in FILES:
        (run / name).unlink()
        (run / name).symlink_to(finished() / name)
    assert refused(run) == "none"
    (place.root / "secret").write_text("password")
    (run / "episodes.csv").unlink()
    (run / "episodes.csv").symlink_to(place.root / "secret")
    with pytest.raises(files.DamagedFileError, match="changed since it was written") as caught:
        read_runs(place.runs)
    assert "password" not in str(caught.value)


@pytest.mark.parametrize("method", ["../../outside", "/etc", "..", "ours/../../outside"])
def test_a_name_in_a_record_leads_nowhere(place: Place, method: str) -> None:
    run = place.fresh_run()
    record = json.loads((run / "run.json").read_text())
    record["method"] = method
    (run / "run.json").write_text(json.dumps(record))
    with pytest.raises(files.DamagedFileError, match="but its folder says 'ours'"):
        read_runs(place.runs)
    with pytest.raises(ConfigError, match="no method and no run folder"):
        find_run(method, USUAL_SETTING, [place.runs])


def header(entries: object, data: bytes = b"", length: int | None = None) -> bytes:
    """A safetensors file that says what it likes of itself."""
    text = entries if isinstance(entries, bytes) else json.dumps(entries).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + data


def entry(dtype: str, shape: list[int], start: int, end: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}


LIES: dict[str, bytes] = {
    "a header of 2^63 bytes": header(b"", length=1 << 63),
    "a header of 1 TB": header(b"{}", length=1 << 40),
    "a header of 99 MB": header(b"{}", length=99_000_000),
    "a header as long as allowed, of brackets": header(b"[" * 60_000),
    "a header of many names": header({str(i): entry("U8", [0], 0, 0) for i in range(500_000)}),
    "4 TB of weights": header({"a": entry("F32", [1 << 40], 0, 1 << 42)}),
    "more weights than can be counted": header({"a": entry("F32", [(1 << 64) - 1, 4], 0, 16)}, bytes(16)),
    "offsets beyond the end": header({"a": entry("F32", [4], 0, 16)}, bytes(8)),
    "offsets that overlap": header({"a": entry("F32", [2], 0, 8), "b": entry("F32", [2], 4, 12)}, bytes(12)),
    "offsets in reverse": header({"a": entry("F32", [2], 8, 0)}, bytes(8)),
    "a hole": header({"a": entry("F32", [1], 0, 4), "b": entry("F32", [1], 8, 12)}, bytes(12)),
    "another type than its size": header({"a": entry("F64", [2], 0, 8)}, bytes(8)),
    "a type that is none": header({"a": entry("object", [1], 0, 8)}, bytes(8)),
    "a negative shape": header({"a": entry("F32", [-1], 0, 4)}, bytes(4)),
    "one name twice": header(b'{"a":%b,"a":%b}' % ((json.dumps(entry("F32", [1], 0, 4)).encode(),) * 2), bytes(4)),
    "no header": b"",
    "half a length": b"\x08\0\0",
}


def read_lies(root: Path) -> None:
    """Read them all with 256 MB of memory to spare and a minute of processor time; exit with the number believed."""
    used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20),) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
    believed = 0
    for run in sorted(root.iterdir()):
        for door, name in ((load_run, ""), (checkpoint.load_tree, "policy.safetensors")):
            try:
                door(run / name)
                believed += 1
            except files.DamagedFileError:
                pass
    raise SystemExit(believed)


def test_a_header_that_lies_costs_neither_memory_nor_time(tmp_path: Path) -> None:
    for number, lie in enumerate(LIES.values()):
        run = tmp_path / "runs" / str(number)
        shutil.copytree(finished(), run)
        vouch(run, "policy.safetensors", lie)
    process = multiprocessing.get_context("forkserver").Process(target=read_lies, args=(tmp_path / "runs",))
    process.start()
    process.join()
    assert process.exitcode == 0


@pytest.mark.parametrize("lie", LIES)
def test_a_header_that_lies_is_refused_by_name(place: Place, lie: str) -> None:
    run = place.fresh_run()
    vouch(run, "policy.safetensors", LIES[lie])
    with pytest.raises(files.DamagedFileError, match=r"policy\.safetensors: does not hold this policy's") as caught:
        load_policy(run)
    assert len(str(caught.value)) < 500


def tree(value: object) -> dict[str, str]:
    """The metadata of a checkpoint."""
    text = value if isinstance(value, str) else json.dumps(value)
    return {"tree": f"{files.sha256_bytes(text.encode())} {text}"}


EMPTY = {"a": entry("U8", [0], 0, 0)}
HASH = files.sha256_bytes(b"|u1 (0,)")
TREES: dict[str, tuple[bytes, str]] = {
    "no metadata": (header({"a": entry("U8", [2], 0, 2)}, bytes(2)), "not the tree that says what they are"),
    "other metadata": (header({"__metadata__": {"format": "pt"}}), "not the tree that says what they are"),
    "a tree without its hash": (header({"__metadata__": {"tree": "{}"}}), "its tree has changed"),
    "a list": (header({"__metadata__": tree([1])}), r"its tree is \[1\], no dictionary"),
    "many brackets": (header({"__metadata__": tree("[" * 50_000)}), "recursion"),
    "a long number": (header({"__metadata__": tree("9" * 50_000)}), "limit"),
    "one array many times": (
        header({"__metadata__": tree({"x": [{"$array": "a", "sha256": HASH}] * 9}), **EMPTY}), "'a'"),
    "an array too many": (header({"__metadata__": tree({}), **EMPTY}), "lacks 1 of the arrays, a among them"),
    "an array too few": (header({"__metadata__": tree({"x": {"$array": "a", "sha256": HASH}})}), "'a'"),
    "an array without its hash": (header({"__metadata__": tree({"x": {"$array": "a"}}), **EMPTY}), "'sha256'"),
    "another hash": (header({"__metadata__": tree({"x": {"$array": "a", "sha256": ""}}), **EMPTY}), "a has changed"),
    "a list for a name": (header({"__metadata__": tree({"x": {"$array": ["a"]}}), **EMPTY}), "unhashable"),
    **{
        f"a type that NumPy lacks: {kind}": (
            header({"__metadata__": tree({"x": {"$array": "a"}}), "a": entry(kind, [2], 0, size)}, bytes(size)),
            "data type|attribute|sha256",  # another library may have taught NumPy the type
        )
        for kind, size in {"BF16": 4, "F8_E4M3": 2, "F8_E5M2": 2, "F4": 1}.items()
    },
}  # fmt: skip
"""What a checkpoint says of itself, and the reason why it is refused."""


def test_what_those_trees_are_made_of_is_read(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(header({"__metadata__": tree({"x": {"$array": "a", "sha256": HASH}}), **EMPTY}))
    assert checkpoint.load_tree(path)["x"].shape == (0,)


@pytest.mark.parametrize("lie", [*LIES, *TREES])
def test_a_checkpoint_that_lies_is_refused_by_name(tmp_path: Path, lie: str) -> None:
    path = tmp_path / "checkpoint.safetensors"
    data, reason = TREES.get(lie) or (LIES[lie], ".")
    path.write_bytes(data)
    with pytest.raises(
        files.DamagedFileError, match=rf"checkpoint\.safetensors: not a valid checkpoint: .*(?i:{reason})"
    ):
        checkpoint.load_tree(path)


def test_a_checkpoint_larger_than_the_memory_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    size = 1 << 42  # which takes no room on the disk
    with path.open("wb") as file:
        file.write(header({"__metadata__": tree({"x": {"$array": "a"}}), "a": entry("F32", [size // 4], 0, size)}))
        file.truncate(file.tell() + size)
    with pytest.raises(files.DamagedFileError, match="larger than this machine's memory"):
        checkpoint.load_tree(path)


class Interrupt(Exception):  # noqa: N818 - no error
    """As a kill after a checkpoint."""


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tiny training that was stopped after some updates."""

    def save_and_stop(self: train._Run) -> None:
        save(self)
        if self.model._n_updates:
            raise Interrupt

    save, out = train._Run.save_checkpoint, tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train._Run, "save_checkpoint", save_and_stop)
        with pytest.raises(Interrupt):
            train.train(tiny(), 0, "native", out, checkpoint_every=1e-9)
    return train.run_folder(tiny(), 0, out)


MISFITS: dict[str, list[Any]] = {
    "seconds": ["x", []],
    "rows": [1, [1]],
    "training": ["x"],
    "training/parameters/policy": [{}],
    "training/parameters/actor.optimizer/state": [{"0": {"exp_avg": np.zeros((3, 5), np.float32)}}],
    "training/counters/num_timesteps": ["x", None],
    "training/last_obs": [np.zeros((3, 5), np.float32), None],
    "training/last_episode_starts": [np.zeros(3, bool)],
    "training/monitor/episode_returns": [np.zeros(3)],
    "training/replay/rewards": [np.zeros((240, 7), np.float32), np.zeros((10**5, 3), np.float32)],
    "training/replay_position": [[-1, False], [10**9, False]],
    "training/worlds": [[], ["x"], {}],
    "training/world_steps": ["x"],
    "training/random/exploration": [{"bit_generator": "MT19937"}],
    "training/random/exploration/state/state": [-1],
    "training/random/numpy": [[]],
    "training/random/torch": [np.zeros(3, np.uint8)],
    "training/random/python": [[3, [1], None]],
}
"""What a checkpoint may hold that no training has saved."""


@pytest.mark.parametrize(("key", "number"), [(key, i) for key, values in MISFITS.items() for i in range(len(values))])
def test_what_no_training_has_saved_is_not_gone_on_with(
    tmp_path: Path, interrupted: Path, key: str, number: int
) -> None:
    folder = train.run_folder(tiny(), 0, tmp_path)
    saved = checkpoint.load(interrupted)
    *path, last = key.split("/")
    place: Any = saved
    for part in path:
        place = place[part]
    assert last in place
    place[last] = MISFITS[key][number]
    checkpoint.save(folder, saved or {})
    with pytest.raises(files.DamagedFileError, match=r"checkpoint\.safetensors: does not fit this training: ."):
        train.train(tiny(), 0, "native", tmp_path)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    """A hundred megabytes of nothing in a hundred kilobytes, under the name of a model."""
    bomb = tmp_path / "model.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("data", "w") as out:
        for _ in range(100):
            out.write(bytes(1 << 20))
    tracemalloc.start()
    with pytest.raises(files.DamagedFileError, match="zip-file"):
        load_policy(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


def read_band(text: str) -> object:
    return band_of([curve_from_csv(text)], 1)


@pytest.mark.parametrize("rows", ["\n", "1,0\n", "ab,"], ids=["blank", "narrow", "wide"])
@pytest.mark.parametrize(
    ("columns", "read"),
    [(",".join(Episode._fields), episodes_from_csv), ("world_steps,success", read_band)],
    ids=["rounds", "curve"],
)
def test_a_bomb_of_cells_is_not_unpacked(columns: str, read: Callable[[str], object], rows: str) -> None:
    """Rows and cells take up to eighty times the memory of their text."""
    text = f"{columns}\n{rows * (1 << 20)}"[: 1 << 20]
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"^line 2: |must rise|without points"):
        read(text)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


def test_an_archive_that_is_trusted_still_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with zipfile.ZipFile(tmp_path / "in" / "model.zip", "w") as archive:
        archive.writestr("../evil.pth", b"x")
        archive.writestr("/tmp/evil.pth", b"x")
    with pytest.raises(files.DamagedFileError, match="holds no actors"):
        load_policy(tmp_path / "in" / "model.zip", trusted=True)
    assert [path.name for path in tmp_path.rglob("*")] == ["in", "model.zip"]


# --- Damage -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILES)
def test_every_flipped_bit_and_every_cut_of_a_file_is_noticed(place: Place, name: str) -> None:
    path = place.fresh_run() / name
    data = path.read_bytes()
    rng = random.Random(3)
    cuts = {0, 1, len(data) - 1, *rng.sample(range(len(data)), min(100, len(data)))}
    bits = rng.sample(range(8 * len(data)), min(500, 8 * len(data)))
    for content in [*(data[:length] for length in cuts), *(flipped(data, bit) for bit in bits)]:
        path.write_bytes(content)
        assert refused(path.parent, read_all) == name
        if name == "policy.safetensors":
            assert refused(path.parent, load_run) == name


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def test_no_flipped_bit_of_a_record_changes_what_is_read(place: Place) -> None:
    """Nobody vouches for ``run.json`` itself: a bit of a version or a time may flip, but no result and no policy."""
    run = place.fresh_run()
    path, rng = run / "run.json", random.Random(4)
    data = path.read_bytes()
    policy, rounds = (run / "policy.safetensors").read_bytes(), read_runs(place.runs)
    unnoticed = 0
    for bit in rng.sample(range(8 * len(data)), 500):
        path.write_bytes(flipped(data, bit))
        if refused(run) == "none":
            unnoticed += 1
            assert policy_bytes(load_policy(run)) == policy
            assert read_runs(place.runs) == rounds
    assert 0 < unnoticed < 250
    for length in rng.sample(range(len(data) - 1), 100):
        path.write_bytes(data[:length])
        assert refused(run) == "run.json"


def test_weights_that_somebody_vouches_for_are_finite_or_refused(place: Place) -> None:
    """A flipped bit that the record was changed along with cannot be told from other weights; it must do no harm."""
    run = place.fresh_run()
    data = (run / "policy.safetensors").read_bytes()
    read = 0
    for bit in random.Random(5).sample(range(8 * len(data)), 500):
        vouch(run, "policy.safetensors", flipped(data, bit))
        try:
            policy = load_policy(run)
        except files.DamagedFileError:
            continue
        read += 1
        assert all(bool(weights.isfinite().all()) for weights in policy.actor_state_dict().values())
    assert 0 < read < 500
