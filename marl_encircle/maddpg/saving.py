"""Files in SB3's format: a zip-file of pickled objects and weights, which can run code when it is loaded."""

import io
import json
import pathlib
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape
from stable_baselines3.common.save_util import load_from_zip_file, open_path
from stable_baselines3.common.type_aliases import GymEnv

from marl_encircle import files
from marl_encircle.maddpg.agents import refuse_pettingzoo
from marl_encircle.maddpg.buffers import JointReplayBuffer
from marl_encircle.maddpg.policies import MADDPGPolicy

SelfSaved = TypeVar("SelfSaved", bound="SavedOffPolicyAlgorithm")


class UntrustedFileWarning(UserWarning):
    """A file that can run code is about to be read."""


class SavedOffPolicyAlgorithm(OffPolicyAlgorithm):
    """SB3's off-policy algorithm with files that are written whole or not at all, and refused where they do not fit."""

    saved_by: str
    n_agents: int | None
    n_steps: int
    replay_buffer: JointReplayBuffer | None

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the model to a zip-file as SB3 does, whole or not at all: a former file stays until the new one is.

        :param path: the file, with the suffix ``.zip`` if it has none
        :param exclude: attributes to leave out
        :param include: attributes to save although SB3 leaves them out
        :raises OSError: with the file's name; the former file is unchanged
        """
        self.saved_by = type(self).__name__
        with whole_file(path, ".zip") as target:
            super().save(target, exclude, include)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Save the replay buffer to a pickle file as SB3 does, whole or not at all.

        :param path: the file, with the suffix ``.pkl`` if it has none
        :raises OSError: with the file's name; the former file is unchanged
        """
        with whole_file(path, ".pkl") as target:
            super().save_replay_buffer(target)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """Load a replay buffer from a pickle file as SB3 does.

        **Such a file can run code when it is loaded: load only files that you trust.**

        :param path: the file
        :param truncate_last_traj: unused, SB3's interface
        :raises ValueError: if it was made for other spaces, slots, agents or returns; the former buffer stays
        """
        former = self.replay_buffer
        must_be = {
            "obs_shape": get_obs_shape(self.observation_space),
            "action_dim": get_action_dim(self.action_space),
            "n_envs": self.n_envs,
            "n_agents": self.n_agents,
            "n_steps": self.n_steps,
        }
        if self.n_steps > 1:
            must_be["gamma"] = self.replay_buffer_kwargs.get("gamma", self.gamma)
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            for name, wanted in must_be.items():
                saved = getattr(self.replay_buffer, name, "none")
                if saved != wanted:
                    raise ValueError(f"{path} is no replay buffer of this model: its {name} is {saved}, not {wanted}")
        except (ValueError, AssertionError):  # SB3 asserts that it is a replay buffer, once it has taken its place
            self.replay_buffer = former
            raise
        assert self.replay_buffer is not None
        self.replay_buffer.end_episodes()  # the model's own worlds may be elsewhere

    @classmethod
    def load(
        cls: type[SelfSaved],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSaved:
        """Load a model from a zip-file of ``save``, for any number of worlds.

        **Such a file can run code when it is loaded: load only files that you trust.** An ``UntrustedFileWarning``
        says so every time; filter it where you know where your files come from.

        :param path: the file
        :param env: the environment to go on with; it must have the number of agents that was saved
        :param device: where to put the networks
        :param custom_objects: objects to use in place of saved ones
        :param print_system_info: whether to print the versions saved and in use
        :param force_reset: whether ``env`` is reset before training
        :param kwargs: attributes to change; a new ``seed`` seeds all generators
        :raises ValueError: where the number of agents differs, a class saved it that this one does not inherit from,
            or ``env`` is PettingZoo's
        """
        warnings.warn(
            f"{path} is a zip-file of pickled objects, which can run code when it is loaded: load only what you trust.",
            UntrustedFileWarning,
            stacklevel=2,
        )
        refuse_pettingzoo(env)
        name = class_that_saved(path)
        foreign = ValueError(f"{path} was saved by {name}, not by {cls.__name__}: use {name}.load")
        if name not in [base.__name__ for base in cls.__mro__]:
            raise foreign
        try:
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except RuntimeError as error:  # PyTorch's, with the names of the weights that one has and the other has not
            if name == cls.__name__:
                raise
            raise foreign from error
        if kwargs.get("seed") is not None:
            model.set_random_seed(kwargs["seed"])
        return model


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


def class_that_saved(path: str | pathlib.Path | io.BufferedIOBase) -> str:
    """Return the name of the class that wrote a zip-file of ``save``; nothing in it is unpickled.

    :param path: the file, or an open one
    :raises ValueError: if it is no such file
    """
    file = open_path(path, "r", suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            return str(json.loads(archive.read("data"))["saved_by"])
    except (zipfile.BadZipFile, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path} is no model that MADDPG or a subclass of it saved") from error
    finally:
        if file is not path:
            file.close()


@contextmanager
def whole_file(path: str | pathlib.Path | io.BufferedIOBase, suffix: str) -> Iterator[io.BufferedIOBase]:
    """Yield a file for SB3 to save to, which becomes ``path`` in the end; an open one is yielded itself."""
    if isinstance(path, io.BufferedIOBase):
        yield path
        return
    path = pathlib.Path(path)
    path = path if path.suffix else path.with_name(path.name + suffix)
    path = path.resolve()  # what a link points to
    # Opened here: SB3 would leave it open where the disk is full.
    with files.atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file
