"""How pursuers and the target move in one step: MPE's physics, contacts, and the target's escape (Eq. 14, Sec. 5.1).

Every kernel moves one world, b, of the batch in place and reads like its physics; the simulator loops over worlds.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel

if TYPE_CHECKING:  # the scenario looks its target up here
    from marl_encircle.core.scenario import Scenario

Array = NDArray[np.float64]
Constants = NDArray[np.void]
Physics = Any  # the one record of ``Constants``; its fields are the keys in ``physics_of``

FREE_OF_CONTACT = 36.0
"""A gap of this many contact margins: exp(-36) vanishes beside one in double precision."""

PROJECTION_PASSES = 4
"""Gauss-Seidel passes of hard contacts."""


def physics_of(scenario: "Scenario") -> Constants:
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
        "path_samples": scenario.path_samples,
        "units": scenario.units,
        "first_order": scenario.dynamics == "first_order",
        "move_first": scenario.integration == "mpe2",
        "soft_contacts": scenario.contacts == "soft",
        "hard_contacts": scenario.contacts == "hard",
        "from_surface": scenario.repulsion_from == "surface",
        "relaxed_path": scenario.path_rule == "relaxed",
        "target_sees_moves": scenario.turn_order == "pursuers_first",
        "target": list(TARGETS).index(scenario.target),
    }
    fields = [(name, type(value)) for name, value in values.items()]
    # A record rather than a void, so that plain Python (NUMBA_DISABLE_JIT) reads fields by name too.
    return np.array([tuple(values.values())], dtype=(np.record, fields))


@kernel
def move_pursuers(
    b: int,
    actions: Array,
    pursuers: Array,
    velocities: Array,
    target: Array,
    discs: Array,
    physics: Physics,
    moved: Array,
) -> None:
    """Move all pursuers of world b by one step.

    MPE's second-order dynamics: v <- (1 - damping) v + (acceleration a + F / mass) dt, clipped to the limit, then
    x <- x + v dt. ``mpe2`` moves with the old velocity. First order: v = v_P a + F dt / mass. Actions beyond [-1, 1]
    are clipped. Soft contacts F push pursuers off each other, the target and the obstacles; the scene's edge stops the
    velocity across it.

    :param actions: (B, N, 2) in [-1, 1]
    :param pursuers: positions [scene units], (B, N, 2)
    :param velocities: [scene units per time unit], (B, N, 2)
    :param target: (B, 2)
    :param discs: x, y, radius of the obstacles' discs, (B, D, 3)
    :param physics: see :func:`physics_of`
    :param moved: scratch, (N, 2)
    """
    n = pursuers.shape[1]
    dt = physics.time_step
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
    for i in range(n):
        pursuers[b, i, 0], pursuers[b, i, 1] = moved[i, 0], moved[i, 1]
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
def move_target(
    b: int,
    seen: Array,
    target: Array,
    discs: Array,
    speed_ratio: float,
    safety_distance: float,
    physics: Physics,
) -> None:
    """Move the target of world b by one step: along the force of its kind in ``TARGETS``, as far as is safe.

    :param seen: the pursuers' positions that the target goes by, (N, 2)
    :param target: (B, 2)
    :param discs: (B, D, 3)
    :param speed_ratio: lambda
    :param safety_distance: d_safe [scene units]
    :param physics: see :func:`physics_of`
    """
    fx, fy = 0.0, 0.0
    if physics.target == 0:
        fx, fy = repulsion(seen, target[b], discs[b], physics)
    elif physics.target == 1:
        fx, fy = still(seen, target[b], discs[b], physics)
    else:
        raise ValueError("a name in TARGETS has no branch in move_target")
    force = np.sqrt(fx * fx + fy * fy)
    if force > 0.0:
        stride = speed_ratio * physics.max_speed * physics.time_step / physics.path_samples
        _follow_path(seen, target[b], discs[b], stride * fx / force, stride * fy / force, safety_distance, physics)


@kernel
def repulsion(seen: Array, target: Array, discs: Array, physics: Physics) -> tuple[float, float]:
    """Return the force that drives the target away from everything: Eq. 14 as its text says.

    The sum of (T - X) / d^(power + 1) over pursuers, obstacles and the foot points on the four walls (Eq. 14 as printed
    attracts). An obstacle of several discs weighs as much as one of one disc.

    :param seen: (N, 2)
    :param target: (2,)
    :param discs: (D, 3)
    """
    x, y = target[0], target[1]
    fx, fy = 0.0, 0.0
    for i in range(len(seen)):
        px, py = _repel(x - seen[i, 0], y - seen[i, 1], physics.pursuer_radius, physics)
        fx += px
        fy += py
    weight = physics.units / max(len(discs), 1)
    for d in range(len(discs)):
        px, py = _repel(x - discs[d, 0], y - discs[d, 1], discs[d, 2], physics)
        fx += weight * px
        fy += weight * py
    half, wall = physics.half_width, physics.wall_weight
    fx += wall * (_repel(x + half, 0.0, 0.0, physics)[0] + _repel(x - half, 0.0, 0.0, physics)[0])
    fy += wall * (_repel(0.0, y + half, 0.0, physics)[1] + _repel(0.0, y - half, 0.0, physics)[1])
    return fx, fy


@kernel
def _repel(dx: float, dy: float, radius: float, physics: Physics) -> tuple[float, float]:
    """Return the force at (dx, dy) from a body: along (dx, dy), falling with distance to the power."""
    centre = np.sqrt(dx * dx + dy * dy)
    gap = max(centre - (radius + physics.target_radius) * physics.from_surface, 1e-6)
    fall = gap * gap + physics.repulsion_softening * physics.repulsion_softening
    if physics.repulsion_power == 1:
        fall = np.sqrt(fall)
    force = 1.0 / (fall * max(centre, 1e-6))
    return force * dx, force * dy


@kernel
def still(seen: Array, target: Array, discs: Array, physics: Physics) -> tuple[float, float]:
    """Return no force: a scene in which only the pursuers move."""
    return 0.0, 0.0


@kernel
def _follow_path(
    seen: Array, target: Array, discs: Array, sx: float, sy: float, safety_distance: float, physics: Physics
) -> None:
    """Move the target in strides (sx, sy) to the farthest sample before the first invalid one (Sec. 5.1).

    A sample is invalid within ``safety_distance`` of a pursuer, in contact with an obstacle, or outside. Under the
    relaxed rule a sample near a body is valid if the target comes no nearer to it than it is now.
    """
    x, y = target[0], target[1]
    strides = physics.path_samples
    while strides > 0 and not (
        abs(x + strides * sx) <= physics.half_width and abs(y + strides * sy) <= physics.half_width
    ):
        strides -= 1  # the scene is convex: what is beyond the first sample outside is outside too
    relaxed = physics.relaxed_path
    for i in range(len(seen)):
        strides = _valid_strides(x - seen[i, 0], y - seen[i, 1], sx, sy, safety_distance, relaxed, strides)
    for d in range(len(discs)):
        reach = discs[d, 2] + physics.target_radius + physics.obstacle_margin
        strides = _valid_strides(x - discs[d, 0], y - discs[d, 1], sx, sy, reach, relaxed, strides)
    target[0] = x + strides * sx
    target[1] = y + strides * sy


@kernel
def _valid_strides(dx: float, dy: float, sx: float, sy: float, reach: float, relaxed: bool, strides: int) -> int:
    """Return how many of ``strides`` come before the first that is invalid beside one body at -(dx, dy)."""
    now = dx * dx + dy * dy
    length = strides * np.sqrt(sx * sx + sy * sy)
    if now > (reach + length) * (reach + length) * (1 + 1e-9):  # out of reach of the whole path
        return strides
    limit = min(reach * reach, now) if relaxed else reach * reach
    for s in range(1, strides + 1):
        tx, ty = dx + s * sx, dy + s * sy
        if tx * tx + ty * ty < limit:
            return s - 1
    return strides


TARGETS: dict[str, Callable[..., tuple[float, float]]] = {"repulsion": repulsion, "still": still}
"""The target's driving force by the name in ``Scenario.target``, in the order of :func:`move_target`'s branches."""
