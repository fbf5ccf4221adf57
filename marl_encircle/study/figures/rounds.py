"""Figure 6: rounds of the method in five settings, and the moment at which each is solved."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from numpy.typing import NDArray

from marl_encircle.core.geometry import Closure
from marl_encircle.drawing.palette import FAINT, INK, OBSTACLE, OBSTACLE_EDGE, PAPER, pursuer_colour
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.records import Setting
from marl_encircle.replays.replay import Replay
from marl_encircle.study.figures.canvas import SMALL, WIDTH, put_below, rgb, say, style, write_letter
from marl_encircle.study.figures.enclosures import (
    draw_enclosure,
    draw_obstacles,
    draw_ring,
    draw_target,
    show_square,
    write_shares,
)

Array = NDArray[np.float64]

METHOD = "ours"

ZOOM = 0.36
"""Half the side of the lower panels [scene units]."""


class Place(NamedTuple):
    """A column of Figure 6: where the round is played."""

    title: str
    setting: Setting


PLACES = (
    Place("no obstacle", Setting(1.1, 3, 0)),
    Place("one obstacle", Setting(1.1, 3, 1)),
    Place("two pursuers", Setting(1.1, 2, 1)),
    Place("concave", Setting(1.1, 3, 1, "concave")),
    Place("tunnel", Setting(1.1, 3, 1, "tunnel")),
)


class Choice(NamedTuple):
    """Which round to draw, and out of how many."""

    round: int
    with_obstacle: int
    """Solved rounds in which the pursuers alone did not yet enclose the target at success."""
    solved: int
    played: int


class Column(NamedTuple):
    """What is shown in a column."""

    title: str
    replay: Replay | None
    """None where there is nothing to show."""
    choice: Choice | None = None
    note: str = ""
    """Why there is nothing to show, or what is to be known of the policy."""


def choose_round(episodes: Sequence[Episode], closure: Closure) -> Choice | None:
    """Return the round to draw, by rule: of median length among those that an obstacle helped to solve.

    Among all solved ones if none did. Of two in the middle the shorter one, of equally long ones the first.

    :param episodes: all rounds of an evaluation
    :param closure: the rule that counts as success
    :return: None if no round was solved
    """
    solved = [episode for episode in episodes if episode.success_step(closure) is not None]
    if not solved:
        return None
    helped = [episode for episode in solved if _obstacle_helped(episode, closure)]
    lengths = sorted((episode.success_step(closure) or 0, episode.round) for episode in helped or solved)
    return Choice(lengths[(len(lengths) - 1) // 2][1], len(helped), len(solved), len(episodes))


def _obstacle_helped(episode: Episode, closure: Closure) -> bool:
    """Whether the pursuers alone closed the circle later, or never."""
    later = episode.step_pursuers
    return closure == "all" and episode.step_all is not None and (later is None or later > episode.step_all)


@style()
def draw_figure6(columns: Sequence[Column]) -> Figure:
    """Draw trajectories above, the enclosures that they end in below.

    :param columns: one of each place, with a round or with what stands in its place
    """
    figure = Figure((WIDTH, 4.1))
    grid = figure.subplots(2, len(columns), squeeze=False)
    figure.subplots_adjust(left=0.062, right=0.995, top=0.955, bottom=0.205, wspace=0.07, hspace=0.33)
    for number, (column, (above, below)) in enumerate(zip(columns, grid.T, strict=True)):
        write_letter(above, "abcdefgh"[number], column.title)
        if column.replay is None or column.replay.success_step is None:
            for axes in (above, below):
                show_square(axes, np.zeros(2), 1.0)
                say(axes, column.note)
            continue
        _draw_trajectories(above, column.replay, column.replay.success_step)
        _draw_moment(below, column.replay, column.replay.success_step)
        below.set_xlabel(_in_words(column), fontsize=SMALL, labelpad=13, color=rgb(FAINT), linespacing=1.35)
        if number > 0:
            above.set_yticklabels([])
    grid[0][0].set_ylabel("y [scene units]", labelpad=1)
    grid[1][0].set_ylabel(f"at success, {2 * ZOOM:.2g} units wide")
    grid[0][len(columns) // 2].set_xlabel("x [scene units]", labelpad=1)
    put_below(figure, _legend())
    return figure


def _in_words(column: Column) -> str:
    """Say how many rounds went like the one that is shown, and whose policy it is."""
    choice, replay = column.choice, column.replay
    if choice is None or replay is None:
        return column.note
    rounds = f"{choice.with_obstacle} of {choice.solved} solved rounds\nclosed with the obstacle"
    if replay.scenario.obstacles == 0:
        rounds = f"{choice.solved} of {choice.played} rounds solved"
    return f"{rounds}\n{column.note}".rstrip()


def _draw_trajectories(axes: Axes, replay: Replay, step: int) -> None:
    """Draw the round until its success: starts hollow, ends in their true size, a dot each step."""
    reach = 1.05 * replay.scenario.half_width
    show_square(axes, np.zeros(2), reach)
    ticks = [share * replay.scenario.half_width for share in (-0.5, 0, 0.5)]
    labels = [f"{tick:g}".replace("-", "\N{MINUS SIGN}") for tick in ticks]
    axes.set_xticks(ticks, labels)
    axes.set_yticks(ticks, labels)
    draw_obstacles(axes, replay.discs)
    draw_enclosure(axes, replay.snapshot(step), linewidth=0.7)
    bodies = [*np.moveaxis(replay.pursuers[: step + 1], 1, 0), replay.target[: step + 1]]
    for i, path in enumerate(bodies):
        colour = rgb(INK if i == len(bodies) - 1 else pursuer_colour(i))
        axes.plot(*path.T, "-", color=colour, linewidth=0.8, zorder=5)
        axes.plot(*path[1:-1].T, ".", color=colour, markersize=2.2, markeredgewidth=0, zorder=5)
        hollow: dict[str, Any] = {"markerfacecolor": rgb(PAPER), "markeredgecolor": colour, "markeredgewidth": 0.8}
        axes.plot(*path[0], "o", markersize=3.6, zorder=6, **hollow)
    for i, place in enumerate(replay.pursuers[step]):
        _draw_body(axes, place, replay.scenario.pursuer_radius, i, 1.0)
    draw_target(axes, replay.target[step], 4.6)


def _draw_moment(axes: Axes, replay: Replay, step: int) -> None:
    """Draw the surroundings of the target at one step, and below them the contributing angles."""
    moment = replay.snapshot(step)
    show_square(axes, moment.target, ZOOM)
    draw_obstacles(axes, moment.discs)
    draw_enclosure(axes, moment)
    draw_ring(axes, moment, 0.91 * ZOOM, 0.98 * ZOOM)
    for i, place in enumerate(moment.pursuers):
        _draw_body(axes, place, replay.scenario.pursuer_radius, i, 0.5)
        if np.abs(place - moment.target).max() < ZOOM:
            note: dict[str, Any] = {"fontsize": SMALL, "ha": "center", "va": "center_baseline", "zorder": 8}
            axes.annotate(str(i + 1), place, **note)
    reach = replay.scenario.target_radius
    axes.add_patch(Circle(tuple(moment.target), reach, facecolor="none", edgecolor=rgb(INK), linewidth=0.5, zorder=8))
    draw_target(axes, moment.target, 5.0)
    text = rf"step {step}, $R_m$ = {moment.movement_range:.3g}"
    axes.set_title(text, fontsize=SMALL, pad=3)
    write_shares(axes, moment, len(moment.contributing_angle))


def _draw_body(axes: Axes, place: Array, radius: float, number: int, opacity: float) -> None:
    face = (*rgb(pursuer_colour(number)), opacity)
    axes.add_patch(Circle((place[0], place[1]), radius, facecolor=face, edgecolor=rgb(INK), linewidth=0.5, zorder=3.5))


def _legend() -> list[Artist]:
    ink = rgb(INK)
    return [
        Line2D([], [], color=rgb(pursuer_colour(0)), marker=".", markersize=3, label="pursuer"),
        Line2D([], [], color=ink, marker=".", markersize=3, label="target"),
        Line2D([], [], linestyle="none", marker="o", markersize=4, markerfacecolor="none", color=ink, label="start"),
        Patch(facecolor=rgb(OBSTACLE), edgecolor=rgb(OBSTACLE_EDGE), label="obstacle"),
        Line2D([], [], color=rgb(pursuer_colour(1)), linewidth=0.9, label="Apollonius circle"),
        Line2D([], [], color=rgb(pursuer_colour(1)), linewidth=3.5, label="contributing angle"),
        Patch(facecolor="none", edgecolor=ink, label=r"range $R_m$"),
    ]
