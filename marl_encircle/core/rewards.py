"""Reward terms: one function each on a batch of transitions, and the weighted sum of those that a method uses.

A term gets its weight, its parameters and its name in the logs from the reward's YAML line of the same name.
"""

import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import Closure, Enclosure, Measure
from marl_encircle.core.scenario import Scenario, plain
from marl_encircle.core.simulator import State
from marl_encircle.spelling import nearest

Array = NDArray[np.float64]

CIRCLE = 2 * np.pi


class Transition(NamedTuple):
    """One step of B worlds, as reward terms see it."""

    scenario: Scenario
    state: State
    """After the step."""
    actions: Array
    """What the pursuers did, in [-1, 1], (B, N, 2)."""
    measure: Measure
    """After the step."""
    former_measure: Measure
    """Before the step."""
    closure: Closure
    """Which enclosure the method works with."""

    @property
    def enclosure(self) -> Enclosure:
        """The enclosure after the step, under the method's closure rule."""
        return self.measure.enclosure[self.closure]

    @property
    def pursuers(self) -> int:
        """N."""
        return self.scenario.pursuers


def overall_angle(t: Transition) -> Array:
    """Share of the full circle that is occupied: r_A of Eq. 12. In [0, 1], the same for all pursuers, (B, N)."""
    return _for_all(t, t.enclosure.occupied_angle / CIRCLE)


def contributing_angle(t: Transition) -> Array:
    """Share of the circle that each pursuer contributes, times N: r_c of Eq. 12.

    Eq. 8 gives the angle. The factor makes the mean over pursuers comparable to r_A. In [0, N], (B, N).
    """
    return t.pursuers * t.enclosure.contributing_angle[:, : t.pursuers] / CIRCLE


def obstacle_angle(t: Transition) -> Array:
    """Share of the circle that all obstacles contribute: r_o of Eq. 12. In [0, 1], (B, N)."""
    return _for_all(t, np.add.reduce(t.enclosure.contributing_angle[:, t.pursuers :], axis=1) / CIRCLE)


def contraction(t: Transition, *, cap: float = 20 / 3) -> Array:
    """Inverse distance to the target: r_d of Eq. 13 [1 / scene units], (B, N).

    :param cap: highest reward, so that closeness beyond 1 / cap brings nothing
    """
    return np.minimum(1.0 / np.maximum(t.measure.target_distance, 1e-9), cap)


def collision(t: Transition) -> Array:
    """Minus the number of bodies that each pursuer touches: r_a of Eq. 11, (B, N)."""
    m = t.measure
    return -(m.contacts_pursuers + m.contacts_target + m.contacts_obstacles).astype(np.float64)


def completion(t: Transition) -> Array:
    """1 when the encirclement is complete: r_done of Eq. 11, (B, N)."""
    return _for_all(t, t.enclosure.complete.astype(np.float64))


def time(t: Transition) -> Array:
    """-1 at every step, (B, N).

    Not in the paper: success ends a round, so that a positive reward at every step would teach to put it off.
    """
    return np.full(t.measure.target_distance.shape, -1.0)


def encirclement_radius(t: Transition, *, radius: float = 0.15) -> Array:
    """Minus the distance from a ring around the target (Ma et al. 2019) [scene units], (B, N).

    :param radius: of the ring. Their 0.25 makes R_m < 0.05 impossible for three pursuers
    """
    return -np.abs(t.measure.target_distance - radius)


def phase_difference(t: Transition) -> Array:
    """Minus how far each pursuer is from the middle of its two neighbours around the target (Ma et al. 2019).

    Neighbours are those next in angle. As a share of the half circle, in [-1, 0], (B, N); 0 for a single pursuer.
    """
    offset = t.state.pursuers - t.state.target[:, None]
    phase = np.arctan2(offset[..., 1], offset[..., 0])
    order = np.argsort(phase, axis=1, kind="stable")
    gap = np.diff(np.take_along_axis(phase, order, 1), axis=1, append=0.0)
    gap[:, -1] = CIRCLE - gap[:, :-1].sum(axis=1)
    imbalance = np.abs(gap - np.roll(gap, 1, axis=1)) / 2
    out = np.empty_like(phase)
    np.put_along_axis(out, order, -imbalance / np.pi, 1)
    return out


def _for_all(t: Transition, shared: Array) -> Array:
    return shared[:, None].repeat(t.pursuers, axis=1)


TERMS: dict[str, Callable[..., Array]] = {
    "overall_angle": overall_angle,
    "contributing_angle": contributing_angle,
    "obstacle_angle": obstacle_angle,
    "contraction": contraction,
    "collision": collision,
    "completion": completion,
    "time": time,
    "encirclement_radius": encirclement_radius,
    "phase_difference": phase_difference,
}
"""Reward terms by name; a term takes a :class:`Transition` and returns (B, N).

One's own is added by assignment, ``TERMS["approach"] = approach``, before the configuration that names it is loaded.
"""

CONTRACTION_STAGE = frozenset({"contraction", "completion"})
"""Terms that a two-stage reward gives only from the stage threshold on (Eq. 11)."""

OURS: Mapping[str, float] = {
    "overall_angle": 1.0,
    "contributing_angle": 1.0,
    "obstacle_angle": 0.5,
    "contraction": 1.0,
    "collision": 0.5,
    "completion": 50.0,
    "time": 8.0,
}
"""The paper's method; ``ablations/ours.yaml`` holds the same weights."""


@dataclass(frozen=True)
class Reward:
    """A method's reward: the weighted sum of its terms (Eq. 11).

    :param terms: weight of each term, or its ``weight`` and parameters; a term whose weight is None is not called
    :param closure: which enclosure counts, in the terms and for success: with obstacles (``all``) or ``pursuers`` alone
    :param two_stage: whether contraction and completion wait for the stage threshold (the lion method)
    :param scale: factor of the whole reward
    :raises ValueError: for an unknown term or parameter, naming the nearest known one; for a term without weight, a
        number that is not finite or an unknown closure rule
    """

    terms: Mapping[str, float | Mapping[str, float] | None] = field(default_factory=lambda: dict(OURS))
    closure: Closure = "all"
    two_stage: bool = True
    scale: float = 0.05

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, plain(getattr(self, f.name)))
        if self.closure not in get_args(Closure):
            raise ValueError(f"closure must be one of {', '.join(get_args(Closure))}; got {self.closure!r:.80}")
        _check_finite("scale", self.scale)
        if not isinstance(self.terms, Mapping):
            raise ValueError(f"terms must be a mapping of terms to their weights; got {self.terms!r:.80}")
        terms: dict[str, Any] = {}
        for name, term in self.terms.items():
            terms[name] = {k: plain(v) for k, v in term.items()} if isinstance(term, Mapping) else plain(term)
            _check(name, terms[name])
        object.__setattr__(self, "terms", terms)

    @cached_property
    def active(self) -> dict[str, tuple[float, dict[str, float]]]:
        """Weight and parameters of the terms that are called, in the order of ``TERMS``."""
        result = {}
        for name in TERMS:
            term = self.terms.get(name)
            settings: dict[str, Any] = dict(term) if isinstance(term, Mapping) else {"weight": term}
            weight = settings.pop("weight")
            if weight is not None:
                result[name] = (float(weight), settings)
        return result

    def parts(self, t: Transition) -> dict[str, Array]:
        """Return each term's share of the reward, (B, N) each.

        :raises ValueError: if a term returns anything else
        """
        shape, gate = t.measure.target_distance.shape, None
        if self.two_stage:
            gate = t.enclosure.occupies(t.scenario.stage_threshold)[:, None]
        shares = {}
        for name, (weight, parameters) in self.active.items():
            value = TERMS[name](t, **parameters)
            if getattr(value, "shape", None) != shape:
                raise ValueError(f"terms.{name} must return an array (B, N), here {shape}; got {np.shape(value)}")
            share = (self.scale * weight) * value
            shares[name] = share * gate if gate is not None and name in CONTRACTION_STAGE else share
        return shares


def _check(name: str, term: Any) -> None:
    """Raise a ValueError unless this is a term's weight, or its weight and parameters."""
    if name not in TERMS:
        raise ValueError(f"terms.{name:.80}: unknown reward term{nearest(name, TERMS)}")
    settings = term if isinstance(term, Mapping) else {"weight": term}
    known = ("weight", *list(inspect.signature(TERMS[name]).parameters)[1:])
    for key, value in settings.items():
        if key not in known:
            raise ValueError(f"terms.{name}.{key:.80}: unknown parameter{nearest(key, known)}")
        if key != "weight" or value is not None:
            _check_finite(f"terms.{name}.{key}", value)
    if "weight" not in settings:
        raise ValueError(f"terms.{name} needs a weight")


def _check_finite(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name} must be a finite number; got {value!r:.80}")
