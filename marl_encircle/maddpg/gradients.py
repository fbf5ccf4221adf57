"""The losses of Eq. 2 and 3 and their gradients: by hand for ReLU networks on plain observations, else by autograd.

Both set the parameters' ``grad``. By hand an update takes two thirds of the time.

Shape legend: B minibatch, N agents, O observation size, U action size.
"""

from collections.abc import Iterable

import torch as th
from torch import nn
from torch.nn import functional

from marl_encircle.maddpg.policies import Actor, CentralCritic


def critic_gradients(critic: CentralCritic, obs: th.Tensor, actions: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """Return the loss of Eq. 3, the mean over B of sum_i (y_i - Q_i(s, a_1 .. a_N))^2, and set its gradients.

    :param obs: observations, shape (B, N, *O)
    :param actions: actions in [-1, 1], shape (B, N, U)
    :param targets: y_i, shape (N, B)
    """
    if not critic.has_backward:
        q_values = critic(obs, actions)
        loss = functional.mse_loss(q_values, targets.expand_as(q_values), reduction="sum") / len(obs)
        return _differentiate(loss, critic.parameters())
    with th.no_grad():
        x = critic.inputs(obs, actions)
        losses = []
        for network in critic.networks:
            activations = network.activations(x)
            errors = network.outputs(activations) - targets[..., None]
            network.backward(activations, errors * (2 / len(obs)))
            losses.append(errors.square().sum() / len(obs))
        return th.stack(losses).sum()


def actor_gradients(
    actor: Actor, critic: CentralCritic, obs: th.Tensor, actions: th.Tensor, regularization: float
) -> th.Tensor:
    """Return the loss of Eq. 2, minus the mean over B of sum_i Q_i(s, a_1 .. mu_i(o_i) .. a_N), and set its gradients.

    :param obs: observations, shape (B, N, *O)
    :param actions: actions in [-1, 1] that the other agents keep, shape (B, N, U)
    :param regularization: weight of the mean squared logits of each agent, which are added to what is differentiated
    """
    if not (actor.has_backward and critic.has_backward):
        logits = actor.logits(obs)
        loss = -critic.own_action_values(obs, actions, th.tanh(logits)).sum() / len(obs)
        penalty = regularization * logits.square().mean(dim=(0, 2)).sum()
        _differentiate(loss + penalty, actor.parameters())
        return loss.detach()
    with th.no_grad():
        activations = actor.mu.activations(actor.inputs(obs))
        logits = actor.mu.outputs(activations)
        own_actions = th.tanh(logits)
        q_values, grad = critic.own_action_gradients(obs, actions, own_actions.transpose(0, 1))
        grad = grad * (own_actions.square() - 1) / len(obs)  # d tanh = 1 - tanh^2
        actor.mu.backward(activations, grad + logits * (2 * regularization / logits[0].numel()))
        return -q_values.sum() / len(obs)


def _differentiate(loss: th.Tensor, parameters: Iterable[nn.Parameter]) -> th.Tensor:
    """Set the gradients of these parameters alone; return the loss."""
    parameters = list(parameters)
    for parameter, grad in zip(parameters, th.autograd.grad(loss, parameters), strict=True):
        parameter.grad = grad
    return loss.detach()
