"""Networks with an agent axis: N multilayer perceptrons as one, evaluated by one batched product a layer.

Shape legend: B minibatch, N agents, O observation size, U action size.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class StackedMLP(nn.Module):
    """``n`` multilayer perceptrons of one shape; layer l has weights (n, in, out) and biases (n, 1, out).

    The leading axis broadcasts: ``n`` networks read ``n`` inputs or one common input, one network reads any number.
    Weights start as in ``nn.Linear``: uniform in +-1/sqrt(in).

    :param n: number of networks
    :param input_dim: size of a network's input
    :param layer_dims: sizes of the layers after it, the output's last
    :param activation_fn: activation after every layer, but not after the last
    :param activate_last: whether it follows the last layer too
    """

    def __init__(
        self,
        n: int,
        input_dim: int,
        layer_dims: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        *,
        activate_last: bool = False,
    ) -> None:
        super().__init__()
        self.n = n
        self.activate_last = activate_last
        self.output_dim = layer_dims[-1] if layer_dims else input_dim
        # In place is safe: no layer's gradient needs its product before the activation
        self.activation = nn.ReLU(inplace=True) if activation_fn is nn.ReLU else activation_fn()
        dims = list(zip([input_dim, *layer_dims], layer_dims, strict=False))
        self.weights = nn.ParameterList(uniform_parameter(n, i, o, fan_in=i) for i, o in dims)
        self.biases = nn.ParameterList(uniform_parameter(n, 1, o, fan_in=i) for i, o in dims)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the outputs of all networks, shape (max(m, n), B, out).

        :param x: inputs, shape (m, B, in) with m = n, m = 1 or n = 1
        """
        m, batch_size, _ = x.shape
        x = x.reshape(1, m * batch_size, -1) if self.n == 1 else x.expand(self.n, -1, -1)
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = th.baddbmm(bias, x, weight)
            if layer < last or self.activate_last:
                x = self.activation(x)
        return x.reshape(-1, batch_size, self.output_dim)


class QNetwork(nn.Module):
    """The N action values Q_1 ... Q_N: a trunk per agent or one for all, and a linear head per agent.

    :param n_agents: number of agents N
    :param input_dim: size of all observations and actions together
    :param net_arch: sizes of the hidden layers
    :param activation_fn: activation after every hidden layer
    :param shared: one trunk for all agents
    """

    def __init__(
        self, n_agents: int, input_dim: int, net_arch: Sequence[int], activation_fn: type[nn.Module], *, shared: bool
    ) -> None:
        super().__init__()
        n_trunks = 1 if shared else n_agents
        self.trunk = StackedMLP(n_trunks, input_dim, net_arch, activation_fn, activate_last=True)
        fan_in = self.trunk.output_dim
        self.head_weight = uniform_parameter(n_agents, 1, fan_in, fan_in=fan_in)
        self.head_bias = uniform_parameter(n_agents, 1, fan_in=fan_in)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return Q_i of agent i's input, shape (N, B).

        :param x: an input per agent, shape (N, B, in), or one for all, (1, B, in)
        """
        # One output per agent: a row product is faster than a matrix product that is one column wide
        hidden: th.Tensor = self.trunk(x)
        return (hidden * self.head_weight).sum(-1) + self.head_bias


class AgentFeatures(BaseFeaturesExtractor):
    """SB3's features extractor applied to each agent's own observation: (B, N, ...) -> (B, N, features).

    :param extractors: one per agent, or one for all (always so when it has nothing to learn)
    :param n_agents: number of agents N
    """

    def __init__(
        self, observation_space: spaces.Space[Any], extractors: Sequence[BaseFeaturesExtractor], n_agents: int
    ):
        super().__init__(observation_space, extractors[0].features_dim)
        self.extractors = nn.ModuleList(extractors)
        self.n_agents = n_agents

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features of every agent's observation, shape (B, N, features)."""
        if len(self.extractors) == 1:
            features: th.Tensor = self.extractors[0](observations.flatten(0, 1))
            return features.view(-1, self.n_agents, self.features_dim)
        per_agent = zip(self.extractors, observations.unbind(1), strict=True)
        return th.stack([extractor(observation) for extractor, observation in per_agent], dim=1)


def uniform_parameter(*shape: int, fan_in: int) -> nn.Parameter:
    """Uniform in +-1/sqrt(fan_in), as ``nn.Linear`` starts its weights and biases."""
    bound = 1 / math.sqrt(fan_in) if fan_in > 0 else 0.0
    return nn.Parameter(th.empty(shape).uniform_(-bound, bound))
