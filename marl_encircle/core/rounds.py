"""What is remembered of a round while it is played: when each closure rule held, contributions, contacts, rewards."""

from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel
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
        self._terms: tuple[str, ...] = ()
        self._term_sums = np.zeros((0, n_worlds))

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether the encirclement has been completed under the method's closure rule, (B,)."""
        done: NDArray[np.bool_] = self.success_step[self.closure] != NEVER
        return done

    def start(self, worlds: NDArray[np.int64]) -> None:
        """Forget the former round of some worlds."""
        counters = (self.length, self.contacts_pursuers, self.contacts_obstacles, *self.success_step.values())
        for array in (*counters, self.returns, self._occupied_angle, self._contributing_angle):
            array[worlds] = 0
        self._term_sums[:, worlds] = 0

    def add(self, step: NDArray[np.int64], measure: Measure, shares: Mapping[str, Array]) -> Array:
        """Take in one step of all worlds.

        :param step: number of the step in its round, from 1, (B,)
        :param measure: after the step
        :param shares: each reward term's share, (B, N) each; the same terms at every step
        :return: the sum of the shares, the rewards of this step, (B, N)
        """
        if tuple(shares) != self._terms:
            if self._terms:
                raise ValueError(f"shares of {', '.join(shares)} after shares of {', '.join(self._terms)}")
            self._terms = tuple(shares)
            self._term_sums = np.zeros((len(shares), len(self.length)))
        enclosure = measure.enclosure[self.closure]
        rewards = np.zeros(self.returns.shape)
        _add(
            step,
            measure.enclosure["all"].complete,
            measure.enclosure["pursuers"].complete,
            enclosure.occupied_angle,
            enclosure.contributing_angle,
            measure.contacts_pursuers,
            measure.contacts_obstacles,
            np.concatenate([self.returns[:0], *shares.values()]),
            self.complete,
            self.success_step["all"],
            self.success_step["pursuers"],
            self.length,
            self._occupied_angle,
            self._contributing_angle,
            self.contacts_pursuers,
            self.contacts_obstacles,
            self.returns,
            self._term_sums,
            rewards,
        )
        return rewards

    @property
    def contribution_spread(self) -> Array:
        """sigma_c: standard deviation over the pursuers of theta_c averaged over the round (Eq. 15) [rad], (B,)."""
        return self._spread(slice(None))

    def success_steps(self, world: int) -> dict[Closure, int | None]:
        """Return the step of one round, from 1, at which each rule first held; None if it has not."""
        return {rule: None if step[world] == NEVER else int(step[world]) for rule, step in self.success_step.items()}

    def summary(self, world: int) -> dict[str, float]:
        """Return one round's figures by the names under which they are logged."""
        length = max(int(self.length[world]), 1)
        return {
            "success_all": float(self.success_step["all"][world] != NEVER),
            "success_pursuers": float(self.success_step["pursuers"][world] != NEVER),
            "length": float(length),
            "occupied_angle": float(self._occupied_angle[world]) / length,
            "sigma_c": float(self._spread(slice(world, world + 1))[0]),
            "contacts_pursuers": float(self.contacts_pursuers[world]),
            "contacts_obstacles": float(self.contacts_obstacles[world]),
            **dict(zip((f"reward/{name}" for name in self._terms), self._term_sums[:, world].tolist(), strict=True)),
        }

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Return copies of all running figures by name."""
        arrays: dict[str, NDArray[Any]] = {f"success_{rule}": a for rule, a in self.success_step.items()}
        arrays |= {f"term_{name}": a for name, a in zip(self._terms, self._term_sums, strict=True)}
        for name in ("length", "returns", "contacts_pursuers", "contacts_obstacles"):
            arrays[name] = getattr(self, name)
        arrays |= {"occupied_angle": self._occupied_angle, "contributing_angle": self._contributing_angle}
        return {name: array.copy() for name, array in arrays.items()}

    def set_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what :meth:`get_state` returned."""
        self._terms = tuple(key.removeprefix("term_") for key in saved if key.startswith("term_"))
        self._term_sums = np.array([saved[f"term_{name}"] for name in self._terms]).reshape(-1, len(self.length))
        for rule, first in self.success_step.items():
            first[:] = saved[f"success_{rule}"]
        for name in ("length", "returns", "contacts_pursuers", "contacts_obstacles"):
            getattr(self, name)[:] = saved[name]
        self._occupied_angle[:] = saved["occupied_angle"]
        self._contributing_angle[:] = saved["contributing_angle"]

    def _spread(self, worlds: slice) -> Array:
        mean = self._contributing_angle[worlds] / np.maximum(self.length[worlds], 1)[:, None]
        spread: Array = mean.std(axis=1)
        return spread


@kernel
def _add(
    step: NDArray[np.int64],
    complete_all: NDArray[np.bool_],
    complete_pursuers: NDArray[np.bool_],
    occupied_angle: Array,
    contributing_angle: Array,
    contacts_pursuers: NDArray[np.int64],
    contacts_obstacles: NDArray[np.int64],
    shares: Array,
    over: NDArray[np.bool_],
    success_all: NDArray[np.int64],
    success_pursuers: NDArray[np.int64],
    length: NDArray[np.int64],
    occupied_angle_sum: Array,
    contributing_angle_sum: Array,
    contacts_pursuers_sum: NDArray[np.int64],
    contacts_obstacles_sum: NDArray[np.int64],
    returns: Array,
    term_sums: Array,
    rewards: Array,
) -> None:
    """Add one step's figures to those of the rounds that are not ``over``, and note first successes, in place.

    :param shares: (T * B, N), term by term
    :param term_sums: means over the pursuers, (T, B)
    :param rewards: to add up the shares in, of all rounds, (B, N)
    """
    n_worlds, n = returns.shape
    for b in range(n_worlds):
        if complete_all[b] and success_all[b] == NEVER:
            success_all[b] = step[b]
        if complete_pursuers[b] and success_pursuers[b] == NEVER:
            success_pursuers[b] = step[b]
        for t in range(len(term_sums)):
            for i in range(n):
                rewards[b, i] += shares[t * n_worlds + b, i]
        if over[b]:
            continue
        length[b] += 1
        occupied_angle_sum[b] += occupied_angle[b]
        for i in range(n):
            contributing_angle_sum[b, i] += contributing_angle[b, i]
            contacts_pursuers_sum[b] += contacts_pursuers[b, i]
            contacts_obstacles_sum[b] += contacts_obstacles[b, i]
            returns[b, i] += rewards[b, i]
        for t in range(len(term_sums)):
            total = 0.0
            for i in range(n):
                total += shares[t * n_worlds + b, i]
            term_sums[t, b] += total / n
