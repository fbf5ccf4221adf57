"""The sheet that figures are drawn on, and its bytes: the same in every process and at every hour."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from marl_encircle.drawing.palette import FAINT, INK, LINE, Colour

WIDTH = 7.16
"""Both columns of a paper's page [inches]."""

COLUMN = 3.5
"""One column [inches]."""

SMALL, NORMAL = 7.0, 7.5
"""Sizes of letters in a figure of these widths [points]."""

# Of each format: nothing of the program, the user and the day.
_METADATA: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}
_DPI = 300


def rgb(colour: Colour) -> tuple[float, float, float]:
    """Return a colour as Matplotlib wants it, 0 to 1."""
    red, green, blue = colour
    return red / 255, green / 255, blue / 255


_STYLE: Any = {  # the keys have types of their own
    "font.family": "DejaVu Sans",  # comes with Matplotlib
    "mathtext.fontset": "dejavusans",
    "font.size": NORMAL,
    "axes.titlesize": NORMAL,
    "axes.labelsize": NORMAL,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": NORMAL,
    "legend.handletextpad": 0.5,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "text.color": rgb(INK),
    "axes.labelcolor": rgb(INK),
    "axes.edgecolor": rgb(FAINT),
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": rgb(LINE),
    "grid.linewidth": 0.4,
    "xtick.color": rgb(FAINT),
    "ytick.color": rgb(FAINT),
    "xtick.labelcolor": rgb(INK),
    "ytick.labelcolor": rgb(INK),
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "hatch.linewidth": 0.5,
    "svg.hashsalt": "marl-encircle",
    "svg.fonttype": "path",  # looks the same where the font is missing
    "pdf.fonttype": 42,
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the figures' style, whatever the user's own settings are; they are back afterwards."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def encode(figure: Figure, suffixes: Sequence[str] = ()) -> dict[str, bytes]:
    """Return a figure's files by suffix.

    :param suffixes: the ones to make; ``svg``, ``pdf`` and ``png`` unless told
    """
    encoded = {}
    with style():
        for suffix in suffixes or _METADATA:
            data = io.BytesIO()
            figure.savefig(data, format=suffix, metadata=_METADATA[suffix], dpi=_DPI)
            encoded[suffix] = _with_palette(data) if suffix == "png" else data.getvalue()
    return encoded


def _with_palette(png: io.BytesIO) -> bytes:
    """Return a picture with 256 colours, a third of the bytes: flat areas and smoothed edges need no more."""
    picture, small = Image.open(png).convert("RGB"), io.BytesIO()
    picture.quantize(256, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()


def write_letter(axes: Axes, letter: str, text: str) -> None:
    """Write a panel's letter, bold, and title above its left edge."""
    axes.set_title(rf"$\mathbf{{({letter})}}$ {text}", loc="left", pad=4)


def put_below(figure: Figure, handles: Sequence[Artist], text: str = "") -> None:
    """Put the legend, and a line that says how to read the figure, below everything."""
    if handles:
        place: dict[str, Any] = {
            "loc": "lower center",
            "bbox_to_anchor": (0.5, 0.16 / figure.get_figheight() if text else 0.0),
        }
        figure.legend(handles=list(handles), ncols=len(handles), borderpad=0.1, columnspacing=1.4, **place)
    figure.text(0.5, 0.05 / figure.get_figheight(), text, ha="center", fontsize=SMALL, color=rgb(FAINT))


def say(axes: Axes, text: str) -> None:
    """Write into the middle of a panel why there is nothing in it."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=rgb(FAINT))


def note(axes: Axes, text: str) -> None:
    """Write into a panel's lower right corner what it lacks."""
    axes.text(0.985, 0.04, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=SMALL, color=rgb(FAINT))
