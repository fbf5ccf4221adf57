"""Figures 1 and 3: situations put together by hand, measured by the simulator's own geometry.

As in the paper the target is a point. At a speed ratio of 1.3 the Apollonius circles are small enough to be seen as
circles; it takes four pursuers there, or obstacles (Eq. 6).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import ArrayLike, NDArray

from marl_encircle.core.geometry import Closure
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator
from marl_encircle.drawing.outlines import borders, polar, stretches
from marl_encircle.drawing.palette import FAINT, GAP, INK, OBSTACLE, PURSUERS, pursuer_colour
from marl_encircle.replays.replay import Snapshot
from marl_encircle.study.figures.canvas import COLUMN, NORMAL, WIDTH, put_below, rgb, style, write_letter
from marl_encircle.study.figures.enclosures import (
    draw_angle,
    draw_bodies,
    draw_enclosure,
    draw_gaps,
    draw_obstacles,
    draw_ring,
    show_square,
    write_shares,
)

Array = NDArray[np.float64]

SPEED_RATIO = 1.3
DIRECTIONS = 720

_MISSED: dict[str, Any] = {"markerfacecolor": "none", "markeredgecolor": rgb(INK), "markeredgewidth": 0.8}
_OCCUPIED = PURSUERS[5]
"""The paper's occupied angle is orange, its contributing angle blue."""
_BEARINGS, _DISTANCES = (8.0, 82.0, 180.0, 278.0), (1.0, 0.7, 0.95, 1.05)
"""The pursuers of Figure 3 as seen from the target: degrees and distances."""


class Situation(NamedTuple):
    """A panel of Figure 1."""

    title: str
    bearings: tuple[float, ...]
    """Of the pursuers, seen from the target [degrees]."""
    distances: tuple[float, ...]
    discs: tuple[tuple[float, float, float], ...] = ()
    closure: Closure = "all"
    missed: tuple[float, float] | None = None
    """Bearing [degrees] and distance of a place that a pursuer cannot take."""


SITUATIONS = (
    Situation("open field", (45, 135, 225, 315), (1, 1, 1, 1)),
    Situation("obstacle in the way", (45, 135, 225, 349), (1, 1, 1, 1), ((0.95, -0.85, 0.55),), "pursuers", (315, 1)),
    Situation("shared directions", (47, 147, 290), (1, 1, 0.95), ((0.97, -0.56, 0.5),)),
    Situation("partial engagement", (80, 155, 245, 118), (1, 1, 1, 1.42), ((0.9, -0.1, 0.55),)),
    Situation("obstacle used", (77, 166, 255), (1, 1, 1), ((0.85, -0.2, 0.62),)),
)


def measure(
    pursuers: ArrayLike, discs: ArrayLike, speed_ratio: float = SPEED_RATIO, closure: Closure = "all"
) -> Snapshot:
    """Measure bodies around a target at the origin, each disc an obstacle of its own.

    :param pursuers: (N, 2)
    :param discs: x, y, radius, (M, 3)
    :param speed_ratio: lambda
    :param closure: the rule to measure under
    """
    places = np.asarray(pursuers, np.float64)
    obstacles = np.asarray(discs, np.float64).reshape(-1, 3)
    scenario = Scenario(
        pursuers=len(places),
        obstacles=len(obstacles),
        speed_ratio=speed_ratio,
        target_radius=0.0,
        obstacle_radius=0.1,  # of the discs that make room for the true ones
        n_directions=DIRECTIONS,
    )
    sim = Simulator(scenario, seed=0)
    sim.reset()
    saved = sim.get_state()
    saved["state"] |= {"pursuers": places[None], "target": np.zeros((1, 2)), "discs": obstacles[None]}
    sim.set_state(saved)
    state = sim.state
    return Snapshot.of(
        state.pursuers[0], state.target[0], state.discs[0], speed_ratio, sim.measure.enclosure[closure], 0
    )


def moment_of(situation: Situation) -> Snapshot:
    """Return a panel's situation, measured under its rule."""
    pursuers = polar(np.zeros(2), np.radians(situation.bearings), np.asarray(situation.distances, np.float64))
    return measure(pursuers, situation.discs, closure=situation.closure)


@style()
def draw_figure1() -> Figure:
    """Draw Figure 1: five situations of encirclement."""
    figure = Figure((WIDTH, 2.08))
    all_axes = figure.subplots(1, len(SITUATIONS))
    figure.subplots_adjust(left=0.005, right=0.995, top=0.9, bottom=0.22, wspace=0.06)
    for axes, letter, situation in zip(all_axes, "abcde", SITUATIONS, strict=True):
        _draw_situation(axes, situation)
        write_letter(axes, letter, situation.title)
    put_below(figure, _legend())
    return figure


def _draw_situation(axes: Axes, situation: Situation) -> None:
    moment = moment_of(situation)
    n = len(moment.pursuers)
    show_square(axes, np.array([0.0, 0.0]), 1.85)
    draw_obstacles(axes, moment.discs)
    draw_enclosure(axes, moment)
    draw_gaps(axes, moment, 1.66)
    draw_ring(axes, moment, 1.66, 1.8)
    draw_bodies(axes, moment, [str(i + 1) for i in range(n)])
    if situation.missed is not None:
        (place,) = polar(np.zeros(2), np.radians([situation.missed[0]]), np.array([situation.missed[1]]))
        axes.plot(*place, "o", markersize=10, zorder=7, **_MISSED)
    write_shares(axes, moment, n + (len(moment.discs) if situation.closure == "all" else 0))


def _legend() -> list[Artist]:
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    return [
        Line2D([], [], markersize=5, color=rgb(pursuer_colour(0)), label="contributing angle of a pursuer", **dot),
        Line2D([], [], markersize=5, color=rgb(OBSTACLE), label="of the obstacle", **dot),
        Patch(facecolor="none", edgecolor=rgb(INK), label=r"movement range $R_m$"),
        Patch(facecolor=(*rgb(GAP), 0.25), edgecolor=rgb(GAP), label="gap"),
        Line2D([], [], markersize=8, label="place that cannot be taken", **dot, **_MISSED),
    ]


@style()
def draw_figure3() -> Figure:
    """Draw Figure 3: Apollonius circle, its tangents, occupied and contributing angle, movement range."""
    moment = measure(polar(np.zeros(2), np.radians(_BEARINGS), np.array(_DISTANCES)), ())
    figure = Figure((COLUMN, COLUMN * 4.2 / 6.2))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-1.75, 4.45), ylim=(-1.8, 2.4))
    axes.axis("off")
    draw_enclosure(axes, moment)
    _draw_circle(axes, moment)
    draw_bodies(axes, moment, ["1", "2", "3", "4"])
    return figure


def _draw_circle(axes: Axes, moment: Snapshot) -> None:
    """Draw all that belongs to the first pursuer."""
    ratio, (bearing, *_), (way, *_) = moment.speed_ratio, np.radians(_BEARINGS), _DISTANCES
    here = np.zeros(2)
    ahead = np.array([bearing])
    # Eq. 1 with pursuer and target in their places.
    (centre,) = polar(here, ahead, np.array([ratio**2 * way / (ratio**2 - 1)]))
    radius = ratio * way / (ratio**2 - 1)
    colour = rgb(pursuer_colour(0))
    axes.add_patch(Circle(tuple(centre), radius, facecolor=(*colour, 0.05), edgecolor=colour, linewidth=0.9, zorder=0))
    widest = math.asin(1 / ratio)
    for side in (-widest, widest):
        end = polar(here, ahead + side, np.array([2.4 * way]))[0]
        axes.plot(*zip(here, end, strict=True), color=rgb(INK), linewidth=0.7, dashes=(5, 3), zorder=2)
    axes.plot(*zip(here, centre, strict=True), color=rgb(FAINT), linewidth=0.6, zorder=0.5)
    axes.plot(*centre, "o", color=colour, markersize=3)
    (rim,) = polar(centre, ahead - 1.0, np.array([radius]))
    axes.plot(*zip(centre, rim, strict=True), color=colour, linewidth=0.8)
    draw_angle(axes, here, 1.28, bearing - widest, bearing + widest, _OCCUPIED)
    (stretch,) = (directions for owner, directions in stretches(moment.owner) if owner == 0)
    angles = borders(stretch, len(moment.owner))
    draw_angle(axes, here, 0.27, angles[0], angles[-1], pursuer_colour(0))
    note: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": NORMAL + 0.5}
    axes.annotate(r"$A_1$", (centre[0] + 0.12, centre[1] + 0.16), **note)
    axes.annotate(r"$r_1$", polar(centre, ahead - 0.86, np.array([0.55 * radius]))[0], **note)
    axes.annotate(r"$\alpha_1$", polar(here, ahead + 0.3, np.array([1.47]))[0], color=rgb(_OCCUPIED), **note)
    axes.annotate(r"$\theta_c$", polar(here, ahead - 0.24, np.array([0.43]))[0], color=colour, **note)
    axes.annotate(r"$R_m$", (-0.3, -0.24), **note)
    axes.annotate("$T$", (-0.17, 0.12), **note)
    axes.annotate("$o_1$", polar(centre, ahead + 1.0, np.array([radius + 0.18]))[0], color=colour, **note)
