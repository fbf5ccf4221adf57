"""Small drawings of the first selection rounds of a policy in training, for TensorBoard. Costs a fifth of a second."""

from typing import Any

from marl_encircle.drawing.palette import FAINT, GOOD, PAPER
from marl_encircle.drawing.pen import SUPERSAMPLING, pygame, write
from marl_encircle.drawing.render import array_of, draw_scene
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.tensorboard import Picture
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.replays.film import gif, png
from marl_encircle.replays.replay import Replay, record_first_rounds
from marl_encircle.replays.watch import end_of, view_of

SIDE, STRIP = 260, 24
"""Side of a scene, height of the line below it [pixels]."""

ENDS = 4
"""Rounds of which the end is shown, two in a row."""

FRAMES = 9
"""Of a film, at most."""

FPS = 4.0


def thumbnails(policy: MADDPGPolicy, config: Config) -> list[Picture]:
    """Return a film of the first selection round, and how the first four ended."""
    replays = record_first_rounds(policy, config, ENDS, config.evaluation.curve_seed)
    first = replays[0]
    frames = [array_of(_tile(first, step)) for step in _steps(end_of(first))]
    ends = [_tile(replay, end_of(replay)) for replay in replays]
    width, height = ends[0].get_size()
    sheet = pygame.Surface((2 * width, -(-ENDS // 2) * height))
    for place, end in enumerate(ends):
        sheet.blit(end, (place % 2 * width, place // 2 * height))
    return [
        Picture("selection_rounds/first_round", gif(frames, FPS), width, height),
        Picture("selection_rounds/ends", png(array_of(sheet), optimize=False), *sheet.get_size()),
    ]


def _steps(end: int) -> list[int]:
    """Return the steps that are shown of a round: evenly spaced, its end among them."""
    stride = -(-end // (FRAMES - 1))
    return [*range(0, end, stride), end]


def _tile(replay: Replay, step: int) -> Any:
    """Draw a scene with a line below it that says how far the round is."""
    large = pygame.Surface((SIDE * SUPERSAMPLING, (SIDE + STRIP) * SUPERSAMPLING))
    large.fill(PAPER)
    draw_scene(large.subsurface((0, 0, SIDE * SUPERSAMPLING, SIDE * SUPERSAMPLING)), view_of(replay, step))
    solved = replay.success_step is not None and step >= replay.success_step
    line = f"round {replay.round}: " + (f"success at step {replay.success_step}" if solved else f"step {step}")
    write(large, line, (10 * SUPERSAMPLING, (SIDE + STRIP / 2 - 2) * SUPERSAMPLING), 12, GOOD if solved else FAINT)
    return pygame.transform.smoothscale(large, (SIDE, SIDE + STRIP))
