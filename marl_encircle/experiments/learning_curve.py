"""The learning curve of a run, ``progress.csv``: what its selection rounds said during the training."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_encircle import files
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import csv_lines
from marl_encircle.experiments.records import CURVE, MAX_FILE

COLUMNS = ("world_steps", "success", "mean_episode_length", "success_all", "success_pursuers", "sigma_c")


class Curve(NamedTuple):
    """The learning curve of one run. P points, none before the first one has been played."""

    world_steps: NDArray[np.int64]
    """When the rounds were played, rising, (P,)."""
    success: NDArray[np.float64]
    """Share of them that the method's own rule counts as a success, (P,)."""


def count_points(config: Config) -> int:
    """Return how many points the learning curve of a whole training has.

    One comes where a rollout begins, as soon as ``curve_every`` world steps more are behind, and one at the end.

    :param config: of the training; its rollouts are no longer than ``curve_every``, see
        :func:`~marl_encircle.experiments.trainable.check_training`
    """
    training = config.training
    rollout = training.n_worlds * config.algorithm.train_freq
    last_beginning = (training.world_steps - 1) // rollout * rollout
    return last_beginning // training.curve_every + 1


def curve_to_csv(rows: Iterable[Sequence[float | None]]) -> str:
    """Write points, a line each.

    :param rows: in the order of ``COLUMNS``
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return text.getvalue()


def read_curve(folder: Path, sha256: str | None = None) -> Curve:
    """Read the learning curve in a run folder.

    :param sha256: what the file must hash to, if the run has ended
    :raises files.DamagedFileError: if it is missing, changed, or none
    """
    path = folder / CURVE
    data = files.read_bytes(path, sha256=sha256, max_bytes=MAX_FILE)
    try:
        return curve_from_csv(data.decode())
    except ValueError as error:
        raise files.DamagedFileError(path, f"no learning curve: {str(error)[:200]}") from error


def curve_from_csv(text: str) -> Curve:
    """Read ``progress.csv``.

    :param text: content of the file
    :raises ValueError: without the columns ``world_steps`` and ``success``, or for what is no count of steps, rising,
        or no share in them
    """
    steps: list[int] = []
    shares: list[float] = []
    reader = csv.DictReader(csv_lines(text))
    try:
        if not {"world_steps", "success"} <= set(reader.fieldnames or ()):
            raise ValueError("world_steps and success must be among the columns")
        for row in reader:
            steps.append(int(row["world_steps"]))
            shares.append(float(row["success"]))
            if steps[-1] <= max(steps[-2:-1], default=-1):
                raise ValueError("world_steps must rise from line to line")
        curve = Curve(np.array(steps, np.int64), np.array(shares, np.float64))
    except csv.Error as error:
        raise ValueError(f"not CSV: {error}") from error
    except OverflowError as error:
        raise ValueError("world_steps: too large") from error
    except TypeError as error:
        raise ValueError("world_steps and success must be in every line") from error
    if not ((curve.success >= 0) & (curve.success <= 1)).all():
        raise ValueError("success must be between 0 and 1")
    return curve
