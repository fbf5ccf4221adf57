"""A checkpoint gives back exactly what was put in, or says that it cannot."""

import logging
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from marl_encircle import files
from marl_encircle.experiments import checkpoint
from marl_encircle.experiments.checkpoint import load_tree, save_tree


def tree() -> dict[str, Any]:
    generator = np.random.default_rng(3)
    return {
        "plain": {"none": None, "yes": True, "no": False, "text": "λ/\n", "number": -0.1 + 0.3, "empty": {}},
        "large": [2**127 + 1, -(2**90)],
        "infinite": float("inf"),
        "arrays": [np.arange(6.0).reshape(2, 3).T, np.zeros((0, 4)), np.array(7, np.int8), np.array([True, False])],
        "a": {"b/c": np.ones(2)},
        "a/b": {"c": np.zeros(2)},
        "rng": generator.bit_generator.state,
        "numpy": list(np.random.RandomState(1).get_state()),
        "tensors": (th.full((2, 2), np.nan), th.tensor(3, dtype=th.int64), th.ones(2, dtype=th.uint8)),
        "scalars": [np.float32(0.1), np.int64(3), np.bool_(True)],
    }


def assert_same(one: Any, other: Any) -> None:
    if isinstance(one, th.Tensor):
        one = one.numpy()
    if isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            assert_same(left, right)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()
    else:
        assert one == other
        assert isinstance(other, type(one)) or isinstance(one, np.generic)


def test_a_tree_comes_back_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    save_tree(path, tree())
    assert_same(tree(), load_tree(path))
    generator = np.random.default_rng()
    generator.bit_generator.state = load_tree(path)["rng"]
    assert generator.random() == np.random.default_rng(3).random()


def test_equal_trees_are_equal_files(tmp_path: Path) -> None:
    for name in ("one", "other"):
        save_tree(tmp_path / name, tree())
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_a_missing_or_foreign_file_is_damaged(tmp_path: Path) -> None:
    for name, content in {"empty": b"", "text": b"hello", "zeros": bytes(200), "pickle": b"\x80\x04N."}.items():
        (tmp_path / name).write_bytes(content)
    for name in ("empty", "text", "zeros", "pickle", "absent"):
        with pytest.raises(files.DamagedFileError, match=f"{name}: not a valid checkpoint"):
            load_tree(tmp_path / name)


def test_weights_without_a_tree_are_no_checkpoint(tmp_path: Path) -> None:
    import safetensors.numpy

    safetensors.numpy.save_file({"a": np.ones(2)}, tmp_path / "f")
    with pytest.raises(files.DamagedFileError, match="not a valid checkpoint"):
        load_tree(tmp_path / "f")


def test_every_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    save_tree(path, tree())
    data = path.read_bytes()
    for length in {0, 1, 7, 8, 9, len(data) - 1, *random.Random(1).sample(range(len(data)), 100)}:
        path.write_bytes(data[:length])
        with pytest.raises(files.DamagedFileError, match=r"c\.safetensors: not a valid checkpoint"):
            load_tree(path)


def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    save_tree(path, tree())
    data = path.read_bytes()
    for bit in random.Random(2).sample(range(8 * len(data)), 500):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with pytest.raises(files.DamagedFileError, match=r"c\.safetensors: not a valid checkpoint"):
            load_tree(path)


def test_what_cannot_be_saved_leaves_the_former_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "c.safetensors"
    save_tree(path, {"a": 1})
    with pytest.raises(TypeError):
        save_tree(path, {"a": object()})
    assert load_tree(path) == {"a": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


# the two newest


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_two_newest_are_kept(tmp_path: Path) -> None:
    assert checkpoint.load(tmp_path) is None
    for number in range(4):
        checkpoint.save(tmp_path, {"number": number})
        assert checkpoint.load(tmp_path) == {"number": number}
    assert names(tmp_path) == sorted([checkpoint.NAME, checkpoint.FORMER])
    assert load_tree(tmp_path / checkpoint.FORMER) == {"number": 2}
    checkpoint.remove(tmp_path)
    assert names(tmp_path) == []


def test_where_the_newest_is_damaged_the_former_is_taken_and_said_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(2):
        checkpoint.save(tmp_path, {"number": number})
    newest = tmp_path / checkpoint.NAME
    newest.write_bytes(newest.read_bytes()[:-1])
    with caplog.at_level(logging.WARNING):
        assert checkpoint.load(tmp_path) == {"number": 0}
    (line,) = caplog.messages
    assert line.startswith(f"{newest}: not a valid checkpoint: ")
    assert line.endswith(f"; going on from the checkpoint before it, {checkpoint.FORMER}")
    assert names(tmp_path) == sorted([checkpoint.DAMAGED, checkpoint.FORMER])
    # the good one is kept until a better one is there
    checkpoint.save(tmp_path, {"number": 5})
    assert load_tree(tmp_path / checkpoint.FORMER) == {"number": 0}
    assert checkpoint.load(tmp_path) == {"number": 5}
    checkpoint.remove(tmp_path)
    assert names(tmp_path) == []


def test_a_process_killed_between_the_two_names_leaves_the_former(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, {"number": 0})
    (tmp_path / checkpoint.NAME).replace(tmp_path / checkpoint.FORMER)
    assert checkpoint.load(tmp_path) == {"number": 0}
    assert names(tmp_path) == [checkpoint.FORMER]


def test_where_both_are_damaged_both_are_named_and_kept(tmp_path: Path) -> None:
    for name in (checkpoint.NAME, checkpoint.FORMER):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(files.DamagedFileError, match=rf"{checkpoint.NAME}: .*; neither is .*{checkpoint.FORMER}: not"):
        checkpoint.load(tmp_path)
    assert names(tmp_path) == sorted([checkpoint.NAME, checkpoint.FORMER])
