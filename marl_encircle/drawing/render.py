"""Drawing one world with pygame-ce: into an array without a display, or into a window.

The scene on the left: obstacles, trails, pursuers by colour and number, the target with a ring that shows who owns each
direction around it, the arcs of the Apollonius circles that face it, and, once closed, the area it can still reach.
The panel on the right puts the same measures into figures.
"""

import math
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_encircle.drawing.gauges import Panel
from marl_encircle.drawing.outlines import facing_arc, far_arc, polar, wedges
from marl_encircle.drawing.palette import (
    BACKGROUND,
    GOOD,
    INK,
    LINE,
    OBSTACLE,
    OBSTACLE_EDGE,
    PAPER,
    entity_colour,
    mixed,
    pursuer_colour,
    readable_on,
)
from marl_encircle.drawing.pen import SUPERSAMPLING, draw_owners, pygame, write
from marl_encircle.drawing.view import Layers, View, view

__all__ = [
    "PANEL",
    "SCENE",
    "Window",
    "array_of",
    "check_display",
    "draw",
    "draw_scene",
    "draw_tall",
    "draw_wide",
    "open_window",
    "picture",
    "shrunk",
    "view",
]

Array = NDArray[np.float64]

SCENE = 720
"""Side of the scene [pixels]."""

PANEL = 260
"""Width of the panel [pixels]."""

TALL_SCENE, TALL_TITLE, TALL_PANEL = 560, 56, 186
"""Of a tall drawing, with the panel below: side of the scene, height of title and panel [pixels]."""

LENS, LENS_REACH = 0.36, 0.19
"""Side of the lens, as a share of the scene's; what it shows to each side of the target [half widths]."""

LENS_LIMIT = 0.2
"""The lens is there once the target can reach no more than a circle of this radius [half widths]."""

COMFORTABLE = 0.7
"""Height of a resizable window on a large screen, as a share of the screen's."""

EVERYTHING = Layers()

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Variables of which at least one is set where there is a display."""


def picture(view: View) -> NDArray[np.uint8]:
    """Return a drawing of the world, (H, W, 3); needs no display."""
    return array_of(draw(view))


def array_of(surface: Any) -> NDArray[np.uint8]:
    """Return the pixels of a pygame surface, (H, W, 3)."""
    return np.ascontiguousarray(pygame.surfarray.array3d(surface).swapaxes(0, 1))


def draw(view: View, layers: Layers = EVERYTHING) -> Any:
    """Return a drawing of the world as a pygame surface, the panel at its right; needs no display."""
    return shrunk(draw_wide(view, layers))


def draw_wide(view: View, layers: Layers = EVERYTHING) -> Any:
    """Return a drawing with the panel at its right, ``SUPERSAMPLING`` times its finished size; see :func:`shrunk`."""
    large = _sheet(SCENE + PANEL, SCENE)
    draw_scene(_part(large, 0, 0, SCENE, SCENE), view, layers)
    Panel(_part(large, SCENE, 0, PANEL, SCENE), view).draw_column()
    return large


def draw_tall(view: View, layers: Layers = EVERYTHING) -> Any:
    """Return a narrower drawing, the panel below, two of which fit side by side; ``SUPERSAMPLING`` times its size."""
    large = _sheet(TALL_SCENE, TALL_TITLE + TALL_SCENE + TALL_PANEL)
    Panel(_part(large, 0, 0, TALL_SCENE, TALL_TITLE), view).draw_head()
    draw_scene(_part(large, 0, TALL_TITLE, TALL_SCENE, TALL_SCENE), view, layers)
    Panel(_part(large, 0, TALL_TITLE + TALL_SCENE, TALL_SCENE, TALL_PANEL), view).draw_row()
    return large


def shrunk(large: Any) -> Any:
    """Return a large drawing in its finished size, with smooth edges."""
    width, height = large.get_size()
    return pygame.transform.smoothscale(large, (width // SUPERSAMPLING, height // SUPERSAMPLING))


def draw_scene(surface: Any, view: View, layers: Layers = EVERYTHING) -> None:
    """Draw the scene alone on a square surface, ``SUPERSAMPLING`` times as large as it will be seen."""
    scene = _Scene(surface, view, layers)
    scene.draw()
    scene.draw_lens()


def _sheet(width: int, height: int) -> Any:
    sheet = pygame.Surface((width * SUPERSAMPLING, height * SUPERSAMPLING))
    sheet.fill(PAPER)
    return sheet


def _part(sheet: Any, left: int, top: int, width: int, height: int) -> Any:
    return sheet.subsurface([SUPERSAMPLING * each for each in (left, top, width, height)])


def check_display(advice: str) -> None:
    """Look for a display, and take it.

    :param advice: what to do where there is none
    :raises RuntimeError: if there is none
    """
    try:
        if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
            raise pygame.error("no video device")  # SDL would try every driver, and some complain on stderr
        pygame.display.init()
        # Where SDL finds no display it takes one that nobody sees; fine only for those who asked for it.
        if pygame.display.get_driver() in ("offscreen", "dummy") and "SDL_VIDEODRIVER" not in os.environ:
            raise pygame.error("no video device")
    except pygame.error as error:
        pygame.display.quit()
        raise RuntimeError(f"found no display to open a window on ({error}); {advice}") from error


def open_window(title: str, size: tuple[int, int], advice: str, resizable: bool = False) -> Any:
    """Return the surface of a new window.

    :param size: width, height [pixels]
    :param advice: what to do where there is no display
    :param resizable: by the user, and at first as large as it is well seen on the screen
    :raises RuntimeError: if there is no display
    """
    check_display(advice)
    try:
        if resizable:
            desktop = pygame.display.get_desktop_sizes()[0]
            share = max(1.0, COMFORTABLE * desktop[1] / size[1])
            share = min(share, 0.92 * desktop[0] / size[0], 0.86 * desktop[1] / size[1])
            size = (max(round(share * size[0]), 1), max(round(share * size[1]), 1))
        screen = pygame.display.set_mode(size, pygame.RESIZABLE if resizable else 0)
    except pygame.error as error:
        pygame.display.quit()
        raise RuntimeError(f"found no display to open a window on ({error}); {advice}") from error
    pygame.display.set_caption(title)
    return screen


class Window:
    """A window that shows one world at a time.

    :param title: of the window
    :param fps: steps shown per second
    :raises RuntimeError: if there is no display
    """

    def __init__(self, title: str, fps: int) -> None:
        advice = (
            "instead of render_mode='human' use render_mode='rgb_array', which needs none, or set "
            "SDL_VIDEODRIVER=dummy to draw into nothing"
        )
        self._screen = open_window(title, (SCENE + PANEL, SCENE), advice)
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
    """The scene, in which scene units become pixels.

    :param centre: of a lens; without one the whole scene is drawn
    """

    def __init__(self, surface: Any, view: View, layers: Layers, centre: Array | None = None) -> None:
        self.surface, self.view, self.layers = surface, view, layers
        scenario = view.scenario
        # Bodies' centres reach the edge, so that the picture is wider than the scene by a body.
        reach = scenario.half_width + max(scenario.pursuer_radius, scenario.target_radius, 0.04 * scenario.half_width)
        self.side = surface.get_width()
        self.centre = np.zeros(2) if centre is None else centre
        self.scale = self.side / (2 * (reach if centre is None else LENS_REACH * scenario.half_width))
        edge = scenario.half_width * self.scale
        left, top = self._pixel(np.array([-scenario.half_width, scenario.half_width]))
        self.area = pygame.Rect(left, top, 2 * edge, 2 * edge)

    def draw(self) -> None:
        """Draw from the ground up."""
        self._draw_ground()
        self.surface.set_clip(self.area)
        if self.layers.area:
            self._draw_wedges()
        if self.layers.trails:
            self._draw_trails()
        if self.layers.circles:
            self._draw_circles()
        self._draw_obstacles()
        pygame.draw.rect(self.surface, LINE, self.area, 2 * SUPERSAMPLING)
        self.surface.set_clip(None)
        if self.layers.angles:
            self._draw_ring()
        self._draw_way_ahead()
        self._draw_pursuers()
        self._draw_target()

    def draw_inside(self) -> None:
        """Draw what bodies and trails would hide: the bodies as outlines."""
        self._draw_ground()
        self.surface.set_clip(self.area)
        if self.layers.area:
            self._draw_wedges()
        if self.layers.circles:
            self._draw_circles()
        self._draw_obstacles()
        pygame.draw.rect(self.surface, LINE, self.area, 2 * SUPERSAMPLING)
        self.surface.set_clip(None)
        radius = max(self.view.scenario.pursuer_radius * self.scale, 4 * SUPERSAMPLING)
        for i, place in enumerate(self.view.pursuers):
            pygame.draw.circle(self.surface, pursuer_colour(i), self._pixel(place), radius, 2 * SUPERSAMPLING)
            write(self.surface, str(i), self._pixel(place), 15, INK, 0.5, bold=True)
        around = max(self.view.scenario.target_radius * self.scale, 4 * SUPERSAMPLING)
        pygame.draw.circle(self.surface, INK, self._pixel(self.view.target), around, SUPERSAMPLING)
        pygame.draw.circle(self.surface, INK, self._pixel(self.view.target), 4 * SUPERSAMPLING)

    def draw_lens(self) -> None:
        """Draw what is about the target larger, in a corner, while the target can reach little."""
        view, half = self.view, self.view.scenario.half_width
        if not (self.layers.lens and math.sqrt(view.movement_range / math.pi) < LENS_LIMIT * half):
            return
        side = round(LENS * self.side)
        gap = self.area.left + 6 * SUPERSAMPLING
        corners = [(x, y) for x in (gap, self.side - gap - side) for y in (gap, self.side - gap - side)]
        bodies = [self._pixel(body) for body in (view.target, *view.pursuers)]

        def room(corner: tuple[int, int]) -> float:
            """Return how far the nearest body is from the middle of the lens."""
            return min(float(max(abs(x - corner[0] - side / 2), abs(y - corner[1] - side / 2))) for x, y in bodies)

        place = max(corners, key=room)
        lens = pygame.Surface((side, side))
        _Scene(lens, view, self.layers, centre=view.target).draw_inside()
        pygame.draw.rect(lens, INK, lens.get_rect(), 2 * SUPERSAMPLING)
        self.surface.blit(lens, place)
        shown = LENS_REACH * half * self.scale
        x, y = bodies[0]
        frame = pygame.Rect(x - shown, y - shown, 2 * shown, 2 * shown).clip(self.area)
        pygame.draw.rect(self.surface, INK, frame, SUPERSAMPLING)

    def _pixel(self, place: Array) -> tuple[float, float]:
        """Return where a place in the scene lies on the surface; y points up in the scene, down in the picture."""
        x, y = place[0] - self.centre[0], place[1] - self.centre[1]
        return self.side / 2 + float(x) * self.scale, self.side / 2 - float(y) * self.scale

    def _pixels(self, places: Array) -> list[tuple[float, float]]:
        """Return where places in the scene, (K, 2), lie on the surface; see :meth:`_pixel`."""
        away = (places - self.centre) * self.scale
        return list(zip((self.side / 2 + away[:, 0]).tolist(), (self.side / 2 - away[:, 1]).tolist(), strict=True))

    def _polar(self, angles: NDArray[np.floating[Any]], distances: Array) -> list[tuple[float, float]]:
        """Return pixels at these angles and distances from the target."""
        distances = np.minimum(distances, 4 * self.view.scenario.half_width)  # far outside of the picture
        return self._pixels(polar(self.view.target, angles, distances))

    def _draw_ground(self) -> None:
        self.surface.fill(BACKGROUND)
        pygame.draw.rect(self.surface, PAPER, self.area)
        for share in np.linspace(0, 1, 9)[1:-1]:
            x, y = self.area.left + share * self.area.width, self.area.top + share * self.area.height
            pygame.draw.line(self.surface, BACKGROUND, (x, self.area.top), (x, self.area.bottom), SUPERSAMPLING)
            pygame.draw.line(self.surface, BACKGROUND, (self.area.left, y), (self.area.right, y), SUPERSAMPLING)

    def _draw_wedges(self) -> None:
        """Tint what the target can reach before it is met, in the colour of who meets it there."""
        view, closed = self.view, self.view.closed
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
            pygame.draw.lines(self.surface, GOOD if view.complete else INK, True, outline, 2 * SUPERSAMPLING)

    def _draw_trails(self) -> None:
        if len(self.view.trail) < 2:
            return
        layer = pygame.Surface((self.side, self.side), pygame.SRCALPHA)
        path = np.stack(self.view.trail)
        for body in range(path.shape[1]):
            colour = pursuer_colour(body) if body < path.shape[1] - 1 else INK
            pixels = self._pixels(path[:, body])
            for age, (start, end) in enumerate(zip(pixels[-2::-1], pixels[:0:-1], strict=True)):
                fading = (*colour, max(60, 220 - 8 * age))
                pygame.draw.line(layer, fading, start, end, (3 if age < 6 else 2) * SUPERSAMPLING)
                pygame.draw.circle(layer, fading, start, 2.5 * SUPERSAMPLING)  # one step is one dot
        self.surface.blit(layer, (0, 0))

    def _draw_obstacles(self) -> None:
        # All edges first: discs of one obstacle that overlap get one outline.
        for colour, edge in ((OBSTACLE_EDGE, 0), (OBSTACLE, 2 * SUPERSAMPLING)):
            for disc in self.view.discs:
                pygame.draw.circle(self.surface, colour, self._pixel(disc), disc[2] * self.scale - edge)

    def _draw_circles(self) -> None:
        """Draw the Apollonius circles, the part that faces the target thicker."""
        ratio, reach = self.view.speed_ratio, 10 * self.view.scenario.half_width
        for i, offset in enumerate(self.view.pursuers - self.view.target):
            if np.hypot(*offset) == 0.0:
                continue
            angles, distances = far_arc(offset, ratio)
            near = distances < reach  # nearly a straight line otherwise
            if near.all():
                pale = mixed(pursuer_colour(i), 0.5)
                pygame.draw.lines(self.surface, pale, False, self._polar(angles, distances), SUPERSAMPLING)
            pixels = self._polar(*facing_arc(offset, ratio))
            pygame.draw.lines(self.surface, pursuer_colour(i), False, pixels, 2 * SUPERSAMPLING)

    def _draw_ring(self) -> None:
        unit = max(self.view.scenario.target_radius, 0.02 * self.view.scenario.half_width) * self.scale
        centre = self._pixel(self.view.target)
        draw_owners(self.surface, self.view.owner, self.view.scenario.pursuers, centre, 1.3 * unit, 1.75 * unit)

    def _draw_way_ahead(self) -> None:
        """Draw the path that the target takes in the next step."""
        if self.view.ahead is None or np.allclose(self.view.ahead, self.view.target):
            return
        radius = max(0.3 * self.view.scenario.target_radius * self.scale, 3 * SUPERSAMPLING)
        start, end = self._pixel(self.view.target), self._pixel(self.view.ahead)
        for colour, wider in ((PAPER, 2 * SUPERSAMPLING), (INK, 0)):
            pygame.draw.line(self.surface, colour, start, end, 2 * SUPERSAMPLING + wider)
            pygame.draw.circle(self.surface, colour, end, radius + wider / 2)
        pygame.draw.circle(self.surface, PAPER, end, radius - 2 * SUPERSAMPLING)

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
            size = int(1.05 * radius / SUPERSAMPLING)
            if size >= 8:
                write(self.surface, str(i), (x, y), size, readable_on(pursuer_colour(i)), 0.5, bold=True)
