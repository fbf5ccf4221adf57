"""Rounds for the report's player: which ones, and packed as text that ``decode.js`` reads.

A packed round is base64 of whole numbers in sequence. Each number is zigzagged (0, -1, 1, -2, ... become 0, 1, 2, 3,
...) and written in base 128, lowest digit first, all bytes but its last with the high bit set. What changes little from
one value to the next is written as differences. In order:

1. of each disc: x, y, radius;
2. of each pursuer, then the target: x at all moments as differences, y at all moments as differences;
3. of each pursuer: velocity in x, then in y, likewise;
4. of each moment: its state, R_m (0 unless closed), the contributing angles, the number of stretches of directions
   with one owner, of each stretch its length and its owner + 1, and how far the target gets in each direction that has
   an owner, as differences.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_encircle.core.geometry import NOBODY
from marl_encircle.drawing.outlines import facing_arc, polar
from marl_encircle.drawing.palette import PURSUERS
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.records import Cell, Run, Setting, run_path
from marl_encircle.replays.replay import Replay, record_round
from marl_encircle.study.cells import gather, result_of
from marl_encircle.study.paper import by_method, label

ROUNDS = 6
"""Of each cell the first so many rounds of the evaluation, played by the policy of its first training seed."""

POSITION = 1e-4
"""Step of a packed position [scene units]."""
VELOCITY = 1e-2
"""Step of a packed velocity [scene units per time unit]."""
REACH = 1e-3
"""Step of a packed distance from the target [scene units]."""
ANGLE = 1e-4
"""Step of a packed angle [rad]."""
AREA = 1e-5
"""Step of a packed R_m [scene units^2]."""

FAR = 4.0
"""Distances are cut to so many half widths of the scene: far outside of the picture."""

OPEN, CLOSED, COMPLETE = 0, 1, 2
"""States of a moment: some direction is free; none is; R_m is below its limit too."""


class Played(NamedTuple):
    """A round to be shown, and how it ended when the run was evaluated."""

    replay: Replay
    recorded: int | None
    """Success step in ``episodes.csv``; another one where this processor rounds otherwise."""


class ShownCell(NamedTuple):
    """A cell in the player."""

    cell: Cell
    status: str
    """``run``, or what is there instead of rounds."""
    seed: int | None = None
    """Training seed whose policy plays."""
    runs_of: str | None = None
    """Method that the runs are shared with."""
    rounds: Sequence[Played] = ()
    """Empty for a cell that shares another's."""


def shown_cells(
    runs: Sequence[Run], folder: Path, aliases: Mapping[Cell, Cell], asked: Iterable[Cell]
) -> list[ShownCell]:
    """Play the rounds of every cell again, methods in the order of the tables.

    :param folder: of all runs
    :param aliases: cell -> the cell whose runs it shares
    :param asked: cells to show, with or without runs
    """
    by_cell = gather(runs, aliases)
    first = {run.cell: run for run in sorted(runs, key=lambda run: run.seed, reverse=True) if run.status == "finished"}
    shown = []
    for cell in by_method({*asked, *by_cell}):
        result = result_of(cell, by_cell.get(cell))
        owner = result.runs.runs_of if result.runs else None
        if result.summary is None:
            shown.append(ShownCell(cell, result.status))
        elif owner is not None:
            shown.append(ShownCell(cell, result.status, runs_of=owner))
        else:
            run = first[cell]
            shown.append(ShownCell(cell, result.status, run.seed, rounds=_play(run, folder)))
    return shown


def _play(run: Run, folder: Path) -> list[Played]:
    policy, config, _ = load_run(folder / run_path(run.cell, run.seed))
    closure, seed = config.reward.closure, config.evaluation.seed
    return [
        Played(record_round(policy, config, episode.round, seed), episode.success_step(closure))
        for episode in run.episodes[:ROUNDS]
    ]


def player_data(cells: Sequence[ShownCell]) -> dict[str, Any]:
    """Return everything that the player shows, as plain data."""
    methods = list(dict.fromkeys(each.cell.method for each in cells))
    settings = sorted({each.cell.setting for each in cells})
    return {
        "start": _start(cells, methods, settings),
        "units": {"position": POSITION, "velocity": VELOCITY, "reach": REACH, "angle": ANGLE, "area": AREA},
        "methods": [label(method) for method in methods],
        "settings": [in_words(setting) for setting in settings],
        "cells": [
            {
                "method": methods.index(each.cell.method),
                "setting": settings.index(each.cell.setting),
                "status": each.status,
                "runsOf": methods.index(each.runs_of) if each.runs_of is not None else None,
                "seed": each.seed,
                "closure": each.rounds[0].replay.closure if each.rounds else None,
                "world": _world(each.rounds[0].replay) if each.rounds else None,
                "rounds": [_round(played) for played in each.rounds],
            }
            for each in cells
        ],
    }


def _start(cells: Sequence[ShownCell], methods: Sequence[str], settings: Sequence[Setting]) -> dict[str, int]:
    """Say what is shown first: Ours if it has rounds, with few pursuers and the one obstacle that has to help them."""
    played = [each.cell for each in cells if each.rounds]
    if not played:
        return {"method": 0, "setting": 0}
    first = min(played, key=lambda cell: (cell.method != "ours", cell.setting.obstacles != 1, cell.setting.pursuers))
    return {"method": methods.index(first.method), "setting": settings.index(first.setting)}


def in_words(setting: Setting) -> str:
    """Name a setting."""
    n, m = setting.pursuers, setting.obstacles
    scene = "" if setting.scene == "random" else f" ({setting.scene})"
    obstacles = f"{m or 'no'} obstacle{'' if m == 1 else 's'}{scene}"
    return f"{n} pursuer{'' if n == 1 else 's'}, {obstacles}, λ = {setting.speed_ratio:g}"


def _world(replay: Replay) -> dict[str, Any]:
    """Return what all rounds of a cell have in common."""
    scenario = replay.scenario
    # The arc of a pursuer at (1, 0): that of any other is it, turned and scaled.
    angles, distances = facing_arc(np.array([1.0, 0.0]), scenario.speed_ratio)
    return {
        "pursuers": scenario.pursuers,
        "entities": scenario.pursuers + scenario.units,
        "discs": len(replay.discs),
        "colours": len(PURSUERS),
        "halfWidth": scenario.half_width,
        "pursuerRadius": scenario.pursuer_radius,
        "targetRadius": scenario.target_radius,
        "maxSpeed": scenario.max_speed,
        "limit": scenario.movement_range_limit,
        "arc": np.round(polar(np.zeros(2), angles, distances)[::3], 4).tolist(),
    }


def _round(played: Played) -> dict[str, Any]:
    replay = played.replay
    return {
        "number": replay.round,
        "moments": moments_shown(replay),
        "success": replay.success_step,
        "recorded": played.recorded,
        "data": pack(replay),
    }


def moments_shown(replay: Replay) -> int:
    """Moments from the start until the method's own success, or until time was up."""
    return (replay.length if replay.success_step is None else replay.success_step) + 1


def pack(replay: Replay) -> str:
    """Return a round as text; see the module's docstring."""
    t, enclosure = moments_shown(replay), replay.enclosure[replay.closure]
    numbers = _steps(replay.discs, POSITION).ravel().tolist()
    bodies = np.concatenate([replay.pursuers[:t], replay.target[:t, None]], axis=1)
    for values, unit in ((bodies, POSITION), (replay.velocities[:t], VELOCITY)):
        for series in _steps(values, unit).reshape(t, -1).T:
            numbers += _differences(series)
    reach = np.minimum(enclosure.distance[:t], FAR * replay.scenario.half_width)
    for moment in range(t):
        closed = bool(enclosure.closed[moment])
        numbers.append(COMPLETE if enclosure.complete[moment] else CLOSED if closed else OPEN)
        numbers.append(int(_steps(enclosure.movement_range[moment], AREA)) if closed else 0)
        numbers += _steps(enclosure.contributing_angle[moment], ANGLE).tolist()
        owner = enclosure.owner[moment]
        starts = [0, *(np.flatnonzero(np.diff(owner)) + 1).tolist()]
        lengths = np.diff([*starts, len(owner)]).tolist()
        numbers.append(len(starts))
        for start, length in zip(starts, lengths, strict=True):
            numbers += [length, int(owner[start]) - NOBODY]
        numbers += _differences(_steps(reach[moment][owner != NOBODY], REACH))
    return base64.b64encode(_digits(numbers)).decode("ascii")


def _steps(values: ArrayLike, unit: float) -> NDArray[np.int64]:
    return np.rint(np.asarray(values) / unit).astype(np.int64)


def _differences(series: NDArray[np.int64]) -> list[int]:
    """First value, then each one's difference to the one before."""
    differences: list[int] = np.diff(series, prepend=0).tolist()
    return differences


def _digits(numbers: Iterable[int]) -> bytes:
    """Write whole numbers in base 128 after zigzagging them."""
    out = bytearray()
    for number in numbers:
        rest = 2 * number if number >= 0 else -2 * number - 1
        while rest >= 128:
            out.append(rest % 128 + 128)
            rest //= 128
        out.append(rest)
    return bytes(out)
