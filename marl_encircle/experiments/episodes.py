"""Evaluation rounds, and ``episodes.csv``, where they are written down."""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, get_type_hints

from marl_encircle.core.geometry import Closure

MAX_ROUNDS = 10**6
"""Of an evaluation."""
MAX_LINE = 10_000
"""Characters of a line of a CSV file: cells take twenty times the memory of their text."""


class Episode(NamedTuple):
    """An evaluation round, a row of ``episodes.csv``; the files and SB3 say episode.

    :param round: number of the round within its evaluation
    :param seed: seed the world was reset with
    :param step_all: first step, from 1, at which the target was enclosed by pursuers and obstacles with R_m below its
        threshold; None if never
    :param step_pursuers: the same for an enclosure by the pursuers alone
    :param length: steps until both rules have held, else the time limit; what follows stops at the method's own success
    :param return_mean: return of the round, mean over the pursuers
    :param sigma_c: Eq. 15, population standard deviation over the pursuers of their mean contributing angle [rad],
        under the method's own closure rule
    :param contacts_pursuers: sum over steps and pursuers of the other pursuers touched (a pair counts twice a step)
    :param contacts_obstacles: the same of obstacles' discs
    """

    round: int
    seed: int
    step_all: int | None
    step_pursuers: int | None
    length: int
    return_mean: float
    sigma_c: float
    contacts_pursuers: int
    contacts_obstacles: int

    def success_step(self, closure: Closure) -> int | None:
        """First step, from 1, at which the closure rule held; None if never."""
        return self.step_all if closure == "all" else self.step_pursuers


_KINDS = get_type_hints(Episode)


def episodes_to_csv(episodes: Sequence[Episode]) -> str:
    """Text of ``episodes.csv``: the shortest digits that give every number back exactly."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Episode._fields)
    for episode in episodes:
        writer.writerow([_text(value, kind) for value, kind in zip(episode, _KINDS.values(), strict=True)])
    return out.getvalue()


def _text(value: float | None, kind: object) -> str:
    """One value of a row; NumPy's scalars are written like Python's."""
    if value is None:
        return ""
    return repr(float(value)) if kind is float else str(int(value))


def episodes_from_csv(text: str) -> list[Episode]:
    """Read ``episodes.csv``.

    :param text: content of the file
    :raises ValueError: for another header, a value of the wrong kind or out of range, with line and column; without
        rounds or with too many; for a duplicate round number
    """
    reader = csv.reader(csv_lines(text))
    episodes: list[Episode] = []
    try:
        if tuple(next(reader, ())) != Episode._fields:
            raise ValueError(f"line 1: the columns must be {','.join(Episode._fields)}")
        for number, cells in enumerate(reader, start=2):
            if len(episodes) == MAX_ROUNDS:
                raise ValueError(f"more than {MAX_ROUNDS} rounds")
            episodes.append(_episode(cells, number))
    except csv.Error as error:
        raise ValueError(f"not CSV: {error}") from error
    if not episodes:
        raise ValueError("no rounds")
    if len({episode.round for episode in episodes}) != len(episodes):
        raise ValueError("duplicate round number")
    return episodes


def csv_lines(text: str) -> Iterator[str]:
    """Yield the lines of a stranger's CSV text; a ValueError ends it at one that is too long."""
    for number, line in enumerate(io.StringIO(text), start=1):
        if len(line) > MAX_LINE:
            raise ValueError(f"line {number}: longer than {MAX_LINE} characters")
        yield line


def _episode(cells: list[str], line: int) -> Episode:
    """One row; its kinds are those of the fields of ``Episode``."""
    if len(cells) != len(Episode._fields):
        raise ValueError(f"line {line}: {len(cells)} values for {len(Episode._fields)} columns")
    episode = Episode._make(
        _cell(cell, kind, f"line {line}, {name}") for cell, (name, kind) in zip(cells, _KINDS.items(), strict=True)
    )
    for name, step in (("step_all", episode.step_all), ("step_pursuers", episode.step_pursuers)):
        if step is not None and not 1 <= step <= episode.length:
            raise ValueError(f"line {line}, {name}: {step} is not within 1 to the length {episode.length}")
    return episode


def _cell(cell: str, kind: object, where: str) -> int | float | None:
    """One value of a row."""
    if cell == "" and kind == int | None:
        return None
    try:
        value = float(cell) if kind is float else int(cell)
    except ValueError:
        raise ValueError(f"{where}: {cell[:80]!r} is not {'a number' if kind is float else 'an integer'}") from None
    if not (math.isfinite(value) if kind is float else 0 <= value < 1 << 63):
        raise ValueError(f"{where}: {cell[:80]!r} is out of range")
    return value
