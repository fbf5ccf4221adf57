"""The losses' gradients: by hand and by autograd they are the same."""

from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from marl_encircle.maddpg.gradients import actor_gradients, critic_gradients, is_plain
from marl_encircle.maddpg.networks import StackedMLP
from marl_encircle.maddpg.policies import MADDPGPolicy

N_AGENTS, BATCH_SIZE, OBSERVATION_SIZE, ACTION_SIZE = 3, 7, 5, 2


class Squares(FlattenExtractor):
    """Features that have nothing to learn."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).square()


class Rectifier(nn.ReLU):
    """ReLU under another name, for which nothing is done by hand."""


def policy(activation_fn: type[nn.Module], **kwargs: Any) -> MADDPGPolicy:
    """A policy of three agents in float64; equal weights whatever the activation."""
    th.manual_seed(0)
    observation_space, action_space = spaces.Box(-1, 1, (OBSERVATION_SIZE,)), spaces.Box(-1, 1, (ACTION_SIZE,))
    policy = MADDPGPolicy(
        observation_space,
        action_space,
        lambda _: 1e-3,
        N_AGENTS,
        net_arch=[8, 6],
        activation_fn=activation_fn,
        **kwargs,
    )
    return policy.double()


@pytest.mark.parametrize("features", [FlattenExtractor, Squares])
@pytest.mark.parametrize("share_parameters", [False, True])
@pytest.mark.parametrize("n_critics", [1, 2])
@pytest.mark.parametrize("critic", ["per_agent", "shared"])
def test_by_hand_and_by_autograd_are_the_same(
    critic: str, n_critics: int, share_parameters: bool, features: type[FlattenExtractor]
) -> None:
    how: dict[str, Any] = {"critic": critic, "n_critics": n_critics, "share_parameters": share_parameters}
    how["features_extractor_class"] = features
    by_hand, by_autograd = policy(nn.ReLU, **how), policy(Rectifier, **how)
    assert is_plain(by_hand.actor)
    assert is_plain(by_hand.critic)
    assert not is_plain(by_autograd.actor)
    assert not is_plain(by_autograd.critic)
    obs = th.randn(BATCH_SIZE, N_AGENTS, OBSERVATION_SIZE, dtype=th.float64)
    actions = 2 * th.rand(BATCH_SIZE, N_AGENTS, ACTION_SIZE, dtype=th.float64) - 1
    targets = th.randn(N_AGENTS, BATCH_SIZE, dtype=th.float64)

    losses = [critic_gradients(p.critic, obs, actions, targets, p is by_hand) for p in (by_hand, by_autograd)]
    th.testing.assert_close(losses[0], losses[1], rtol=1e-12, atol=1e-12)
    critic_grads = assert_same_gradients(by_hand.critic, by_autograd.critic)

    losses = [actor_gradients(p.actor, p.critic, obs, actions, 0.3, p is by_hand) for p in (by_hand, by_autograd)]
    th.testing.assert_close(losses[0], losses[1], rtol=1e-12, atol=1e-12)
    assert_same_gradients(by_hand.actor, by_autograd.actor)
    # The critics' gradients are those of their own loss
    for before, after in zip(critic_grads, gradients(by_hand.critic), strict=True):
        assert th.equal(before, after)


def gradients(network: nn.Module) -> list[th.Tensor]:
    grads = [parameter.grad for parameter in network.parameters()]
    assert all(grad is not None for grad in grads)
    return [grad.clone() for grad in grads if grad is not None]


def assert_same_gradients(first: nn.Module, second: nn.Module) -> list[th.Tensor]:
    one, other = gradients(first), gradients(second)
    th.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)
    assert all(grad.abs().max() > 0 for grad in one)
    return one


def freeze(model: Any, network: StackedMLP) -> None:
    network.weights[0].requires_grad_(False)


def hook_a_parameter(model: Any, network: StackedMLP) -> None:
    network.head_weight.register_hook(lambda grad: grad * 0)


def hook_after_accumulation(model: Any, network: StackedMLP) -> None:
    network.head_weight.register_post_accumulate_grad_hook(lambda parameter: parameter.grad.zero_())


def hook_a_module(model: Any, network: StackedMLP) -> None:
    network.register_forward_hook(lambda module, args, output: output * 2)


def hook_a_gradient(model: Any, network: StackedMLP) -> None:
    network.register_full_backward_hook(lambda module, grad_input, grad_output: None)


def parametrize(model: Any, network: StackedMLP) -> None:
    nn.utils.parametrize.register_parametrization(network, "head_weight", nn.Identity())


def parametrize_a_hidden_layer(model: Any, network: StackedMLP) -> None:
    nn.utils.parametrize.register_parametrization(network.weights, "0", nn.Identity())


def replace_the_activation(model: Any, network: StackedMLP) -> None:
    network.activation = nn.Tanh()


def subclass(model: Any, network: StackedMLP) -> None:
    model.__class__ = type("Mine", (type(model),), {})


def learn_features(model: Any, network: StackedMLP) -> None:
    model.features_extractor.register_parameter("scale", nn.Parameter(th.ones(1)))


CHANGES = [
    freeze,
    hook_a_parameter,
    hook_after_accumulation,
    hook_a_module,
    hook_a_gradient,
    parametrize,
    parametrize_a_hidden_layer,
    replace_the_activation,
    subclass,
    learn_features,
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_a_user_changes_is_left_to_autograd(change: Callable[[Any, StackedMLP], None]) -> None:
    for name in ("actor", "critic"):
        model = getattr(policy(nn.ReLU), name)
        assert is_plain(model)
        change(model, model.mu if name == "actor" else model.networks[0])
        assert not is_plain(model)


def test_other_networks_are_left_to_autograd() -> None:
    assert not is_plain(policy(nn.ReLU, features_extractor_class=Learned).critic)
    th.manual_seed(0)
    twins = policy(nn.ReLU, n_critics=2).critic
    twins.q_networks[1] = twins.q_networks[0]
    assert not is_plain(twins)
    linear = MADDPGPolicy(spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (1,)), lambda _: 1e-3, N_AGENTS, net_arch=[])
    assert not is_plain(linear.actor)
    with th.autocast("cpu"):
        assert not is_plain(policy(nn.ReLU).actor)


class Learned(FlattenExtractor):
    """Features that have something to learn."""

    def __init__(self, observation_space: spaces.Space[Any]) -> None:
        super().__init__(observation_space)
        self.scale = nn.Parameter(th.ones(1))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.scale * super().forward(observations)


def test_frozen_parameters_and_unused_ones_have_no_gradient() -> None:
    p = policy(nn.ReLU)
    frozen = p.critic.networks[0].weights[0].requires_grad_(False)
    p.critic.unused = nn.Parameter(th.zeros(1))
    obs = th.randn(BATCH_SIZE, N_AGENTS, OBSERVATION_SIZE, dtype=th.float64)
    actions = th.zeros(BATCH_SIZE, N_AGENTS, ACTION_SIZE, dtype=th.float64)
    critic_gradients(p.critic, obs, actions, th.zeros(N_AGENTS, BATCH_SIZE, dtype=th.float64), by_hand=False)
    assert frozen.grad is None
    assert p.critic.unused.grad is None
    assert p.critic.networks[0].weights[1].grad is not None
    actor_gradients(
        p.actor, p.critic, obs, actions, 0.0, by_hand=False
    )  # a frozen critic is as good as any for the actors
    assert all(parameter.grad is not None for parameter in p.actor.parameters())
