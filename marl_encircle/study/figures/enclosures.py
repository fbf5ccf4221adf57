"""Drawing an enclosure: obstacles, Apollonius circles, what each entity contributes, the area within."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, Polygon
from matplotlib.patches import Wedge as Sector
from numpy.typing import NDArray

from marl_encircle.core.geometry import NOBODY
from marl_encircle.drawing.outlines import borders, facing_arc, polar, stretches, wedges
from marl_encircle.drawing.palette import (
    GAP,
    INK,
    OBSTACLE,
    OBSTACLE_EDGE,
    PAPER,
    Colour,
    entity_colour,
    pursuer_colour,
    readable_on,
)
from marl_encircle.replays.replay import Snapshot
from marl_encircle.study.figures.canvas import SMALL, rgb

Array = NDArray[np.float64]


def show_square(axes: Axes, centre: Array, half_width: float) -> None:
    """Show a square of the scene, as wide as high, without ticks."""
    axes.set(
        xlim=(centre[0] - half_width, centre[0] + half_width),
        ylim=(centre[1] - half_width, centre[1] + half_width),
        xticks=[],
        yticks=[],
        aspect="equal",
    )
    axes.spines[:].set_visible(True)


def draw_obstacles(axes: Axes, discs: Array) -> None:
    """Draw discs; those that overlap get one outline.

    :param discs: x, y, radius, (D, 3)
    """
    for x, y, radius in discs:
        axes.add_patch(Circle((x, y), radius, facecolor="none", edgecolor=rgb(OBSTACLE_EDGE), linewidth=1.4, zorder=3))
    for x, y, radius in discs:
        axes.add_patch(Circle((x, y), radius, facecolor=rgb(OBSTACLE), edgecolor="none", zorder=3))


def draw_enclosure(axes: Axes, moment: Snapshot, linewidth: float = 1.0) -> None:
    """Tint what the target can reach in the colours of who meets it there; outline it once closed; draw the arcs.

    :param linewidth: of the outline [points]
    """
    n = len(moment.pursuers)
    for wedge in wedges(moment.owner, moment.distance, moment.closed):
        outline = np.vstack([moment.target, polar(moment.target, wedge.angles, wedge.distances)])
        tint = (*rgb(entity_colour(wedge.owner, n)), 0.42 if moment.closed else 0.2)
        axes.add_patch(Polygon(outline, facecolor=tint, edgecolor="none", zorder=1))
    if moment.closed:
        angles = np.arange(len(moment.owner)) * (2 * np.pi / len(moment.owner))
        outline = polar(moment.target, angles, moment.distance)
        axes.add_patch(Polygon(outline, facecolor="none", edgecolor=rgb(INK), linewidth=linewidth, zorder=4))
    draw_arcs(axes, moment, 0.9 * linewidth)


def draw_arcs(axes: Axes, moment: Snapshot, linewidth: float) -> None:
    """Draw the part of each Apollonius circle that faces the target.

    :param linewidth: of the arcs [points]
    """
    for i, offset in enumerate(moment.pursuers - moment.target):
        if np.hypot(*offset) > 0.0:
            arc = polar(moment.target, *facing_arc(offset, moment.speed_ratio))
            axes.plot(*arc.T, color=rgb(pursuer_colour(i)), linewidth=linewidth, zorder=2)


def draw_ring(axes: Axes, moment: Snapshot, inner: float, outer: float) -> None:
    """Draw a ring around the target whose segments, the contributing angles, have the colours of their owners.

    :param inner: its inner radius [scene units]
    :param outer: its outer radius [scene units]
    """
    for owner, directions in stretches(moment.owner):
        if owner == NOBODY:
            continue
        angles = np.degrees(borders(directions, len(moment.owner)))
        axes.add_patch(
            Sector(
                (moment.target[0], moment.target[1]),
                outer,
                angles[0],
                angles[-1],
                width=outer - inner,
                facecolor=rgb(entity_colour(owner, len(moment.pursuers))),
                edgecolor=rgb(PAPER),
                linewidth=0.5,
                zorder=5,
            )
        )


def draw_gaps(axes: Axes, moment: Snapshot, length: float) -> None:
    """Draw an arrow through the middle of every gap, and the gap itself.

    :param length: how far from the target the gap is shown [scene units]
    """
    for owner, directions in stretches(moment.owner):
        if owner != NOBODY:
            continue
        angles = borders(directions, len(moment.owner))
        sides = np.vstack([moment.target, polar(moment.target, angles, np.full(len(angles), length))])
        axes.add_patch(Polygon(sides, facecolor=(*rgb(GAP), 0.22), edgecolor="none", zorder=1))
        middle = (angles[0] + angles[-1]) / 2
        tip, tail = polar(moment.target, np.array([middle, middle]), np.array([0.97 * length, 0.2 * length]))
        arrow = {"arrowstyle": "-|>", "color": rgb(GAP), "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, tail, arrowprops=arrow, zorder=6)


def draw_bodies(axes: Axes, moment: Snapshot, labels: Sequence[str], size: float = 10.5) -> None:
    """Draw pursuers with their numbers, and the target, in sizes of letters, not to scale.

    :param labels: of the pursuers
    :param size: diameter of a pursuer [points]
    """
    for i, ((x, y), label) in enumerate(zip(moment.pursuers, labels, strict=True)):
        colour = pursuer_colour(i)
        axes.plot(
            x, y, "o", color=rgb(colour), markersize=size, markeredgecolor=rgb(INK), markeredgewidth=0.6, zorder=7
        )
        axes.annotate(
            label,
            (x, y),
            color=rgb(readable_on(colour)),
            fontsize=SMALL,
            ha="center",
            va="center_baseline",
            zorder=8,
        )
    draw_target(axes, moment.target, 0.72 * size)


def draw_target(axes: Axes, place: Array, size: float) -> None:
    """Draw the target, two rings.

    :param size: diameter [points]
    """
    for share, colour in ((1.0, INK), (0.6, PAPER), (0.3, INK)):
        axes.plot(*place, "o", color=rgb(colour), markersize=share * size, markeredgewidth=0, zorder=9)


def draw_angle(axes: Axes, centre: Array, radius: float, low: float, high: float, colour: Colour) -> None:
    """Draw an arc between two directions, with a tick at either end.

    :param low: [rad]
    :param high: [rad]
    """
    arc = Arc((centre[0], centre[1]), 2 * radius, 2 * radius, theta1=math.degrees(low), theta2=math.degrees(high))
    arc.set(edgecolor=rgb(colour), linewidth=1.6, zorder=6)
    axes.add_patch(arc)
    for angle in (low, high):
        ends = polar(centre, np.array([angle, angle]), radius * np.array([0.94, 1.06]))
        axes.plot(*ends.T, color=rgb(colour), linewidth=1.2, zorder=6)


def write_shares(axes: Axes, moment: Snapshot, entities: int) -> None:
    """Write contributing angles below a panel, each beside a dot in the colour of its owner.

    :param entities: number of them to write, pursuers first
    """
    step, y = 1 / entities, -0.07  # of the panel's width and height
    for entity in range(entities):
        colour = entity_colour(entity, len(moment.pursuers))
        text = f"{math.degrees(moment.contributing_angle[entity]):.0f}°"
        # The dot and up to four signs, together in the middle of their share of the width.
        left = (entity + 0.5) * step - 0.012 - 0.022 * len(text)
        axes.plot(left, y, "o", color=rgb(colour), markersize=4, transform=axes.transAxes, clip_on=False)
        axes.text(left + 0.03, y, text, transform=axes.transAxes, fontsize=SMALL, va="center_baseline")
