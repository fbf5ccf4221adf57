"""Learning curves as SVG within HTML: their colours are classes, so that they follow the page's."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from marl_encircle.drawing.palette import SERIES
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.study.cells import NOT_RUN
from marl_encircle.study.figures.curves import Band, series_of
from marl_encircle.study.paper import label, rank
from marl_encircle.study.report.replays import in_words

WIDTH, HEIGHT = 360, 220
LEFT, RIGHT, TOP, BOTTOM = 36, 352, 10, 186
"""The frame of the curves within the panel."""

_MILLION = 1e6


def charts(bands: Mapping[Cell, Band], asked: Sequence[Cell], absent: Mapping[Cell, str]) -> str:
    """Return a legend and a panel for each setting: mean, interval and every seed of each method.

    :param bands: of the cells that have finished runs
    :param asked: all cells; those without curves are named
    :param absent: cell -> why it has no curve, unless it is not run
    """
    methods = sorted({cell.method for cell in asked}, key=rank)
    settings = sorted({cell.setting for cell in asked})
    drawn = [setting for setting in settings if any(Cell(method, setting) in bands for method in methods)]
    parts = []
    if drawn:
        panels = (_panel(setting, bands, asked, absent, methods) for setting in drawn)
        legend = _legend([method for method in methods if any(cell.method == method for cell in bands)], methods)
        parts += [legend, '<div class="charts">', *panels, "</div>"]
    without: dict[str, list[str]] = {}
    for setting in settings:
        if setting not in drawn:
            reasons = (absent.get(cell, NOT_RUN) for cell in asked if cell.setting == setting)
            without.setdefault(", ".join(dict.fromkeys(reasons)), []).append(in_words(setting))
    for reason, names in without.items():
        text = f"{reason[0].upper()}{reason[1:]}: {'; '.join(names)}."
        parts.append(f'<p class="quiet">{escape(text)}</p>')
    return "\n".join(parts)


def _legend(drawn: Sequence[str], methods: Sequence[str]) -> str:
    items = (
        f'<li><svg width="34" height="10" aria-hidden="true">{_line([(1, 5), (33, 5)], method, methods)}</svg>'
        f"{escape(label(method))}</li>"
        for method in drawn
    )
    return f'<ul class="legend">{"".join(items)}</ul>'


def _panel(
    setting: Setting,
    bands: Mapping[Cell, Band],
    asked: Sequence[Cell],
    absent: Mapping[Cell, str],
    methods: Sequence[str],
) -> str:
    cells = {method: Cell(method, setting) for method in methods}
    present = {method: bands[cell] for method, cell in cells.items() if cell in bands}
    last = max(float(band.world_steps[-1]) for band in present.values()) or 1.0
    ends = ", ".join(f"{label(method)} {100 * band.mean[-1]:.0f} %" for method, band in present.items())
    curves = "".join(_band(band, method, methods, last) for method, band in reversed(present.items()))
    missing = [
        f"{label(method)}: {absent.get(cell, NOT_RUN)}"
        for method, cell in cells.items()
        if method not in present and cell in asked
    ]
    note = f'<span class="quiet">{escape("; ".join(missing))}</span>' if missing else ""
    return (
        f'<figure class="chart"><figcaption>{escape(in_words(setting))}{note}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img"'
        f' aria-label="{escape(f"Success over training, {in_words(setting)}; at the end {ends}")}">'
        f"{_axes(last)}{curves}</svg></figure>"
    )


def _axes(last: float) -> str:
    """Grid, ticks and their labels.

    :param last: world steps at the right end
    """
    parts = []
    for share in (0, 25, 50, 75, 100):
        y = _y(share / 100)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{share}</text>')
    for place in ticks(last / _MILLION):
        x = _x(place * _MILLION, last)
        parts.append(f'<text class="tick" x="{x:.1f}" y="{BOTTOM + 16}" text-anchor="middle">{place:g}</text>')
    middle = (LEFT + RIGHT) / 2
    parts.append(f'<text class="tick" x="{middle}" y="{HEIGHT - 4}" text-anchor="middle">million world steps</text>')
    return "".join(parts)


def ticks(last: float) -> list[float]:
    """Return round places from 0 to ``last``, five or six of them at most."""
    if last <= 0:
        return [0.0]
    power = 10.0 ** np.floor(np.log10(last / 5))
    step = next(step for step in (power, 2 * power, 5 * power, 10 * power) if last / step <= 5 + 1e-9)
    return [round(i * float(step), 12) for i in range(int(last / step + 1e-9) + 1)]


def _band(band: Band, method: str, methods: Sequence[str], last: float) -> str:
    places = [_x(float(step), last) for step in band.world_steps]
    colour = f"series-{_number(method, methods)}"
    parts = []
    if band.low is not None and band.high is not None:
        edge = [*_points(places, band.high), *_points(places, band.low)[::-1]]
        parts.append(f'<path class="interval {colour}" d="{_path(edge)}Z"/>')
    if len(band.success) > 1:
        parts += [f'<path class="seed {colour}" d="{_path(_points(places, seed))}"/>' for seed in band.success]
    parts.append(_line(_points(places, band.mean), method, methods))
    return f"<g><title>{escape(label(method))}</title>{''.join(parts)}</g>"


def _line(points: Sequence[tuple[float, float]], method: str, methods: Sequence[str]) -> str:
    series = series_of(method, methods)
    dashes = f' stroke-dasharray="{" ".join(f"{2 * dash:g}" for dash in series.dashes)}"' if series.dashes else ""
    return f'<path class="mean series-{_number(method, methods)}"{dashes} d="{_path(points)}"/>'


def _number(method: str, methods: Sequence[str]) -> int:
    return SERIES.index(series_of(method, methods))


def _points(places: Sequence[float], success: NDArray[np.float64]) -> list[tuple[float, float]]:
    return [(x, _y(float(share))) for x, share in zip(places, success, strict=True)]


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _x(world_steps: float, last: float) -> float:
    return LEFT + (RIGHT - LEFT) * world_steps / last


def _y(share: float) -> float:
    return BOTTOM - (BOTTOM - TOP) * share
