"""The policy that holds the actors, the critics and their targets.

Shape legend: B minibatch, N agents, O observation size, U action size.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from marl_encircle.maddpg.models import Actor, CentralCritic, CriticKind
from marl_encircle.maddpg.networks import AgentFeatures


class MADDPGPolicy(BasePolicy):
    """Actors, critics and their targets.

    :param observation_space: one agent's observation space
    :param action_space: one agent's action space
    :param lr_schedule: learning rate schedule
    :param n_agents: number of agents N
    :param critic: ``"per_agent"``: a critic per agent; ``"shared"``: one trunk with a head per agent
    :param n_critics: independent estimates of each Q_i
    :param net_arch: sizes of the hidden layers, one list for all networks or ``dict(pi=[...], qf=[...])``
    :param activation_fn: activation after every hidden layer
    :param features_extractor_class: applied to each agent's observation
    :param features_extractor_kwargs: its keyword arguments
    :param normalize_images: whether to divide images by 255
    :param optimizer_class: one optimizer for all actors, one for all critics
    :param optimizer_kwargs: its keyword arguments, except the learning rate; Adam is fused unless told otherwise
    :param share_parameters: one actor for all agents, its features extractor too; the critics stay as ``critic`` says
    :param agents: the agents' names in the order of the slots, where they are known: whose observation is whose in a
        dict
    :raises ValueError: for a ``critic`` that there is not
    """

    actor: Actor
    actor_target: Actor
    critic: CentralCritic
    critic_target: CentralCritic

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        n_agents: int = 1,
        critic: CriticKind = "per_agent",
        n_critics: int = 1,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        share_parameters: bool = False,
        agents: tuple[str, ...] | None = None,
    ) -> None:
        if optimizer_kwargs is None:
            optimizer_kwargs = {"fused": True} if optimizer_class is th.optim.Adam else {}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        if critic not in ("per_agent", "shared"):
            raise ValueError(f'critic is "per_agent" or "shared", not {critic!r}')
        self.n_agents = n_agents
        self.critic_kind = critic
        self.n_critics = n_critics
        # Two hidden layers of 64 as in openai/maddpg
        self.net_arch = [64, 64] if net_arch is None else net_arch
        self.activation_fn = activation_fn
        self.share_parameters = share_parameters
        self.agents = agents
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor, self.actor_target = self.make_actor(), self.make_actor()
        self.critic, self.critic_target = self.make_critic(), self.make_critic()
        for network, target in (self.actor, self.actor_target), (self.critic, self.critic_target):
            target.load_state_dict(network.state_dict())
            target.set_training_mode(False)
            target.requires_grad_(False)
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]  # not every optimizer's base class has lr
                **self.optimizer_kwargs,
            )
        # Walking through the modules at every update would take longer than the update of the targets itself
        networks, targets = (
            nn.ModuleList([self.actor, self.critic]),
            nn.ModuleList([self.actor_target, self.critic_target]),
        )
        self._parameter_lists = list(targets.parameters()), list(networks.parameters())
        pairs = zip(targets.modules(), networks.modules(), strict=True)
        self._switched = [*self.actor.modules(), *self.critic.modules()]
        self._buffer_owners = [(target, network) for target, network in pairs if target._buffers]

    @th.no_grad()
    def update_targets(self, tau: float) -> None:
        """Move the targets by the share ``tau`` towards the networks (Polyak), and copy running statistics.

        :param tau: share, in [0, 1]
        """
        target_parameters, parameters = self._parameter_lists
        th._foreach_lerp_(target_parameters, parameters, tau)  # type: ignore[arg-type]  # parameters are tensors
        for target, network in self._buffer_owners:
            for name, buffer in network.named_buffers(recurse=False):
                getattr(target, name).copy_(buffer)

    def make_features_extractor(self, shared: bool = False) -> AgentFeatures:
        """SB3's extractor for one observation, copied for every agent if it learns and is not to be shared."""
        first = super().make_features_extractor()
        learns = any(True for _ in first.parameters())
        n_more = self.n_agents - 1 if learns and not shared else 0
        more = [super(MADDPGPolicy, self).make_features_extractor() for _ in range(n_more)]
        return AgentFeatures(self.observation_space, [first, *more], self.n_agents)

    def _net_args(self, shared_features: bool = False) -> dict[str, Any]:
        return self._update_features_extractor(
            {
                "observation_space": self.observation_space,
                "action_space": self.action_space,
                "n_agents": self.n_agents,
                "activation_fn": self.activation_fn,
                "normalize_images": self.normalize_images,
            },
            self.make_features_extractor(shared_features),
        )

    def make_actor(self) -> Actor:
        """Return new actors."""
        net_arch, _ = get_actor_critic_arch(self.net_arch)
        shared = self.share_parameters
        return Actor(**self._net_args(shared), net_arch=net_arch, share_parameters=shared).to(self.device)

    def make_critic(self) -> CentralCritic:
        """Return new critics."""
        _, net_arch = get_actor_critic_arch(self.net_arch)
        return CentralCritic(**self._net_args(), net_arch=net_arch, kind=self.critic_kind, n_critics=self.n_critics).to(
            self.device
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "lr_schedule": self._dummy_schedule,  # not needed to load a policy alone
            "n_agents": self.n_agents,
            "critic": self.critic_kind,
            "n_critics": self.n_critics,
            "net_arch": self.net_arch,
            "activation_fn": self.activation_fn,
            "features_extractor_class": self.features_extractor_class,
            "features_extractor_kwargs": self.features_extractor_kwargs,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            "share_parameters": self.share_parameters,
            "agents": self.agents,
        }

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions of the slots in [-1, 1], shape (B * N, U)."""
        return self._predict(observation, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor._predict(observation, deterministic=deterministic)

    def predict(  # type: ignore[override]  # a dict gives a dict
        self,
        observation: np.ndarray | Mapping[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray | dict[str, np.ndarray], tuple[np.ndarray, ...] | None]:
        """Actions for the agents of one or more worlds.

        :param observation: worlds, shape (B, N, *O), their slots, (B * N, *O), one world, (N, *O), or a dict of the
            agents' observations, each (*O): by name where the policy knows the ``agents``, else in the order of the
            environment's ``possible_agents``
        :param state: unused, SB3's interface
        :param episode_start: unused, SB3's interface
        :param deterministic: unused: the actors are deterministic
        :return: actions in the form of the observation, and ``state``
        :raises ValueError: where observations of some agents are missing
        """
        if not isinstance(observation, Mapping):
            shape: tuple[int, ...] = getattr(observation, "shape", ())
            if len(shape) != len(self.observation_space.shape or ()) + 2:  # slots
                return super().predict(observation, state, episode_start, deterministic)
            if shape[1] != self.n_agents:
                raise ValueError(f"predict needs the observations of all {self.n_agents} agents, but got {shape[1]}")
            slots = observation.reshape(-1, *shape[2:])
            actions, state = super().predict(slots, state, episode_start, deterministic)
            return actions.reshape(*shape[:2], *actions.shape[1:]), state
        agents = self.agents or tuple(observation)
        if len(agents) != self.n_agents or set(agents) != set(observation):
            wanted = ", ".join(map(str, self.agents)) if self.agents else f"all {self.n_agents} agents"
            raise ValueError(f"predict needs the observations of {wanted}, but got {list(observation)}")
        slots = np.stack([observation[agent] for agent in agents])
        actions, state = super().predict(slots, state, episode_start, deterministic)
        return dict(zip(agents, actions, strict=True)), state

    def actor_state_dict(self) -> dict[str, th.Tensor]:
        """All that is needed to act: the actors' weights as plain named tensors on the CPU."""
        return {name: tensor.detach().cpu().contiguous() for name, tensor in self.actor.state_dict().items()}

    def set_training_mode(self, mode: bool) -> None:
        """Put actors and critics in training or evaluation mode; the targets are always in evaluation mode.

        :param mode: whether to train
        """
        if self.training == mode and all(module.training == mode for module in self._switched):
            return
        self.actor.set_training_mode(mode)
        self.critic.set_training_mode(mode)
        self.training = mode


MlpPolicy = MADDPGPolicy


class CnnPolicy(MADDPGPolicy):
    """MADDPGPolicy for images: SB3's ``NatureCNN`` extracts the features unless told otherwise."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )
