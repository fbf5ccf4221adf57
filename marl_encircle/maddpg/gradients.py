"""The losses of Eq. 2 and 3 and their gradients, set as the parameters' ``grad``.

By hand, which takes two thirds of the time, where every module between a parameter and the loss is one of those that
this file knows and has no hook; by autograd wherever something else may stand there.

Shape legend: B minibatch, N agents, O observation size, U action size.
"""

from collections.abc import Iterable

import torch as th
from torch import nn
from torch.nn import functional

from marl_encircle.maddpg.models import Actor, CentralCritic
from marl_encircle.maddpg.networks import StackedMLP

PLAIN = {Actor, CentralCritic, StackedMLP, nn.ModuleList, nn.ParameterList, nn.ReLU}
"""Types of the modules whose arithmetic is known; a subclass may compute something else."""


def critic_gradients(
    critic: CentralCritic, obs: th.Tensor, actions: th.Tensor, targets: th.Tensor, by_hand: bool
) -> th.Tensor:
    """Return the loss of Eq. 3, the mean over B of sum_i (y_i - Q_i(s, a_1 .. a_N))^2, and set its gradients.

    :param obs: observations, shape (B, N, *O)
    :param actions: actions in [-1, 1], shape (B, N, U)
    :param targets: y_i, shape (N, B)
    :param by_hand: only where the critic ``is_plain``
    """
    if not by_hand:
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
    actor: Actor, critic: CentralCritic, obs: th.Tensor, actions: th.Tensor, regularization: float, by_hand: bool
) -> th.Tensor:
    """Return the loss of Eq. 2, minus the mean over B of sum_i Q_i(s, a_1 .. mu_i(o_i) .. a_N), and set its gradients.

    :param obs: observations, shape (B, N, *O)
    :param actions: actions in [-1, 1] that the other agents keep, shape (B, N, U)
    :param regularization: weight of the mean squared logits of each agent, which are added to what is differentiated
    :param by_hand: only where actor and critic are plain, see ``is_plain``
    """
    if not by_hand:
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


def is_plain(model: Actor | CentralCritic) -> bool:
    """Whether the gradients by hand are those of autograd, with all that a user may have changed in the model.

    That is: ReLU networks of one or more hidden layers, on features that have nothing to learn, none shared by two
    estimates; no subclass or parametrisation, no hook, no frozen parameter, no autocast.
    """
    features = set(model.features_extractor.modules())
    modules = [module for module in model.modules() if module not in features]
    networks = [module for module in modules if type(module) is StackedMLP]
    return (
        not any(True for _ in model.features_extractor.parameters())
        and all(type(module) in PLAIN for module in modules)
        and all(type(network.activation) is nn.ReLU and len(network.weights) for network in networks)
        and len(networks) == (len(model.q_networks) if isinstance(model, CentralCritic) else 1)
        and not any(_has_hooks(module) for module in modules)
        and all(_is_plain_parameter(parameter) for module in modules for parameter in module._parameters.values())
        and not th.is_autocast_enabled(networks[0].head_weight.device.type)
    )


def _has_hooks(module: nn.Module) -> bool:
    hooks = module._forward_hooks, module._forward_pre_hooks, module._backward_hooks, module._backward_pre_hooks
    return any(hooks)


def _is_plain_parameter(parameter: nn.Parameter | None) -> bool:
    if parameter is None:  # as a layer without bias has it
        return True
    hooks = parameter._backward_hooks, parameter._post_accumulate_grad_hooks
    return parameter.requires_grad and not any(hooks)


def _differentiate(loss: th.Tensor, parameters: Iterable[nn.Parameter]) -> th.Tensor:
    """Set the gradients of these parameters alone, of none that is frozen; return the loss."""
    parameters = list(parameters)
    for parameter in parameters:
        parameter.grad = None
    learning = [parameter for parameter in parameters if parameter.requires_grad]
    if learning:
        th.autograd.backward(loss, inputs=learning)
    return loss.detach()
