"""Replay of joint transitions: what all agents of one world saw and did at the same moment."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize


class JointReplayBuffer(ReplayBuffer):
    """SB3's replay buffer over world-major slots (slot = world * N + agent), sampled by worlds.

    The arrays are SB3's, (pos, B * N, ...); the agents of a world lie side by side in them, so that a joint
    transition is a view. ``buffer_size`` counts agent steps as SB3 does: ``buffer_size // N`` joint transitions,
    rounded down to whole steps of the B worlds.

    :param buffer_size: number of agent steps to keep
    :param observation_space: one agent's observation space
    :param action_space: one agent's action space
    :param device: where samples go
    :param n_envs: number of slots, B * N
    :param n_agents: number of agents N
    :param n_steps: steps whose rewards are summed, fewer where the episode or the newest step comes first
    :param gamma: discount factor of that sum
    :param kwargs: passed on to SB3's ``ReplayBuffer``
    :raises ValueError: for slots that are no whole worlds, a sum of no rewards, or one that
        ``optimize_memory_usage`` has no observations for
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        n_agents: int = 1,
        n_steps: int = 1,
        gamma: float = 0.99,
        **kwargs: Any,
    ) -> None:
        if n_envs % n_agents:
            raise ValueError(f"{n_envs} slots are no whole number of worlds with {n_agents} agents")
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, but got {n_steps}")
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, **kwargs)
        if n_steps > 1 and self.optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage keeps no observation behind the end of an episode: n_steps must be 1"
            )
        self.n_agents = n_agents
        self.n_steps = n_steps
        self.gamma = float(gamma)  # numpy's own would make the sums more precise than the networks
        self.n_worlds = n_envs // n_agents

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add one step of all slots; ``infos`` are read only where ``done``.

        :param obs: observations, shape (B * N, *O)
        :param next_obs: the observations that follow, before any reset, shape (B * N, *O)
        :param action: actions in [-1, 1], shape (B * N, *U)
        :param reward: rewards, shape (B * N,)
        :param done: whether the episode ended, shape (B * N,)
        :param infos: ``TimeLimit.truncated`` tells time limits from terminations
        """
        self.observations[self.pos] = obs
        if self.optimize_memory_usage:
            self.observations[(self.pos + 1) % self.buffer_size] = next_obs
        else:
            self.next_observations[self.pos] = next_obs
        self.actions[self.pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = reward
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = False
            ended = np.flatnonzero(done)
            truncated = [infos[slot].get("TimeLimit.truncated", False) for slot in ended]
            self.timeouts[self.pos, ended] = np.reshape(truncated, len(ended))

        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def end_episodes(self) -> None:
        """Let returns of several steps end at the newest step: the environment is about to be reset.

        An episode that was under way there counts as truncated, so that its last observation is still bootstrapped.
        """
        if self.n_steps > 1 and self.size():
            newest = (self.pos - 1) % self.buffer_size
            under_way = self.dones[newest] == 0
            self.dones[newest, under_way] = self.timeouts[newest, under_way] = 1

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Joint transitions of randomly drawn worlds, over ``n_steps`` steps.

        :param batch_inds: steps, shape (B,)
        :param env: to normalise observations and rewards with
        :return: observations (B, N, *O), actions (B, N, U), next observations (B, N, *O), dones without time
            limits (B, N), rewards (B, N), and with ``n_steps`` above 1 what the value of the next observations is
            discounted by, (B, 1)
        """
        worlds = np.random.randint(self.n_worlds, size=len(batch_inds))  # noqa: NPY002 - SB3 draws from the same one
        first = last = batch_inds * self.n_worlds + worlds
        if self.n_steps == 1:
            rewards, discounts = self._normalize_reward(self._joint(self.rewards, first), env), None
        else:
            last, rewards, discounts = self._look_ahead(batch_inds, worlds, env)
        if self.optimize_memory_usage:
            next_joint = (batch_inds + 1) % self.buffer_size * self.n_worlds + worlds
            next_obs = self._joint(self.observations, next_joint)
        else:
            next_obs = self._joint(self.next_observations, last)
        data = (
            self._normalize_obs(self._joint(self.observations, first), env),
            self._joint(self.actions, first),
            self._normalize_obs(next_obs, env),
            self._joint(self.dones, last) * (1 - self._joint(self.timeouts, last)),
            rewards,
            *([] if discounts is None else [discounts]),
        )
        return ReplayBufferSamples(*(self.to_torch(array, copy=False) for array in data))

    def _look_ahead(
        self, batch_inds: np.ndarray, worlds: np.ndarray, env: VecNormalize | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sum the rewards of ``n_steps`` steps, up to the end of the episode or the newest step.

        :return: index of the last step's joint transition (B,), discounted sums (B, N), gamma ** steps (B, 1)
        """
        ahead = np.arange(self.n_steps)
        steps = (batch_inds[:, None] + ahead) % self.buffer_size
        joint = steps * self.n_worlds + worlds[:, None]
        ends = self._joint(self.dones, joint).any(axis=2) | (steps == (self.pos - 1) % self.buffer_size)
        ends[:, -1] = True
        last = ends.argmax(axis=1)
        weights = np.where(ahead <= last[:, None], self.gamma ** ahead.astype(np.float32), 0)
        rewards = self._normalize_reward(self._joint(self.rewards, joint), env) * weights[..., None]
        discounts = self.gamma ** (last + 1).astype(np.float32)[:, None]
        return joint[np.arange(len(joint)), last], rewards.sum(axis=1), discounts

    def _joint(self, slots: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Rows of ``slots`` (pos, B * N, ...) regrouped by worlds: a copy of shape (*indices.shape, N, ...)."""
        return slots.reshape(-1, self.n_agents, *slots.shape[2:]).take(indices, axis=0)
