"""The scenario: everything about the world that the paper leaves open or varies, with default, unit and symbol."""

import math
import numbers
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from marl_encircle.core.dynamics import TARGETS
from marl_encircle.core.scenes import SCENES, discs_of

Extra = Literal["occupied_angle", "stage", "speed_ratio"]

MAX_COVER = 0.5
"""Share of the scene that bodies may cover; denser scenes cannot be drawn by random placement (jamming is at 0.547)."""

MAX_ENTITIES = 128
"""Most pursuers and obstacles together: a direction's owner is one byte."""


def _bounded(default: float, low: float, high: float = 1e6) -> Any:
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One world's rules. Lengths are in scene units (the paper's scene is 2 x 2), times in simulator time units.

    :param pursuers: number of pursuers n
    :param obstacles: number of obstacles m; a composite obstacle (concave, tunnel) is one
    :param scene: what an obstacle looks like, a name in ``SCENES``
    :param speed_ratio: lambda = target speed / pursuer speed
    :param max_cycles: steps after which a round is truncated
    :param half_width: the scene is the square [-half_width, half_width]^2; it bounds the bodies' centres
    :param movement_range_limit: delta_r, the area R_m below which a closed enclosure is complete [scene units^2]
    :param stage_threshold: delta_e, the share of the full circle at which contraction begins
    :param n_directions: K, the sampled directions of Eq. 8; even
    :param pursuer_radius: radius of a pursuer's body
    :param target_radius: radius of the target's body
    :param obstacle_radius: R, radius of an obstacle's body; the target's centre keeps out of R + target_radius.
        Composite obstacles scale with it
    :param time_step: dt
    :param max_speed: the pursuers' speed limit v_P [scene units per time unit]; 1.0 x 0.1 is the paper's 0.1 a step
    :param dynamics: ``second_order`` (an action is an acceleration, MPE) or ``first_order`` (an action is a velocity)
    :param acceleration: acceleration of a full action [scene units per time unit^2]
    :param damping: share of the velocity lost per step
    :param pursuer_mass: mass that contact forces act on
    :param integration: ``mpe`` (damp, accelerate, clip, move) or ``mpe2`` (move first, as PettingZoo >= 1.23)
    :param contacts: bodies push pursuers away ``soft`` (MPE's penalty force), ``hard`` (projection), or not: ``off``
    :param contact_force: stiffness of soft contacts
    :param contact_margin: softness of soft contacts
    :param turn_order: the target sees the pursuers after their move (``pursuers_first``) or before (``simultaneous``)
    :param target: how the target moves, a name in ``TARGETS``
    :param repulsion_power: the force of Eq. 14 falls with distance to this power: 2 as the text says, or 1 as printed
    :param repulsion_softening: added in quadrature to each distance of Eq. 14
    :param repulsion_from: distances of Eq. 14 are from the other body's ``centre`` or ``surface``
    :param wall_weight: weight of each of the four walls' forces in Eq. 14
    :param path_samples: samples along the target's path (Sec. 5.1)
    :param path_rule: ``literal`` (a sample within reach is invalid) or ``relaxed`` (only if it is also nearer than now)
    :param safety_distance: d_safe of the target to pursuers, centre to centre
    :param obstacle_margin: what the target keeps from obstacles beyond contact
    :param placement: initial bodies are ``separated`` or may be ``overlapping`` (MPE)
    :param obstacle_limit: obstacles' discs are centred within this share of the half width
    :param composite_unit: a composite obstacle is one unit with one observed centre; else each disc is an obstacle
    :param observe_directions: add the unit direction r / (norm(r) + direction_softening) of each relative position
    :param direction_softening: see ``observe_directions``
    :param observe_extras: further inputs: share of the circle occupied, stage, speed ratio
    :raises ValueError: for a value out of range, naming the field, the value and what is allowed
    """

    pursuers: int = _bounded(3, 1, 64)
    obstacles: int = _bounded(1, 0, 64)
    scene: str = "random"
    speed_ratio: float = _bounded(1.1, 1.0, 100.0)
    max_cycles: int = _bounded(60, 1, 100_000)
    half_width: float = _bounded(1.0, 1e-3, 1e3)
    movement_range_limit: float = _bounded(0.05, 1e-9)
    stage_threshold: float = _bounded(0.93, 0.0, 1.0)
    n_directions: int = _bounded(72, 8, 4096)

    pursuer_radius: float = _bounded(0.05, 0.0)
    target_radius: float = _bounded(0.05, 0.0)
    obstacle_radius: float = _bounded(0.2, 1e-6)

    time_step: float = _bounded(0.1, 1e-6)
    max_speed: float = _bounded(1.0, 1e-6)
    dynamics: Literal["second_order", "first_order"] = "second_order"
    acceleration: float = _bounded(3.0, 1e-6)
    damping: float = _bounded(0.25, 0.0, 1.0)
    pursuer_mass: float = _bounded(1.0, 1e-6)
    integration: Literal["mpe", "mpe2"] = "mpe"
    contacts: Literal["soft", "hard", "off"] = "soft"
    contact_force: float = _bounded(100.0, 0.0)
    contact_margin: float = _bounded(1e-3, 1e-9)
    turn_order: Literal["pursuers_first", "simultaneous"] = "simultaneous"

    target: str = "repulsion"
    repulsion_power: int = _bounded(2, 1, 2)
    repulsion_softening: float = _bounded(0.0, 0.0)
    repulsion_from: Literal["centre", "surface"] = "centre"
    wall_weight: float = _bounded(1.0, 0.0)
    path_samples: int = _bounded(10, 1, 1000)
    path_rule: Literal["literal", "relaxed"] = "literal"
    safety_distance: float = _bounded(0.11, 0.0)
    obstacle_margin: float = _bounded(0.0, 0.0)

    placement: Literal["separated", "overlapping"] = "separated"
    obstacle_limit: float = _bounded(0.9, 0.0, 1.0)
    composite_unit: bool = True

    observe_directions: bool = True
    direction_softening: float = _bounded(0.1, 1e-9)
    observe_extras: tuple[Extra, ...] = ()

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for f in fields(self):
            value = plain(getattr(self, f.name))
            _check(f.name, value, hints[f.name], f.metadata)
            # 1, 1.0 and NumPy's are one scenario, and one compilation
            object.__setattr__(self, f.name, hints[f.name](value) if hints[f.name] in (int, float) else value)
        if self.n_directions % 2:
            raise ValueError(f"n_directions must be even (each direction has its opposite); got {self.n_directions}")
        for name, known in (("scene", SCENES), ("target", TARGETS)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}; got {getattr(self, name)!r:.80}")
        if self.pursuers + self.units > MAX_ENTITIES:
            raise ValueError(
                f"too many obstacles: {self.pursuers} pursuers and {self.units} obstacles (each disc is one unless "
                f"composite_unit); at most {MAX_ENTITIES} together can be told apart"
            )
        if self.cover > MAX_COVER:
            raise ValueError(
                f"too many bodies to place: obstacles, pursuers and target cover {self.cover:.0%} of the scene; "
                f"at most {MAX_COVER:.0%} can be placed at random"
            )

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the pursuers, in slot order."""
        return tuple(f"pursuer_{i}" for i in range(self.pursuers))

    @property
    def discs(self) -> int:
        """Number D of discs that the obstacles consist of."""
        return self.obstacles * len(discs_of(self.scene))

    @property
    def units(self) -> int:
        """Number M of obstacles as the observation and the contributing angles count them."""
        return self.obstacles if self.composite_unit else self.discs

    @property
    def cover(self) -> float:
        """Share of the scene that all bodies cover; overlaps within a composite obstacle count twice."""
        obstacles = self._squared_radii * self.obstacle_radius**2
        others = self.pursuers * self.pursuer_radius**2 + self.target_radius**2
        return math.pi * (obstacles + others) / (2 * self.half_width) ** 2

    def obstacle_radius_at(self, cover: float) -> float:
        """Return the obstacle radius at which all bodies would cover so much of the scene; needs an obstacle.

        :param cover: share of the scene, see :attr:`cover`
        :return: radius [scene units]; 0.0 where pursuers and target alone cover more
        """
        others = self.pursuers * self.pursuer_radius**2 + self.target_radius**2
        obstacles = cover * (2 * self.half_width) ** 2 / math.pi - others
        return math.sqrt(max(0.0, obstacles) / self._squared_radii)

    @property
    def _squared_radii(self) -> float:
        """Sum of the squared radii of all obstacles' discs [obstacle radii^2]."""
        return self.obstacles * float((discs_of(self.scene)[:, 2] ** 2).sum())

    @property
    def solvable_without_obstacles(self) -> bool:
        """Whether the pursuers alone can close the circle: n >= pi / arcsin(1 / lambda), Eq. 6."""
        return self.pursuers >= math.pi / math.asin(1 / self.speed_ratio)


def plain(value: Any) -> Any:
    """Return a NumPy scalar as Python's own number, truth value or text; anything else as it is."""
    return value.item() if isinstance(value, np.generic) else value


def _check(name: str, value: object, hint: Any, metadata: Any) -> None:
    """Raise a ValueError unless ``value`` has the field's type and lies within its bounds."""
    if get_origin(hint) is Literal:
        if not isinstance(value, str) or value not in get_args(hint):
            raise ValueError(f"{name} must be one of {', '.join(map(str, get_args(hint)))}; got {value!r:.80}")
    elif hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        if isinstance(value, bool) or not isinstance(value, kind):
            raise ValueError(f"{name} must be {'an integer' if hint is int else 'a number'}; got {value!r:.80}")
        low, high = metadata["low"], metadata["high"]
        if not low <= value <= high:
            raise ValueError(f"{name} must be between {low:g} and {high:g}; got {value!r:.80}")
    elif get_origin(hint) is tuple:
        extras = get_args(Extra)
        if not isinstance(value, tuple) or any(not isinstance(extra, str) or extra not in extras for extra in value):
            raise ValueError(f"{name} must be a tuple of {', '.join(extras)}; got {value!r:.80}")
    elif not isinstance(value, hint):
        raise ValueError(f"{name} must be a {hint.__name__}; got {value!r:.80}")
