"""A trained policy's actors as one file that needs nothing of this package to be used.

The file maps observations of B worlds (B, N, O) to actions of the action space (B, N, U), as ``predict`` does. It is
compared with ``predict`` before it is written: on random observations and on those of rounds that the policy plays.
"""

import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from torch import nn

from marl_encircle import files
from marl_encircle.core.observations import layout
from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.arena import Arena
from marl_encircle.experiments.choices import ExportFormat
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.records import POLICY, run_path
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg.policies import MADDPGPolicy

Array = NDArray[np.float32]
Act = Callable[[Array], Array]
"""From observations (B, N, O) to actions (B, N, U)."""

SUFFIXES: dict[ExportFormat, str] = {"onnx": ".onnx", "torchscript": ".pt", "torch-export": ".pt2"}
TOLERANCE = 1e-5
"""Largest difference from ``predict`` in any action."""

RANDOM = 1000
PLAYED = 16
"""Random joint observations, and rounds played, that are compared."""


class ParityError(Exception):
    """The exported actors do not act as the policy does."""


class Export(NamedTuple):
    """What was written.

    :param path: the file
    :param random: largest difference from ``predict`` in any action, on random observations
    :param played: the same on the observations of rounds played
    :param description: what the file says about itself
    """

    path: Path
    random: float
    played: float
    description: dict[str, Any]


class Actors(nn.Module):
    """The actors of a policy, their actions in the action space."""

    def __init__(self, policy: MADDPGPolicy) -> None:
        super().__init__()
        assert isinstance(policy.action_space, spaces.Box)
        self.actor = policy.actor
        self.low: th.Tensor
        self.high: th.Tensor
        self.register_buffer("low", th.as_tensor(policy.action_space.low))
        self.register_buffer("high", th.as_tensor(policy.action_space.high))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the actions of all agents, (B, N, U).

        :param observations: (B, N, O)
        """
        scaled = self.actor(observations)
        # The clamp changes nothing but rounding at the bounds.
        return th.clamp(self.low + 0.5 * (scaled + 1.0) * (self.high - self.low), self.low, self.high)


def export_run(run: str | Path, to: ExportFormat, out: str | Path | None = None) -> Export:
    """Write the actors of a finished run as one file.

    :param run: its folder
    :param to: the format
    :param out: the file; by default ``<method>_<setting>_seed<s>`` with the format's suffix, in the working folder
    :raises ConfigError: if the format needs a library that is missing
    :raises DamagedFileError: if the run is not what its record says
    :raises ParityError: if the actors of the file act otherwise; nothing is written then
    """
    policy, config, record = load_run(run)
    if out is None:
        out = "_".join(run_path(config.cell, record["seed"]).parts) + SUFFIXES[to]
    description = describe(policy, config, record)
    data = _WRITERS[to](Actors(policy).eval(), example(policy), description)
    act = _READERS[to](data)
    samples = random_observations(policy), played_observations(policy, config)
    random, played = (difference(policy, act, observations) for observations in samples)
    if not max(random, played) <= TOLERANCE:  # nor if it is no number
        raise ParityError(
            f"{out}: not written: an action differs from predict by {max(random, played):.1e}; allowed is {TOLERANCE:g}"
        )
    files.write_bytes(out, data)
    return Export(Path(out), random, played, description)


def describe(policy: MADDPGPolicy, config: Config, record: dict[str, Any]) -> dict[str, Any]:
    """Return what somebody who has only the file needs to know, as plain data."""
    parts = {name: [part.start, part.stop] for name, part in layout(config.scenario).items()}
    return {
        "method": config.reward.name,
        "setting": config.cell.setting._asdict(),
        "agents": list(policy.agents or ()),
        "observation_layout": parts,
        "train_seed": record["seed"],
        "status": record["status"],
        "config_hash": record["config_hash"],
        "policy_sha256": record["sha256"][POLICY],
        "marl_encircle": metadata.version("marl-encircle"),
    }


def example(policy: MADDPGPolicy) -> th.Tensor:
    """Return observations of two worlds: with one, exporters would take the number of worlds for a constant."""
    return th.zeros(2, policy.n_agents, *(policy.observation_space.shape or ()))


def random_observations(policy: MADDPGPolicy) -> Array:
    """Return samples of the observation space, (RANDOM, N, O)."""
    space = policy.observation_space
    assert isinstance(space, spaces.Box)
    space = spaces.Box(space.low, space.high, seed=0)
    return np.stack([space.sample() for _ in range(RANDOM * policy.n_agents)]).reshape(RANDOM, policy.n_agents, -1)


def played_observations(policy: MADDPGPolicy, config: Config) -> Array:
    """Return what is seen in rounds that the policy plays, (PLAYED * max_cycles, N, O)."""
    arena = Arena(config.scenario, config.reward.build(), PLAYED)
    arena.simulator.seed(world_seeds(config.evaluation.curve_seed, PLAYED))
    seen = [arena.reset()]
    while len(seen) < config.scenario.max_cycles:
        actions, _ = policy.predict(seen[-1], deterministic=True)
        seen.append(arena.step(np.asarray(actions)).observations)
    return np.concatenate(seen)


def difference(policy: MADDPGPolicy, act: Act, observations: Array) -> float:
    """Return the largest difference from the policy's own in any action, for a world alone and for many."""
    expected, _ = policy.predict(observations, deterministic=True)
    actions = np.concatenate([act(observations[:1]), act(observations[1:])])
    return float(np.abs(actions - expected).max())


def _to_onnx(actors: Actors, observations: th.Tensor, description: dict[str, Any]) -> bytes:
    try:
        import onnx
        import onnx_ir
        import onnxruntime  # noqa: F401 - the comparison needs it
        import onnxscript  # noqa: F401 - torch.onnx needs it
        from onnx_ir.passes.common import ClearMetadataAndDocStringPass
    except ImportError as error:
        raise ConfigError(f"ONNX needs {error.name}: pip install 'marl-encircle[export]'") from error
    with _quiet(), th.no_grad():
        program = th.onnx.export(
            actors,
            (observations,),
            dynamo=True,
            verbose=False,
            input_names=["observations"],
            output_names=["actions"],
            dynamic_shapes=({0: "worlds"},),
        )
    assert program is not None
    ClearMetadataAndDocStringPass()(program.model)  # with stack traces, and so the paths of this machine
    model = onnx_ir.to_proto(program.model)
    onnx.helper.set_model_props(model, {key: _as_text(value) for key, value in description.items()})
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString(deterministic=True)
    return data


def _as_text(value: Any) -> str:
    """Return a value of ONNX's metadata: a string as it is, else JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _from_onnx(data: bytes) -> Act:
    import onnxruntime

    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    return lambda observations: session.run(["actions"], {"observations": observations})[0]


def _to_torchscript(actors: Actors, observations: th.Tensor, description: dict[str, Any]) -> bytes:
    out = io.BytesIO()
    with _quiet(), th.no_grad():  # torch deprecates TorchScript in favour of torch.export, and reads it still
        module = th.jit.trace(actors, observations)  # type: ignore[no-untyped-call]  # torch does not type it
        th.jit.save(module, out, _extra_files={"metadata.json": json.dumps(description)})
    return out.getvalue()


def _from_torchscript(data: bytes) -> Act:
    with _quiet():
        module = th.jit.load(io.BytesIO(data))  # type: ignore[no-untyped-call]  # torch does not type it
    return _act(module)


def _to_torch_export(actors: Actors, observations: th.Tensor, description: dict[str, Any]) -> bytes:
    out = io.BytesIO()
    with _quiet(), th.no_grad():
        program = th.export.export(actors, (observations,), dynamic_shapes=({0: th.export.Dim("worlds")},))
        for node in program.graph.nodes:
            node.meta.pop("stack_trace", None)  # with the paths of this machine
        th.export.save(program, out, extra_files={"metadata.json": json.dumps(description)})
    return out.getvalue()


def _from_torch_export(data: bytes) -> Act:
    with _quiet():
        module = th.export.load(io.BytesIO(data)).module()
    return _act(module)


def _act(module: nn.Module) -> Act:
    def act(observations: Array) -> Array:
        with th.no_grad():
            actions: Array = module(th.from_numpy(observations)).numpy()
        return actions

    return act


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out what torch says about its own exporters, none of which a user can change."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


_WRITERS: dict[ExportFormat, Callable[[Actors, th.Tensor, dict[str, Any]], bytes]] = {
    "onnx": _to_onnx,
    "torchscript": _to_torchscript,
    "torch-export": _to_torch_export,
}
_READERS: dict[ExportFormat, Callable[[bytes], Act]] = {
    "onnx": _from_onnx,
    "torchscript": _from_torchscript,
    "torch-export": _from_torch_export,
}
