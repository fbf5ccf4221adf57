"""How pursuers and the target move in one step: MPE's physics, contacts, and the target's escape (Eq. 14, Sec. 5.1).

Every kernel loops over worlds and reads like the physics of one of them. ``worlds`` may be any subset of the batch.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel
from marl_encircle.core.scenario import Scenario

Array = NDArray[np.float64]
Worlds = NDArray[np.int64]
Constants = NDArray[np.void]
Physics = Any  # the one record of ``Constants``; its fields are the keys in ``physics_of``

FREE_OF_CONTACT = 36.0
"""A gap of this many contact margins: exp(-36) vanishes beside one in double precision."""

PROJECTION_PASSES = 4
"""Gauss-Seidel passes of hard contacts."""


def physics_of(scenario: Scenario) -> Constants:
    """Return the scenario's physics as an array of one record, whose scalars the kernels read by name."""
    values = {
        "half_width": scenario.half_width,
        "pursuer_radius": scenario.pursuer_radius,
        "target_radius": scenario.target_radius,
        "time_step": scenario.time_step,
        "max_speed": scenario.max_speed,
        "acceleration": scenario.acceleration,
        "damping": scenario.damping,
        "mass": scenario.pursuer_mass,
        "contact_force": scenario.contact_force,
        "contact_margin": scenario.contact_margin,
        "repulsion_power": scenario.repulsion_power,
        "repulsion_softening": scenario.repulsion_softening,
        "wall_weight": scenario.wall_weight,
        "obstacle_margin": scenario.obstacle_margin,
        "movement_range_limit": scenario.movement_range_limit,
        "stage_threshold": scenario.stage_threshold,
        "direction_softening": scenario.direction_softening,
        "path_samples": scenario.path_samples,
        "units": scenario.units,
        "first_order": scenario.dynamics == "first_order",
        "move_first": scenario.integration == "mpe2",
        "soft_contacts": scenario.contacts == "soft",
        "hard_contacts": scenario.contacts == "hard",
        "from_surface": scenario.repulsion_from == "surface",
        "relaxed_path": scenario.path_rule == "relaxed",
    }
    fields = [(name, type(value)) for name, value in values.items()]
    # A record rather than a void, so that plain Python (NUMBA_DISABLE_JIT) reads fields by name too.
    return np.array([tuple(values.values())], dtype=(np.record, fields))


@kernel
def first_bad_action(actions: Array) -> int:
    """Return the slot (world * N + pursuer) of the first action that is not finite, or -1."""
    for b in range(actions.shape[0]):
        for i in range(actions.shape[1]):
            if not (np.isfinite(actions[b, i, 0]) and np.isfinite(actions[b, i, 1])):
                return int(b * actions.shape[1] + i)
    return -1


@kernel
def move_pursuers(
    worlds: Worlds,
    actions: Array,
    pursuers: Array,
    velocities: Array,
    target: Array,
    discs: Array,
    constants: Constants,
) -> None:
    """Move all pursuers of ``worlds`` by one step, in place.

    MPE's second-order dynamics: v <- (1 - damping) v + (acceleration a + F / mass) dt, clipped to the limit, then
    x <- x + v dt. ``mpe2`` moves with the old velocity. First order: v = v_P a + F dt / mass. Actions beyond [-1, 1] are
    clipped. Soft contacts F push pursuers off each other, the target and the obstacles; the scene's edge stops the
    velocity across it.

    :param actions: (B, N, 2) in [-1, 1]
    :param pursuers: positions [scene units], (B, N, 2)
    :param velocities: [scene units per time unit], (B, N, 2)
    :param target: (B, 2)
    :param discs: x, y, radius of the obstacles' discs, (B, D, 3)
    :param constants: see :func:`physics_of`
    """
    physics = constants[0]
    n = pursuers.shape[1]
    dt = physics.time_step
    moved = np.empty((n, 2))
    for b in worlds:
        for i in range(n):
            fx, fy = 0.0, 0.0
            if physics.soft_contacts:
                fx, fy = _contact_force(b, i, pursuers, target, discs, physics)
            ax = min(max(actions[b, i, 0], -1.0), 1.0)
            ay = min(max(actions[b, i, 1], -1.0), 1.0)
            old_vx, old_vy = velocities[b, i, 0], velocities[b, i, 1]
            if physics.first_order:
                vx = physics.max_speed * ax + fx / physics.mass * dt
                vy = physics.max_speed * ay + fy / physics.mass * dt
            else:
                vx = (1 - physics.damping) * old_vx + (physics.acceleration * ax + fx / physics.mass) * dt
                vy = (1 - physics.damping) * old_vy + (physics.acceleration * ay + fy / physics.mass) * dt
            speed = np.sqrt(vx * vx + vy * vy)
            if speed > physics.max_speed:
                vx *= physics.max_speed / speed
                vy *= physics.max_speed / speed
            velocities[b, i, 0] = vx
            velocities[b, i, 1] = vy
            moved[i, 0] = pursuers[b, i, 0] + (old_vx if physics.move_first else vx) * dt
            moved[i, 1] = pursuers[b, i, 1] + (old_vy if physics.move_first else vy) * dt
        pursuers[b] = moved
        if physics.hard_contacts:
            _separate(b, pursuers, target, discs, physics)
        for i in range(n):
            for axis in range(2):
                if abs(pursuers[b, i, axis]) > physics.half_width:
                    pursuers[b, i, axis] = np.copysign(physics.half_width, pursuers[b, i, axis])
                    velocities[b, i, axis] = 0.0


@kernel
def _contact_force(
    b: int, i: int, pursuers: Array, target: Array, discs: Array, physics: Physics
) -> tuple[float, float]:
    """Return the sum of MPE's contact forces on pursuer i of world b."""
    x, y = pursuers[b, i, 0], pursuers[b, i, 1]
    fx, fy = 0.0, 0.0
    for j in range(pursuers.shape[1]):
        if j != i:
            side = 1.0 if i < j else -1.0
            px, py = _push(x - pursuers[b, j, 0], y - pursuers[b, j, 1], 2 * physics.pursuer_radius, side, physics)
            fx += px
            fy += py
    px, py = _push(x - target[b, 0], y - target[b, 1], physics.pursuer_radius + physics.target_radius, 1.0, physics)
    fx += px
    fy += py
    for d in range(discs.shape[1]):
        reach = physics.pursuer_radius + discs[b, d, 2]
        px, py = _push(x - discs[b, d, 0], y - discs[b, d, 1], reach, 1.0, physics)
        fx += px
        fy += py
    return fx, fy


@kernel
def _push(dx: float, dy: float, reach: float, side: float, physics: Physics) -> tuple[float, float]:
    """Return the force along (dx, dy): stiffness x margin x log(1 + exp(penetration / margin)), MPE's penalty.

    Coincident bodies are pushed along x, one to each ``side``; MPE divides by zero there.
    """
    free = reach + FREE_OF_CONTACT * physics.contact_margin
    if dx * dx + dy * dy > free * free:
        return 0.0, 0.0
    distance = np.sqrt(dx * dx + dy * dy)
    depth = (reach - distance) / physics.contact_margin
    softplus = depth if depth > FREE_OF_CONTACT else np.log1p(np.exp(depth))
    force = physics.contact_force * physics.contact_margin * softplus
    if distance == 0.0:
        return side * force, 0.0
    return force * dx / distance, force * dy / distance


@kernel
def _separate(b: int, pursuers: Array, target: Array, discs: Array, physics: Physics) -> None:
    """Project overlapping bodies apart: pursuers share a correction, target and obstacles do not yield."""
    n = pursuers.shape[1]
    radius = physics.pursuer_radius
    for _ in range(PROJECTION_PASSES):
        for i in range(n):
            for j in range(i):
                dx, dy = pursuers[b, i, 0] - pursuers[b, j, 0], pursuers[b, i, 1] - pursuers[b, j, 1]
                sx, sy = _overlap(dx, dy, 2 * radius)
                pursuers[b, i, 0] += sx / 2
                pursuers[b, i, 1] += sy / 2
                pursuers[b, j, 0] -= sx / 2
                pursuers[b, j, 1] -= sy / 2
            dx, dy = pursuers[b, i, 0] - target[b, 0], pursuers[b, i, 1] - target[b, 1]
            sx, sy = _overlap(dx, dy, radius + physics.target_radius)
            pursuers[b, i, 0] += sx
            pursuers[b, i, 1] += sy
            for d in range(discs.shape[1]):
                dx, dy = pursuers[b, i, 0] - discs[b, d, 0], pursuers[b, i, 1] - discs[b, d, 1]
                sx, sy = _overlap(dx, dy, radius + discs[b, d, 2])
                pursuers[b, i, 0] += sx
                pursuers[b, i, 1] += sy


@kernel
def _overlap(dx: float, dy: float, reach: float) -> tuple[float, float]:
    """Return the shortest shift along (dx, dy) that ends an overlap."""
    distance = np.sqrt(dx * dx + dy * dy)
    if distance >= reach:
        return 0.0, 0.0
    if distance == 0.0:
        return reach, 0.0
    return (reach - distance) * dx / distance, (reach - distance) * dy / distance


@kernel
def repulsion(
    worlds: Worlds,
    pursuers: Array,
    target: Array,
    discs: Array,
    speed_ratio: Array,
    safety_distance: Array,
    constants: Constants,
) -> None:
    """Move the target of ``worlds`` away from everything, in place: Eq. 14 as its text says.

    The sum of (T - X) / d^(power + 1) over pursuers, obstacles and the foot points on the four walls gives the
    direction (Eq. 14 as printed attracts). An obstacle of several discs weighs as much as one of one disc.

    :param pursuers: the positions that the target sees, (B, N, 2)
    :param target: (B, 2)
    :param discs: (B, D, 3)
    :param speed_ratio: lambda, (B,)
    :param safety_distance: d_safe, (B,)
    :param constants: see :func:`physics_of`
    """
    physics = constants[0]
    weight = physics.units / max(discs.shape[1], 1)
    half = physics.half_width
    for b in worlds:
        x, y = target[b, 0], target[b, 1]
        fx, fy = 0.0, 0.0
        for i in range(pursuers.shape[1]):
            px, py = _repel(x - pursuers[b, i, 0], y - pursuers[b, i, 1], physics.pursuer_radius, physics)
            fx += px
            fy += py
        for d in range(discs.shape[1]):
            px, py = _repel(x - discs[b, d, 0], y - discs[b, d, 1], discs[b, d, 2], physics)
            fx += weight * px
            fy += weight * py
        fx += physics.wall_weight * (_repel(x + half, 0.0, 0.0, physics)[0] + _repel(x - half, 0.0, 0.0, physics)[0])
        fy += physics.wall_weight * (_repel(0.0, y + half, 0.0, physics)[1] + _repel(0.0, y - half, 0.0, physics)[1])
        _follow_path(b, fx, fy, pursuers, target, discs, speed_ratio[b], safety_distance[b], physics)


@kernel
def _repel(dx: float, dy: float, radius: float, physics: Physics) -> tuple[float, float]:
    """Return the force at (dx, dy) from a body: along (dx, dy), falling with distance to the power."""
    centre = np.sqrt(dx * dx + dy * dy)
    gap = centre - (radius + physics.target_radius) * physics.from_surface
    softened = np.sqrt(max(gap, 1e-6) ** 2 + physics.repulsion_softening**2)
    fall = softened * softened if physics.repulsion_power == 2 else softened
    force = 1.0 / (fall * max(centre, 1e-6))
    return force * dx, force * dy


@kernel
def still(
    worlds: Worlds,
    pursuers: Array,
    target: Array,
    discs: Array,
    speed_ratio: Array,
    safety_distance: Array,
    constants: Constants,
) -> None:
    """Leave the target where it is: a scene in which only the pursuers move."""


@kernel
def _follow_path(
    b: int,
    fx: float,
    fy: float,
    pursuers: Array,
    target: Array,
    discs: Array,
    speed_ratio: float,
    safety_distance: float,
    physics: Physics,
) -> None:
    """Move the target along (fx, fy) to the farthest sample before the first invalid one (Sec. 5.1).

    A sample is invalid within ``safety_distance`` of a pursuer, in contact with an obstacle, or outside. Under
    the relaxed rule a sample near a body is valid if the target comes no nearer to it than it is now.
    """
    force = np.sqrt(fx * fx + fy * fy)
    if not force > 0.0:
        return
    stride = speed_ratio * physics.max_speed * physics.time_step / physics.path_samples
    sx, sy = stride * fx / force, stride * fy / force
    x, y = target[b, 0], target[b, 1]
    reached = 0
    for s in range(1, physics.path_samples + 1):
        tx, ty = x + s * sx, y + s * sy
        valid = abs(tx) <= physics.half_width and abs(ty) <= physics.half_width
        for i in range(pursuers.shape[1]):
            px, py = pursuers[b, i, 0], pursuers[b, i, 1]
            valid &= _is_valid(tx - px, ty - py, x - px, y - py, safety_distance, physics.relaxed_path)
        for d in range(discs.shape[1]):
            px, py = discs[b, d, 0], discs[b, d, 1]
            reach = discs[b, d, 2] + physics.target_radius + physics.obstacle_margin
            valid &= _is_valid(tx - px, ty - py, x - px, y - py, reach, physics.relaxed_path)
        if not valid:
            break
        reached = s
    target[b, 0] = x + reached * sx
    target[b, 1] = y + reached * sy


@kernel
def _is_valid(dx: float, dy: float, now_x: float, now_y: float, reach: float, relaxed: bool) -> bool:
    square = dx * dx + dy * dy
    return square >= reach * reach or (relaxed and square >= now_x * now_x + now_y * now_y)


TARGETS: dict[str, Callable[..., None]] = {"repulsion": repulsion, "still": still}
"""How the target may move, by the name in ``Scenario.target``."""
