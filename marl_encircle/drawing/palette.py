"""The colours and line styles of every drawing: of the window, of recorded rounds and of the figures."""

from typing import NamedTuple

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

PURSUERS: tuple[Colour, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (213, 94, 0),
    (240, 228, 66),
)
"""Okabe and Ito's colours, which colour-blind people tell apart; an eighth pursuer has the first one's again."""

INK: Colour = (34, 34, 38)
FAINT: Colour = (106, 106, 112)
LINE: Colour = (214, 214, 216)
PAPER: Colour = (255, 255, 255)
BACKGROUND: Colour = (246, 246, 244)
GROOVE: Colour = (236, 236, 234)
OBSTACLE: Colour = (114, 114, 120)
"""So dark that nobody takes it for the fourth pursuer's."""
OBSTACLE_EDGE: Colour = (72, 72, 78)
GOOD: Colour = (0, 122, 89)
GAP: Colour = (213, 94, 0)
"""Where nobody is met."""


class Series(NamedTuple):
    """How one of several curves is told from the others, also without colours."""

    colour: Colour
    dashes: tuple[float, ...]
    """Lengths drawn and left out in turn [line widths]; empty for a solid line."""
    marker: str
    """In Matplotlib's letters."""


SERIES: tuple[Series, ...] = (
    Series((0, 114, 178), (), "o"),
    Series((213, 94, 0), (5.0, 1.6), "s"),
    Series((0, 158, 115), (1.2, 1.4), "^"),
    Series((204, 121, 167), (5.0, 1.4, 1.2, 1.4), "D"),
    Series((110, 110, 116), (9.0, 2.0), "v"),
    Series((86, 180, 233), (3.0, 1.2, 1.2, 1.2, 1.2, 1.2), "P"),
    Series((146, 92, 30), (2.6, 1.2), "X"),
    Series((98, 60, 168), (8.0, 1.4, 1.2, 1.4, 1.2, 1.4), "*"),
)
"""Curves in the order of their importance."""


def pursuer_colour(pursuer: int) -> Colour:
    """Return the colour of a pursuer."""
    return PURSUERS[pursuer % len(PURSUERS)]


def entity_colour(entity: int, pursuers: int) -> Colour:
    """Return the colour of the owner of a direction: pursuers come first, then obstacles.

    :param pursuers: number of pursuers N
    """
    return pursuer_colour(entity) if entity < pursuers else OBSTACLE


def mixed(colour: Colour, share: float) -> Colour:
    """Return a colour diluted with that of the paper.

    :param share: of the colour, 0 to 1
    """
    red, green, blue = (round(share * own + (1 - share) * white) for own, white in zip(colour, PAPER, strict=True))
    return red, green, blue


def readable_on(colour: Colour) -> Colour:
    """Return black or white, whichever stands out more."""
    red, green, blue = colour
    return INK if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else PAPER
