"""Multi-Agent Deep Deterministic Policy Gradient."""

from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from torch import nn

from marl_encircle.maddpg.agents import count_agents, names_of_agents, refuse_pettingzoo
from marl_encircle.maddpg.arguments import check_range, number_or_schedule
from marl_encircle.maddpg.buffers import JointReplayBuffer
from marl_encircle.maddpg.gradients import actor_gradients, critic_gradients, is_plain
from marl_encircle.maddpg.models import Actor, CentralCritic, CriticKind
from marl_encircle.maddpg.policies import CnnPolicy, MADDPGPolicy, MlpPolicy
from marl_encircle.maddpg.rollouts import MultiAgentOffPolicyAlgorithm

SelfMADDPG = TypeVar("SelfMADDPG", bound="MADDPG")


class MADDPG(MultiAgentOffPolicyAlgorithm):
    """Multi-Agent Deep Deterministic Policy Gradient (MADDPG).

    Paper: https://arxiv.org/abs/1706.02275 (Lowe et al., 2017). Equation numbers in this file are those of
    Zheng et al. (2023), https://proceedings.mlr.press/v222/zheng24a.html.

    B worlds of N agents are a ``VecEnv`` of B * N slots, slot = world * N + agent, with an attribute ``n_agents``;
    plain Gymnasium environments are worlds of one agent, for which MADDPG is DDPG. What SB3 counts in steps
    (``total_timesteps``, ``learning_starts``, ``buffer_size``) are steps of agents; ``train_freq`` counts steps of
    the ``VecEnv``, ``gradient_steps`` joint updates (-1: one per step of a world), ``log_interval`` episodes of
    worlds.

    :param policy: the policy to use (MlpPolicy, CnnPolicy)
    :param env: the environment to learn from
    :param learning_rate: learning rate of all networks, a number or a function of the progress remaining (1 to 0)
    :param buffer_size: agent steps to keep
    :param learning_starts: agent steps with uniformly random actions before learning starts
    :param batch_size: joint transitions per update
    :param tau: share by which the targets follow per update (Polyak)
    :param gamma: discount factor
    :param train_freq: steps of the ``VecEnv`` between trainings, or ``(n, "step" | "episode")``
    :param gradient_steps: joint updates per training, -1: as many as steps of a world were made
    :param action_noise: SB3's action noise, in place of ``exploration_noise`` unless both are given
    :param n_agents: number of agents N, where the environment does not tell it by an attribute ``n_agents``
    :param critic: ``"per_agent"``: a critic per agent (Lowe et al.); ``"shared"``: one trunk with a head per agent
    :param exploration_noise: standard deviation of the Gaussian noise on scaled actions [-1, 1], a number or a
        function of the progress remaining; by default 0.3, or none where ``action_noise`` is given
    :param exploration_random: share of actions that are replaced by uniformly random ones, a number or a function
        of the progress remaining
    :param policy_delay: critic updates per update of the actors and the targets
    :param max_grad_norm: largest norm of the gradient of the actors and of the critics, None: no limit
    :param actor_regularization: weight of the actors' mean squared output before tanh (openai/maddpg: 1e-3)
    :param n_steps: rewards in a target before the critics estimate the rest; 1 is Eq. 3
    :param policy_kwargs: passed on to the policy, see ``MADDPGPolicy``
    :param seed: seed of the pseudo random generators
    :param kwargs: passed on to SB3's ``OffPolicyAlgorithm``
    :raises ValueError: for what MADDPG cannot do with this policy, environment or number, with what is allowed
    :raises AssertionError: for an action space that is no bounded Box, as SB3 does
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy}
    n_critics: ClassVar[int] = 1
    policy: MADDPGPolicy
    actor: Actor
    actor_target: Actor
    critic: CentralCritic
    critic_target: CentralCritic

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 1024,
        tau: float = 0.01,
        gamma: float = 0.95,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        *,
        n_agents: int | None = None,
        critic: CriticKind = "per_agent",
        exploration_noise: float | Schedule | None = None,
        exploration_random: float | Schedule = 0.05,
        policy_delay: int = 1,
        max_grad_norm: float | None = None,
        actor_regularization: float = 1e-3,
        n_steps: int = 1,
        policy_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        refuse_pettingzoo(env)
        if kwargs.pop("use_sde", False):
            raise ValueError("use_sde is not for deterministic actors: see exploration_noise and action_noise")
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            policy_kwargs=policy_kwargs,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
            **kwargs,
        )
        self.n_agents = n_agents
        self.agents: tuple[str, ...] | None = None
        self.n_steps = self.replay_buffer_kwargs.get("n_steps", n_steps)  # not SB3's, which asks for its own buffer
        self.critic_kind = critic
        if exploration_noise is None:
            exploration_noise = 0.3 if action_noise is None else 0.0
        self.exploration_noise = number_or_schedule("exploration_noise", exploration_noise)
        self.exploration_random = number_or_schedule("exploration_random", exploration_random, 1)
        check_range("batch_size", batch_size, 1)
        check_range("gamma", gamma, 0, 1)
        check_range("tau", tau, 0, 1)
        check_range("policy_delay", policy_delay, 1)
        check_range("actor_regularization", actor_regularization, 0)
        if "critic" in self.policy_kwargs:
            raise ValueError(f"critic is an argument of {type(self).__name__}, not of policy_kwargs")
        if max_grad_norm is not None and max_grad_norm <= 0:
            raise ValueError(f"max_grad_norm must be positive or None, but got {max_grad_norm}")
        self.policy_delay = policy_delay
        self.max_grad_norm = max_grad_norm
        self.actor_regularization = actor_regularization
        self.exploration_rng = np.random.default_rng(seed)

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self._convert_train_freq()
        check_range("train_freq", self.train_freq.frequency, 1)  # type: ignore[union-attr]  # converted
        if not isinstance(self.observation_space, spaces.Box):
            raise ValueError(f"MADDPG needs a Box observation space, but got {self.observation_space}")
        if not isinstance(self.action_space, spaces.Box):
            raise AssertionError(  # SB3's type for it, with a reason
                f"MADDPG needs a Box action space, as its actors are deterministic, but got {self.action_space}. Many "
                "environments have continuous actions by an argument, MPE's by continuous_actions=True"
            )
        self.n_agents = count_agents(self.env, self.n_agents)
        self.agents = names_of_agents(self.env, self.n_agents, self.agents)
        if isinstance(self.action_noise, VectorizedActionNoise) and self.action_noise.n_envs != self.n_envs:
            self.action_noise = self.action_noise.base_noise  # SB3 makes one of it for as many slots as there are
        # The exploration's own generator goes on where a loaded model stopped
        super().set_random_seed(self.seed)

        self.replay_buffer_class = self.replay_buffer_class or JointReplayBuffer
        if not issubclass(self.replay_buffer_class, JointReplayBuffer):
            raise ValueError(
                f"replay_buffer_class must be a JointReplayBuffer, but got {self.replay_buffer_class.__name__}"
            )
        if self.replay_buffer is None:
            self.replay_buffer = self.replay_buffer_class(
                self.buffer_size,
                self.observation_space,
                self.action_space,
                device=self.device,
                n_envs=self.n_envs,
                n_agents=self.n_agents,
                optimize_memory_usage=self.optimize_memory_usage,
                **({"n_steps": self.n_steps, "gamma": self.gamma} | self.replay_buffer_kwargs),
            )
        self.policy = self.policy_class(  # type: ignore[assignment]  # SB3 types any BasePolicy
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            n_agents=self.n_agents,
            critic=self.critic_kind,
            agents=self.agents,
            **{"n_critics": self.n_critics, **self.policy_kwargs},
        )
        self.policy = self.policy.to(self.device)
        self._create_aliases()

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all generators, the exploration's own included.

        :param seed: None: nothing is changed
        """
        super().set_random_seed(seed)
        if seed is not None:
            self.exploration_rng = np.random.default_rng(seed)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the environment to learn from; it must have as many slots and agents as before.

        :param env: the environment
        :param force_reset: whether it is reset before training
        :raises ValueError: where the number of agents or their order differs, and for a PettingZoo environment that is
            not wrapped
        """
        refuse_pettingzoo(env)
        agents = names_of_agents(env, count_agents(env, self.n_agents), self.agents)
        super().set_env(env, force_reset)
        self.agents = self.policy.agents = agents

    def train(self, gradient_steps: int, batch_size: int = 1024) -> None:
        """Update critics, actors and targets from the replay buffer.

        :param gradient_steps: number of joint updates
        :param batch_size: joint transitions per update
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        assert self.replay_buffer is not None

        by_hand = is_plain(self.actor) and is_plain(self.critic)
        actor_losses: list[th.Tensor] = []
        critic_losses: list[th.Tensor] = []
        for _ in range(gradient_steps):
            self._n_updates += 1
            # A minibatch of joint transitions (s, a_1 .. a_n, r_1 .. r_n, s')
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

            # The targets y_i = r_i + gamma Q'_i(s', mu'_1(o'_1) .. mu'_n(o'_n)) of Eq. 3; termination cuts the future
            discounts = self.gamma if batch.discounts is None else batch.discounts.T
            with th.no_grad():
                next_q_values = self.critic_target(batch.next_observations, self._target_actions(batch)).amin(dim=0)
                target_q_values = batch.rewards.T + (1 - batch.dones.T) * discounts * next_q_values

            # Critics: minimise the mean of (y_i - Q_i(s, a_1 .. a_n))^2, Eq. 3
            obs, actions = batch.observations, batch.actions
            critic_losses.append(critic_gradients(self.critic, obs, actions, target_q_values, by_hand))
            self._step(self.critic)

            if self._n_updates % self.policy_delay == 0:
                # Actors: ascend the mean of Q_i(s, a_1 .. mu_i(o_i) .. a_n), Eq. 2
                regularization = self.actor_regularization
                actor_losses.append(actor_gradients(self.actor, self.critic, obs, actions, regularization, by_hand))
                self._step(self.actor)

                # Targets follow slowly
                self.policy.update_targets(self.tau)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if actor_losses:
            self.logger.record("train/actor_loss", th.stack(actor_losses).mean().item())
        self.logger.record("train/critic_loss", th.stack(critic_losses).mean().item())

    def _target_actions(self, batch: ReplayBufferSamples) -> th.Tensor:
        """Return the target actors' actions mu'_k(o'_k) in [-1, 1], shape (B, N, U)."""
        actions: th.Tensor = self.actor_target(batch.next_observations)
        return actions

    def _step(self, network: Actor | CentralCritic) -> None:
        """One step of the optimizer along the gradients that are set."""
        if self.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(network.optimizer.param_groups[0]["params"], self.max_grad_norm)
        network.optimizer.step()

    def learn(
        self: SelfMADDPG,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "MADDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMADDPG:
        """Return the trained model.

        :param total_timesteps: agent steps to train on, a lower bound
        :param callback: called at every step of the ``VecEnv``
        :param log_interval: episodes of worlds between logs, None: no logs; at most one log a step
        :param tb_log_name: name of the run for TensorBoard
        :param reset_num_timesteps: whether to count from 0 again
        :param progress_bar: whether to show one
        :raises ValueError: for a ``log_interval`` or ``action_noise`` that does not fit
        """
        if log_interval is not None and log_interval < 1:
            raise ValueError(f"log_interval must be at least 1, or None for no logs, but got {log_interval}")
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)  # type: ignore[arg-type]  # SB3 takes None too

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "actor_target", "critic_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
