"""Oracles of the geometry: exact arcs by plane geometry, and the paper's sampled directions written as they read.

Both work on circles around obstacles and Apollonius circles (the corrected Eq. 1); neither knows of the inversion that
the fast kernel uses. Positions are relative to the target.
"""

import math
from itertools import combinations
from typing import NamedTuple

TURN = 2 * math.pi


class Circle(NamedTuple):
    x: float
    y: float
    radius: float
    owner: int


class Layout(NamedTuple):
    pursuers: tuple[tuple[float, float], ...]
    discs: tuple[tuple[float, float, float], ...]
    speed_ratio: float
    target_radius: float = 0.05


class Enclosed(NamedTuple):
    contributing_angle: list[float]
    occupied_angle: float
    movement_range: float
    arcs: list[int]
    """Number of separate arcs of each entity."""


def circles(layout: Layout) -> list[Circle]:
    """Apollonius circles A = l^2 P / (l^2 - 1), r = l d / (l^2 - 1), and discs that the target's centre meets."""
    ratio, square = layout.speed_ratio, layout.speed_ratio**2
    result = [
        Circle(x * square / (square - 1), y * square / (square - 1), ratio * math.hypot(x, y) / (square - 1), i)
        for i, (x, y) in enumerate(layout.pursuers)
    ]
    n = len(result)
    return result + [Circle(x, y, r + layout.target_radius, n + j) for j, (x, y, r) in enumerate(layout.discs)]


def first_hit(circle: Circle, angle: float) -> float:
    """Distance at which the ray at ``angle`` enters the circle, inf if it does not."""
    cos, sin = math.cos(angle), math.sin(angle)
    along, across = circle.x * cos + circle.y * sin, circle.x * sin - circle.y * cos
    if along <= 0 or abs(across) > circle.radius:
        return math.inf
    return along - math.sqrt(circle.radius**2 - across**2)


def breakpoints(all_circles: list[Circle]) -> list[float]:
    """Angles at which the owner can change: tangents from the target, and points where two circles cross, sorted."""
    angles = []
    for c in all_circles:
        bearing, half = math.atan2(c.y, c.x), math.asin(min(c.radius / math.hypot(c.x, c.y), 1.0))
        angles += [bearing - half, bearing + half]
    for a, b in combinations(all_circles, 2):
        dx, dy = b.x - a.x, b.y - a.y
        distance = math.hypot(dx, dy)
        touch = 1e-9  # where circles touch the owner changes hands too, or would but for rounding
        if not abs(a.radius - b.radius) - touch < distance < a.radius + b.radius + touch or distance == 0.0:
            continue
        along = (distance**2 + a.radius**2 - b.radius**2) / (2 * distance)
        across = math.sqrt(max(a.radius**2 - along**2, 0.0))
        for side in (-across, across):
            x = a.x + (along * dx - side * dy) / distance
            y = a.y + (along * dy + side * dx) / distance
            angles.append(math.atan2(y, x))
    return sorted(angle % TURN for angle in angles)


def exact(layout: Layout, *, obstacles_count: bool = True) -> Enclosed:
    everything = circles(layout)
    counted = everything if obstacles_count else everything[: len(layout.pursuers)]
    ends = breakpoints(counted)
    angle, area, arcs = [0.0] * len(everything), 0.0, [0] * len(everything)
    owners = []
    for start, stop in zip(ends, [*ends[1:], ends[0] + TURN], strict=True):
        nearest = min(counted, key=lambda c: first_hit(c, (start + stop) / 2))
        if stop - start < 1e-12:
            continue
        if first_hit(nearest, (start + stop) / 2) == math.inf:
            area = math.inf
            owners.append(-1)
            continue
        owners.append(nearest.owner)
        angle[nearest.owner] += stop - start
        area += _sector(nearest, start, stop)
    for owner, former in zip(owners, [owners[-1], *owners[:-1]], strict=True):
        if owner >= 0 and (owner != former or len(set(owners)) == 1):
            arcs[owner] += 1
    return Enclosed(angle, sum(angle), area, arcs)


def _sector(c: Circle, start: float, stop: float) -> float:
    """Area between the target and the circle's near arc: 1/2 of the integral of x dy - y dx along the arc (Green)."""
    ends = []
    for angle in (start, stop):
        cos, sin = math.cos(angle), math.sin(angle)
        along, across = c.x * cos + c.y * sin, c.x * sin - c.y * cos
        rho = along - math.sqrt(max(c.radius**2 - across**2, 0.0))
        ends.append(math.atan2(rho * sin - c.y, rho * cos - c.x))
    a, b = ends
    swept = (b - a + math.pi) % TURN - math.pi
    straight = c.x * (math.sin(b) - math.sin(a)) - c.y * (math.cos(b) - math.cos(a))
    return (c.radius**2 * swept + c.radius * straight) / 2


class Sampled(NamedTuple):
    owner: list[int]
    distance: list[float]
    contributing_angle: list[float]
    occupied_angle: float
    movement_range: float


def sampled(layout: Layout, n_directions: int, *, obstacles_count: bool = True) -> Sampled:
    """Eq. 8 and 9 word by word: sample directions, find the first one met in each, count."""
    entities = len(layout.pursuers) + len(layout.discs)
    owner, distance = [], []
    for k in range(n_directions):
        angle = k * TURN / n_directions
        met = [_ray_form(x, y, layout.speed_ratio, angle) for x, y in layout.pursuers]
        if obstacles_count:
            met += [first_hit(Circle(x, y, r + layout.target_radius, 0), angle) for x, y, r in layout.discs]
        nearest = min(range(len(met)), key=met.__getitem__)
        distance.append(met[nearest])
        owner.append(-1 if met[nearest] == math.inf else nearest)
    angles = [TURN / n_directions * owner.count(e) for e in range(entities)]
    area = sum(rho**2 for rho in distance) / 2 * TURN / n_directions
    return Sampled(owner, distance, angles, sum(angles), area)


def _ray_form(x: float, y: float, ratio: float, angle: float) -> float:
    phi = angle - math.atan2(y, x)
    inside = 1 - (ratio * math.sin(phi)) ** 2
    if inside < 0 or math.cos(phi) <= 0:
        return math.inf
    return ratio * math.hypot(x, y) / (ratio * math.cos(phi) + math.sqrt(inside))


def ring(n: int, distance: float, turn: float = 0.0) -> tuple[tuple[float, float], ...]:
    """The corners of a regular n-gon."""
    angles = [turn + TURN * i / n for i in range(n)]
    return tuple((distance * math.cos(a), distance * math.sin(a)) for a in angles)
