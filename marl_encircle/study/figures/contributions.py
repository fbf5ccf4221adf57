"""Figure 5: how evenly the pursuers contribute, with and without the individual contributing angle."""

import math
from collections.abc import Callable, Mapping, Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marl_encircle.experiments.metrics import CellSummary, Estimate
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.study.cells import NOT_RUN
from marl_encircle.study.figures.canvas import WIDTH, note, put_below, rgb, say, style, write_letter
from marl_encircle.study.figures.curves import series_of
from marl_encircle.study.paper import label

METHODS = ("ours", "model_c")
SETTINGS = tuple(Setting(1.1, pursuers, 1) for pursuers in (2, 3, 4, 5))


@style()
def draw_figure5(summaries: Mapping[Cell, CellSummary], absent: Mapping[Cell, str] | None = None) -> Figure:
    """Draw sigma_c and success over the number of pursuers, with intervals over the training seeds.

    :param summaries: of the cells that have finished runs, under each method's own rule
    :param absent: cell -> why it has none, unless it is not run
    """
    figure = Figure((WIDTH, 2.6))
    spread, success = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.985, top=0.9, bottom=0.295, wspace=0.2)
    handles = _draw_panel(spread, summaries, lambda summary: summary.sigma_c, 1.0, absent or {})
    _draw_panel(success, summaries, lambda summary: summary.success, 100.0, absent or {})
    write_letter(spread, "a", "spread of the contributing angles, all rounds")
    write_letter(success, "b", "success")
    spread.set_ylabel(r"$\sigma_c$ [rad]")
    spread.set_ylim(bottom=0.0)
    success.set(ylabel="success S [%]", ylim=(-2, 102), yticks=range(0, 101, 20))
    text = (
        "mean over the training seeds and its 95 % interval; hollow, not joined: less than half of the rounds are won"
    )
    put_below(figure, handles, text)
    return figure


def _draw_panel(
    axes: Axes,
    summaries: Mapping[Cell, CellSummary],
    value: Callable[[CellSummary], Estimate],
    scale: float,
    absent: Mapping[Cell, str],
) -> list[Artist]:
    """Draw one figure of merit of all methods; return what is to be in the legend."""
    handles: list[Artist] = []
    missing = []
    for place, method in enumerate(METHODS):
        settings = [setting for setting in SETTINGS if Cell(method, setting) in summaries]
        if settings:
            found = [summaries[Cell(method, setting)] for setting in settings]
            shift = 0.1 * (place - (len(METHODS) - 1) / 2)
            places = [setting.pursuers + shift for setting in settings]
            won = [summary.success.mean >= 0.5 for summary in found]
            handles.append(_draw_method(axes, method, places, [value(summary) for summary in found], scale, won))
        reasons: dict[str, list[str]] = {}
        for setting in SETTINGS:
            if setting not in settings:
                reasons.setdefault(absent.get(Cell(method, setting), NOT_RUN), []).append(str(setting.pursuers))
        missing += [f"{label(method)}, n = {', '.join(numbers)}: {reason}" for reason, numbers in reasons.items()]
    axes.set(xlim=(1.6, 5.4), xticks=[setting.pursuers for setting in SETTINGS], xlabel="number of pursuers n")
    axes.grid(axis="y")
    if not handles and not any(Cell(method, setting) in absent for method in METHODS for setting in SETTINGS):
        say(axes, NOT_RUN)
    elif missing:
        note(axes, "\n".join(missing))
    return handles


def _draw_method(
    axes: Axes,
    method: str,
    places: Sequence[float],
    estimates: Sequence[Estimate],
    scale: float,
    won: Sequence[bool],
) -> Artist:
    """Draw one method's means with their intervals; those of settings that are won are filled and joined."""
    series = series_of(method)
    colour = rgb(series.colour)
    means = [scale * estimate.mean for estimate in estimates]
    for place, estimate in zip(places, estimates, strict=True):
        if estimate.interval is not None:
            ends = [scale * end for end in estimate.interval]
            axes.plot([place, place], ends, "_-", color=colour, linewidth=0.9, markersize=5, zorder=3)
    joined = [mean if has else math.nan for mean, has in zip(means, won, strict=True)]
    (line,) = axes.plot(places, joined, series.marker, color=colour, markersize=4.5, zorder=4, label=label(method))
    line.set(linestyle="-", linewidth=1.0)
    if series.dashes:
        line.set_dashes(series.dashes)
    hollow = [(place, mean) for place, mean, has in zip(places, means, won, strict=True) if not has]
    for place, mean in hollow:
        axes.plot(place, mean, series.marker, color=colour, markerfacecolor="white", markersize=4.5, zorder=4)
    return line
