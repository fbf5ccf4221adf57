"""Files in SB3's format: a zip-file of pickled objects and weights, which can run code when it is loaded."""

import io
import pathlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file

from marl_encircle import files
from marl_encircle.maddpg.policies import MADDPGPolicy


class UntrustedFileWarning(UserWarning):
    """A file that can run code is about to be read."""


def load_actors(path: str | pathlib.Path) -> MADDPGPolicy:
    """Return the policy of a zip-file that ``save`` of MADDPG or a subclass wrote, to act with: no critic is loaded.

    **Such a file can run code when it is loaded: load only files that you trust.**

    :param path: the file
    :raises ValueError: if it is no zip-file, or not of such a model; unpickling it may raise anything else
    """
    data, parameters, _ = load_from_zip_file(path, device="cpu")
    needed = ("policy_class", "observation_space", "action_space", "n_agents", "critic_kind", "policy_kwargs")
    if not data or "policy" not in parameters or not data.keys() >= set(needed):
        raise ValueError("not a model of MADDPG")
    policy: MADDPGPolicy = data["policy_class"](
        data["observation_space"],
        data["action_space"],
        lambda _: 0.0,
        n_agents=data["n_agents"],
        critic=data["critic_kind"],
        agents=data.get("agents"),
        **data["policy_kwargs"],
    )
    saved = cast(dict[str, th.Tensor], parameters["policy"])
    prefix = "actor."
    policy.actor.load_state_dict({name.removeprefix(prefix): saved[name] for name in saved if name.startswith(prefix)})
    policy.set_training_mode(False)
    return policy


def saved_critics(path: str | pathlib.Path | io.BufferedIOBase) -> int:
    """Return how many critics each agent has in a zip-file of ``save``; only tensors are read.

    :param path: the file, or an open one
    """
    _, parameters, _ = load_from_zip_file(path, load_data=False, device="cpu")
    prefix = "critic.q_networks."
    names = [name for name in cast(dict[str, th.Tensor], parameters.get("policy", {})) if name.startswith(prefix)]
    return len({name.removeprefix(prefix).partition(".")[0] for name in names})


@contextmanager
def whole_file(path: str | pathlib.Path | io.BufferedIOBase, suffix: str) -> Iterator[io.BufferedIOBase]:
    """Yield a file for SB3 to save to, which becomes ``path`` in the end; an open one is yielded itself."""
    if isinstance(path, io.BufferedIOBase):
        yield path
        return
    path = pathlib.Path(path)
    path = path if path.suffix else path.with_name(path.name + suffix)
    # Opened here: SB3 would leave it open where the disk is full.
    with files.atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file
