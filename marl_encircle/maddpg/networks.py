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
        self.activation = activation_fn()
        dims = [input_dim, *net_arch]
        layers = list(zip(dims[:-1], net_arch, strict=True))
        self.weights = nn.ParameterList(uniform_parameter(n, i, o, fan_in=i) for i, o in layers)
        self.biases = nn.ParameterList(uniform_parameter(n, 1, o, fan_in=i) for i, o in layers)
        n_heads = n if n_heads is None else n_heads
        self.head_weight = uniform_parameter(n_heads, dims[-1], output_dim, fan_in=dims[-1])
        self.head_bias = uniform_parameter(n_heads, 1, output_dim, fan_in=dims[-1])
        # W_1, b_1, W_2 ...: looking them up in the modules at every call would take longer
        layer_parameters = chain.from_iterable(zip(self.weights, self.biases, strict=True))
        self._in_order: list[th.Tensor] = [*layer_parameters, self.head_weight, self.head_bias]

    @property
    def dtype(self) -> th.dtype:
        """The weights' precision."""
        return self.head_weight.dtype

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the outputs of all heads, shape (max(m, n_heads), B, out).

        :param x: inputs, shape (m, B, in) with m = n, m = 1 or n = 1
        """
        return self._outputs(x, None, None, self._in_order)

    def with_changes(self, x: th.Tensor, changes: th.Tensor, columns: th.Tensor) -> th.Tensor:
        """Return the outputs where every head reads a few inputs of its own and all others in common.

        x W_1 is made once for all, without a gradient, and only the thin product with ``changes`` is each head's own.
        The weights are constants: gradients reach ``changes`` only.

        :param x: common inputs, shape (1, B, in)
        :param changes: what head i adds to its columns of ``x``, shape (n_heads, B, U)
        :param columns: these columns, shape (n_heads, U)
        :return: shape (n_heads, B, out)
        """
        parameters = [parameter.detach() for parameter in self._in_order]
        heads = th.arange(columns.shape[0], device=columns.device)[:, None]
        change_weight = parameters[0].expand(columns.shape[0], -1, -1)[heads, columns]
        return self._outputs(x, changes, change_weight, parameters)

    def _outputs(
        self, x: th.Tensor, changes: th.Tensor | None, change_weight: th.Tensor | None, parameters: list[th.Tensor]
    ) -> th.Tensor:
        if self._is_relu and len(parameters) > 2:
            outputs: th.Tensor = ReLUMLP.apply(x, changes, change_weight, *parameters)  # type: ignore[no-untyped-call]  # torch does not type apply
            return outputs
        weight, bias, *above = parameters
        sums = x @ weight + bias
        if changes is not None and change_weight is not None:
            sums = sums + changes @ change_weight
        for weight, bias in zip(above[::2], above[1::2], strict=True):
            sums = self.activation(sums) @ weight + bias
        return sums


class ReLUMLP(th.autograd.Function):
    """ReLU(... ReLU(x W_1 + dx W_dx + b_1) ...) W_L + b_L, as autograd has it but in fewer steps and less memory.

    All leading axes broadcast.
    """

    @staticmethod
    def forward(
        ctx: Any, x: th.Tensor, dx: th.Tensor | None, dx_weight: th.Tensor | None, *parameters: th.Tensor
    ) -> th.Tensor:
        """Return the last layer's outputs, shape (N, B, out).

        :param x: inputs, shape (m, B, in)
        :param dx: further inputs of the first layer, shape (N, B, U)
        :param dx_weight: their weights, shape (N, U, H)
        :param parameters: W_1, b_1, W_2 ... b_L; weights (n, in, out), biases (n, 1, out)
        """
        *layers, head_weight, head_bias = parameters
        activations = [x]
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            sums = (activations[-1] @ weight).add_(bias)
            if dx is not None and dx_weight is not None and len(activations) == 1:
                sums = (dx @ dx_weight).add_(sums)
            activations.append(sums.relu_())
        hidden = activations[-1]
        # The head is thin: as rows it is the left factor of a product that is fast, and heads of one trunk are one
        rows = head_weight.mT.reshape(min(hidden.shape[0], head_weight.shape[0]), -1, hidden.shape[2])
        ctx.save_for_backward(dx_weight, rows, *layers[::2], *activations)
        ctx.head_shape = head_weight.mT.shape
        # A product with one row is sent to a slower kernel than one with two
        padded = rows.expand(-1, 2, -1).contiguous() if rows.shape[1] == 1 else rows
        outputs = (padded @ hidden.mT)[:, : rows.shape[1]]
        return outputs.reshape(-1, head_weight.shape[2], hidden.shape[1]).mT + head_bias

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Return the gradients of ``x``, ``dx`` and all parameters; ``dx_weight`` has none."""
        dx_weight, rows, *saved = ctx.saved_tensors
        n_layers = len(saved) // 2
        weights, activations = saved[:n_layers], saved[n_layers:]
        needs_x, needs_dx, _, *_, needs_parameters = ctx.needs_input_grad
        grad_parameters: list[th.Tensor | None] = [None] * (2 * n_layers + 2)

        hidden, (grad,) = activations[-1], grads
        grad_rows = grad.mT.reshape(hidden.shape[0], -1, grad.shape[1])
        if needs_parameters:
            grad_head = (grad_rows @ hidden).sum_to_size(rows.shape).view(ctx.head_shape).mT
            grad_bias = grad.sum(1, keepdim=True).sum_to_size(ctx.head_shape[0], 1, ctx.head_shape[1])
            grad_parameters[-2:] = grad_head, grad_bias
        grad = grad_rows.mT @ rows
        for layer in reversed(range(n_layers)):
            weight, below, above = weights[layer], activations[layer], activations[layer + 1]
            # In place: nobody else has this array
            th.ops.aten.threshold_backward.grad_input(grad, above, 0, grad_input=grad)
            if needs_parameters:
                n, _, size = weight.shape
                grad_weight, grad_bias = below.mT @ grad, grad.sum(1, keepdim=True)
                grad_parameters[2 * layer : 2 * layer + 2] = (
                    grad_weight.sum_to_size(weight.shape),
                    grad_bias.sum_to_size(n, 1, size),
                )
            if layer > 0:
                grad = grad @ weight.mT
        grad_x = (grad @ weights[0].mT).sum_to_size(activations[0].shape) if needs_x else None
        grad_dx = (dx_weight @ grad.mT).mT if needs_dx else None
        return grad_x, grad_dx, None, *grad_parameters


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
