"""Drawing one world with pygame-ce: into an array without a display, or into a window.

The scene on the left: obstacles, trails, pursuers by colour and number, the target with a ring that shows who owns each
direction around it, the arcs of the Apollonius circles that face it, and, once closed, the area it can still reach.
The panel on the right puts the same measures into figures.
"""

import math
import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import NOBODY, Closure
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator
from marl_encircle.envs.outlines import borders, facing_arc, polar, stretches, wedges
from marl_encircle.envs.palette import (
    BACKGROUND,
    FAINT,
    GOOD,
    GROOVE,
    INK,
    LINE,
    OBSTACLE,
    OBSTACLE_EDGE,
    PAPER,
    Colour,
    entity_colour,
    pursuer_colour,
    readable_on,
)

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    import pygame
except ImportError as error:
    raise ImportError("drawing needs pygame-ce: pip install 'marl-encircle[render]'") from error

Array = NDArray[np.float64]

SCENE = 720
"""Side of the scene [pixels]."""

PANEL = 260
"""Width of the panel [pixels]."""

SUPERSAMPLING = 2
"""Everything is drawn this many times as large and then scaled down, which smooths edges and letters."""


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


def view(simulator: Simulator, closure: Closure, trail: Sequence[Array] = (), world: int = 0) -> View:
    """Return what is to be drawn of a world.

    :param closure: the enclosure that is shown
    :param trail: pursuers and target at this round's states until now, (N + 1, 2) each
    """
    s, enclosure = simulator.state, simulator.measure.enclosure[closure]
    return View(
        simulator.scenario,
        s.pursuers[world],
        s.velocities[world],
        s.target[world],
        s.discs[world],
        float(s.speed_ratio[world]),
        enclosure.owner[world],
        enclosure.distance[world],
        float(enclosure.movement_range[world]),
        bool(enclosure.complete[world]),
        int(simulator.steps[world]),
        trail,
    )


def picture(view: View) -> NDArray[np.uint8]:
    """Return a drawing of the world, (H, W, 3); needs no display."""
    return np.ascontiguousarray(pygame.surfarray.array3d(draw(view)).swapaxes(0, 1))


def draw(view: View) -> Any:
    """Return a drawing of the world as a pygame surface; needs no display."""
    large = pygame.Surface(((SCENE + PANEL) * SUPERSAMPLING, SCENE * SUPERSAMPLING))
    large.fill(PAPER)
    _Scene(large.subsurface((0, 0, SCENE * SUPERSAMPLING, SCENE * SUPERSAMPLING)), view).draw()
    _Panel(large.subsurface((SCENE * SUPERSAMPLING, 0, PANEL * SUPERSAMPLING, SCENE * SUPERSAMPLING)), view).draw()
    return pygame.transform.smoothscale(large, (SCENE + PANEL, SCENE))


class Window:
    """A window that shows one world at a time.

    :param title: of the window
    :param fps: steps shown per second
    :raises RuntimeError: if there is no display
    """

    def __init__(self, title: str, fps: int) -> None:
        try:
            pygame.display.init()
            # Where SDL finds no display it takes one that nobody sees; fine only for those who asked for it.
            if pygame.display.get_driver() in ("offscreen", "dummy") and "SDL_VIDEODRIVER" not in os.environ:
                raise pygame.error("no video device")
            self._screen = pygame.display.set_mode((SCENE + PANEL, SCENE))
        except pygame.error as error:
            pygame.display.quit()
            raise RuntimeError(
                f"render_mode='human' found no display to open a window on ({error}); use render_mode='rgb_array', "
                "which needs none, or set SDL_VIDEODRIVER=dummy to draw into nothing"
            ) from error
        pygame.display.set_caption(title)
        self._fps = fps
        self._clock = pygame.time.Clock()

    def show(self, view: View) -> None:
        """Show a world, not before the former one has had its time; closing the window ends the showing."""
        if not pygame.display.get_init():
            return
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return
        self._screen.blit(draw(view), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()


class _Scene:
    """The left part of a drawing, in which scene units become pixels."""

    def __init__(self, surface: Any, view: View) -> None:
        self.surface, self.view = surface, view
        scenario = view.scenario
        # Bodies' centres reach the edge, so that the picture is wider than the scene by a body.
        reach = scenario.half_width + max(scenario.pursuer_radius, scenario.target_radius, 0.04 * scenario.half_width)
        self.side = surface.get_width()
        self.scale = self.side / (2 * reach)
        edge = scenario.half_width * self.scale
        self.area = pygame.Rect(self.side / 2 - edge, self.side / 2 - edge, 2 * edge, 2 * edge)

    def draw(self) -> None:
        """Draw from the ground up."""
        self._draw_ground()
        self.surface.set_clip(self.area)
        self._draw_wedges()
        self._draw_trails()
        self._draw_arcs()
        self.surface.set_clip(None)
        self._draw_obstacles()
        self._draw_ring()
        self._draw_pursuers()
        self._draw_target()

    def _pixel(self, place: Array) -> tuple[float, float]:
        """Return where a place in the scene lies on the surface; y points up in the scene, down in the picture."""
        return self.side / 2 + float(place[0]) * self.scale, self.side / 2 - float(place[1]) * self.scale

    def _polar(self, angles: NDArray[np.floating[Any]], distances: Array) -> list[tuple[float, float]]:
        """Return pixels at these angles and distances from the target."""
        distances = np.minimum(distances, 4 * self.view.scenario.half_width)  # far outside of the picture
        return [self._pixel(place) for place in polar(self.view.target, angles, distances)]

    def _draw_ground(self) -> None:
        self.surface.fill(BACKGROUND)
        pygame.draw.rect(self.surface, PAPER, self.area)
        for share in np.linspace(0, 1, 9)[1:-1]:
            x, y = self.area.left + share * self.area.width, self.area.top + share * self.area.height
            pygame.draw.line(self.surface, BACKGROUND, (x, self.area.top), (x, self.area.bottom), SUPERSAMPLING)
            pygame.draw.line(self.surface, BACKGROUND, (self.area.left, y), (self.area.right, y), SUPERSAMPLING)
        pygame.draw.rect(self.surface, LINE, self.area, 2 * SUPERSAMPLING)

    def _draw_wedges(self) -> None:
        """Tint what the target can reach before it is met, in the colour of who meets it there."""
        view, closed = self.view, math.isfinite(self.view.movement_range)
        layer = pygame.Surface((self.side, self.side), pygame.SRCALPHA)
        centre = self._pixel(view.target)
        for wedge in wedges(view.owner, view.distance, closed):
            colour = entity_colour(wedge.owner, view.scenario.pursuers)
            pixels = self._polar(wedge.angles, wedge.distances)
            pygame.draw.polygon(layer, (*colour, 110 if closed else 42), [centre, *pixels])
        self.surface.blit(layer, (0, 0))
        if closed:
            count = len(view.owner)
            outline = self._polar(np.arange(count) * (2 * np.pi / count), view.distance)
            pygame.draw.lines(self.surface, INK, True, outline, 2 * SUPERSAMPLING)

    def _draw_trails(self) -> None:
        if len(self.view.trail) < 2:
            return
        layer = pygame.Surface((self.side, self.side), pygame.SRCALPHA)
        path = np.stack(self.view.trail)
        for body in range(path.shape[1]):
            colour = pursuer_colour(body) if body < path.shape[1] - 1 else INK
            pixels = [self._pixel(place) for place in path[:, body]]
            for age, (start, end) in enumerate(zip(pixels[-2::-1], pixels[:0:-1], strict=True)):
                opacity = max(40, 190 - 6 * age)
                pygame.draw.line(layer, (*colour, opacity), start, end, 2 * SUPERSAMPLING)
        self.surface.blit(layer, (0, 0))

    def _draw_obstacles(self) -> None:
        # All edges first: discs of one obstacle that overlap get one outline.
        for colour, edge in ((OBSTACLE_EDGE, 0), (OBSTACLE, 2 * SUPERSAMPLING)):
            for disc in self.view.discs:
                pygame.draw.circle(self.surface, colour, self._pixel(disc), disc[2] * self.scale - edge)

    def _draw_arcs(self) -> None:
        """Draw the part of each Apollonius circle that faces the target."""
        ratio = self.view.speed_ratio
        for i, offset in enumerate(self.view.pursuers - self.view.target):
            if np.hypot(*offset) == 0.0:
                continue
            pixels = self._polar(*facing_arc(offset, ratio))
            pygame.draw.lines(self.surface, pursuer_colour(i), False, pixels, SUPERSAMPLING)

    def _draw_ring(self) -> None:
        unit = max(self.view.scenario.target_radius, 0.02 * self.view.scenario.half_width) * self.scale
        _draw_ring(self.surface, self.view, self._pixel(self.view.target), 1.3 * unit, 1.75 * unit)

    def _draw_target(self) -> None:
        x, y = self._pixel(self.view.target)
        radius = max(self.view.scenario.target_radius * self.scale, 4 * SUPERSAMPLING)
        pygame.draw.circle(self.surface, INK, (x, y), radius)
        pygame.draw.circle(self.surface, PAPER, (x, y), 0.55 * radius)
        pygame.draw.circle(self.surface, INK, (x, y), 0.27 * radius)

    def _draw_pursuers(self) -> None:
        radius = max(self.view.scenario.pursuer_radius * self.scale, 4 * SUPERSAMPLING)
        for i, (place, velocity) in enumerate(zip(self.view.pursuers, self.view.velocities, strict=True)):
            x, y = self._pixel(place)
            speed = float(np.hypot(*velocity)) / self.view.scenario.max_speed
            if speed > 0.02:
                angle = math.atan2(-velocity[1], velocity[0])
                tip = radius * (1.25 + 0.75 * speed)
                corners = [(tip, 0.0), (1.02 * radius, 0.5), (1.02 * radius, -0.5)]
                arrow = [(x + r * math.cos(angle + turn), y + r * math.sin(angle + turn)) for r, turn in corners]
                pygame.draw.polygon(self.surface, INK, arrow)
            pygame.draw.circle(self.surface, INK, (x, y), radius)
            pygame.draw.circle(self.surface, pursuer_colour(i), (x, y), radius - 2 * SUPERSAMPLING)
            size = int(1.3 * radius / SUPERSAMPLING)
            if size >= 8:
                _write(self.surface, str(i), (x, y), size, readable_on(pursuer_colour(i)), 0.5)


class _Panel:
    """The right part of a drawing: the round, the ring at large, everybody's share, the movement range."""

    def __init__(self, surface: Any, view: View) -> None:
        self.surface, self.view = surface, view
        self.left, self.right = 22 * SUPERSAMPLING, (PANEL - 22) * SUPERSAMPLING
        self.closed = math.isfinite(view.movement_range)

    def draw(self) -> None:
        """Draw from top to bottom."""
        pygame.draw.line(self.surface, LINE, (0, 0), (0, self.surface.get_height()), SUPERSAMPLING)
        view, closed = self.view, self.closed
        state, colour = ("complete", GOOD) if view.complete else ("closed", INK) if closed else ("open", FAINT)
        self._write(state, 36, 28, colour)
        self._write(f"step {view.step} of {view.scenario.max_cycles}", 37, 17, FAINT, at_right=True)
        self._draw_ring(174)
        bottom = self._draw_shares(300)
        self._draw_movement_range(bottom + 30)
        self._write(f"target {view.speed_ratio:g} times as fast", 696, 17, FAINT)

    def _draw_ring(self, y: float) -> None:
        centre = (self.surface.get_width() / 2, y * SUPERSAMPLING)
        _draw_ring(self.surface, self.view, centre, 62 * SUPERSAMPLING, 90 * SUPERSAMPLING)
        owned = float((self.view.owner != NOBODY).mean())
        _write(self.surface, f"{owned:.0%}", (centre[0], centre[1] - 6 * SUPERSAMPLING), 38, INK, 0.5)
        _write(self.surface, "of the circle", (centre[0], centre[1] + 22 * SUPERSAMPLING), 16, FAINT, 0.5)

    def _draw_shares(self, y: float) -> float:
        """Draw one bar each; return where they end."""
        self._write("contributing angles", y, 17, FAINT)
        shares = _shares(self.view)
        height = min(22.0, 250 / len(shares))
        y += 24 - height / 2
        for label, share, colour in shares:
            y += height
            self._draw_bar(y, min(10, height), 34, 50, share, colour)
            if height >= 12:
                self._write(label, y, 17, INK)
                self._write(f"{share:.0%}", y, 17, INK, at_right=True)
        return y + height / 2

    def _draw_movement_range(self, y: float) -> None:
        view, limit = self.view, self.view.scenario.movement_range_limit
        self._write("movement range", y, 17, FAINT)
        self._write(f"{view.movement_range:.3g}" if self.closed else "unbounded", y, 17, INK, at_right=True)
        # From a hundred times the limit down to it, by orders of magnitude.
        share = 1 - math.log10(max(view.movement_range / limit, 1.0)) / 2 if self.closed else 0.0
        self._draw_bar(y + 24, 12, 0, 0, share, GOOD if view.complete else INK)
        self._write(f"complete below {limit:g}", y + 46, 15, FAINT, at_right=True)

    def _draw_bar(self, y: float, height: float, indent: float, outdent: float, share: float, colour: Colour) -> None:
        """Draw a bar around y that is full at 1."""
        left, right = self.left + indent * SUPERSAMPLING, self.right - outdent * SUPERSAMPLING
        area = pygame.Rect(left, (y - height / 2) * SUPERSAMPLING, right - left, height * SUPERSAMPLING)
        pygame.draw.rect(self.surface, GROOVE, area, border_radius=area.height // 2)
        width = round(area.width * min(max(share, 0.0), 1.0))
        if width > 0:
            # A short bar has no room for round ends of its own: cut it from a full one.
            self.surface.set_clip((*area.topleft, width, area.height))
            pygame.draw.rect(self.surface, colour, area, border_radius=area.height // 2)
            self.surface.set_clip(None)

    def _write(self, text: str, y: float, size: int, colour: Colour, at_right: bool = False) -> None:
        place = (self.right if at_right else self.left, y * SUPERSAMPLING)
        _write(self.surface, text, place, size, colour, 1.0 if at_right else 0.0)


def _shares(view: View) -> list[tuple[str, float, Colour]]:
    """Return label, share of the circle and colour of every pursuer, and of the obstacles together."""
    n = view.scenario.pursuers
    shares = [(str(i), float((view.owner == i).mean()), pursuer_colour(i)) for i in range(n)]
    if len(view.discs):
        shares.append(("obst.", float((view.owner >= n).mean()), OBSTACLE))
    return shares


def _draw_ring(surface: Any, view: View, centre: tuple[float, float], inner: float, outer: float) -> None:
    """Draw a ring whose segments have the colours of who owns these directions; nobody's are left pale."""
    for owner, directions in stretches(view.owner):
        angles = borders(directions, len(view.owner))
        fine = np.linspace(angles[0], angles[-1], 6 * len(angles))
        unit = np.stack([np.cos(fine), -np.sin(fine)], axis=1)
        outline = np.concatenate([centre + outer * unit, centre + inner * unit[::-1]])
        colour = LINE if owner == NOBODY else entity_colour(owner, view.scenario.pursuers)
        pygame.draw.polygon(surface, colour, outline.tolist())


def _write(surface: Any, text: str, place: tuple[float, float], size: int, colour: Colour, align: float) -> None:
    """Write text around the height of ``place``: to its right (``align`` 0), around it (0.5) or to its left (1)."""
    written = _font(size * SUPERSAMPLING).render(text, True, colour)
    surface.blit(written, (place[0] - align * written.get_width(), place[1] - written.get_height() / 2))


@lru_cache
def _font(size: int) -> Any:
    pygame.font.init()
    return pygame.font.Font(None, size)
