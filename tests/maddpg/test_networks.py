import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

from marl_encircle.maddpg.networks import AgentFeatures, StackedMLP


def plain_outputs(network: StackedMLP, x: th.Tensor) -> th.Tensor:
    """One network after the other by ``nn.functional.linear``; ReLU after every layer but the last."""
    outputs = []
    for head in range(max(len(x), len(network.head_weight))):
        hidden = x[min(head, len(x) - 1)]
        for weight, bias in zip(network.weights, network.biases, strict=True):
            n = min(head, network.n - 1)
            hidden = nn.functional.linear(hidden, weight[n].T, bias[n, 0]).relu()
        n = min(head, len(network.head_weight) - 1)
        outputs.append(nn.functional.linear(hidden, network.head_weight[n].T, network.head_bias[n, 0]))
    return th.stack(outputs)


CASES = {
    "a network per input": (3, 3, 3),
    "networks with a common input": (3, 3, 1),
    "one trunk, a head per agent, a common input": (1, 3, 1),
    "one trunk, a head and an input per agent": (1, 3, 3),
    "one network for all inputs": (1, 1, 3),
    "one network": (1, 1, 1),
}


@pytest.mark.parametrize("output_dim", [1, 2])
@pytest.mark.parametrize("net_arch", [[], [1], [4], [4, 6]], ids=str)
@pytest.mark.parametrize("case", CASES)
def test_stacked_networks_equal_single_ones_in_values_and_gradients(
    case: str, net_arch: list[int], output_dim: int
) -> None:
    n, n_heads, m = CASES[case]
    th.manual_seed(0)
    network = StackedMLP(n, 5, net_arch, output_dim, n_heads=n_heads).double()
    x = th.randn(m, 7, 5, dtype=th.float64, requires_grad=True)
    weights = th.randn(max(m, n_heads), 7, output_dim, dtype=th.float64)
    inputs = [x, *network.parameters()]

    outputs, expected = network(x), plain_outputs(network, x)
    th.testing.assert_close(outputs, expected, rtol=1e-12, atol=1e-12)
    with th.no_grad():
        th.testing.assert_close(network(x), expected, rtol=1e-12, atol=1e-12)
    grads = th.autograd.grad((outputs * weights).sum(), inputs)
    expected_grads = th.autograd.grad((expected * weights).sum(), inputs)
    th.testing.assert_close(grads, expected_grads, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("output_dim", [1, 2])
@pytest.mark.parametrize("net_arch", [[4], [4, 6]], ids=str)
@pytest.mark.parametrize("case", CASES)
def test_gradients_by_hand_equal_those_of_autograd(case: str, net_arch: list[int], output_dim: int) -> None:
    n, n_heads, m = CASES[case]
    th.manual_seed(0)
    network = StackedMLP(n, 5, net_arch, output_dim, n_heads=n_heads).double()
    x = th.randn(m, 7, 5, dtype=th.float64)
    weights = th.randn(max(m, n_heads), 7, output_dim, dtype=th.float64)
    parameters = list(network.parameters())
    expected = th.autograd.grad((network(x) * weights).sum(), parameters)
    with th.no_grad():
        grad = network.backward(network.activations(x), weights)
        th.testing.assert_close([parameter.grad for parameter in parameters], list(expected), rtol=1e-12, atol=1e-12)
        # The first bias is added to the sums, so that its gradient is theirs, summed up
        th.testing.assert_close(grad.sum(1, keepdim=True).sum_to_size(network.biases[0].shape), network.biases[0].grad)


def test_constant_parameters_get_no_gradients() -> None:
    network = StackedMLP(3, 5, [4], 1)
    with th.no_grad():
        network.backward(network.activations(th.randn(3, 7, 5)), th.ones(3, 7, 1), constant=True)
    assert all(parameter.grad is None for parameter in network.parameters())


def test_other_activations_are_those_of_torch() -> None:
    network = StackedMLP(2, 5, [4], 1, nn.Tanh).double()
    x = th.randn(2, 7, 5, dtype=th.float64, requires_grad=True)
    assert th.autograd.gradcheck(network, x)
    by_hand = th.tanh(x @ network.weights[0] + network.biases[0]) @ network.head_weight + network.head_bias
    th.testing.assert_close(network(x), by_hand)


@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh])
@pytest.mark.parametrize("net_arch", [[], [4], [4, 6]], ids=str)
@pytest.mark.parametrize("n", [1, 3])
def test_changes_equal_other_inputs(n: int, net_arch: list[int], activation_fn: type[nn.Module]) -> None:
    th.manual_seed(0)
    network = StackedMLP(n, 8, net_arch, 1, activation_fn, n_heads=3).double()
    x = th.randn(1, 7, 8, dtype=th.float64)
    changes = th.randn(3, 7, 2, dtype=th.float64, requires_grad=True)
    # Head i reads two columns of its own; the first two are common
    columns = th.tensor([[2, 3], [4, 5], [6, 7]])
    inputs = x.repeat(3, 1, 1)
    for head, (first, second) in enumerate(columns.tolist()):
        inputs[head, :, [first, second]] += changes[head]

    outputs, expected = network.outputs(network.activations(x, changes, columns)), network(inputs)
    th.testing.assert_close(outputs, expected, rtol=1e-12, atol=1e-12)
    (expected_grad,) = th.autograd.grad(expected.square().sum(), changes)
    (grad,) = th.autograd.grad(outputs.square().sum(), changes)
    th.testing.assert_close(grad, expected_grad, rtol=1e-12, atol=1e-12)


def test_an_activation_that_learns_is_refused() -> None:
    with pytest.raises(ValueError, match="activation_fn must have no parameters"):
        StackedMLP(2, 5, [4], 1, nn.PReLU)


def test_replaced_parameters_are_used() -> None:
    network = StackedMLP(2, 5, [4], 1)
    x = th.randn(2, 7, 5)
    network.load_state_dict(StackedMLP(2, 5, [4], 1).state_dict(), assign=True)
    th.testing.assert_close(network(x), plain_outputs(network, x))


def test_weights_start_like_those_of_linear_layers() -> None:
    th.manual_seed(0)
    network = StackedMLP(3, 100, [400], 100)
    # nn.Linear: uniform in +-1/sqrt(fan_in), for weights and biases
    for parameter, fan_in in [(network.weights[0], 100), (network.biases[0], 100), (network.head_weight, 400)]:
        assert parameter.abs().max().item() == pytest.approx(fan_in**-0.5, rel=0.01)
        assert parameter.mean().item() == pytest.approx(0, abs=0.05 * fan_in**-0.5)


class Learnt(BaseFeaturesExtractor):
    """Four sums of an observation's numbers."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, features_dim=4)
        self.linear = nn.Linear(6, 4)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(observations.flatten(1))


def test_an_agents_features_are_those_of_its_own_observation() -> None:
    space, obs = spaces.Box(-1, 1, (2, 3)), th.randn(5, 3, 2, 3)
    flat, common, own = [FlattenExtractor(space)], [Learnt(space)], [Learnt(space) for _ in range(3)]
    for extractors, size in ((flat, 6), (common, 4), (own, 4)):
        features = AgentFeatures(space, extractors, 3)
        assert features.features_dim == size
        expected = [extractors[i % len(extractors)](obs[:, i]) for i in range(3)]
        th.testing.assert_close(features(obs), th.stack(expected, dim=1))
