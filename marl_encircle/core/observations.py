"""What a pursuer sees: the state of Sec. 3.1 and, by default, the softened direction of everything in it."""

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

Array = NDArray[np.float64]


def layout(scenario: Scenario) -> dict[str, slice]:
    """Return which part of an observation holds what.

    ``position``, ``velocity``: the pursuer's own; ``target``, ``pursuers`` (the others in index order), ``obstacles``:
    relative positions; ``*_direction(s)``: r / (norm(r) + softening) of each; then the scenario's extras.
    """
    others, units = scenario.pursuers - 1, scenario.units
    sizes = {"position": 2, "velocity": 2, "target": 2, "pursuers": 2 * others, "obstacles": 2 * units}
    if scenario.observe_directions:
        sizes |= {"target_direction": 2, "pursuer_directions": 2 * others, "obstacle_directions": 2 * units}
    sizes |= dict.fromkeys(scenario.observe_extras, 1)
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def bounds(scenario: Scenario) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the lowest and highest values of an observation, (O,) each."""
    width = {"position": scenario.half_width, "velocity": scenario.max_speed}
    width |= dict.fromkeys(("target", "pursuers", "obstacles"), 2 * scenario.half_width)
    width |= {"speed_ratio": np.inf}
    parts = layout(scenario)
    high = np.concatenate([np.full(part.stop - part.start, width.get(name, 1.0)) for name, part in parts.items()])
    # One part in a million covers the rounding to single precision.
    high = (high * (1 + 1e-6)).astype(np.float32)
    return -high, high


def observe(simulator: Simulator, out: NDArray[np.float32], worlds: NDArray[np.int64] | None = None) -> None:
    """Write the observations of all pursuers of some worlds, all by default.

    :param out: to fill in, (B, N, O)
    :param worlds: indices of worlds, (W,)
    """
    scenario, state = simulator.scenario, simulator.state
    worlds = np.arange(simulator.n_worlds) if worlds is None else worlds
    things = state.obstacles if scenario.composite_unit else np.ascontiguousarray(state.discs[:, :, :2])
    softening = scenario.direction_softening if scenario.observe_directions else 0.0
    _observe(worlds, state.pursuers, state.velocities, state.target, things, softening, out)
    if not scenario.observe_extras:
        return
    enclosure = simulator.measure.enclosure["all"]
    extras = {
        "occupied_angle": enclosure.occupied_angle / (2 * np.pi),
        "stage": enclosure.occupies(scenario.stage_threshold),
        "speed_ratio": state.speed_ratio,
    }
    for name in scenario.observe_extras:
        out[worlds, :, layout(scenario)[name]] = extras[name][worlds, None, None]


@kernel
def _observe(
    worlds: NDArray[np.int64],
    pursuers: Array,
    velocities: Array,
    target: Array,
    obstacles: Array,
    softening: float,
    out: NDArray[np.float32],
) -> None:
    """Fill in own position and velocity, relative positions, and their directions unless ``softening`` is 0."""
    n, m = pursuers.shape[1], obstacles.shape[1]
    for b in worlds:
        for i in range(n):
            row = out[b, i]
            x, y = pursuers[b, i, 0], pursuers[b, i, 1]
            row[0], row[1] = x, y
            row[2], row[3] = velocities[b, i, 0], velocities[b, i, 1]
            at = 4
            for e in range(-1, n + m):
                if e == i:
                    continue
                if e < 0:
                    dx, dy = target[b, 0] - x, target[b, 1] - y
                elif e < n:
                    dx, dy = pursuers[b, e, 0] - x, pursuers[b, e, 1] - y
                else:
                    dx, dy = obstacles[b, e - n, 0] - x, obstacles[b, e - n, 1] - y
                row[at], row[at + 1] = dx, dy
                if softening > 0.0:
                    scale = 1.0 / (np.sqrt(dx * dx + dy * dy) + softening)
                    row[at + 2 * (n + m)] = dx * scale
                    row[at + 2 * (n + m) + 1] = dy * scale
                at += 2
