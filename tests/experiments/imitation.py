"""An environment to be found by its import path: each agent is to do what it sees. Its arguments make it unfit."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

Array = NDArray[np.float32]

SPACES: dict[str, dict[str, Space[Any]]] = {
    "discrete": {"action": Discrete(3)},
    "unbounded": {"action": Box(-np.inf, np.inf, (1,), np.float32)},
    "symbols": {"observation": Discrete(3)},
    "images": {"observation": Box(0, 255, (8, 8, 3), np.uint8)},
}


class Imitation(ParallelEnv[str, Array, Array]):
    """Two agents see a number in [-1, 1] each; the reward is minus the distance of the action from it.

    :param unfit: one of ``SPACES``, or ``unequal``, ``staggered``, ``endless``
    """

    metadata: dict[str, Any] = {"name": "imitation_v0"}  # noqa: RUF012

    def __init__(self, length: int = 5, unfit: str = "") -> None:
        if length < 1:
            raise ValueError(f"length must be at least 1; got {length}")
        self.length, self.unfit, self.render_mode = length, unfit, None
        self.possible_agents = ["left", "right"]
        self.agents: list[str] = []
        self.random = np.random.default_rng()

    def observation_space(self, agent: str) -> Space[Any]:
        size = 2 if self.unfit == "unequal" and agent == "right" else 1
        return SPACES.get(self.unfit, {}).get("observation", Box(-1.0, 1.0, (size,), np.float32))

    def action_space(self, agent: str) -> Space[Any]:
        return SPACES.get(self.unfit, {}).get("action", Box(-1.0, 1.0, (1,), np.float32))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.agents, self.steps = self.possible_agents[:], 0
        return self._look(), {agent: {} for agent in self.agents}

    def _look(self) -> dict[str, Array]:
        self.seen = {
            agent: self.random.uniform(-1, 1, self.observation_space(agent).shape or ()).astype(np.float32)
            for agent in self.possible_agents
        }
        return self.seen

    def step(
        self, actions: dict[str, Array]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        self.steps += 1
        agents = self.agents
        rewards = {agent: -abs(float(actions[agent][0] - self.seen[agent][0])) for agent in agents}
        over = dict.fromkeys(agents, self.steps >= self.length and self.unfit != "endless")
        if self.unfit == "staggered":
            over["right"] = self.steps >= self.length - 1
        self.agents = [agent for agent in agents if not over[agent]]
        return self._look(), rewards, dict.fromkeys(agents, False), over, {agent: {} for agent in agents}


parallel_env = Imitation
no_environment = object
