"""Exact resume: one file that holds everything the rest of a training depends on.

A checkpoint is a tree of dictionaries and lists with arrays and plain numbers in it. The arrays go into a safetensors
file, the tree that refers to them and has their hashes into its metadata as JSON: no pickle, and one atomic write for
all of it. A run folder keeps the two newest ones.
"""

import errno
import hashlib
import json
import logging
import os
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch as th

from marl_encircle import files
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments.memory import available_memory
from marl_encircle.maddpg import MADDPG

NAME = "checkpoint.safetensors"
FORMER = "checkpoint.former.safetensors"
DAMAGED = "checkpoint.damaged.safetensors"
ARRAY = "$array"
COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
MONITOR = ("episode_returns", "episode_lengths")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")

MAX_TREE_HEADER = 1 << 24
"""Largest header [bytes], with the tree: the most worlds of the native engine need 12 MB. Each name costs memory."""

_FAULTS = (
    *(OSError, MemoryError, RecursionError, safetensors.SafetensorError),
    *(AttributeError, KeyError, TypeError, ValueError),  # AttributeError: of a type that NumPy lacks
)
"""What reading a stranger's checkpoint may raise."""

MISFIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What :func:`restore` may raise for what another training, or a stranger, has saved."""

logger = logging.getLogger(__name__)


def save(folder: Path, tree: Mapping[str, Any]) -> None:
    """Write the newest checkpoint of a run folder; the newest until now becomes the former one.

    :param tree: see :func:`save_tree`
    :raises OSError: with the file's name; the newest one is unchanged
    """
    save_tree(folder / NAME, tree, folder / FORMER)


def load(folder: Path) -> dict[str, Any] | None:
    """Return the newest whole checkpoint of a run folder, None if there is no checkpoint.

    Where the newest is damaged or missing, a warning says so and the former one is taken; the damaged file is put aside
    under another name, lest the next save take it for a former one.

    :raises DamagedFileError: if there are checkpoints, none of which is whole
    """
    newest, former = folder / NAME, folder / FORMER
    if not former.exists():
        return load_tree(newest) if newest.exists() else None
    try:
        return load_tree(newest)
    except files.DamagedFileError as error:
        try:
            tree = load_tree(former)
        except files.DamagedFileError as other:
            raise files.DamagedFileError(newest, f"{error.reason}; neither is the former one: {other}") from error
        if newest.exists():
            newest.replace(folder / DAMAGED)
        logger.warning("%s; going on from the checkpoint before it, %s", error, former.name)
        return tree


def remove(folder: Path) -> None:
    """Remove the checkpoints of a run folder, if there are any."""
    for name in (FORMER, DAMAGED, NAME):
        files.remove(folder / name)


def save_tree(path: Path, tree: Mapping[str, Any], former: Path | None = None) -> None:
    """Write a tree as one file, atomically.

    :param tree: dictionaries with names as keys, lists, arrays, tensors, numbers, strings, None
    :param former: name that the old file takes
    :raises OSError: with the file's name; the old file is unchanged
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps(_take_arrays(tree, "", arrays))
    checked = f"{files.sha256_bytes(text.encode())} {text}"
    header = _header(arrays, {"tree": checked})
    if len(header) > MAX_TREE_HEADER:
        reason = f"its header of {len(header)} bytes could not be read back; train with fewer worlds"
        raise OSError(errno.EFBIG, f"not saved: {reason}", str(path))
    pieces = [array.reshape(-1).view(np.uint8).data for array in arrays.values()]
    files.write_bytes(path, header, *pieces, former=former)


def _header(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> bytes:
    """Return what comes before the arrays in a safetensors file.

    The library's own ``save_file`` leaves a temporary file of its own where it is killed, and its errors hide those of
    the disk; its ``save`` holds everything in memory twice.
    """
    header: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name, array in arrays.items():
        start, end = end, end + array.nbytes
        kind = "BOOL" if array.dtype.kind == "b" else f"{array.dtype.kind.upper()}{8 * array.itemsize}"
        header[name] = {"dtype": kind, "shape": array.shape, "data_offsets": (start, end)}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)  # the arrays start at a multiple of 8
    return len(text).to_bytes(8, "little") + text


def load_tree(path: Path) -> dict[str, Any]:
    """Read what :func:`save_tree` wrote; tensors come back as arrays.

    :raises DamagedFileError: if it is no such file, or a bit of it has changed
    """
    try:
        with files.open_regular(path) as start:
            if int.from_bytes(start.read(8), "little") > MAX_TREE_HEADER:
                raise ValueError(f"its header is larger than the {MAX_TREE_HEADER} bytes allowed")
            if os.fstat(start.fileno()).st_size > available_memory():
                raise ValueError("it is larger than this machine's memory")
        with safetensors.safe_open(path, framework="numpy") as file:
            checked = (file.metadata() or {}).get("tree")
            if checked is None:
                raise ValueError("there are arrays in it, but not the tree that says what they are")
            sha256, _, text = checked.partition(" ")
            if files.sha256_bytes(text.encode()) != sha256:
                raise ValueError("its tree has changed since it was written")
            names = set(file.keys())
            restored = _put_arrays(json.loads(text), file.get_tensor, names)
        if not isinstance(restored, dict):
            raise ValueError(f"its tree is {restored!r:.80}, no dictionary")
        if names:
            raise ValueError(f"its tree lacks {len(names)} of the arrays, {min(names):.80} among them")
    except _FAULTS as error:
        reason = error.reason if isinstance(error, files.DamagedFileError) else str(error)[:200]
        raise files.DamagedFileError(path, f"not a valid checkpoint: {reason}") from error
    return restored


def capture(model: MADDPG, curriculum: CurriculumVecEnv, *, with_replay: bool = True) -> dict[str, Any]:
    """Return everything that the rest of the training depends on, between two vectorised steps.

    :param with_replay: not needed when only the evaluation is left; it is nearly all of the size
    """
    buffer = model.replay_buffer
    assert buffer is not None
    filled = (buffer.buffer_size if buffer.full else buffer.pos) if with_replay else 0
    return {
        "parameters": model.get_parameters(),
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "last_obs": model._last_obs,
        "last_episode_starts": model._last_episode_starts,
        "monitor": {name: getattr(model.env, name) for name in MONITOR},
        "replay": {name: getattr(buffer, name)[:filled] for name in REPLAY},
        "replay_position": [buffer.pos, buffer.full] if with_replay else [0, False],
        "worlds": _distinct(curriculum.venv.env_method("get_state")),
        "world_steps": curriculum.world_steps,
        "random": {
            "exploration": model.exploration_rng.bit_generator.state,
            "numpy": list(np.random.get_state()),  # noqa: NPY002 - SB3's replay buffer draws from it
            "torch": th.get_rng_state().numpy(),
            "python": random.getstate(),
        },
    }


def restore(model: MADDPG, curriculum: CurriculumVecEnv, saved: Mapping[str, Any]) -> None:
    """Put a freshly built model and its environment where :func:`capture` was called, bit for bit.

    :raises Exception: ``MISFIT``, if it was captured from others
    """
    restore_parameters(model, saved)
    slots = curriculum.num_envs
    model._last_obs = _of_shape(saved["last_obs"], slots, *(curriculum.observation_space.shape or ()))
    model._last_episode_starts = _of_shape(saved["last_episode_starts"], slots)
    for name, value in saved.get("monitor", {}).items():  # older checkpoints have none; it is only logged
        setattr(model.env, name, _of_shape(value, slots))
    buffer = model.replay_buffer
    assert buffer is not None
    for name in REPLAY:
        getattr(buffer, name)[: len(saved["replay"][name])] = saved["replay"][name]
    position, full = saved["replay_position"]
    buffer.pos, buffer.full = int(position), bool(full)
    if not 0 <= buffer.pos < buffer.buffer_size:
        raise ValueError(f"{buffer.pos} is no place in a replay buffer of {buffer.buffer_size}")
    curriculum.world_steps = int(saved["world_steps"])
    slots_each = curriculum.num_envs // len(saved["worlds"])
    for i, state in enumerate(saved["worlds"]):
        curriculum.venv.env_method("set_state", state, indices=[i * slots_each])
    rng = saved["random"]
    model.exploration_rng.bit_generator.state = rng["exploration"]
    np.random.set_state(tuple(rng["numpy"]))  # noqa: NPY002
    th.set_rng_state(th.from_numpy(rng["torch"]))
    version, internal, gauss = rng["python"]
    random.setstate((version, tuple(internal), gauss))


def restore_parameters(model: MADDPG, saved: Mapping[str, Any]) -> None:
    """Put weights, optimisers and counters back."""
    model.set_parameters({name: to_torch(value) for name, value in saved["parameters"].items()})
    for network in (model.actor, model.critic):
        for parameter, state in network.optimizer.state.items():
            for value in state.values():
                _of_shape(value, *(parameter.shape if value.ndim else ()))
    for name in COUNTERS:
        setattr(model, name, type(getattr(model, name))(saved["counters"][name]))


def _of_shape(value: Any, *shape: int) -> Any:
    """Return an array or tensor of that shape; raise a ValueError for anything else."""
    if tuple(value.shape) != shape:
        raise ValueError(f"an array of shape {tuple(value.shape)} in place of one of {shape}")
    return value


def _distinct(states: list[Any]) -> list[Any]:
    """Return each state once: the native engine answers for all slots at once, SuperSuit's world by world."""
    return list({id(state): state for state in states}.values())


def _take_arrays(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return ``value`` with every array moved to ``arrays`` and a reference in its place."""
    if isinstance(value, th.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        name = f"{len(arrays)}{path}"
        arrays[name] = np.asarray(value, order="C")
        return {ARRAY: name, "sha256": _digest(arrays[name])}
    if isinstance(value, Mapping):
        return {str(key): _take_arrays(inner, f"{path}/{key}", arrays) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_take_arrays(inner, f"{path}/{i}", arrays) for i, inner in enumerate(value)]
    if isinstance(value, np.generic):
        return value.item()
    return value


def _put_arrays(value: Any, read: Callable[[str], np.ndarray], names: set[str]) -> Any:
    """Return ``value`` with the arrays in the place of the references to them.

    :param names: of all arrays; those that are read are taken out, so that a small file cannot ask for one many times
    """
    if isinstance(value, dict):
        if ARRAY in value:
            names.remove(value[ARRAY])
            array = read(value[ARRAY])
            if _digest(array) != value["sha256"]:
                raise ValueError(f"{value[ARRAY]} has changed since it was written")
            return array
        return {key: _put_arrays(inner, read, names) for key, inner in value.items()}
    if isinstance(value, list):
        return [_put_arrays(inner, read, names) for inner in value]
    return value


def _digest(array: np.ndarray) -> str:
    """sha256 of an array's type, shape and numbers, in hexadecimal."""
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def to_torch(value: Any) -> Any:
    """Return a state dict of arrays as PyTorch wants it: tensors, and an optimiser's parameters by number."""
    if isinstance(value, np.ndarray):
        return th.from_numpy(value)
    if isinstance(value, list):
        return [to_torch(inner) for inner in value]
    if isinstance(value, dict):
        return {int(key) if key.isdigit() else key: to_torch(inner) for key, inner in value.items()}
    return value
