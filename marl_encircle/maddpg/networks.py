"""Networks with an agent axis: N multilayer perceptrons as one, evaluated by one batched product a layer.

Shape legend: B minibatch, N agents, O observation size, U action size, H size of a hidden layer.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

mask_where_zero = th.ops.aten.threshold_backward.grad_input
"""ReLU's backward pass, in place; looked up once, as that takes as long as a small product."""


class StackedMLP(nn.Module):
    """``n`` multilayer perceptrons of one shape, each with an activation after every layer but the last.

    Layer l has weights (n, in, out) and biases (n, 1, out), uniform in +-1/sqrt(in) at the start as in ``nn.Linear``.
    The leading axis broadcasts: ``n`` networks read ``n`` inputs or a common one, one network reads any number.

    :param n: number of networks
    :param input_dim: size of a network's input
    :param net_arch: sizes of the hidden layers
    :param output_dim: size of a network's output
    :param activation_fn: activation after every hidden layer
    :param n_heads: number of last layers: ``n``, or more that share the hidden layers of one network
    """

    def __init__(
        self,
        n: int,
        input_dim: int,
        net_arch: Sequence[int],
        output_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        n_heads: int | None = None,
    ) -> None:
        super().__init__()
        self.n = n
        self.activation = nn.ReLU(inplace=True) if activation_fn is nn.ReLU else activation_fn()
        if any(True for _ in self.activation.parameters()):
            raise ValueError(f"activation_fn must have no parameters: networks would share them; got {activation_fn}")
        dims = [input_dim, *net_arch]
        layers = list(zip(dims[:-1], net_arch, strict=True))
        self.weights = nn.ParameterList(uniform_parameter(n, i, o, fan_in=i) for i, o in layers)
        self.biases = nn.ParameterList(uniform_parameter(n, 1, o, fan_in=i) for i, o in layers)
        self._layer_names = [str(layer) for layer in range(len(net_arch))]
        n_heads = n if n_heads is None else n_heads
        self.head_weight = uniform_parameter(n_heads, dims[-1], output_dim, fan_in=dims[-1])
        self.head_bias = uniform_parameter(n_heads, 1, output_dim, fan_in=dims[-1])

    @property
    def dtype(self) -> th.dtype:
        """The weights' precision."""
        return self.head_weight.dtype

    @property
    def layers(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """Weights and biases of the hidden layers."""
        weights, biases = self.weights, self.biases
        # By name, since a ParameterList takes five times as long to walk through
        return [(getattr(weights, name), getattr(biases, name)) for name in self._layer_names]

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the outputs of all heads, shape (max(m, n_heads), B, out).

        :param x: inputs, shape (m, B, in) with m = n, m = 1 or n = 1
        """
        return self.outputs(self.activations(x))

    def activations(
        self, x: th.Tensor, changes: th.Tensor | None = None, columns: th.Tensor | None = None
    ) -> list[th.Tensor]:
        """Return the inputs and what each hidden layer makes of them.

        Where every head reads a few inputs of its own and all others in common, the wide product with the first weights
        is made once for all; only the thin one with ``changes`` is each head's own.

        :param x: inputs, shape (m, B, in); with ``changes``, shape (1, B, in)
        :param changes: what head i adds to its columns of ``x``, shape (n_heads, B, U)
        :param columns: these columns, shape (n_heads, U); given with ``changes``
        """
        layers = self.layers
        sums = [(x @ weight).add_(bias) for weight, bias in layers[:1]]
        if changes is not None:
            assert columns is not None
            if layers:
                sums = [(changes @ self.first_weight(columns)).add_(sums[0])]
            else:
                x = x.expand(len(changes), -1, -1).scatter_add(2, columns[:, None].expand_as(changes), changes)
        activations = [x, *map(self.activation, sums)]
        for weight, bias in layers[1:]:
            activations.append(self.activation((activations[-1] @ weight).add_(bias)))
        return activations

    def first_weight(self, columns: th.Tensor) -> th.Tensor:
        """Return the first layer's weights of each head's own inputs, shape (n_heads, U, H).

        :param columns: the inputs of each head, shape (n_heads, U)
        """
        weight: th.Tensor = self.weights[0]
        rows = columns[..., None].expand(-1, -1, weight.shape[2])
        return weight.expand(len(columns), -1, -1).gather(1, rows)

    def outputs(self, activations: list[th.Tensor]) -> th.Tensor:
        """Return the outputs of all heads, shape (max(m, n_heads), B, out).

        :param activations: of the network's layers
        """
        hidden = activations[-1]
        rows = self._head_rows(hidden)
        # A product with one row is sent to a slower kernel than one with two
        padded = rows.expand(-1, 2, -1).contiguous() if rows.shape[1] == 1 else rows
        products = (padded @ hidden.mT)[:, : rows.shape[1]]
        return products.reshape(-1, self.head_weight.shape[2], hidden.shape[1]).mT + self.head_bias

    def backward(self, activations: list[th.Tensor], grad: th.Tensor, constant: bool = False) -> th.Tensor:
        """Set the parameters' gradients by hand; for one or more hidden layers of ReLU.

        Former gradients are replaced. Hooks and ``requires_grad`` are not looked at: see ``gradients.is_plain``.

        :param activations: of the network's layers; the list is emptied
        :param grad: gradient of the outputs, shape (max(m, n_heads), B, out)
        :param constant: whether the parameters are constants that get no gradients
        :return: gradient of the first layer's sums, shape (max(m, n_heads), B, H)
        """
        above = activations.pop()  # what is not needed any more is freed at once, which keeps the cache warm
        rows = self._head_rows(above)
        grad_rows = grad.mT.reshape(above.shape[0], -1, grad.shape[1])
        if not constant:
            grad_weight = (grad_rows @ above).sum_to_size(rows.shape)
            self.head_weight.grad = grad_weight.view_as(self.head_weight.mT).mT.contiguous()
            self.head_bias.grad = grad.sum(1, keepdim=True).sum_to_size(self.head_bias.shape)
        grad = grad_rows.mT @ rows
        for weight, bias in reversed(self.layers):
            mask_where_zero(grad, above, 0, grad_input=grad)
            above = activations.pop()
            if not constant:
                weight.grad = (above.mT @ grad).sum_to_size(weight.shape)
                bias.grad = grad.sum(1, keepdim=True).sum_to_size(bias.shape)
            if activations:
                grad = grad @ weight.mT
        return grad

    def _head_rows(self, hidden: th.Tensor) -> th.Tensor:
        """Return the last weights as rows: a thin matrix is a fast left factor, and heads of one trunk are one matrix.

        :param hidden: the last hidden layer, shape (m, B, H)
        :return: shape (min(m, n_heads), rows, H)
        """
        return self.head_weight.mT.contiguous().view(min(len(hidden), len(self.head_weight)), -1, hidden.shape[2])


class AgentFeatures(BaseFeaturesExtractor):
    """SB3's features extractor applied to each agent's own observation: (B, N, ...) -> (B, N, features).

    :param extractors: one per agent, or one for all (always so when it has nothing to learn)
    :param n_agents: number of agents N
    """

    def __init__(
        self, observation_space: spaces.Space[Any], extractors: Sequence[BaseFeaturesExtractor], n_agents: int
    ) -> None:
        super().__init__(observation_space, extractors[0].features_dim)
        self.extractors = nn.ModuleList(extractors)
        self.n_agents = n_agents
        self.only_flattens = type(extractors[0]) is FlattenExtractor

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features of every agent's observation, shape (B, N, features)."""
        if self.only_flattens:
            return observations.flatten(2)
        if len(self.extractors) == 1:
            features: th.Tensor = self.extractors[0](observations.flatten(0, 1))
            return features.view(-1, self.n_agents, self.features_dim)
        per_agent = zip(self.extractors, observations.unbind(1), strict=True)
        return th.stack([extractor(observation) for extractor, observation in per_agent], dim=1)


def uniform_parameter(*shape: int, fan_in: int) -> nn.Parameter:
    """Uniform in +-1/sqrt(fan_in), as ``nn.Linear`` starts its weights and biases."""
    bound = 1 / math.sqrt(fan_in) if fan_in > 0 else 0.0
    return nn.Parameter(th.empty(shape).uniform_(-bound, bound))
