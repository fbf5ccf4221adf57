"""The panel of a drawing: the round, who owns the circle (theta_A), everybody's share, R_m, and success so far."""

import math
from typing import Any, NamedTuple

import numpy as np

from marl_encircle.core.geometry import NOBODY, Closure
from marl_encircle.drawing.palette import FAINT, GOOD, INK, LINE, OBSTACLE, PAPER, Colour, pursuer_colour, readable_on
from marl_encircle.drawing.pen import SUPERSAMPLING, cut, draw_bar, draw_owners, pygame, write
from marl_encircle.drawing.view import View

MARGIN = 22
"""Between the panel's edge and what is in it [pixels]."""

MINUS = "\u2212"

ROWS = 8
"""Pursuers that get a row with a number; more of them get bars without."""


class _Share(NamedTuple):
    label: str
    """Nothing for the obstacles."""
    share: float
    """Of the full circle."""
    colour: Colour


class Panel:
    """Measures of one world, one below the other or, in a low and wide panel, in three columns.

    :param surface: the whole panel
    """

    def __init__(self, surface: Any, view: View) -> None:
        self.surface, self.view = surface, view
        self.width = surface.get_width() // SUPERSAMPLING
        self.height = surface.get_height() // SUPERSAMPLING
        self.left, self.right = MARGIN, self.width - MARGIN

    def draw_column(self) -> None:
        """Draw from top to bottom."""
        pygame.draw.line(self.surface, LINE, (0, 0), (0, self.surface.get_height()), SUPERSAMPLING)
        self._draw_title(30)
        self._draw_step(31)
        self._draw_circle((self.width / 2, 160), 84)
        bottom = self._draw_shares(276)
        bottom = self._draw_movement_range(bottom + 34)
        bottom = self._draw_success(bottom + 38)
        self._draw_rewards(bottom + 32)
        lines = [*self.view.caption.splitlines(), f"target {self.view.speed_ratio:g} times as fast"]
        for number, line in enumerate(reversed(lines)):
            self._write(cut(line, 11, self.right - self.left), self.height - 24 - 18 * number, 11, FAINT)

    def draw_head(self) -> None:
        """Draw what is shown, above a scene."""
        self._draw_title(self.height / 2)
        caption = self.view.caption.replace("\n", ", ")
        self._draw_step(self.height / 2 - (9 if caption else 0))
        self._write(caption, self.height / 2 + 10, 11, FAINT, at_right=True)

    def draw_row(self) -> None:
        """Draw from left to right."""
        left, right = self.left, self.right
        self._draw_circle((left + 60, self.height / 2 - 2), 60)
        self.left, self.right = left + 136, left + 318
        self._draw_shares(24)
        self.left, self.right = left + 342, right
        bottom = self._draw_movement_range(24)
        bottom = self._draw_success(bottom + 20)
        self._draw_rewards(bottom + 24)
        self.left, self.right = left, right

    def _draw_title(self, y: float) -> None:
        """Write what is shown; without a title, how the enclosure stands."""
        view = self.view
        word, colour = ("complete", GOOD) if view.complete else ("closed", INK) if view.closed else ("open", FAINT)
        title = cut(view.title, 17, 0.58 * (self.right - self.left), bold=True)
        self._write(title or word, y, 17, INK if title else colour, bold=True)

    def _draw_step(self, y: float) -> None:
        self._write(f"step {self.view.step} of {self.view.scenario.max_cycles}", y, 12, FAINT, at_right=True)

    def _draw_circle(self, centre: tuple[float, float], radius: float) -> None:
        """Draw theta_A: the share of the circle that somebody owns, and who."""
        x, y = centre
        large = (x * SUPERSAMPLING, y * SUPERSAMPLING)
        inner, outer = 0.7 * radius * SUPERSAMPLING, radius * SUPERSAMPLING
        draw_owners(self.surface, self.view.owner, self.view.scenario.pursuers, large, inner, outer)
        owned = float((self.view.owner != NOBODY).mean())
        # Rounded down, so that 100 % is said of the whole circle alone.
        symbol = "θ_A" if self.view.closure == "all" else "θ_G"
        self._write_at(
            f"{math.floor(100 * owned + 1e-9)}%", (x, y - 0.1 * radius), round(0.3 * radius), INK, 0.5, bold=True
        )
        self._write_at(f"{symbol} = {360 * owned:.0f}°", (x, y + 0.26 * radius), 12, FAINT, 0.5)

    def _draw_shares(self, y: float) -> float:
        """Draw one bar each; return where they end."""
        self._write("contributing angles θ_c", y, 12, FAINT)
        shares = _shares(self.view)
        room = 176.0 if self.height > self.width else self.height - y - 24
        height = min(22.0, room / len(shares))
        y += 24 - height / 2
        for label, share, colour in shares:
            y += height
            named = len(shares) <= ROWS
            self._draw_bar(y - 2, min(10, 0.8 * height), 30 if named else 0, 44 if named else 0, share, colour)
            if named:
                self._draw_name(label, y - 2, colour)
                self._write("<1%" if 0 < share < 0.005 else f"{share:.0%}", y - 2, 12, INK, at_right=True)
        return y + height / 2

    def _draw_name(self, label: str, y: float, colour: Colour) -> None:
        """Draw the body that a row is about."""
        place = ((self.left + 9) * SUPERSAMPLING, y * SUPERSAMPLING)
        pygame.draw.circle(self.surface, INK, place, 9 * SUPERSAMPLING)
        pygame.draw.circle(self.surface, colour, place, 8 * SUPERSAMPLING)
        if label:
            write(self.surface, label, place, 11, readable_on(colour), 0.5, bold=True)

    def _draw_movement_range(self, y: float) -> float:
        """Draw R_m by orders of magnitude, from a hundred times its limit down to it; return where that ends."""
        view, limit = self.view, self.view.scenario.movement_range_limit
        self._write("movement range R_m", y, 12, FAINT)
        self._write(f"{view.movement_range:.3g}" if view.closed else "open", y, 12, INK, at_right=True)
        share = 1 - math.log10(max(view.movement_range / limit, 1.0)) / 2 if view.closed else 0.0
        self._draw_bar(y + 21, 12, 0, 0, share, GOOD if view.complete else INK)
        self._write(f"complete below {limit:g}", y + 40, 11, FAINT, at_right=True)
        return y + 46

    def _draw_success(self, y: float) -> float:
        """Write when each rule first held; return where that ends."""
        view = self.view
        if view.success is None:
            return y
        self._write("success", y, 12, FAINT)
        labels: dict[Closure, str] = {"all": "with obstacles", "pursuers": "pursuers alone"}
        for rule, label in labels.items():
            if rule == "all" and not len(view.discs):
                continue  # the same as the other
            y += 22
            step = view.success[rule]
            own = rule == view.closure or not len(view.discs)
            place = ((self.left + 7) * SUPERSAMPLING, y * SUPERSAMPLING)
            pygame.draw.circle(self.surface, LINE if step is None else GOOD, place, 7 * SUPERSAMPLING)
            if step is not None:
                tick = [(-3.2, 0.2), (-0.9, 2.6), (3.4, -2.6)]
                points = [(place[0] + dx * SUPERSAMPLING, place[1] + dy * SUPERSAMPLING) for dx, dy in tick]
                pygame.draw.lines(self.surface, PAPER, False, points, 2 * SUPERSAMPLING)
            self._write_at(label, (self.left + 22, y), 12, INK, 0.0, bold=own)
            self._write("not yet" if step is None else f"step {step}", y, 12, INK, at_right=True)
        return y

    def _draw_rewards(self, y: float) -> None:
        if self.view.rewards is not None:
            now, until_now = self.view.rewards
            self._write("reward", y, 12, FAINT)
            self._write(f"{now:+.2f}, sum {until_now:+.2f}".replace("-", MINUS), y, 12, INK, at_right=True)

    def _draw_bar(self, y: float, height: float, indent: float, outdent: float, share: float, colour: Colour) -> None:
        """Draw a bar around y that is full at 1."""
        left, right = self.left + indent, self.right - outdent
        area = [SUPERSAMPLING * each for each in (left, y - height / 2, right - left, height)]
        draw_bar(self.surface, (area[0], area[1], area[2], area[3]), share, colour)

    def _write(
        self, text: str, y: float, size: int, colour: Colour, at_right: bool = False, bold: bool = False
    ) -> None:
        place = (self.right if at_right else self.left, y)
        self._write_at(text, place, size, colour, 1.0 if at_right else 0.0, bold)

    def _write_at(
        self, text: str, place: tuple[float, float], size: int, colour: Colour, align: float, bold: bool = False
    ) -> None:
        write(self.surface, text, (place[0] * SUPERSAMPLING, place[1] * SUPERSAMPLING), size, colour, align, bold)


def _shares(view: View) -> list[_Share]:
    """Return the share of every pursuer, and of the obstacles together."""
    n = view.scenario.pursuers
    shares = [_Share(str(i), float(np.mean(view.owner == i)), pursuer_colour(i)) for i in range(n)]
    if len(view.discs):
        shares.append(_Share("", float(np.mean(view.owner >= n)), OBSTACLE))
    return shares
