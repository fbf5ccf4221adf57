"""Outlines of what an enclosure consists of, for every way of drawing it: numbers only."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import NOBODY

Array = NDArray[np.float64]


class Wedge(NamedTuple):
    """Neighbouring directions with one owner, and how far the target gets along them. L directions and two borders."""

    owner: int
    angles: Array
    """Of its first border, its directions and its last border [rad], (L + 2,)."""
    distances: Array
    """How far the target gets there [scene units], (L + 2,)."""


def stretches(owner: NDArray[np.int8]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each stretch of neighbouring directions with one owner; numbers go on beyond the full circle.

    :param owner: of each direction, (K,)
    """
    changes = np.flatnonzero(owner != np.roll(owner, 1))
    starts = changes.tolist() or [0]
    for start, end in zip(starts, [*starts[1:], starts[0] + len(owner)], strict=True):
        yield int(owner[start]), np.arange(start, end)


def borders(directions: NDArray[np.int64], count: int) -> Array:
    """Return the angles of a stretch of directions, and of its two borders.

    :param directions: numbers of neighbouring directions, (L,)
    :param count: K
    :return: [rad], (L + 2,)
    """
    return np.concatenate([[directions[0] - 0.5], directions, [directions[-1] + 0.5]]) * (2 * np.pi / count)


def wedges(owner: NDArray[np.int8], distance: Array, closed: bool) -> Iterator[Wedge]:
    """Yield what the target can reach before it is met, owner by owner.

    :param owner: of each direction, (K,)
    :param distance: how far away the owner is met [scene units], (K,)
    :param closed: whether every direction has an owner; neighbours then meet half-way
    """
    count = len(owner)
    for entity, directions in stretches(owner):
        if entity == NOBODY:
            continue
        distances = distance[directions % count]
        ends = distances[[0, -1]]
        if closed:
            ends = (ends + distance[[directions[0] - 1, (directions[-1] + 1) % count]]) / 2
        yield Wedge(entity, borders(directions, count), np.concatenate([ends[:1], distances, ends[1:]]))


def facing_arc(offset: Array, speed_ratio: float) -> tuple[Array, Array]:
    """Return the part of a pursuer's Apollonius circle that faces the target, from tangent to tangent.

    :param offset: from the target to the pursuer, not zero [scene units], (2,)
    :param speed_ratio: lambda
    :return: angles [rad] and distances from the target [scene units], (181,) each
    """
    widest = math.asin(1 / speed_ratio)
    phi = widest * np.sin(np.linspace(-np.pi / 2, np.pi / 2, 181))  # closest where the arc leaves along the tangent
    root = np.sqrt(np.maximum(1 - (speed_ratio * np.sin(phi)) ** 2, 0.0))
    distance = speed_ratio * float(np.hypot(*offset)) / (speed_ratio * np.cos(phi) + root)
    return phi + math.atan2(offset[1], offset[0]), distance


def far_arc(offset: Array, speed_ratio: float) -> tuple[Array, Array]:
    """Return the rest of the circle: where the same rays leave it; inf where lambda is 1 and the circle a line.

    :param offset: from the target to the pursuer, not zero [scene units], (2,)
    :param speed_ratio: lambda
    :return: angles [rad] and distances from the target [scene units], (181,) each
    """
    angles, near = facing_arc(offset, speed_ratio)
    with np.errstate(divide="ignore"):
        power = np.float64(offset @ offset) / (1 - 1 / np.float64(speed_ratio) ** 2)  # of the target: near times far
    return angles, power / near


def polar(centre: Array, angles: NDArray[np.floating[Any]], distances: Array) -> Array:
    """Return the places at these angles and distances from a centre, (L, 2).

    :param centre: (2,)
    :param angles: [rad], (L,)
    :param distances: (L,)
    """
    places: Array = centre + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return places
