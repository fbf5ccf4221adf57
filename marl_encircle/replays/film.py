"""Rounds as pictures: one drawing per step, as PNG files, as a GIF or as an MP4. Needs no display."""

import importlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from marl_encircle import files
from marl_encircle.drawing.palette import LINE
from marl_encircle.drawing.pen import SUPERSAMPLING, pygame
from marl_encircle.drawing.render import EVERYTHING, array_of, draw_tall, draw_wide, shrunk
from marl_encircle.drawing.view import Layers
from marl_encircle.experiments.memory import available_memory, check_memory
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays.watch import Match

Picture = NDArray[np.uint8]

LAST = 1.5
"""How long the last picture of a film stands [s]."""

GIF_COLOURS, GIF_FLAT = 160, 48
"""In a palette, and how many of them are taken as they are."""


def drawing(match: Match, number: int, step: int, layers: Layers = EVERYTHING) -> Any:
    """Return a drawing of one moment of a round as a pygame surface; two policies side by side."""
    return shrunk(large_drawing(match, number, step, layers))


def large_drawing(match: Match, number: int, step: int, layers: Layers = EVERYTHING, tall: bool = False) -> Any:
    """Return a drawing of one moment of a round, ``SUPERSAMPLING`` times its finished size.

    :param tall: with the panel below the scene, as it always is of two policies
    """
    views = match.views(number, step)
    if len(views) == 1 and not tall:
        return draw_wide(views[0], layers)
    parts = [draw_tall(view, layers) for view in views]
    width, height = parts[0].get_size()
    both = pygame.Surface((len(parts) * width, height))
    for place, part in enumerate(parts):
        both.blit(part, (place * width, 0))
        if place:
            pygame.draw.line(both, LINE, (place * width, 0), (place * width, height), 2 * SUPERSAMPLING)
    return both


def pictures(match: Match, number: int, layers: Layers = EVERYTHING) -> Iterator[Picture]:
    """Yield a round's start and every step, (H, W, 3) each."""
    for step in range(match.length(number) + 1):
        yield array_of(drawing(match, number, step, layers))


def save(path: Path, match: Match, number: int, fps: float, layers: Layers = EVERYTHING) -> None:
    """Write a round as a film.

    :param path: of a ``.gif`` or ``.mp4`` file
    :param fps: steps per second
    :raises ConfigError: for another ending, if MP4 is wanted and its extra is missing, or for a round so long that its
        pictures do not fit into this machine's memory
    """
    check_film(path)
    n_pictures, size = match.length(number) + 1, array_of(drawing(match, number, 0, layers)).nbytes
    check_memory({f"--save {path}, {n_pictures} pictures": n_pictures * size}, available_memory())
    if path.suffix.lower() == ".gif":
        files.write_bytes(path, gif(list(pictures(match, number, layers)), fps))
    else:
        _write_mp4(path, list(pictures(match, number, layers)), fps)


def check_film(path: Path) -> None:
    """Raise a ConfigError unless a film of this name can be written."""
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise ConfigError(f"--save {path}: must end in .gif or .mp4")
    if path.suffix.lower() == ".mp4":
        _load_imageio()


def save_pictures(folder: Path, match: Match, number: int, layers: Layers = EVERYTHING) -> list[Path]:
    """Write a round's start and every step as ``step000.png`` and so on; return the files."""
    paths = []
    for step, picture in enumerate(pictures(match, number, layers)):
        paths.append(folder / f"step{step:03}.png")
        files.write_bytes(paths[-1], png(picture))
    return paths


def png(picture: Picture, optimize: bool = True) -> bytes:
    """Return a picture as PNG; equal pictures give equal bytes.

    :param optimize: take four times as long for a somewhat smaller file
    """
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG", optimize=optimize)
    return out.getvalue()


def gif(frames: list[Picture], fps: float) -> bytes:
    """Return pictures as a GIF that starts over; equal pictures give equal bytes.

    :param frames: (H, W, 3) each
    :param fps: pictures per second; the last one stands longer
    """
    palette = _palette(np.vstack([frames[0], frames[len(frames) // 2], frames[-1]]))
    nearest = _Nearest(palette)
    indexed = [nearest.indexed(frame) for frame in frames]
    durations = [round(1000 / fps)] * (len(frames) - 1) + [round(1000 * max(LAST, 1 / fps))]
    out = io.BytesIO()
    indexed[0].save(out, "GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False)
    return out.getvalue()


def _palette(picture: Picture) -> Picture:
    """Return one palette for all pictures of a film, so that nothing flickers, (L, 3).

    The flat colours as they are, and those at their smoothed edges by median cut.
    """
    packed, counts = np.unique(_packed(picture), return_counts=True)
    flat = _unpacked(packed[np.argsort(-counts, kind="stable")[:GIF_FLAT]])
    edges = Image.fromarray(picture).quantize(GIF_COLOURS - GIF_FLAT, dither=Image.Dither.NONE).getpalette() or []
    return np.concatenate([flat, np.array(edges, np.uint8).reshape(-1, 3)])


class _Nearest:
    """The nearest colour of a palette to any other, each looked for once; Pillow's own search is only roughly so.

    :param palette: fewer than 255 colours, (L, 3)
    """

    UNKNOWN = 255

    def __init__(self, palette: Picture) -> None:
        self.palette = palette
        self._index = np.full(1 << 24, self.UNKNOWN, np.uint8)

    def indexed(self, picture: Picture) -> Image.Image:
        """Return a picture in the colours of the palette."""
        packed = _packed(picture)
        new = np.unique(packed[self._index[packed] == self.UNKNOWN])
        square = ((_unpacked(new).astype(np.int64)[:, None] - self.palette.astype(np.int64)) ** 2).sum(axis=2)
        self._index[new] = square.argmin(axis=1)
        image = Image.fromarray(self._index[packed].reshape(picture.shape[:2]), "P")
        image.putpalette(self.palette.ravel().tolist())
        return image


def _packed(picture: Picture) -> NDArray[np.int64]:
    """Return one number for each pixel's colour, (H * W,)."""
    red, green, blue = picture.reshape(-1, 3).T.astype(np.int64)
    packed: NDArray[np.int64] = (red << 16) | (green << 8) | blue
    return packed


def _unpacked(packed: NDArray[np.int64]) -> Picture:
    return np.stack([packed >> 16, (packed >> 8) & 255, packed & 255], axis=1).astype(np.uint8)


def _write_mp4(path: Path, frames: list[Picture], fps: float) -> None:
    imageio = _load_imageio()
    with files.atomic_path(path) as temporary:
        options = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        with imageio.get_writer(temporary, format="FFMPEG", fps=fps, **options) as writer:
            for frame in [*frames, *[frames[-1]] * round(LAST * fps)]:
                writer.append_data(frame)


def _load_imageio() -> Any:
    try:
        import imageio.v2 as imageio

        importlib.import_module("imageio_ffmpeg")  # imageio finds it by itself, and says little when it is missing
    except ImportError as error:
        raise ConfigError("an MP4 needs imageio and its ffmpeg: pip install 'marl-encircle[video]'") from error
    return imageio
