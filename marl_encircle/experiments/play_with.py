"""MADDPG and MATD3 on any PettingZoo ParallelEnv: trained through SuperSuit, held against chance, written as a policy.

The hyper-parameters are those of ``benchmarks/simple_spread.py``, chosen for MPE's ``simple_spread``, but each agent
has an actor of its own: a start, not what another environment deserves.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor

from marl_encircle import files
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv, World, WorldError
from marl_encircle.experiments.build import policy_bytes
from marl_encircle.experiments.choices import AlgorithmName
from marl_encircle.experiments.config import MAX_CRITIC_BYTES, MAX_POLICY_BYTES
from marl_encircle.experiments.divergence import Diverged, fault
from marl_encircle.experiments.loading import load_weights
from marl_encircle.experiments.memory import available_memory, check_memory
from marl_encircle.experiments.metrics import Interval, student_interval
from marl_encircle.experiments.progress import ProgressBar
from marl_encircle.experiments.provenance import git_commit, versions
from marl_encircle.experiments.sections import MAX_LAYERS
from marl_encircle.experiments.sizes import weights_between
from marl_encircle.experiments.worlds import MAX_ROUND, NO_END, random_actions
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG
from marl_encircle.maddpg.policies import MADDPGPolicy

Returns = NDArray[np.float64]
"""Return of each round, mean over the agents."""

Act = Callable[[NDArray[Any]], NDArray[Any]]
"""From the observations of one world's agents (N, O) to their actions (N, U)."""

NET_ARCH = [64, 64]
RANDOM_WORLD_STEPS = 3_000
BUFFER_WORLD_STEPS = 500_000
FIRST_ROUND = 5_000_000
"""Seed of the first evaluation round; the next ones follow."""

WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"


class Played(NamedTuple):
    """What came of a training.

    :param policy: the trained one
    :param agents: in the order of its rows
    :param world_steps: trained on
    :param returns: of its evaluation rounds
    :param random: of the same rounds with uniformly random actions
    """

    policy: MADDPGPolicy
    agents: tuple[str, ...]
    world_steps: int
    returns: Returns
    random: Returns

    def summary(self) -> dict[str, tuple[float, Interval | None]]:
        """Return means and their 95 % intervals over the rounds: of the policy, of chance, of the paired difference."""
        rows = {"trained": self.returns, "random": self.random, "difference": self.returns - self.random}
        return {name: (float(values.mean()), student_interval(values.tolist())) for name, values in rows.items()}


def play_with(
    name: str,
    world: Callable[[], World],
    algorithm: AlgorithmName = "maddpg",
    world_steps: int = 60_000,
    *,
    n_worlds: int = 8,
    seed: int = 0,
    rounds: int = 100,
    progress_bar: bool = False,
) -> Played:
    """Train, then play the evaluation's rounds, and the same ones by chance.

    :param name: of the environment, for errors
    :param world: makes a new world, see :func:`find_world`
    :param world_steps: steps of all agents of one world
    :param rounds: of the evaluation, none of which was trained on
    :raises ConfigError: if a round cannot be trained on: agents that end at different steps; or if so many steps do not
        fit into this machine's memory
    :raises Diverged: if a loss or a weight is no finite number any more
    """
    env = SuperSuitVecEnv(world, n_worlds)
    n, steps = env.n_agents, min(world_steps + n_worlds, BUFFER_WORLD_STEPS)
    check_memory({"--world-steps": steps * n * _transition_bytes(env)}, available_memory())
    model = ALGORITHMS[algorithm](
        "MlpPolicy",
        VecMonitor(env),
        n_agents=n,
        learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
        buffer_size=steps * n,
        learning_starts=min(RANDOM_WORLD_STEPS, world_steps // 10) * n,
        batch_size=512,
        gamma=0.95,
        tau=0.01,
        gradient_steps=2,
        exploration_noise=0.4,
        policy_kwargs={"net_arch": NET_ARCH},
        seed=seed,
        device="cpu",
    )
    bar = ProgressBar(
        world_steps, lambda: model.num_timesteps // n, lambda step: _ended_returns(step, n), "return {:.2f}"
    )
    guard = _Guard()
    try:
        model.learn(world_steps * n, callback=CallbackList([guard, *([bar] if progress_bar else [])]))
        guard.check()  # the last updates too
    except WorldError as error:
        raise ConfigError(f"{name}: {error}") from error
    finally:
        bar.close()
    policy = model.policy
    policy.set_training_mode(False)
    returns = play_returns(name, world, lambda seen: np.asarray(policy.predict(seen, deterministic=True)[0]), rounds)
    random = play_returns(name, world, random_actions(env.action_space), rounds)
    env.close()
    return Played(policy, env.agents, model.num_timesteps // n, returns, random)


def _transition_bytes(env: SuperSuitVecEnv) -> int:
    """Return the memory [bytes] that an agent's transition takes in the replay buffer."""
    seen, act = (int(np.prod(space.shape or ())) for space in (env.observation_space, env.action_space))
    return 2 * seen * np.dtype(env.observation_space.dtype).itemsize + 4 * (act + 3)


class _Guard(BaseCallback):
    """End a training that has diverged."""

    model: MADDPG

    def _on_rollout_start(self) -> None:
        self.check()

    def _on_step(self) -> bool:
        return True

    def check(self) -> None:
        """Look at the updates that were made since the last rollout."""
        if reason := fault(self.model):
            raise Diverged(f"diverged: {reason} after {self.model.num_timesteps:,} agent steps; try another --seed")


def _ended_returns(step: BaseCallback, n_agents: int) -> list[float]:
    """Return the mean return of the agents of each world whose round ended in this step."""
    ended = [info["episode"]["r"] for info in step.locals["infos"] if "episode" in info]
    return [float(np.mean(ended[first : first + n_agents])) for first in range(0, len(ended), n_agents)]


def play_returns(name: str, world: Callable[[], World], act: Act, rounds: int) -> Returns:
    """Return what each round brought, round r in a world of seed ``FIRST_ROUND + r``.

    :raises ConfigError: if a round does not end, or not for all agents at once
    """
    env = world()
    agents = env.possible_agents
    returns = np.zeros(rounds)
    for number in range(rounds):
        observations, _ = env.reset(seed=FIRST_ROUND + number)
        for _ in range(MAX_ROUND):
            actions = act(np.stack([observations[agent] for agent in agents]))
            observations, rewards, *_ = env.step(dict(zip(agents, actions, strict=True)))
            returns[number] += np.mean([rewards[agent] for agent in agents])
            if 0 < len(env.agents) < len(agents):
                raise ConfigError(f"{name}: only {', '.join(env.agents)} went on; all agents must end together")
            if not env.agents:
                break
        else:
            raise ConfigError(f"{name}: {NO_END}")
    env.close()  # type: ignore[no-untyped-call]  # PettingZoo does not type it
    return returns


def save_policy(folder: Path, played: Played, about: Mapping[str, Any]) -> None:
    """Write ``policy.safetensors``, the actors, and ``policy.json``, all that :func:`load_played` needs to read them.

    :param about: what else the description is to say
    """
    data = policy_bytes(played.policy)
    act = played.policy.action_space
    assert isinstance(act, spaces.Box)
    description = {
        **about,
        "agents": list(played.agents),
        "observation_shape": list(played.policy.observation_space.shape or ()),
        "action_low": act.low.tolist(),
        "action_high": act.high.tolist(),
        "net_arch": NET_ARCH,
        "world_steps": played.world_steps,
        "returns": {name: mean for name, (mean, _) in played.summary().items()},
        "git_commit": git_commit(),
        "versions": versions(),
        "sha256": files.sha256_bytes(data),
    }
    files.write_bytes(folder / WEIGHTS, data)
    files.write_json(folder / DESCRIPTION, description)


def load_played(folder: str | Path) -> MADDPGPolicy:
    """Return a policy that ``marl-encircle play-with --save`` wrote. Reads JSON and safetensors only.

    :raises DamagedFileError: if a file is missing, changed or does not fit the other
    """
    path = Path(folder) / DESCRIPTION
    try:
        about = json.loads(files.read_bytes(path, max_bytes=1 << 20))
        low, high = (np.array(about[key], np.float32) for key in ("action_low", "action_high"))
        _check_size(len(about["agents"]), math.prod(about["observation_shape"]), about["net_arch"], low.size)
        policy = MADDPGPolicy(
            spaces.Box(-np.inf, np.inf, tuple(about["observation_shape"])),
            spaces.Box(low, high),
            lambda _: 0.0,
            n_agents=len(about["agents"]),
            critic="shared",
            net_arch={"pi": about["net_arch"], "qf": []},
        )
        sha256 = str(about["sha256"])
    except files.DamagedFileError:
        raise
    except (ValueError, TypeError, KeyError, AssertionError, RuntimeError) as error:
        raise files.DamagedFileError(path, f"does not describe a policy: {str(error)[:200]}") from error
    data = files.read_bytes(Path(folder) / WEIGHTS, sha256=sha256, max_bytes=MAX_POLICY_BYTES)
    try:
        load_weights(policy, data)
    except (safetensors.SafetensorError, RuntimeError, ValueError) as error:
        raise files.DamagedFileError(Path(folder) / WEIGHTS, f"does not fit {path}: {str(error)[:200]}") from error
    policy.agents = tuple(about["agents"])
    policy.set_training_mode(False)
    return policy


def _check_size(n: int, size: int, net_arch: list[int], act: int) -> None:
    """Raise a ValueError for networks that are larger than any that could have been saved."""
    actors, critic = n * weights_between([size, *net_arch, act]), weights_between([n * (size + act), n])
    if len(net_arch) > MAX_LAYERS or 4 * actors > MAX_POLICY_BYTES or 4 * critic > MAX_CRITIC_BYTES:
        raise ValueError(f"its networks would have {actors + critic} weights in {len(net_arch)} layers")
