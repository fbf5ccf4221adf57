"""Files in SB3's format: a zip-file of pickled objects and weights, which can run code when it is loaded."""

import io
import pathlib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar, cast

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv

from marl_encircle import files
from marl_encircle.maddpg.buffers import JointReplayBuffer
from marl_encircle.maddpg.policies import MADDPGPolicy

SelfSaved = TypeVar("SelfSaved", bound="SavedOffPolicyAlgorithm")


class UntrustedFileWarning(UserWarning):
    """A file that can run code is about to be read."""


class SavedOffPolicyAlgorithm(OffPolicyAlgorithm):
    """SB3's off-policy algorithm with files that are written whole or not at all, and refused where they do not fit."""

    n_critics: ClassVar[int] = 1
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
        :raises ValueError: if it was made for other slots, agents or returns; the former buffer stays
        """
        former = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            for name, wanted in {"n_envs": self.n_envs, "n_agents": self.n_agents, "n_steps": self.n_steps}.items():
                saved = getattr(self.replay_buffer, name, "none")
                if saved != wanted:
                    raise ValueError(f"{path} is no replay buffer of this model: its {name} is {saved}, not {wanted}")
        except (ValueError, AssertionError):  # SB3 asserts that it is a replay buffer, once it has taken its place
            self.replay_buffer = former
            raise

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
        :param kwargs: attributes to change
        :raises ValueError: where the number of agents differs, or another algorithm saved it
        """
        warnings.warn(
            f"{path} is a zip-file of pickled objects, which can run code when it is loaded: load only what you trust.",
            UntrustedFileWarning,
            stacklevel=2,
        )
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except RuntimeError as error:  # PyTorch's, with the names of the weights that one has and the other has not
            n_critics = saved_critics(path)
            bases = SavedOffPolicyAlgorithm.__subclasses__()
            others = [each for base in bases for each in (base, *base.__subclasses__()) if each.n_critics == n_critics]
            if n_critics == cls.n_critics or not others:
                raise
            name = others[0].__name__
            raise ValueError(f"{path} was saved by {name}, not by {cls.__name__}: use {name}.load") from error


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
