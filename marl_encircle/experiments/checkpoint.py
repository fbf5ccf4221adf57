"""Exact resume: one file that holds everything the rest of a training depends on.

A checkpoint is a tree of dictionaries and lists with arrays and plain numbers in it. The arrays go into a safetensors
file, the tree that refers to them and has their hashes into its metadata as JSON: no pickle, and one atomic write for
all of it.
"""

import hashlib
import json
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import torch as th

from marl_encircle import files
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.maddpg import MADDPG

NAME = "checkpoint.safetensors"
ARRAY = "$array"
COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save_tree(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a tree as one file, atomically.

    :param tree: dictionaries with names as keys, lists, arrays, tensors, numbers, strings, None
    """
    arrays: dict[str, np.ndarray] = {}
    plain = _take_arrays(tree, "", arrays)
    with files.atomic_path(path) as temporary:
        text = json.dumps(plain)
        # One entry: safetensors writes several in an order that changes from call to call.
        checked = f"{files.sha256_bytes(text.encode())} {text}"
        safetensors.numpy.save_file(arrays, temporary, metadata={"tree": checked})


def load_tree(path: Path) -> dict[str, Any]:
    """Read what :func:`save_tree` wrote; tensors come back as arrays.

    :raises DamagedFileError: if it is no such file, or a bit of it has changed
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            sha256, _, text = file.metadata()["tree"].partition(" ")
        if files.sha256_bytes(text.encode()) != sha256:
            raise ValueError("its tree has changed since it was written")
        restored: dict[str, Any] = _put_arrays(json.loads(text), arrays)
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise files.DamagedFileError(path, f"not a valid checkpoint: {str(error)[:200]}") from error
    return restored


def capture(model: MADDPG, curriculum: CurriculumVecEnv) -> dict[str, Any]:
    """Return everything that the rest of the training depends on, between two vectorised steps."""
    buffer = model.replay_buffer
    assert buffer is not None
    filled = buffer.buffer_size if buffer.full else buffer.pos
    return {
        "parameters": model.get_parameters(),
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "last_obs": model._last_obs,
        "last_episode_starts": model._last_episode_starts,
        "replay": {name: getattr(buffer, name)[:filled] for name in REPLAY},
        "replay_position": [buffer.pos, buffer.full],
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
    """Put a freshly built model and its environment where :func:`capture` was called, bit for bit."""
    model.set_parameters({name: _to_torch(value) for name, value in saved["parameters"].items()})
    for name in COUNTERS:
        setattr(model, name, saved["counters"][name])
    model._last_obs = saved["last_obs"]
    model._last_episode_starts = saved["last_episode_starts"]
    buffer = model.replay_buffer
    assert buffer is not None
    for name in REPLAY:
        getattr(buffer, name)[: len(saved["replay"][name])] = saved["replay"][name]
    buffer.pos, buffer.full = saved["replay_position"]
    curriculum.world_steps = saved["world_steps"]
    slots_each = curriculum.num_envs // len(saved["worlds"])
    for i, state in enumerate(saved["worlds"]):
        curriculum.venv.env_method("set_state", state, indices=[i * slots_each])
    rng = saved["random"]
    model.exploration_rng.bit_generator.state = rng["exploration"]
    np.random.set_state(tuple(rng["numpy"]))  # noqa: NPY002
    th.set_rng_state(th.from_numpy(rng["torch"]))
    version, internal, gauss = rng["python"]
    random.setstate((version, tuple(internal), gauss))


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


def _put_arrays(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if ARRAY in value:
            if _digest(arrays[value[ARRAY]]) != value["sha256"]:
                raise ValueError(f"{value[ARRAY]} has changed since it was written")
            return arrays[value[ARRAY]]
        return {key: _put_arrays(inner, arrays) for key, inner in value.items()}
    if isinstance(value, list):
        return [_put_arrays(inner, arrays) for inner in value]
    return value


def _digest(array: np.ndarray) -> str:
    """sha256 of an array's type, shape and numbers, in hexadecimal."""
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _to_torch(value: Any) -> Any:
    """Return a state dict of arrays as PyTorch wants it: tensors, and an optimiser's parameters by number."""
    if isinstance(value, np.ndarray):
        return th.from_numpy(value)
    if isinstance(value, list):
        return [_to_torch(inner) for inner in value]
    if isinstance(value, dict):
        return {int(key) if key.isdigit() else key: _to_torch(inner) for key, inner in value.items()}
    return value
