"""What every road to the ecosystem does in a step: move the worlds, reward the pursuers, tell which rounds are over."""

from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from marl_encircle.core.observations import bounds, observe
from marl_encircle.core.rewards import Reward, Transition
from marl_encircle.core.rounds import Rounds
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

ACTION_SIZE = 2
"""U: an acceleration, or a velocity in first-order dynamics, along x and y."""


class Spaces(NamedTuple):
    """What a pursuer may see and do."""

    observation: Box
    """(O,)."""
    action: Box
    """(2,), in [-1, 1]."""


def spaces_of(scenario: Scenario) -> Spaces:
    """Return the spaces of a scenario's pursuers, in objects of their own."""
    return Spaces(Box(*bounds(scenario)), Box(-1.0, 1.0, (ACTION_SIZE,)))


class Outcome(NamedTuple):
    """One step of B worlds, in arrays of its own."""

    observations: NDArray[np.float32]
    """After the step, (B, N, O)."""
    rewards: NDArray[np.float32]
    """Of each pursuer, (B, N)."""
    terminated: NDArray[np.bool_]
    """Whether the encirclement is complete under the reward's closure rule, (B,)."""
    truncated: NDArray[np.bool_]
    """Whether the round is cut at ``scenario.max_cycles`` without success, (B,)."""


class Arena:
    """B worlds together with the reward and the record of their rounds.

    :param scenario: the rules
    :param reward: the reward, and the closure rule that ends a round
    :param n_worlds: B
    :raises ValueError: for fewer than one world
    """

    def __init__(self, scenario: Scenario, reward: Reward, n_worlds: int) -> None:
        self.scenario, self.reward = scenario, reward
        self.simulator = Simulator(scenario, n_worlds)
        self.rounds = Rounds(scenario, reward.closure, n_worlds)
        self._size = len(bounds(scenario)[0])
        self._everywhere = np.arange(n_worlds)

    def observe(self) -> NDArray[np.float32]:
        """Return what all pursuers see now, (B, N, O)."""
        observations = np.empty((self.simulator.n_worlds, self.scenario.pursuers, self._size), np.float32)
        observe(self.simulator, observations, self._everywhere)
        return observations

    def reset(self) -> NDArray[np.float32]:
        """Start a new round in every world.

        :return: what all pursuers see first, (B, N, O)
        :raises PlacementError: if the bodies cannot be placed
        """
        self.simulator.reset()
        self.rounds.start(self._everywhere)
        return self.observe()

    def restart(self, worlds: NDArray[np.int64], observations: NDArray[np.float32]) -> None:
        """Start a new round in some worlds.

        :param worlds: their indices, (W,)
        :param observations: of all worlds; those of ``worlds`` are overwritten, (B, N, O)
        :raises PlacementError: if the bodies cannot be placed
        """
        self.simulator.reset(worlds)
        self.rounds.start(worlds)
        observe(self.simulator, observations, worlds)

    def step(self, actions: ArrayLike) -> Outcome:
        """Move all worlds by one step.

        :param actions: in [-1, 1], clipped beyond, (B, N, 2)
        :raises ValueError: for actions of a wrong shape, or not finite, naming world and pursuer; nothing moves then
        :raises ValueError: if a reward term returns something else than (B, N)
        """
        actions = np.asarray(actions, np.float64)
        sim, closure = self.simulator, self.reward.closure
        measure = sim.step(actions)  # clips as well, once it has refused what is not finite
        clipped = actions.clip(-1.0, 1.0)
        shares = self.reward.parts(Transition(self.scenario, sim.state, clipped, measure, sim.former_measure, closure))
        rewards = self.rounds.add(sim.steps, measure, shares)
        terminated = measure.enclosure[closure].complete.copy()
        truncated = (sim.steps >= self.scenario.max_cycles) & ~terminated
        return Outcome(self.observe(), rewards.astype(np.float32), terminated, truncated)

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, as arrays and plain numbers."""
        return {"simulator": self.simulator.get_state(), "rounds": self.rounds.get_state()}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on from what :meth:`get_state` returned, bit for bit."""
        self.simulator.set_state(saved["simulator"])
        self.rounds.set_state(saved["rounds"])
