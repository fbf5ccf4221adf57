"""Figure 4: success over training, from the learning curves of runs."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from marl_encircle.drawing.palette import SERIES, Series
from marl_encircle.experiments.learning_curve import Curve
from marl_encircle.experiments.metrics import share_interval
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.study.cells import NOT_RUN
from marl_encircle.study.figures.canvas import WIDTH, note, put_below, rgb, say, style, write_letter
from marl_encircle.study.paper import label, rank

Array = NDArray[np.float64]

FIGURE4_METHODS = ("ours", "model_b", "ma2019")
"""What the paper compares."""

BY_IMPORTANCE = ("ours", "model_b", "ma2019", "model_a", "model_c")
"""The paper's methods, each with its place in ``SERIES``; the places left are for all others in turn."""

SETTINGS = (Setting(1.1, 3, 0), Setting(1.1, 3, 1))


class Band(NamedTuple):
    """The curves of one method in one setting. S training seeds, P points."""

    world_steps: NDArray[np.int64]
    """At which all seeds have a point, (P,)."""
    success: Array
    """Of each seed, (S, P)."""
    low: Array | None
    """Lower end of the mean's interval, (P,); None with one seed."""
    high: Array | None
    """Upper end, (P,)."""

    @property
    def mean(self) -> Array:
        """Over the seeds, (P,)."""
        mean: Array = self.success.mean(axis=0)
        return mean


def band_of(curves: Sequence[Curve], rounds: int) -> Band:
    """Gather the curves of all seeds at the steps that they have in common.

    :param curves: one or more
    :param rounds: that were played at each point; see :func:`~marl_encircle.experiments.metrics.share_interval`
    :raises ValueError: for one without points, or if they have none in common
    """
    if not all(len(curve.world_steps) for curve in curves):
        raise ValueError("a learning curve without points")
    steps = np.array(sorted(set.intersection(*(set(curve.world_steps.tolist()) for curve in curves))), np.int64)
    if not len(steps):
        raise ValueError("the learning curves of the seeds have no step in common")
    success = np.stack([curve.success[np.isin(curve.world_steps, steps)] for curve in curves])
    intervals = [interval for point in success.T if (interval := share_interval(point.tolist(), rounds))]
    if not intervals:
        return Band(steps, success, None, None)
    low, high = np.array(intervals).T
    return Band(steps, success, low, high)


def series_of(method: str, methods: Sequence[str] = ()) -> Series:
    """Return how a method's curve looks: those of the paper's methods are the same in every figure, and nobody else's.

    :param methods: all methods of the figure, which give those that the paper lacks their places
    """
    if method in BY_IMPORTANCE:
        return SERIES[BY_IMPORTANCE.index(method)]
    left = SERIES[len(BY_IMPORTANCE) :]
    return left[in_order({method, *methods} - set(BY_IMPORTANCE)).index(method) % len(left)]


def in_order(methods: Iterable[str]) -> list[str]:
    """Sort methods by their importance: the paper's, then what goes beyond, then others by name."""
    papers = {method: place for place, method in enumerate(BY_IMPORTANCE)}
    return sorted(methods, key=lambda method: (papers.get(method, len(papers)), rank(method)))


@style()
def draw_figure4(
    bands: Mapping[Cell, Band], methods: Sequence[str] = FIGURE4_METHODS, absent: Mapping[Cell, str] | None = None
) -> Figure:
    """Draw success over world steps: mean, interval and every seed, one panel without and one with an obstacle.

    :param bands: of the cells that have runs
    :param methods: to show, the most important one first
    :param absent: cell -> why it has no curve, unless it is not run
    """
    figure = Figure((WIDTH, 2.7))
    all_axes = figure.subplots(1, len(SETTINGS), sharey=True)
    figure.subplots_adjust(left=0.07, right=0.985, top=0.91, bottom=0.285, wspace=0.11)
    shown: dict[str, Artist] = {}
    for axes, letter, setting in zip(all_axes, "ab", SETTINGS, strict=True):
        present = [method for method in methods if Cell(method, setting) in bands]
        for method in reversed(present):
            shown[method] = _draw_band(axes, bands[Cell(method, setting)], method, methods)
        cells = [Cell(method, setting) for method in methods if method not in present]
        _write_missing(axes, {cell: (absent or {}).get(cell, NOT_RUN) for cell in cells}, bool(present))
        _arrange(axes)
        title = "no obstacle" if setting.obstacles == 0 else "one obstacle"
        write_letter(axes, letter, f"{title}, n = {setting.pursuers}, λ = {setting.speed_ratio:g}")
    all_axes[0].set_ylabel("success S [%]")
    handles = [shown[method] for method in methods if method in shown]
    rounds = "success on the selection rounds by each method's own closure rule"
    put_below(figure, handles, f"{rounds}; thick: mean of the training seeds, thin: each, shaded: 95 % interval")
    return figure


def _draw_band(axes: Axes, band: Band, method: str, methods: Sequence[str]) -> Artist:
    """Draw one method; return the line for the legend."""
    series = series_of(method, methods)
    steps, colour = band.world_steps / 1e6, rgb(series.colour)
    for seed in band.success:
        axes.plot(steps, 100 * seed, color=colour, linewidth=0.4, alpha=0.55, zorder=2)
    if band.low is not None and band.high is not None:
        axes.fill_between(steps, 100 * band.low, 100 * band.high, color=colour, alpha=0.16, linewidth=0, zorder=1)
    (line,) = axes.plot(steps, 100 * band.mean, color=colour, zorder=4, label=label(method))
    if series.dashes:
        line.set_dashes(series.dashes)
    return line


def _write_missing(axes: Axes, missing: Mapping[Cell, str], are_others_drawn: bool) -> None:
    """Say what is not drawn and why."""
    if not are_others_drawn and set(missing.values()) == {NOT_RUN}:
        say(axes, NOT_RUN)
    elif missing:
        note(axes, "\n".join(f"{label(cell.method)}: {reason}" for cell, reason in missing.items()))


def _arrange(axes: Axes) -> None:
    axes.set(ylim=(-2, 102), yticks=range(0, 101, 20), xlabel="training [million world steps]")
    axes.margins(x=0.01)
    axes.set_xlim(left=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))  # neighbours' labels would meet with more
    axes.grid(axis="y")
