"""Worlds of several settings as one Stable-Baselines3 VecEnv, for one policy that serves them all."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from marl_encircle.core.observations import bounds, layout
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Difficulty, world_seeds
from marl_encircle.envs.arena import ACTION_SIZE
from marl_encircle.envs.slot_vec_env import SlotVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv


class _Part(NamedTuple):
    """The worlds of one setting.

    :param env: the worlds, all of one scenario
    :param worlds: which of all worlds they are
    :param columns: where their observations stand in those of the largest scenario
    """

    env: EncirclementVecEnv
    worlds: slice
    columns: NDArray[np.int64]


class MixedVecEnv(SlotVecEnv):
    """B worlds, as many of each scenario, as B * N slots: slot = world * N + pursuer.

    N is the number of pursuers of the largest scenario, and observations are laid out as its are. What a world lacks is
    zero: bodies in the observations of those that are there; and the observations and rewards of the slots of pursuers
    that are not, whose actions do nothing and whose infos say ``absent``. Otherwise as ``EncirclementVecEnv``.

    :param largest: it has the most pursuers, the most obstacles and the highest speed ratio
    :param scenarios: of the worlds, in this order; they differ from the largest in numbers and speed ratio
    :param reward: the reward, and the closure rule that ends a round
    :param n_worlds: B, a multiple of the number of scenarios
    :raises ValueError: if it is not
    """

    def __init__(self, largest: Scenario, scenarios: Sequence[Scenario], reward: Reward, n_worlds: int) -> None:
        each, rest = divmod(n_worlds, len(scenarios))
        if rest or not each:
            raise ValueError(f"n_worlds must be a multiple of the {len(scenarios)} settings; got {n_worlds}")
        self._parts = [
            _Part(EncirclementVecEnv(s, reward, each), slice(i * each, (i + 1) * each), _columns(s, largest))
            for i, s in enumerate(scenarios)
        ]
        self._size = len(bounds(largest)[0])
        super().__init__(largest, reward, n_worlds)
        pursuers = np.repeat([s.pursuers for s in scenarios], each)
        self._there = np.arange(self.n_agents) < pursuers[:, None]  # whether a slot has a pursuer, (B, N)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give every world its own random stream: ``world_seeds(seed, P)[p]`` is the seed of the worlds of part p of P.

        :return: the seed of each slot's world
        :raises ValueError: for a negative seed
        """
        seeds = [part.env.seed(s) for part, s in zip(self._parts, world_seeds(seed, len(self._parts)), strict=True)]
        by_world = [s for part, own in zip(self._parts, seeds, strict=True) for s in own[:: part.env.n_agents]]
        self._seeds = [s for s in by_world for _ in range(self.n_agents)]
        return self._seeds

    def set_difficulty(self, difficulty: Difficulty) -> None:
        """Change what ``EncirclementVecEnv`` does; no world gets a higher speed ratio than its scenario's.

        :raises ValueError: for another field, or a value that a scenario would not take
        """
        for part in self._parts:
            own = difficulty.copy()
            if "speed_ratio" in own:
                own["speed_ratio"] = min(own["speed_ratio"], part.env.scenario.speed_ratio)
            part.env.set_difficulty(own)

    def step_wait(self) -> VecEnvStepReturn:
        """Move all worlds by one step; worlds whose round ended start the next one.

        :return: observations (B * N, O), rewards (B * N,), dones (B * N,), infos
        :raises ValueError: for an action that is not finite, naming world and pursuer; nothing moves then
        :raises PlacementError: if the bodies of a new round cannot be placed
        """
        self._check_finite()
        steps = [
            env.step(self._actions[worlds, : env.n_agents].reshape(-1, ACTION_SIZE)) for env, worlds, _ in self._parts
        ]
        observations, rewards, dones, infos = zip(*steps, strict=True)
        padded_rewards = np.zeros((self.n_worlds, self.n_agents), rewards[0].dtype)
        padded_dones = np.empty((self.n_worlds, self.n_agents), np.bool_)
        padded_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for part, reward, done, info in zip(self._parts, rewards, dones, infos, strict=True):
            env, worlds, _ = part
            padded_rewards[worlds, : env.n_agents] = reward.reshape(-1, env.n_agents)
            ended = done[:: env.n_agents]
            padded_dones[worlds] = ended[:, None]
            for b in np.flatnonzero(ended).tolist():
                first = (worlds.start + b) * self.n_agents
                padded_infos[first : first + self.n_agents] = self._infos_of_world(
                    part, info[b * env.n_agents : (b + 1) * env.n_agents]
                )
        return self._padded(observations), padded_rewards.ravel(), padded_dones.ravel(), padded_infos

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, for an exact resume."""
        return {"parts": [part.env.get_state() for part in self._parts]}

    def set_state(self, saved: dict[str, Any]) -> NDArray[np.float32]:
        """Go on from what :meth:`get_state` returned.

        :return: the present observations, (B * N, O)
        """
        observations = [part.env.set_state(s) for part, s in zip(self._parts, saved["parts"], strict=True)]
        self._running = True
        return self._padded(observations)

    def _start(self) -> NDArray[np.float32]:
        return self._padded([part.env.reset() for part in self._parts])

    def _check_finite(self) -> None:
        """Raise a ValueError for what a part would refuse after the parts before it have moved."""
        wrong = np.argwhere(self._there & ~np.isfinite(self._actions).all(axis=2))
        if len(wrong):
            world, pursuer = wrong[0].tolist()
            action = self._actions[world, pursuer]
            raise ValueError(f"the action of {self.agents[pursuer]} in world {world} is not finite: {action}")

    def _infos_of_world(self, part: _Part, infos: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the infos of all slots of a world whose round has ended."""
        last = np.zeros((self.n_agents, self._size), np.float32)
        last[: len(infos), part.columns] = [info["terminal_observation"] for info in infos]
        absent = [{**infos[-1], "absent": True}] * (self.n_agents - len(infos))
        return [{**info, "terminal_observation": last[i]} for i, info in enumerate([*infos, *absent])]

    def _padded(self, observations: Sequence[Any]) -> NDArray[np.float32]:
        """Return the observations of all slots from those of each part."""
        out = np.zeros((self.n_worlds, self.n_agents, self._size), np.float32)
        for (env, worlds, columns), own in zip(self._parts, observations, strict=True):
            out[worlds, : env.n_agents, columns] = own.reshape(env.n_worlds, env.n_agents, -1)
        return out.reshape(self.num_envs, -1)


def _columns(scenario: Scenario, largest: Scenario) -> NDArray[np.int64]:
    """Return where a scenario's observations stand in the largest one's."""
    wide = layout(largest)
    parts = layout(scenario).items()
    return np.concatenate([np.arange(part.stop - part.start) + wide[name].start for name, part in parts])
