"""Builders: a simulator with every body where a test wants it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from exact_arcs import Layout

from marl_encircle.core.rewards import Transition
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

Points = Sequence[Sequence[float]]


def arranged(
    pursuers: Points,
    target_at: Sequence[float] = (0.0, 0.0),
    discs: Points = (),
    velocities: Points | None = None,
    **fields: Any,
) -> Simulator:
    """One world with these bodies; an obstacle is one disc (x, y, radius). ``fields`` are those of ``Scenario``."""
    fields = {"obstacle_radius": 1e-3, "n_directions": 72} | fields
    sim = Simulator(Scenario(pursuers=len(pursuers), obstacles=len(discs), **fields), 1, seed=0)
    sim.reset()
    saved = sim.get_state()
    state = saved["state"]
    state["pursuers"][0] = pursuers
    state["target"][0] = target_at
    state["velocities"][0] = 0.0 if velocities is None else velocities
    state["discs"][0] = np.reshape(np.array(discs, dtype=float), (-1, 3))
    state["obstacles"][0] = state["discs"][0, :, :2]
    sim.set_state(saved)
    return sim


def arranged_as(layout: Layout, n_directions: int = 72, at: Sequence[float] = (0.0, 0.0), **fields: Any) -> Simulator:
    """The world of an oracle's layout, with the target at ``at``."""
    fields = {"speed_ratio": layout.speed_ratio, "target_radius": layout.target_radius} | fields
    pursuers = [(x + at[0], y + at[1]) for x, y in layout.pursuers]
    discs = [(x + at[0], y + at[1], r) for x, y, r in layout.discs]
    return arranged(pursuers, at, discs, n_directions=n_directions, **fields)


def push(sim: Simulator, *actions: Sequence[float]) -> Simulator:
    """One step in which pursuer i of each world does ``actions[i]``; the last one stands for later ones too."""
    n = sim.scenario.pursuers
    rows = [*actions, *[actions[-1]] * (n - len(actions))] if actions else [(0.0, 0.0)] * n
    sim.step(np.array([rows] * sim.n_worlds, dtype=float))
    return sim


def transition(sim: Simulator, closure: str = "all") -> Transition:
    """The present state as reward terms see it."""
    actions = np.zeros((sim.n_worlds, sim.scenario.pursuers, 2))
    return Transition(sim.scenario, sim.state, actions, sim.measure, sim.former_measure, closure)  # type: ignore[arg-type]  # one of the two rules


def random_actions(sim: Simulator, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1, 1, (sim.n_worlds, sim.scenario.pursuers, 2))
