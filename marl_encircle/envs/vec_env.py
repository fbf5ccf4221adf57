"""The native road: thousands of worlds as one Stable-Baselines3 VecEnv."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Difficulty, Simulator, world_seeds
from marl_encircle.envs.arena import Arena
from marl_encircle.envs.slot_vec_env import SlotVecEnv


class EncirclementVecEnv(SlotVecEnv):
    """B worlds of N pursuers as B * N environment slots, world by world: slot = world * N + pursuer.

    Every slot has its own scalar reward. All slots of a world end together: terminated when the encirclement is
    complete under the reward's closure rule, truncated (``TimeLimit.truncated``) after ``scenario.max_cycles`` steps.

    At the last step of a round the info of each of its slots holds ``is_success``, ``terminal_observation``,
    ``TimeLimit.truncated`` and ``round``, the round's figures; at other steps it is empty.

    :param scenario: the rules
    :param reward: the reward, and the closure rule that ends a round
    :param n_worlds: B
    :param seed: see :meth:`seed`
    :raises ValueError: for fewer than one world
    """

    def __init__(
        self,
        scenario: Scenario | None = None,
        reward: Reward | None = None,
        n_worlds: int = 1,
        seed: int | None = None,
    ) -> None:
        self._arena = Arena(scenario or Scenario(), reward or Reward(), n_worlds)
        super().__init__(self._arena.scenario, self._arena.reward, n_worlds)
        if seed is not None:
            self.seed(seed)

    @property
    def simulator(self) -> Simulator:
        """The simulator of all worlds."""
        return self._arena.simulator

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give every world its own random stream from the next ``reset`` on: ``world_seeds(seed, B)[b]`` for world b.

        :return: the seed of each slot's world
        :raises ValueError: for a negative seed
        """
        self._seeds = [s for s in world_seeds(seed, self.n_worlds) for _ in range(self.n_agents)]
        return self._seeds

    def set_difficulty(self, difficulty: Difficulty) -> None:
        """Change speed ratio, safety distance or obstacle radius from each world's next round on.

        :raises ValueError: for another field, or a value that the scenario would not take
        """
        self.simulator.set_difficulty(difficulty)

    def step_wait(self) -> VecEnvStepReturn:
        """Move all worlds by one step; worlds whose round ended start the next one.

        :return: observations (B * N, O), rewards (B * N,), dones (B * N,), infos
        :raises ValueError: for an action that is not finite, naming world and pursuer; nothing moves then
        :raises PlacementError: if the bodies of a new round cannot be placed
        """
        observations, rewards, terminated, truncated = self._arena.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        worlds = np.flatnonzero(done)
        if len(worlds):
            for b in worlds.tolist():
                figures = self._arena.rounds.summary(b)
                for i in range(self.n_agents):
                    infos[b * self.n_agents + i] = {
                        "is_success": bool(terminated[b]),
                        "TimeLimit.truncated": bool(truncated[b]),
                        "terminal_observation": observations[b, i].copy(),
                        "round": figures,
                    }
            self._arena.restart(worlds, observations)
        return self._slots(observations), rewards.ravel(), np.repeat(done, self.n_agents), infos

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, for an exact resume."""
        return self._arena.get_state()

    def set_state(self, saved: dict[str, Any]) -> NDArray[np.float32]:
        """Go on from what :meth:`get_state` returned.

        :return: the present observations, (B * N, O)
        """
        self._arena.set_state(saved)
        self._running = True
        return self._slots(self._arena.observe())

    def _start(self) -> NDArray[np.float32]:
        if self._seeds[0] is not None:
            self.simulator.seed([int(s) for s in self._seeds[:: self.n_agents] if s is not None])
        return self._slots(self._arena.reset())

    def _slots(self, per_world: NDArray[np.float32]) -> NDArray[np.float32]:
        return per_world.reshape(self.num_envs, -1)
