"""Divergence: a loss or a weight that is no finite number ends a training, and the moment is kept to be looked at.

    moment = load_moment("results/runs/ours/ratio1.1_n3_m1_random/seed0")
    moment.batches[0].rewards.isnan().any()     # tensor(True), say: it came from a reward term
    moment.repeat()                             # "train/critic_loss is nan"

The last checkpoint before it stays in the run folder.
"""

import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from marl_encircle import files
from marl_encircle.experiments import checkpoint
from marl_encircle.experiments.build import build_model, build_vec_env
from marl_encircle.experiments.config import Config
from marl_encircle.maddpg import MADDPG
from marl_encircle.maddpg.buffers import JointReplayBuffer

NAME = "divergence.safetensors"
LOSSES = ("train/critic_loss", "train/actor_loss")


class Diverged(Exception):  # noqa: N818 - a result, not a fault of the program
    """A loss or a weight is no finite number any more."""


def fault(model: MADDPG) -> str | None:
    """Say which loss of the latest training, or which network's weights, are no finite numbers; None if all are."""
    for name in LOSSES:
        value = model.logger.name_to_value.get(name, 0.0)
        if not math.isfinite(value):
            return f"{name} is {value}"
    with th.no_grad():
        for name, network in (("actor", model.actor), ("critic", model.critic)):
            # Walking through the modules takes as long as the sums. A finite one has finite terms only, and takes a
            # quarter of the time of looking at each of them.
            weights = (p for group in network.optimizer.param_groups for p in group["params"])
            if not all(math.isfinite(p.sum().item()) or bool(p.isfinite().all()) for p in weights):
                return f"the {name} has weights that are not finite"
    return None


class DivergenceGuard(BaseCallback):
    """End the training by ``Diverged`` when a loss or a weight is no finite number any more, and keep the moment.

    Before every training it remembers the weights, the optimisers and the generators. The batches are drawn again when
    they are needed: nothing enters the replay buffer between a training and the look at what came out.

    :param plan: what the training was built from: ``config``, ``seed``, ``engine``
    :param path: of the file that keeps the moment
    """

    model: MADDPG

    def __init__(self, plan: Mapping[str, Any], path: Path) -> None:
        super().__init__()
        self.plan, self.path = plan, path
        self._optimized: tuple[int, ...] = ()
        self._live: list[th.Tensor] = []
        self._kept: list[th.Tensor] = []
        self._parameters: dict[str, Any] = {}
        self._counters: dict[str, Any] = {}
        self._random: dict[str, Any] = {}

    def _on_rollout_end(self) -> None:
        model = self.model
        optimized = len(model.actor.optimizer.state), len(model.critic.optimizer.state)
        if optimized != self._optimized or not self._kept:  # Adam makes its tensors at the first step
            live = model.get_parameters()
            self._parameters = deepcopy(live)
            self._live, self._kept = list(_tensors(live)), list(_tensors(self._parameters))
            self._optimized = optimized
        else:
            th._foreach_copy_(self._kept, self._live)
        self._counters = {name: getattr(model, name) for name in checkpoint.COUNTERS}
        self._random = {"numpy": np.random.get_state(), "torch": th.get_rng_state()}  # noqa: NPY002 - SB3's sampling

    def _on_rollout_start(self) -> None:
        self.check()

    def _on_step(self) -> bool:
        return True

    def check(self) -> None:
        """Keep the moment and raise Diverged unless all is well.

        :raises OSError: if the moment cannot be written
        """
        reason = fault(self.model)
        if reason is not None:
            self._keep(reason)
            raise Diverged(f"{reason} at update {self.model._n_updates}; kept in {self.path}, see load_moment")

    def _keep(self, reason: str) -> None:
        model, buffer = self.model, self.model.replay_buffer
        assert buffer is not None
        np.random.set_state(self._random["numpy"])  # noqa: NPY002
        updates = model._n_updates - self._counters["_n_updates"]
        batches = [buffer.sample(model.batch_size, model._vec_normalize_env)._asdict() for _ in range(updates)]
        moment = {
            "reason": reason,
            "plan": self.plan,
            "counters": self._counters,
            "parameters": self._parameters,
            "batches": batches,
            "random": {
                "numpy": list(self._random["numpy"]),
                "torch": self._random["torch"],
                "exploration": model.exploration_rng.bit_generator.state,
            },
        }
        checkpoint.save_tree(self.path, moment)


class Moment(NamedTuple):
    """A training just before the updates that ended it.

    :param model: weights, optimisers and counters as they were; its environment and replay buffer are new
    :param batches: what each update was made from
    :param random: the generators: ``numpy``, ``torch``, ``exploration``
    :param reason: what was no finite number after the updates
    """

    model: MADDPG
    batches: list[ReplayBufferSamples]
    random: dict[str, Any]
    reason: str

    def repeat(self) -> str | None:
        """Make the updates, bit for bit, and say which loss or weights are then no finite numbers.

        Sets PyTorch's global generator.
        """
        th.set_rng_state(th.from_numpy(self.random["torch"]))
        self.model.replay_buffer = cast(JointReplayBuffer, _Drawn(self.batches))
        self.model.train(len(self.batches), self.model.batch_size)
        return fault(self.model)


class _Drawn:
    """In place of a replay buffer: batches that were drawn from one."""

    def __init__(self, batches: list[ReplayBufferSamples]) -> None:
        self._batches = iter(batches)

    def sample(self, batch_size: int, env: object) -> ReplayBufferSamples:
        return next(self._batches)


def load_moment(run_folder: str | Path) -> Moment:
    """Return the moment at which the training of a run folder diverged. Nothing in the file can run code.

    :raises DamagedFileError: if there is no such file, or a bit of it has changed
    """
    path = Path(run_folder) / NAME
    tree = checkpoint.load_tree(path)
    try:
        config = Config.from_dict(tree["plan"]["config"])
        model = build_model(config, build_vec_env(config, len(config.settings)), tree["plan"]["seed"])
        checkpoint.restore_parameters(model, tree)
        model.set_logger(Logger(None, []))
        batches = [ReplayBufferSamples(**checkpoint.to_torch(batch)) for batch in tree["batches"]]
        return Moment(model, batches, tree["random"], tree["reason"])
    except checkpoint.MISFIT as error:
        raise files.DamagedFileError(path, f"does not fit its own configuration: {str(error)[:200]}") from error


def _tensors(tree: Any) -> Iterator[th.Tensor]:
    """All tensors of a tree, in its order."""
    if isinstance(tree, th.Tensor):
        yield tree
    elif isinstance(tree, Mapping):
        for value in tree.values():
            yield from _tensors(value)
    elif isinstance(tree, (list, tuple)):
        for value in tree:
            yield from _tensors(value)
