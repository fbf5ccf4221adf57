"""Rollouts in worlds of several agents: exploration, and what a step leaves in the replay buffer and in the logs."""

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn, Schedule, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule, should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv

from marl_encircle.maddpg.saving import SavedOffPolicyAlgorithm


class MultiAgentOffPolicyAlgorithm(SavedOffPolicyAlgorithm):
    """SB3's off-policy algorithm on B worlds of N agents: a ``VecEnv`` of B * N slots, slot = world * N + agent."""

    exploration_noise: float | Schedule
    exploration_random: float | Schedule
    exploration_rng: np.random.Generator

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:  # then SB3 resets the environment
            assert self.replay_buffer is not None
            self.replay_buffer.end_episodes()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """Step the environment and store what happens, as SB3 does, but count worlds and touch only slots that end.

        :param env: the training environment
        :param callback: called at every step
        :param train_freq: how much to collect
        :param replay_buffer: where to store it
        :param action_noise: SB3's action noise
        :param learning_starts: agent steps with uniformly random actions
        :param log_interval: episodes of worlds between logs
        :return: steps and episodes of worlds, and whether to go on
        """
        assert self.n_agents is not None
        n_worlds = env.num_envs // self.n_agents
        if train_freq.unit == TrainFrequencyUnit.EPISODE and n_worlds > 1:
            raise ValueError(f"train_freq in episodes needs one world, but there are {n_worlds}")
        self.policy.set_training_mode(False)
        num_collected_steps, num_collected_episodes = 0, 0
        callback.on_rollout_start()
        while should_collect_more_steps(train_freq, num_collected_steps, num_collected_episodes):
            actions, buffer_actions = self._sample_action(learning_starts, action_noise, env.num_envs)
            new_obs, rewards, dones, infos = env.step(actions)
            self.num_timesteps += env.num_envs
            num_collected_steps += 1

            callback.update_locals(locals())
            if not callback.on_step():
                return RolloutReturn(num_collected_steps * n_worlds, num_collected_episodes, continue_training=False)

            self._update_info_buffer(infos, dones)
            self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)  # type: ignore[arg-type]  # SB3 types new_obs with dicts
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._on_step()

            if dones.any():
                if action_noise is not None:
                    action_noise.reset(**({"indices": np.flatnonzero(dones)} if env.num_envs > 1 else {}))
                ended = int(dones.reshape(n_worlds, self.n_agents).all(axis=1).sum())
                num_collected_episodes += ended
                self._episode_num += ended
                if log_interval is not None and self._episode_num % log_interval < ended:
                    self.dump_logs()
        callback.on_rollout_end()
        return RolloutReturn(num_collected_steps * n_worlds, num_collected_episodes, continue_training=True)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions with exploration, in one draw for all slots.

        :param learning_starts: agent steps with uniformly random actions
        :param action_noise: SB3's action noise
        :param n_envs: number of slots
        :return: actions for the environment, and the same scaled to [-1, 1] for the buffer, shapes (B * N, *U)
        """
        rng, shape = self.exploration_rng, (n_envs, *self.action_space.shape)  # type: ignore[misc]  # a Box has a shape
        if self.num_timesteps < learning_starts:
            scaled = rng.uniform(-1, 1, shape)
        else:
            assert self._last_obs is not None
            actions, _ = self.predict(self._last_obs)
            scaled = self.policy.scale_action(actions)
            std = FloatSchedule(self.exploration_noise)(self._current_progress_remaining)
            if std > 0:
                scaled = scaled + std * rng.standard_normal(shape)
            share = FloatSchedule(self.exploration_random)(self._current_progress_remaining)
            if share > 0:
                replaced = rng.random(n_envs) < share
                scaled[replaced] = rng.uniform(-1, 1, (np.count_nonzero(replaced), *shape[1:]))
        if action_noise is not None:
            noise = action_noise()
            try:
                scaled = scaled + np.broadcast_to(noise, shape)
            except ValueError as error:
                raise ValueError(
                    f"action_noise has shape {np.shape(noise)}, but the actions of {n_envs} slots {shape}: that of one "
                    f"slot must have shape {shape[1:]}"
                ) from error
        scaled = np.clip(scaled, -1, 1).astype(np.float32)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray,  # type: ignore[override]  # SB3 allows dicts, we refuse them
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of all slots: unnormalised, and with the last observation of the episodes that ended.

        :param replay_buffer: where to store it
        :param buffer_action: scaled actions, shape (B * N, *U)
        :param new_obs: observations after the step, after the reset where ``dones``, shape (B * N, *O)
        :param reward: rewards, shape (B * N,)
        :param dones: whether the episode ended, shape (B * N,)
        :param infos: ``terminal_observation`` is the last observation of an episode that ended
        """
        obs, next_obs = self._last_obs, new_obs
        if self._vec_normalize_env is not None:
            obs = self._last_original_obs
            next_obs = self._last_original_obs = self._vec_normalize_env.get_original_obs()  # type: ignore[assignment]  # an array: no dicts here
            reward = self._vec_normalize_env.get_original_reward()
        self._last_obs = new_obs

        ended = np.flatnonzero(dones)
        if len(ended):
            next_obs = next_obs.copy()
        for slot in ended:
            terminal_obs = infos[slot].get("terminal_observation")
            if terminal_obs is not None:
                if self._vec_normalize_env is not None:
                    terminal_obs = self._vec_normalize_env.unnormalize_obs(terminal_obs)
                next_obs[slot] = terminal_obs
        assert isinstance(obs, np.ndarray)
        replay_buffer.add(obs, next_obs, buffer_action, reward, dones, infos)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        """Note the return, length and success of the worlds' episodes that ended: means over the world's agents.

        :param infos: ``episode`` of ``Monitor`` and ``is_success`` are read where ``dones``, and none of an agent that
            is ``absent``
        :param dones: whether the episode ended, shape (B * N,)
        """
        assert self.n_agents is not None
        assert self.ep_info_buffer is not None
        assert self.ep_success_buffer is not None
        if dones is None:
            return
        for world in np.flatnonzero(dones.reshape(-1, self.n_agents).all(axis=1)):
            slots = infos[world * self.n_agents : (world + 1) * self.n_agents]
            world_infos = [info for info in slots if not info.get("absent")]
            episodes = [info["episode"] for info in world_infos if "episode" in info]
            successes = [info["is_success"] for info in world_infos if "is_success" in info]
            if episodes:
                self.ep_info_buffer.append({key: np.mean([episode[key] for episode in episodes]) for key in "rlt"})
            if successes:
                self.ep_success_buffer.append(np.mean(successes))
