"""Decentralised actors and centralised critics.

Shape legend: B minibatch, N agents, O observation size, U action size.
"""

from typing import Any, Literal

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from marl_encircle.maddpg.networks import AgentFeatures, StackedMLP

CriticKind = Literal["per_agent", "shared"]


class AgentModel(BaseModel):
    """What actor and critic have in common: features of every agent's observation, in the model's own precision."""

    features_extractor: BaseFeaturesExtractor

    def agent_features(self, obs: th.Tensor, dtype: th.dtype) -> th.Tensor:
        """Features of the joint observation.

        :param obs: observations, shape (B, N, *O)
        :param dtype: the networks' precision
        :return: shape (B, N, features)
        """
        inputs = preprocess_obs(obs, self.observation_space, normalize_images=self.normalize_images)
        assert isinstance(inputs, th.Tensor)
        features: th.Tensor = self.features_extractor(inputs.to(dtype))
        return features


class Actor(AgentModel, BasePolicy):
    """The N deterministic actors mu_i: each maps its agent's own observation to its action.

    :param observation_space: one agent's observation space
    :param action_space: one agent's action space
    :param n_agents: number of agents N
    :param net_arch: sizes of the hidden layers
    :param features_extractor: applied to each agent's observation
    :param features_dim: number of features of one observation
    :param activation_fn: activation after every hidden layer
    :param normalize_images: whether to divide images by 255
    :param share_parameters: one network for all agents
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        n_agents: int,
        net_arch: list[int],
        features_extractor: AgentFeatures,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        share_parameters: bool = False,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.n_agents = n_agents
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.share_parameters = share_parameters
        n_networks = 1 if share_parameters else n_agents
        self.mu = StackedMLP(n_networks, features_dim, net_arch, get_action_dim(action_space), activation_fn)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "n_agents": self.n_agents,
            "net_arch": self.net_arch,
            "features_extractor": self.features_extractor,
            "features_dim": self.features_dim,
            "activation_fn": self.activation_fn,
            "share_parameters": self.share_parameters,
        }

    def logits(self, obs: th.Tensor) -> th.Tensor:
        """Actions before squashing, shape (B, N, U).

        :param obs: observations, shape (B, N, *O)
        """
        logits: th.Tensor = self.mu(self.inputs(obs))
        return logits.transpose(0, 1)

    def inputs(self, obs: th.Tensor) -> th.Tensor:
        """Return what the networks read, the features of each agent's own observation, shape (N, B, features).

        :param obs: observations, shape (B, N, *O)
        """
        return self.agent_features(obs, self.mu.dtype).transpose(0, 1)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """Actions in [-1, 1], shape (B, N, U).

        :param obs: observations, shape (B, N, *O)
        """
        return th.tanh(self.logits(obs))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions of the slots, shape (B * N, U): always deterministic.

        :param observation: observations of the slots, world-major, shape (B * N, *O)
        """
        assert isinstance(observation, th.Tensor)
        if len(observation) % self.n_agents:
            raise ValueError(
                f"predict needs the observations of all {self.n_agents} agents, shape (n_worlds * {self.n_agents}, "
                f"{', '.join(map(str, observation.shape[1:]))}), but got {len(observation)} row(s)"
            )
        actions: th.Tensor = self(observation.view(-1, self.n_agents, *observation.shape[1:]))
        return actions.flatten(0, 1)


class CentralCritic(AgentModel):
    """The action values Q_i(s, a_1 ... a_N) of every agent; s is all agents' observations.

    :param observation_space: one agent's observation space
    :param action_space: one agent's action space
    :param n_agents: number of agents N
    :param net_arch: sizes of the hidden layers
    :param features_extractor: applied to each agent's observation
    :param features_dim: number of features of one observation
    :param activation_fn: activation after every hidden layer
    :param normalize_images: whether to divide images by 255
    :param kind: ``"per_agent"``: a network per agent; ``"shared"``: one trunk with a head per agent
    :param n_critics: independent estimates of each Q_i
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        n_agents: int,
        net_arch: list[int],
        features_extractor: AgentFeatures,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        kind: CriticKind = "per_agent",
        n_critics: int = 1,
    ) -> None:
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        input_dim = n_agents * (features_dim + get_action_dim(action_space))
        n_networks = 1 if kind == "shared" else n_agents
        self.q_networks = nn.ModuleList(
            StackedMLP(n_networks, input_dim, net_arch, 1, activation_fn, n_heads=n_agents) for _ in range(n_critics)
        )
        # (N, U), row i: the inputs of the networks that are the action of agent i
        self.own_columns: th.Tensor
        own_columns = th.arange(n_agents * features_dim, input_dim).view(n_agents, -1)
        self.register_buffer("own_columns", own_columns, persistent=False)

    @property
    def networks(self) -> list[StackedMLP]:
        """The independent estimates' networks."""
        return list(self.q_networks)  # type: ignore[arg-type]  # a ModuleList forgets what it holds

    @property
    def dtype(self) -> th.dtype:
        """The networks' precision."""
        return self.networks[0].dtype

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Estimates of Q_i(s, a_1 ... a_N) of every agent i, shape (n_critics, N, B).

        :param obs: observations, shape (B, N, *O)
        :param actions: actions in [-1, 1], shape (B, N, U)
        """
        x = self.inputs(obs, actions)
        return th.stack([network(x).squeeze(-1) for network in self.networks])

    def own_action_values(self, obs: th.Tensor, actions: th.Tensor, own_actions: th.Tensor) -> th.Tensor:
        """First estimate of Q_i(s, a_1 .. a_i = mu_i(o_i) .. a_N) of every agent i, shape (N, B).

        :param obs: observations, shape (B, N, *O)
        :param actions: actions in [-1, 1] that the other agents keep, shape (B, N, U)
        :param own_actions: the action that agent i takes where Q_i is asked, shape (B, N, U)
        """
        activations = self._own_action_activations(obs, actions, own_actions)
        return self.networks[0].outputs(activations).squeeze(-1)

    def own_action_gradients(
        self, obs: th.Tensor, actions: th.Tensor, own_actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return ``own_action_values`` and the gradient of each Q_i with respect to a_i, shapes (N, B) and (N, B, U).

        The parameters are constants; for networks that ``StackedMLP.backward`` knows.
        """
        network = self.networks[0]
        activations = self._own_action_activations(obs, actions, own_actions)
        q_values = network.outputs(activations)
        grad = network.backward(activations, th.ones_like(q_values), constant=True)
        return q_values.squeeze(-1), (network.first_weight(self.own_columns) @ grad.mT).mT

    def inputs(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return what all networks read, joint observation and joint action, shape (1, B, N * (features + U))."""
        features = self.agent_features(obs, self.dtype).flatten(1)
        return th.cat([features, actions.flatten(1).to(self.dtype)], dim=-1)[None]

    def _own_action_activations(self, obs: th.Tensor, actions: th.Tensor, own_actions: th.Tensor) -> list[th.Tensor]:
        changes = (own_actions - actions).to(self.dtype).transpose(0, 1)
        return self.networks[0].activations(self.inputs(obs, actions), changes, self.own_columns)
