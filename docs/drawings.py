"""Draw the pictures of docs/mathematics.md from the package's own geometry: python docs/drawings.py.

Equal versions give equal bytes; a test compares them with the committed files.
"""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from marl_encircle import files
from marl_encircle.core.dynamics import move_target, physics_of, repulsion
from marl_encircle.core.scenario import Scenario
from marl_encircle.drawing.outlines import facing_arc, far_arc, polar
from marl_encircle.drawing.palette import FAINT, GAP, INK, LINE, PURSUERS, SERIES
from marl_encircle.study.figures.canvas import COLUMN, WIDTH, encode, put_below, rgb, style
from marl_encircle.study.figures.enclosures import draw_bodies, draw_obstacles, draw_target, show_square
from marl_encircle.study.figures.situations import draw_figure1, draw_figure3, measure

Array = NDArray[np.float64]

IMAGES = Path(__file__).parent / "images"

HERE = np.zeros(2)
"""Where the target stands."""

_RIM = np.radians([50.0])
"""Where on its circle a label is written."""


def main() -> None:
    """Write every drawing."""
    for name, data in drawings().items():
        files.write_bytes(IMAGES / name, data)


def drawings() -> dict[str, bytes]:
    """Return every drawing by the name of its file."""
    figures = {
        "apollonius": draw_figure3(),
        "ratios": draw_ratios(),
        "least_pursuers": draw_least_pursuers(),
        "situations": draw_figure1(),
        "movement_range": draw_movement_range(),
        "escape": draw_escape(),
    }
    return {f"{name}.svg": encode(figure, ["svg"])["svg"] for name, figure in figures.items()}


@style()
def draw_ratios() -> Figure:
    """Draw the circles of one pursuer at three speed ratios, and of three distances at one ratio."""
    figure = Figure((WIDTH, 2.6))
    all_axes = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.92, bottom=0.02, wspace=0.04)
    ratios, distances = (1.3, 1.6, 2.2), (0.95, 0.6, 0.3)
    panels = (
        ("a faster target: a narrower angle", [(0.7, ratio) for ratio in ratios]),
        ("a nearer pursuer: a smaller circle, the same angle", [(distance, 1.5) for distance in distances]),
    )
    for axes, (title, pairs) in zip(all_axes, panels, strict=True):
        show_square(axes, np.array([1.45, 0.0]), 1.75)
        axes.set_ylim(-1.35, 1.35)
        axes.axis("off")
        axes.set_title(title, loc="left", pad=4)
        for colour, (distance, ratio) in zip(PURSUERS, pairs, strict=False):
            _draw_circle(axes, np.array([distance, 0.0]), ratio, rgb(colour))
            centre, radius = (
                np.array([ratio, 0.0]) * ratio * distance / (ratio**2 - 1),
                ratio * distance / (ratio**2 - 1),
            )
            label = f"λ = {ratio:g}" if axes is all_axes[0] else f"d = {distance:g}"
            axes.annotate(label, polar(centre, _RIM, np.array([1.03 * radius]))[0], color=rgb(colour))
        draw_target(axes, HERE, 8)
    return figure


def _draw_circle(axes: Axes, pursuer: Array, ratio: float, colour: tuple[float, float, float]) -> None:
    """Draw a pursuer, its Apollonius circle about the target, strong where it faces it, and the tangents."""
    axes.plot(*polar(HERE, *far_arc(pursuer, ratio)).T, color=colour, linewidth=0.6)
    axes.plot(*polar(HERE, *facing_arc(pursuer, ratio)).T, color=colour, linewidth=1.8)
    for side in (-1, 1):
        end = polar(HERE, np.array([side * math.asin(1 / ratio)]), np.array([1.6]))[0]
        axes.plot(*zip(HERE, end, strict=True), color=colour, linewidth=0.7, dashes=(5, 3))
    axes.plot(*pursuer, "o", color=colour, markersize=6, markeredgecolor=rgb(INK), markeredgewidth=0.5)


@style()
def draw_least_pursuers() -> Figure:
    """Draw Eq. 6, and the settings of Tables 2 and 3."""
    figure = Figure((COLUMN, 2.2))
    axes = figure.add_axes((0.11, 0.18, 0.86, 0.78))
    # The largest ratio at which so many pursuers close the circle.
    largest = [1.0, *(1 / math.sin(math.pi / n) for n in (3, 4)), 1.6]
    ratio, least = np.repeat(largest, 2)[1:-1], np.repeat([3, 4, 5], 2)
    axes.fill_between(ratio, least, 6, color=(*rgb(PURSUERS[2]), 0.16), linewidth=0)
    axes.plot(ratio, least, color=rgb(PURSUERS[2]))
    smooth = np.linspace(1.0, 1.6, 61)
    axes.plot(smooth, np.pi / np.arcsin(1 / smooth), color=rgb(FAINT), linewidth=0.7, dashes=(5, 3))
    for number, at in ((2, 1.1), (3, 1.1), (4, 1.1), (5, 1.1), (3, 1.2), (3, 1.3), (3, 1.4)):
        enough = Scenario(pursuers=number, speed_ratio=at).solvable_without_obstacles
        colour = rgb(PURSUERS[2] if enough else GAP)
        axes.plot(
            at,
            number,
            "o" if enough else "s",
            color=colour,
            markersize=5,
            markeredgecolor=rgb(INK),
            markeredgewidth=0.5,
        )
    axes.annotate("closed by pursuers", (1.115, 5.35), color=rgb(PURSUERS[2]))
    axes.annotate("obstacles have to help", (1.31, 2.35), color=rgb(GAP))
    axes.set(xlabel="speed ratio λ", ylabel="pursuers n", xlim=(1.0, 1.6), ylim=(1.6, 5.8), yticks=[2, 3, 4, 5])
    return figure


@style()
def draw_movement_range() -> Figure:
    """Draw R_m of regular rings over their radius at a speed ratio of 1.1, and the limit below which they succeed."""
    figure = Figure((COLUMN, 2.2))
    axes = figure.add_axes((0.15, 0.18, 0.82, 0.78))
    distance = np.linspace(0.02, 0.3, 57)
    for series, n in zip(SERIES, (3, 4, 5), strict=False):
        bearings = np.arange(n) * (2 * np.pi / n)
        area = [measure(polar(HERE, bearings, np.full(n, d)), (), 1.1).movement_range for d in distance]
        axes.plot(distance, area, color=rgb(series.colour), dashes=series.dashes or (1, 0), label=f"n = {n}")
    axes.axhline(0.05, color=rgb(INK), linewidth=0.8)
    axes.annotate("success below", (0.022, 0.0525), va="bottom")
    axes.legend(loc="upper left")
    axes.set(xlabel="radius d [scene units]", ylabel=r"$R_m$ [scene units²]", xlim=(0.02, 0.3), ylim=(0, 0.15))
    return figure


@style()
def draw_escape() -> Figure:
    """Draw the direction of Eq. 14's force over a scene, and the step of a target in it, sample by sample."""
    scenario = Scenario(pursuers=3, obstacles=1)
    physics = physics_of(scenario)[0]
    pursuers = np.array([[-0.55, -0.35], [-0.1, 0.62], [0.18, -0.6]])
    discs, target = np.array([[0.55, 0.3, 0.2]]), np.array([0.16, -0.02])
    figure = Figure((COLUMN, COLUMN + 0.2))
    axes = figure.add_axes((0.01, 0.06, 0.98, 0.935))
    show_square(axes, HERE, 1.0)
    draw_obstacles(axes, discs)
    places = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 15), np.linspace(-0.9, 0.9, 15)), axis=-1).reshape(-1, 2)
    places = places[np.hypot(*(places - discs[0, :2]).T) > 0.25]
    forces = np.array([repulsion(pursuers, place, discs, physics) for place in places])
    units = forces / np.hypot(*forces.T)[:, None]
    axes.quiver(*places.T, *units.T, color=rgb(LINE), scale=22, width=0.004, pivot="mid", zorder=0)
    for pursuer in pursuers:
        axes.add_patch(
            Circle(tuple(pursuer), scenario.safety_distance, facecolor="none", edgecolor=rgb(GAP), linewidth=0.8)
        )
    draw_bodies(axes, measure(pursuers - target, ())._replace(pursuers=pursuers, target=target), ["1", "2", "3"])
    moved = target[None].copy()
    move_target(0, pursuers, moved, discs[None], 1.4, scenario.safety_distance, physics)
    samples = target + np.linspace(0.1, 1, scenario.path_samples)[:, None] * (moved[0] - target)
    axes.plot(*samples.T, ".", color=rgb(INK), markersize=2, zorder=6)
    put_below(figure, [], r"grey: the way to run; dots: samples of the next step; circles: $d_{safe}$")
    return figure


if __name__ == "__main__":
    main()
