"""How many numbers an observation, the features made of it and the networks have."""

from itertools import pairwise

from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.sections import AlgorithmConfig, Features, TrainingConfig

NEAREST = {"pursuers": 4, "obstacles": 3}
"""How many bodies of each kind the features ``set`` show."""

BODY_SIZE = 8
"""Of what they show of each."""


def count_weights(scenario: Scenario, algorithm: AlgorithmConfig) -> dict[str, int]:
    """Return the number of weights of all actors and of one set of critics, one a pursuer or a shared one."""
    n, hidden = scenario.pursuers, algorithm.net_arch
    size = features_size(scenario, algorithm.features)
    actor, joint = weights_between([size, *hidden, 2]), n * (size + 2)
    if algorithm.critic == "shared":
        critics = weights_between([joint, *hidden, n])
    else:
        critics = n * weights_between([joint, *hidden, 1])
    return {"actors": actor if algorithm.features == "set" else n * actor, "critics": critics}


def buffer_world_steps(algorithm: AlgorithmConfig, training: TrainingConfig) -> int:
    """Return the world steps that the replay buffer holds: room for more than the training has would cost memory."""
    return min(algorithm.buffer_world_steps, training.world_steps + training.n_worlds)


def weights_between(sizes: list[int]) -> int:
    """Return the number of weights and biases of dense layers between so many values each."""
    return sum((a + 1) * b for a, b in pairwise(sizes))


def observation_size(scenario: Scenario) -> int:
    """Return the number of values that a pursuer observes."""
    return int(list(layout(scenario).values())[-1].stop)


def features_size(scenario: Scenario, features: Features) -> int:
    """Return the number of values that the networks read of a pursuer's observation."""
    size = observation_size(scenario)
    others = scenario.pursuers - 1 + scenario.units
    if features == "set":
        return int(size - (4 if scenario.observe_directions else 2) * others + BODY_SIZE * sum(NEAREST.values()))
    return int(size + (4 * others if features == "relative" else 0))
