"""Letters, bars and rings with pygame-ce, drawn larger than they will be seen."""

import importlib.util
import os
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.geometry import NOBODY
from marl_encircle.drawing.outlines import borders, stretches
from marl_encircle.drawing.palette import GROOVE, LINE, Colour, entity_colour

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    import pygame
except ImportError as error:
    raise ImportError("drawing needs pygame-ce: pip install 'marl-encircle[render]'") from error

__all__ = ["SUPERSAMPLING", "cut", "draw_bar", "draw_owners", "font", "pygame", "write"]

SUPERSAMPLING = 2
"""Everything is drawn this many times as large and then scaled down, which smooths edges and letters."""

Surface = Any
Place = tuple[float, float]


def write(
    surface: Surface, text: str, place: Place, size: int, colour: Colour, align: float = 0.0, bold: bool = False
) -> None:
    """Write text around the height of a place: to its right (``align`` 0), around it (0.5) or to its left (1).

    :param text: in a symbol such as ``R_m`` the second letter is set lower and smaller
    :param place: [pixels of the surface]
    :param size: of the letters [pixels of the finished drawing]
    """
    pieces = [
        (font(round(size * SUPERSAMPLING * (0.72 if lowered else 1)), bold).render(piece, True, colour), lowered)
        for lowered, piece in _pieces(text)
    ]
    x = place[0] - align * sum(piece.get_width() for piece, _ in pieces)
    for piece, lowered in pieces:
        drop = 0.3 * size * SUPERSAMPLING if lowered else 0.0
        surface.blit(piece, (x, place[1] - piece.get_height() / 2 + drop))
        x += piece.get_width()


def cut(text: str, size: int, width: float, bold: bool = False) -> str:
    """Return as much of a text as fits into a width [pixels of the finished drawing]."""
    letters = font(size * SUPERSAMPLING, bold)
    while len(text) > 1 and letters.size(text)[0] > width * SUPERSAMPLING:
        text = text.removesuffix("…")[:-1] + "…"
    return text


def _pieces(text: str) -> list[tuple[bool, str]]:
    """Return whether each piece of a text is set lower, and the piece."""
    parts = re.split(r"(?<=\b\w)_(\w)\b", text)
    return [(number % 2 == 1, part) for number, part in enumerate(parts) if part]


@lru_cache
def font(size: int, bold: bool = False) -> Any:
    """Return the letters of the figures, which come with Matplotlib; pygame's own where that is missing."""
    pygame.font.init()
    pygame.register_quit(font.cache_clear)  # another environment may end pygame when it is closed
    matplotlib = importlib.util.find_spec("matplotlib")
    if matplotlib is None or matplotlib.origin is None:
        return pygame.font.Font(None, round(1.2 * size))
    folder = Path(matplotlib.origin).parent / "mpl-data" / "fonts" / "ttf"
    return pygame.font.Font(folder / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"), size)


def draw_bar(surface: Surface, area: tuple[float, float, float, float], share: float, colour: Colour) -> None:
    """Draw a bar that is full at 1.

    :param area: left, top, width, height [pixels of the surface]
    """
    bar = pygame.Rect(area)
    pygame.draw.rect(surface, GROOVE, bar, border_radius=bar.height // 2)
    width = round(bar.width * min(max(share, 0.0), 1.0))
    if width > 0:
        # A short bar has no room for round ends of its own: cut it from a full one.
        surface.set_clip((*bar.topleft, width, bar.height))
        pygame.draw.rect(surface, colour, bar, border_radius=bar.height // 2)
        surface.set_clip(None)


def draw_owners(
    surface: Surface, owner: NDArray[np.int8], pursuers: int, centre: Place, inner: float, outer: float
) -> None:
    """Draw a ring whose segments have the colours of who owns these directions; nobody's are left pale.

    :param owner: who is met first in each direction, (K,)
    :param pursuers: N
    """
    for who, directions in stretches(owner):
        angles = borders(directions, len(owner))
        fine = np.linspace(angles[0], angles[-1], 2 + round(outer * (angles[-1] - angles[0])))  # a pixel each
        unit = np.stack([np.cos(fine), -np.sin(fine)], axis=1)
        outline = np.concatenate([centre + outer * unit, centre + inner * unit[::-1]])
        colour = LINE if who == NOBODY else entity_colour(who, pursuers)
        pygame.draw.polygon(surface, colour, outline.tolist())
