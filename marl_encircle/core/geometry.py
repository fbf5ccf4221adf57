"""Who encloses the target, seen along rays from it: Apollonius circles, contributing angles, movement range (Eq. 1-9).

A ray at angle phi off the bearing of a pursuer at distance d first meets its Apollonius circle (the points that target
and pursuer reach at the same time) at

    rho = lambda d / (lambda cos phi + sqrt(1 - lambda^2 sin^2 phi)),   |phi| <= arcsin(1 / lambda).

This ray form stays accurate where the circle's centre and radius lose all digits (lambda near 1); Eq. 1 as printed has
pursuer and target swapped. Read as nearness 1 / rho it says that inversion about the target turns the Apollonius circle
into the circle around P / d^2 of radius 1 / (lambda d), and an obstacle's disc (Q, R) into the one around
Q / (d^2 - R^2) of radius R / (d^2 - R^2). So both are met by the same formula, without a division or a
branch in the loop over directions, the first thing met is the one of largest nearness, and 0 means that nothing is met.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel
from marl_encircle.core.dynamics import Physics

Array = NDArray[np.float64]

Closure = Literal["all", "pursuers"]
"""Who counts for the enclosure: pursuers and obstacles, or the pursuers alone."""

TINY = 1e-12
"""Least distance [scene units], and least d^2 - R^2, that is told from contact."""

NOBODY = -1
"""Owner of a direction in which the target meets nothing."""


class Enclosure(NamedTuple):
    """What surrounds the target under one closure rule. B worlds, K directions, N pursuers, M obstacles.

    Views of the simulator's buffers: valid until the step after the next.
    """

    owner: NDArray[np.int8]
    """The contributor of each direction: pursuers 0..N-1, obstacles N..N+M-1, or ``NOBODY``, (B, K)."""
    nearness: Array
    """1 / distance to the contributor along each direction, 0 where nobody is met [1 / scene units], (B, K)."""
    contributing_angle: Array
    """theta_c of every pursuer and obstacle, Eq. 8 [rad], (B, N + M)."""
    occupied_angle: Array
    """Their sum: theta_A with obstacles (Eq. 9), theta_G without (Eq. 5) [rad], (B,)."""
    movement_range: Array
    """R_m, the area that the target can reach unmet; inf unless closed [scene units^2], (B,)."""
    complete: NDArray[np.bool_]
    """Whether it is closed and R_m < delta_r: the encirclement has succeeded, (B,)."""

    @property
    def distance(self) -> Array:
        """Way to the contributor along each direction, inf where nobody is met [scene units], (B, K)."""
        with np.errstate(divide="ignore", over="ignore"):
            return 1.0 / self.nearness

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Whether every sampled direction has a contributor, (B,)."""
        return np.isfinite(self.movement_range)

    def occupies(self, share: float) -> NDArray[np.bool_]:
        """Whether at least this share of the circle is occupied, rounding aside, (B,)."""
        return self.occupied_angle >= 2 * np.pi * share - 1e-9


class Measure(NamedTuple):
    """Everything that rewards, metrics and drawings know of a state."""

    enclosure: dict[Closure, Enclosure]
    """``all``: obstacles count; ``pursuers``: they are looked through."""
    target_distance: Array
    """Distance d_i of each pursuer to the target [scene units], (B, N)."""
    contacts_pursuers: NDArray[np.int64]
    """Number of other pursuers each one touches, (B, N)."""
    contacts_target: NDArray[np.int64]
    """1 where a pursuer touches the target, (B, N)."""
    contacts_obstacles: NDArray[np.int64]
    """Number of obstacles' discs each pursuer touches, (B, N)."""


def half_circle(n_directions: int) -> Array:
    """Return unit vectors of the first half of n directions from x on; the others are opposite, (2, K/2)."""
    angle = np.arange(n_directions // 2) * (2 * np.pi / n_directions)
    return np.stack([np.cos(angle), np.sin(angle)])


@kernel
def enclose(
    b: int,
    pursuers: Array,
    target: Array,
    discs: Array,
    speed_ratio: float,
    rays: Array,
    physics: Physics,
    owner: NDArray[np.int8],
    nearness: Array,
    contributing_angle: Array,
    occupied_angle: Array,
    movement_range: Array,
    complete: NDArray[np.bool_],
    target_distance: Array,
    contacts: NDArray[np.int64],
    met: Array,
) -> None:
    """Measure world b: fill in its row of the fields of :class:`Enclosure` and :class:`Measure`.

    ``owner`` to ``contacts`` are filled in. Their first axis, 2 long, is the closure rule (all, pursuers), or in
    ``contacts``, 3 long, what is touched (pursuers, target, obstacles).

    :param pursuers: (B, N, 2)
    :param target: (B, 2)
    :param discs: (B, D, 3)
    :param speed_ratio: lambda
    :param rays: see :func:`half_circle`, (2, K/2)
    :param physics: see :func:`marl_encircle.core.dynamics.physics_of`
    :param met: scratch, (K,)
    """
    n, n_directions = pursuers.shape[1], len(met)
    discs_per_unit = discs.shape[1] // max(contributing_angle.shape[2] - n, 1)
    for k in range(n_directions):
        owner[1, b, k], nearness[1, b, k] = NOBODY, 0.0
    for i in range(n):
        x, y = pursuers[b, i, 0] - target[b, 0], pursuers[b, i, 1] - target[b, 1]
        square = x * x + y * y
        target_distance[b, i] = np.sqrt(square)
        if square < TINY * TINY:  # a pursuer on the target has no bearing; it blocks a cone around the x axis
            x, y, square = TINY, 0.0, TINY * TINY
        _meet(x / square, y / square, (1.0 - 1.0 / (speed_ratio * speed_ratio)) / square, rays, met)
        _keep_nearest(i, met, nearness[1, b], owner[1, b])
    for k in range(n_directions):
        owner[0, b, k], nearness[0, b, k] = owner[1, b, k], nearness[1, b, k]
    for d in range(discs.shape[1]):
        x, y = discs[b, d, 0] - target[b, 0], discs[b, d, 1] - target[b, 1]
        reach = discs[b, d, 2] + physics.target_radius
        scale = 1.0 / max(x * x + y * y - reach * reach, TINY)
        _meet(x * scale, y * scale, scale, rays, met)
        _keep_nearest(n + d // discs_per_unit, met, nearness[0, b], owner[0, b])
    for rule in range(2):
        owned = _share_out(owner[rule, b], contributing_angle[rule, b])
        occupied_angle[rule, b] = owned * (2 * np.pi / n_directions)
        movement_range[rule, b] = _area(nearness[rule, b]) if owned == n_directions else np.inf
        complete[rule, b] = movement_range[rule, b] < physics.movement_range_limit
    _count_contacts(b, pursuers, discs, target_distance, physics, contacts)


@kernel
def _meet(x: float, y: float, square_tangent: float, rays: Array, met: Array) -> None:
    """Fill in the nearness at which each direction meets the inverted circle around (x, y); nan or 0 if not at all.

    The target's tangents to the inverted circle give it without the radius, which loses digits at ratios near 1:
    sqrt(1 - 1 / lambda^2) / d for a pursuer, 1 / sqrt(d^2 - R^2) for a disc. A line through the target meets it on one
    side only, so that a direction and its opposite share the square root.
    """
    half = rays.shape[1]
    ahead, behind = met[:half], met[half:]
    for k in range(half):
        along = rays[0, k] * x + rays[1, k] * y
        root = np.sqrt(along * along - square_tangent)
        ahead[k] = root + along if along > 0.0 else 0.0
        behind[k] = root - along if along < 0.0 else 0.0


@kernel
def _keep_nearest(entity: int, met: Array, nearness: Array, owner: NDArray[np.int8]) -> None:
    """Give ``entity`` the directions in which it is met before all earlier ones."""
    for k in range(len(met)):
        nearer = met[k] > nearness[k]  # false for nan
        nearness[k] = met[k] if nearer else nearness[k]
        owner[k] = entity if nearer else owner[k]


@kernel
def _share_out(owner: NDArray[np.int8], contributing_angle: Array) -> int:
    """Fill in the contributing angle of every entity (Eq. 8) and return how many directions have an owner (Eq. 9)."""
    owned = 0
    for e in range(len(contributing_angle)):
        count = 0
        for k in range(len(owner)):
            count += owner[k] == e
        contributing_angle[e] = count * (2 * np.pi / len(owner))
        owned += count
    return owned


@kernel
def _area(nearness: Array) -> float:
    """Return the area R_m = 1/2 (2 pi / K) sum rho^2 of a closed enclosure."""
    total = 0.0
    for k in range(len(nearness)):
        total += 1.0 / (nearness[k] * nearness[k])
    return total * np.pi / len(nearness)


@kernel
def _count_contacts(
    b: int, pursuers: Array, discs: Array, target_distance: Array, physics: Physics, contacts: NDArray[np.int64]
) -> None:
    """Count the bodies that each pursuer overlaps."""
    n = pursuers.shape[1]
    radius = physics.pursuer_radius
    for i in range(n):
        touched = 0
        for j in range(n):
            dx, dy = pursuers[b, i, 0] - pursuers[b, j, 0], pursuers[b, i, 1] - pursuers[b, j, 1]
            touched += j != i and dx * dx + dy * dy < 4 * radius * radius
        contacts[0, b, i] = touched
        contacts[1, b, i] = target_distance[b, i] < radius + physics.target_radius
        touched = 0
        for d in range(discs.shape[1]):
            dx, dy = pursuers[b, i, 0] - discs[b, d, 0], pursuers[b, i, 1] - discs[b, d, 1]
            reach = radius + discs[b, d, 2]
            touched += dx * dx + dy * dy < reach * reach
        contacts[2, b, i] = touched
