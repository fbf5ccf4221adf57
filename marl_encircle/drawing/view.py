"""What a drawing of one world shows, as numbers: taken from a simulator here, from a recorded round elsewhere."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import Closure
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

Array = NDArray[np.float64]


class Layers(NamedTuple):
    """Which parts of a drawing are shown beside the bodies."""

    circles: bool = True
    """Apollonius circles; the part that faces the target is the thicker one."""
    angles: bool = True
    """The ring around the target: who is met first in each direction."""
    area: bool = True
    """What the target can reach before it is met; once closed, its area is R_m."""
    trails: bool = True
    lens: bool = True
    """The target's surroundings at large, once it can reach little."""


class View(NamedTuple):
    """What is drawn of one world. N pursuers, D discs, K directions."""

    scenario: Scenario
    pursuers: Array
    """(N, 2)."""
    velocities: Array
    """(N, 2)."""
    target: Array
    """(2,)."""
    discs: Array
    """x, y, radius, (D, 3)."""
    speed_ratio: float
    owner: NDArray[np.int8]
    """Who is met first in each direction, (K,)."""
    distance: Array
    """How far away, (K,)."""
    movement_range: float
    complete: bool
    step: int
    trail: Sequence[Array]
    """Pursuers and target at this round's states until now, (N + 1, 2) each."""
    closure: Closure = "all"
    """The rule that the enclosure is measured by."""
    success: Mapping[Closure, int | None] | None = None
    """The step at which each rule first held, None where it has not until now; None if nobody kept count."""
    ahead: Array | None = None
    """Where the target goes in the next step, (2,); None if that is not known."""
    rewards: tuple[float, float] | None = None
    """Of this step and of the round until now, mean over the pursuers; None if nobody kept count."""
    title: str = ""
    caption: str = ""

    @property
    def closed(self) -> bool:
        """Whether somebody is met in every direction."""
        return math.isfinite(self.movement_range)


def view(
    simulator: Simulator,
    closure: Closure,
    trail: Sequence[Array] = (),
    world: int = 0,
    success: Mapping[Closure, int | None] | None = None,
) -> View:
    """Return what is to be drawn of a world.

    :param closure: the enclosure that is shown
    :param trail: pursuers and target at this round's states until now, (N + 1, 2) each
    :param success: the step at which each rule first held, None where it has not until now
    """
    s, enclosure = simulator.state, simulator.measure.enclosure[closure]
    return View(
        scenario=simulator.scenario,
        pursuers=s.pursuers[world],
        velocities=s.velocities[world],
        target=s.target[world],
        discs=s.discs[world],
        speed_ratio=float(s.speed_ratio[world]),
        owner=enclosure.owner[world],
        distance=enclosure.distance[world],
        movement_range=float(enclosure.movement_range[world]),
        complete=bool(enclosure.complete[world]),
        step=int(simulator.steps[world]),
        trail=trail,
        closure=closure,
        success=success,
    )
