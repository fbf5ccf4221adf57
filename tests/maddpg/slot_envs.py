"""Tiny slot environments whose numbers tell where they come from."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv


class SlotEnv(VecEnv):
    """B worlds of N agents as B * N slots, world-major; subclasses say what an agent sees and earns."""

    render_mode = None
    truncates = True

    def __init__(self, n_worlds: int, n_agents: int, obs_size: int, action_size: int, *, episode_length: int) -> None:
        observation_space = spaces.Box(-np.inf, np.inf, (obs_size,), np.float32)
        action_space = spaces.Box(-1, 1, (action_size,), np.float32)
        self.n_agents, self.n_worlds, self.episode_length = n_agents, n_worlds, episode_length
        self.world = np.repeat(np.arange(n_worlds), n_agents)
        self.agent = np.tile(np.arange(n_agents), n_worlds)
        super().__init__(n_worlds * n_agents, observation_space, action_space)

    def observe(self) -> np.ndarray:
        raise NotImplementedError

    def rewards(self, actions: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def reset(self) -> np.ndarray:
        self.rng = np.random.default_rng(self._seeds[0])
        self.time = np.zeros(self.num_envs, dtype=int)
        self.returns = np.zeros(self.num_envs)
        return self.observe()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        rewards = self.rewards(self.actions)
        self.time += 1
        self.returns += rewards
        dones = self.time == self.episode_length
        terminal_obs = self.observe()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for slot in np.flatnonzero(dones):
            infos[slot] = {
                "terminal_observation": terminal_obs[slot],
                "TimeLimit.truncated": self.truncates,
                "episode": {"r": self.returns[slot], "l": int(self.time[slot]), "t": 0.0},
                "is_success": bool(self.world[slot] % 2),
            }
        self.time[dones] = 0
        self.returns[dones] = 0
        return self.observe(), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class LabelledWorlds(SlotEnv):
    """Observation (world, agent, step), reward 100 * agent + step: mixed-up indices show."""

    def __init__(self, n_worlds: int = 4, n_agents: int = 3, episode_length: int = 5, action_size: int = 2) -> None:
        super().__init__(n_worlds, n_agents, 3, action_size, episode_length=episode_length)

    def observe(self) -> np.ndarray:
        return np.stack([self.world, self.agent, self.time], axis=1).astype(np.float32)

    def rewards(self, actions: np.ndarray) -> np.ndarray:
        return 100.0 * self.agent + self.time


class IdentityWorlds(SlotEnv):
    """Each agent earns the negative distance of its action from what it sees: the optimum copies, and earns 0.

    Agent i has to answer with the sign (-1)^i, so that agents that share their weights by mistake cannot be right.
    """

    def __init__(self, n_worlds: int = 8, n_agents: int = 3, episode_length: int = 10) -> None:
        super().__init__(n_worlds, n_agents, 1, 1, episode_length=episode_length)

    def observe(self) -> np.ndarray:
        self.goal = self.rng.uniform(-0.9, 0.9, (self.num_envs, 1)).astype(np.float32)
        return self.goal

    def rewards(self, actions: np.ndarray) -> np.ndarray:
        sign = (-1.0) ** self.agent
        return -np.abs(actions[:, 0] - sign * self.last_goal[:, 0])

    def reset(self) -> np.ndarray:
        observation = super().reset()
        self.last_goal = observation
        return observation

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        result = super().step_wait()
        self.last_goal = result[0]
        return result
