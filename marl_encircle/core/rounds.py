"""What is remembered of a round while it is played: when each closure rule held, contributions, contacts, rewards."""

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import Closure, Measure
from marl_encircle.core.scenario import Scenario

Array = NDArray[np.float64]

NEVER = 0
"""Step of a success that did not happen; steps count from 1."""


class Rounds:
    """The running round of each of B worlds.

    Figures other than the two success steps stop growing once the encirclement is complete under ``closure``, so that a
    round may be played on to see when the other rule holds.

    :param scenario: the rules
    :param closure: the rule that ends the round
    :param n_worlds: B
    """

    def __init__(self, scenario: Scenario, closure: Closure, n_worlds: int) -> None:
        self.closure = closure
        self.success_step = {rule: np.full(n_worlds, NEVER) for rule in get_args(Closure)}
        self.length = np.zeros(n_worlds, np.int64)
        self.returns = np.zeros((n_worlds, scenario.pursuers))
        self.contacts_pursuers = np.zeros(n_worlds, np.int64)
        self.contacts_obstacles = np.zeros(n_worlds, np.int64)
        self._occupied_angle = np.zeros(n_worlds)
        self._contributing_angle = np.zeros((n_worlds, scenario.pursuers))
        self._terms: dict[str, Array] = {}

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether the encirclement has been completed under the method's closure rule, (B,)."""
        done: NDArray[np.bool_] = self.success_step[self.closure] != NEVER
        return done

    def start(self, worlds: NDArray[np.int64]) -> None:
        """Forget the former round of some worlds."""
        counters = (self.length, self.contacts_pursuers, self.contacts_obstacles, *self.success_step.values())
        sums = (self.returns, self._occupied_angle, self._contributing_angle, *self._terms.values())
        for array in (*counters, *sums):
            array[worlds] = 0

    def add(self, step: NDArray[np.int64], measure: Measure, shares: Mapping[str, Array]) -> None:
        """Take in one step of all worlds.

        :param step: number of the step in its round, from 1, (B,)
        :param measure: after the step
        :param shares: each reward term's share, (B, N) each
        """
        running = ~self.complete
        everybody = running[:, None]
        enclosure = measure.enclosure[self.closure]
        self.length += running
        self._occupied_angle += running * enclosure.occupied_angle
        self._contributing_angle += everybody * enclosure.contributing_angle[:, : self.returns.shape[1]]
        self.contacts_pursuers += running * measure.contacts_pursuers.sum(axis=1)
        self.contacts_obstacles += running * measure.contacts_obstacles.sum(axis=1)
        for name, share in shares.items():
            if name not in self._terms:
                self._terms[name] = np.zeros(len(running))
            self.returns += everybody * share
            self._terms[name] += running * share.mean(axis=1)
        for rule, first in self.success_step.items():
            now = measure.enclosure[rule].complete & (first == NEVER)
            first[now] = step[now]

    @property
    def contribution_spread(self) -> Array:
        """sigma_c: standard deviation over the pursuers of theta_c averaged over the round (Eq. 15) [rad], (B,)."""
        mean = self._contributing_angle / np.maximum(self.length, 1)[:, None]
        spread: Array = mean.std(axis=1)
        return spread

    def summary(self, world: int) -> dict[str, float]:
        """Return one round's figures by the names under which they are logged."""
        length = max(int(self.length[world]), 1)
        return {
            "success_all": float(self.success_step["all"][world] != NEVER),
            "success_pursuers": float(self.success_step["pursuers"][world] != NEVER),
            "length": float(length),
            "occupied_angle": float(self._occupied_angle[world]) / length,
            "sigma_c": float(self.contribution_spread[world]),
            "contacts_pursuers": float(self.contacts_pursuers[world]),
            "contacts_obstacles": float(self.contacts_obstacles[world]),
            **{f"reward/{name}": float(total[world]) for name, total in self._terms.items()},
        }

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Return copies of all running figures by name."""
        arrays: dict[str, NDArray[Any]] = {f"success_{rule}": a for rule, a in self.success_step.items()}
        arrays |= {f"term_{name}": a for name, a in self._terms.items()}
        for name in ("length", "returns", "contacts_pursuers", "contacts_obstacles"):
            arrays[name] = getattr(self, name)
        arrays |= {"occupied_angle": self._occupied_angle, "contributing_angle": self._contributing_angle}
        return {name: array.copy() for name, array in arrays.items()}

    def set_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what :meth:`get_state` returned."""
        self._terms = {key.removeprefix("term_"): saved[key].copy() for key in saved if key.startswith("term_")}
        for rule, first in self.success_step.items():
            first[:] = saved[f"success_{rule}"]
        for name in ("length", "returns", "contacts_pursuers", "contacts_obstacles"):
            getattr(self, name)[:] = saved[name]
        self._occupied_angle[:] = saved["occupied_angle"]
        self._contributing_angle[:] = saved["contributing_angle"]
