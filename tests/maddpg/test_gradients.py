"""The losses' gradients: by hand and by autograd they are the same."""

from typing import Any

import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from marl_encircle.maddpg.gradients import actor_gradients, critic_gradients
from marl_encircle.maddpg.policies import MADDPGPolicy

N_AGENTS, BATCH_SIZE, OBSERVATION_SIZE, ACTION_SIZE = 3, 7, 5, 2


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


@pytest.mark.parametrize("share_parameters", [False, True])
@pytest.mark.parametrize("n_critics", [1, 2])
@pytest.mark.parametrize("critic", ["per_agent", "shared"])
def test_by_hand_and_by_autograd_are_the_same(critic: str, n_critics: int, share_parameters: bool) -> None:
    how: dict[str, Any] = {"critic": critic, "n_critics": n_critics, "share_parameters": share_parameters}
    by_hand, by_autograd = policy(nn.ReLU, **how), policy(Rectifier, **how)
    assert by_hand.actor.has_backward
    assert by_hand.critic.has_backward
    assert not by_autograd.actor.has_backward
    assert not by_autograd.critic.has_backward
    obs = th.randn(BATCH_SIZE, N_AGENTS, OBSERVATION_SIZE, dtype=th.float64)
    actions = 2 * th.rand(BATCH_SIZE, N_AGENTS, ACTION_SIZE, dtype=th.float64) - 1
    targets = th.randn(N_AGENTS, BATCH_SIZE, dtype=th.float64)

    losses = [critic_gradients(p.critic, obs, actions, targets) for p in (by_hand, by_autograd)]
    th.testing.assert_close(losses[0], losses[1], rtol=1e-12, atol=1e-12)
    critic_grads = assert_same_gradients(by_hand.critic, by_autograd.critic)

    losses = [actor_gradients(p.actor, p.critic, obs, actions, 0.3) for p in (by_hand, by_autograd)]
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
