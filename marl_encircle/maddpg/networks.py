"""Networks with an agent axis: N multilayer perceptrons as one, evaluated by one batched product a layer.

Shape legend: B minibatch, N agents, O observation size, U action size, H size of the last hidden layer.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn
from torch.autograd.function import once_differentiable


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
        self._is_relu = activation_fn is nn.ReLU
        # In place: no gradient needs what was there before
        self.activation = nn.ReLU(inplace=True) if self._is_relu else activation_fn()
        dims = [input_dim, *net_arch]
        layers = list(zip(dims[:-1], net_arch, strict=True))
        self.weights = nn.ParameterList(uniform_parameter(n, i, o, fan_in=i) for i, o in layers)
        self.biases = nn.ParameterList(uniform_parameter(n, 1, o, fan_in=i) for i, o in layers)
        self._layers: list[tuple[th.Tensor, th.Tensor]] = list(zip(self.weights, self.biases, strict=True))
        n_heads = n if n_heads is None else n_heads
        self.head_weight = uniform_parameter(n_heads, dims[-1], output_dim, fan_in=dims[-1])
        self.head_bias = uniform_parameter(n_heads, 1, output_dim, fan_in=dims[-1])

    @property
    def dtype(self) -> th.dtype:
        """The weights' precision."""
        return self.head_weight.dtype

    def forward(self, x: th.Tensor, constant: bool = False) -> th.Tensor:
        """Return the outputs of all heads, shape (max(m, n_heads), B, out).

        :param x: inputs, shape (m, B, in) with m = n, m = 1 or n = 1
        :param constant: whether the weights are constants, so that gradients reach the input only
        """
        layers = self._layers
        head_weight: th.Tensor = self.head_weight
        head_bias: th.Tensor = self.head_bias
        if constant:
            layers = [(weight.detach(), bias.detach()) for weight, bias in layers]
            head_weight, head_bias = head_weight.detach(), head_bias.detach()

        m, batch_size, _ = x.shape
        hidden = x.reshape(1, m * batch_size, -1) if self.n == 1 else x.expand(self.n, -1, -1)
        if self._is_relu and layers and th.is_grad_enabled():
            hidden = ReLULayers.apply(hidden, *chain.from_iterable(layers))  # type: ignore[no-untyped-call]  # torch does not type apply
        else:
            for weight, bias in layers:
                hidden = self.activation(th.baddbmm(bias, hidden, weight))
        if len(head_weight) > 1:
            hidden = hidden.reshape(-1, batch_size, hidden.shape[-1])
        products: th.Tensor = Heads.apply(hidden, head_weight)  # type: ignore[no-untyped-call]  # likewise
        return (products + head_bias).reshape(-1, batch_size, products.shape[-1])


class ReLULayers(th.autograd.Function):
    """ReLU(... ReLU(x W_1 + b_1) ... W_L + b_L), as autograd has it but in less memory, which is what takes the time.

    The gradient is masked in the array in which it comes: ``Heads`` makes that for this function alone.
    """

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, *layers: th.Tensor) -> th.Tensor:
        """Return the last layer's activations, shape (n, B, H).

        :param x: inputs, shape (n, B, in)
        :param layers: W_1, b_1, W_2, b_2 ...; weights (n, in, out), biases (n, 1, out)
        """
        activations = [x]
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            activations.append(th.baddbmm(bias, activations[-1], weight).relu_())
        ctx.save_for_backward(*activations, *layers[::2])
        return activations[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Return the gradients of ``x``, W_1, b_1, W_2 ..."""
        n_layers = len(ctx.saved_tensors) // 2
        activations, weights = ctx.saved_tensors[: n_layers + 1], ctx.saved_tensors[n_layers + 1 :]
        grad_layers: list[th.Tensor | None] = []
        (grad,) = grads
        for layer in range(n_layers, 0, -1):
            th.ops.aten.threshold_backward.grad_input(grad, activations[layer], 0, grad_input=grad)
            below = activations[layer - 1]
            if ctx.needs_input_grad[2 * layer - 1]:
                grad_layers = [below.mT.bmm(grad), grad.sum(1, keepdim=True), *grad_layers]
            else:
                grad_layers = [None, None, *grad_layers]
            if layer == 1 and not ctx.needs_input_grad[0]:
                return None, *grad_layers
            grad = grad.bmm(weights[layer - 1].mT)
        return grad, *grad_layers


class Heads(th.autograd.Function):
    """Thin last layers: products whose result is a few columns wide, in the order of operands that is fast for them."""

    @staticmethod
    def forward(ctx: Any, hidden: th.Tensor, weight: th.Tensor) -> th.Tensor:
        """Return ``hidden @ weight``, shape (N, B, out).

        :param hidden: shape (N, B, H), or (1, B, H) for all heads
        :param weight: shape (N, H, out)
        """
        rows = weight.mT.contiguous()
        ctx.save_for_backward(hidden, rows)
        if len(hidden) < len(rows):
            return hidden[0].mm(rows.flatten(0, 1).T).view(hidden.shape[1], *rows.shape[:2]).transpose(0, 1)
        # A product with one row is sent to a slower kernel than one with two
        padded = rows.expand(-1, 2, -1).contiguous() if rows.shape[1] == 1 else rows
        return padded.bmm(hidden.mT)[:, : rows.shape[1]].mT

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: th.Tensor) -> tuple[th.Tensor | None, th.Tensor | None]:
        """Return the gradients of ``hidden`` and ``weight``."""
        hidden, rows = ctx.saved_tensors
        (grad,) = grads
        shape = rows.shape
        if len(hidden) < len(rows):
            grad, rows = grad.transpose(0, 1).reshape(1, hidden.shape[1], -1), rows.flatten(0, 1)[None]
        grad_weight = grad.mT.bmm(hidden).view(shape).mT if ctx.needs_input_grad[1] else None
        return grad.bmm(rows), grad_weight


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
