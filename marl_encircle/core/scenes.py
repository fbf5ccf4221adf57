"""Scenes: what one obstacle looks like, and the random placement of all bodies at the start of a round.

An obstacle is a rigid set of discs that is put somewhere at some angle. A scene names that set.
"""

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from marl_encircle.core.compilation import kernel

Array = NDArray[np.float64]


def random() -> Array:
    """One disc, the obstacle of Tables 2-4."""
    return np.array([[0.0, 0.0, 1.0]])


def concave() -> Array:
    """Seven overlapping discs on a half circle, open to one side (Fig. 6d)."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 7)
    return _about_centre(1.5 * np.cos(angle), 1.5 * np.sin(angle), radius=0.4)


def tunnel() -> Array:
    """Two parallel walls of five overlapping discs each, open at both ends (Fig. 6e)."""
    along, across = np.meshgrid(np.linspace(-1.5, 1.5, 5), [-1.25, 1.25])
    return _about_centre(along.ravel(), across.ravel(), radius=0.4)


def _about_centre(x: Array, y: Array, radius: float) -> Array:
    return np.column_stack([x - x.mean(), y - y.mean(), np.full(len(x), radius)])


SCENES: dict[str, Callable[[], Array]] = {"random": random, "concave": concave, "tunnel": tunnel}
"""Each scene's obstacle: discs (L, 3) as x, y, radius about their centre [obstacle radii].

One's own is added by assignment, ``SCENES["cross"] = cross``, before the scenario that names it is made. A name is one
word of letters, digits and _, since folders of runs are named after it.
"""


def discs_of(scene: str) -> Array:
    """Return the discs of a scene's obstacle, (L, 3).

    :param scene: a name in ``SCENES``
    :raises ValueError: if the name is no word, or the scene's function returns anything else
    """
    if not re.fullmatch(r"\w+", scene):
        raise ValueError(f"scene {scene!r:.80} must be named by letters, digits and _: folders are named after it")
    discs = np.asarray(SCENES[scene](), np.float64)
    if discs.ndim != 2 or discs.shape[1] != 3 or not len(discs):
        raise ValueError(f"scene {scene!r:.80} must return discs (x, y, radius), (L, 3); got shape {discs.shape}")
    fit = np.isfinite(discs).all(axis=1) & (discs[:, 2] > 0)
    if not fit.all():
        raise ValueError(f"scene {scene!r:.80} must return finite discs of positive radius; got {discs[fit.argmin()]}")
    return discs


@kernel
def place(
    worlds: NDArray[np.int64],
    uniforms: Array,
    shape: Array,
    obstacle_radius: Array,
    pursuer_radius: float,
    target_radius: float,
    half_width: float,
    obstacle_limit: float,
    separated: bool,
    pursuers: Array,
    target: Array,
    discs: Array,
    centres: Array,
) -> NDArray[np.bool_]:
    """Draw obstacles, then the target, then the pursuers, each uniform in the scene; drop and redraw what overlaps.

    :param worlds: worlds to place, (W,)
    :param uniforms: random numbers in [0, 1), one row per world to use up, (W, L)
    :param shape: the discs of one obstacle about its centre [obstacle radii], (L, 3)
    :param obstacle_radius: per world, (B,)
    :param pursuers: positions to fill in, (B, N, 2)
    :param target: to fill in, (B, 2)
    :param discs: x, y, radius to fill in, (B, D, 3)
    :param centres: obstacles' centres to fill in, (B, M, 2)
    :return: which of ``worlds`` were placed before their random numbers ran out, (W,)
    """
    placed = np.zeros(len(worlds), np.bool_)
    length = len(shape)
    for w in range(len(worlds)):
        b = worlds[w]
        u = uniforms[w]
        at = 0
        reach = obstacle_limit * half_width
        m = 0
        while m < centres.shape[1] and at + 3 <= len(u):
            x = (2 * u[at] - 1) * reach
            y = (2 * u[at + 1] - 1) * reach
            cos = np.cos(2 * np.pi * u[at + 2])
            sin = np.sin(2 * np.pi * u[at + 2])
            at += 3
            fits = False
            for k in range(length):
                disc = discs[b, m * length + k]
                disc[0] = x + obstacle_radius[b] * (cos * shape[k, 0] - sin * shape[k, 1])
                disc[1] = y + obstacle_radius[b] * (sin * shape[k, 0] + cos * shape[k, 1])
                disc[2] = obstacle_radius[b] * shape[k, 2]
                fits = abs(disc[0]) <= reach and abs(disc[1]) <= reach
                fits = fits and (not separated or _is_free(disc[0], disc[1], disc[2], discs[b, : m * length]))
                if not fits:
                    break
            if fits:
                centres[b, m, 0] = x
                centres[b, m, 1] = y
                m += 1
        # The target is body -1, so that one loop places it and the pursuers alike.
        i = -1
        while m == centres.shape[1] and i < pursuers.shape[1] and at + 2 <= len(u):
            x = (2 * u[at] - 1) * half_width
            y = (2 * u[at + 1] - 1) * half_width
            at += 2
            radius = target_radius if i < 0 else pursuer_radius
            fits = not separated or _is_free(x, y, radius, discs[b])
            if separated and i >= 0:
                fits &= np.hypot(x - target[b, 0], y - target[b, 1]) >= radius + target_radius
                for j in range(i):
                    fits &= np.hypot(x - pursuers[b, j, 0], y - pursuers[b, j, 1]) >= 2 * radius
            if fits:
                body = target[b] if i < 0 else pursuers[b, i]
                body[0] = x
                body[1] = y
                i += 1
        placed[w] = m == centres.shape[1] and i == pursuers.shape[1]
    return placed


@kernel
def _is_free(x: float, y: float, radius: float, discs: Array) -> bool:
    for d in range(len(discs)):
        dx, dy, reach = x - discs[d, 0], y - discs[d, 1], radius + discs[d, 2]
        if dx * dx + dy * dy < reach * reach:
            return False
    return True
