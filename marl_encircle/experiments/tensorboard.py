"""Event files for TensorBoard: those of a training, with rounds as pictures, and those of learning curves.

The steps are SB3's, those of all agents: world steps times pursuers. All that is under ``eval/`` comes from the
selection rounds, which are never reported.
"""

import csv
import errno
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common import logger
from stable_baselines3.common.logger import TensorBoardOutputFormat

from marl_encircle import files
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.descriptions import CURVES, describe
from marl_encircle.experiments.episodes import csv_lines
from marl_encircle.experiments.learning_curve import count_points
from marl_encircle.experiments.loading import config_of
from marl_encircle.experiments.records import CURVE, MAX_FILE, RECORD, read_record, run_folders
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg.policies import MADDPGPolicy

MOMENTS = 5
"""At how many points of a learning curve rounds are drawn, at most."""

WORLD_STEPS_BETWEEN = 200_000
"""From one such point to the next, at least."""


class Picture(NamedTuple):
    """A drawing for the image dashboard.

    :param tag: its name there
    :param data: a PNG or GIF file
    :param width: [pixels]
    :param height: [pixels]
    """

    tag: str
    data: bytes
    width: int
    height: int


Draw = Callable[[MADDPGPolicy, Config], Sequence[Picture]]
"""Draws rounds of a policy."""


def check_tensorboard() -> None:
    """Raise a ConfigError unless event files can be written."""
    if getattr(logger, "SummaryWriter", None) is None:  # as SB3 says that it cannot import it
        raise ConfigError(
            "event files need TensorBoard, which cannot be imported: pip install 'tensorboard>=2.18', or train without "
            "them (--no-tensorboard)"
        )


class EventFiles(TensorBoardOutputFormat):
    """SB3's event files, which say what is trained and go on after a resume.

    What an earlier process logged after the checkpoint that the training goes on from is hidden. Means over the rounds
    since the last log start anew there.

    :param folder: of the event files
    :param seed: training seed
    :param steps: of all agents until now
    :param draw: how to draw rounds; None for no pictures
    :raises DamagedFileError: if the folder is a link
    """

    def __init__(self, folder: Path, config: Config, seed: int, steps: int, draw: Draw | None = None) -> None:
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        self.config, self.draw, self.folder = config, draw, folder
        if folder.is_symlink():
            raise files.DamagedFileError(folder, "a link, where files would be removed and written elsewhere")
        earlier = list(folder.glob("events.out.tfevents.*"))
        if steps == 0:  # the training starts over
            for path in earlier:
                path.unlink()
        with _named(folder):
            super().__init__(str(folder))
            if earlier and steps:
                # The last point comes after the last checkpoint, at the same step.
                is_trained = steps >= config.training.world_steps * config.scenario.pursuers
                first = steps if is_trained else steps + 1
                writer: Any = self.writer.file_writer
                writer.add_event(Event(file_version="brain.Event:2"), first)
                writer.add_event(Event(session_log=SessionLog(status=SessionLog.START)), first)
            else:
                describe(self.writer, config, seed)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Write a log."""
        with _named(self.folder):
            super().write(key_values, key_excluded, step)

    def close(self) -> None:
        """Write what waits."""
        with _named(self.folder):
            super().close()

    def add_pictures(self, policy: MADDPGPolicy, point: int, steps: int) -> None:
        """Draw the rounds of a policy if it is time to.

        :param point: number of the point of the learning curve, from 1
        :param steps: of all agents until now
        """
        if self.draw is None or not is_drawn(self.config, point):
            return
        pictures = self.draw(policy, self.config)
        with _named(self.folder):
            for picture in pictures:
                add_picture(self.writer, picture, steps)
            self.writer.flush()


@contextmanager
def _named(folder: Path) -> Iterator[None]:
    """Have errors of the disk name the folder: TensorBoard hands on those of its writing thread, which name nothing."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno or errno.EIO, f"not saved: {error.strerror or error}", str(folder)) from error


def is_drawn(config: Config, point: int) -> bool:
    """Whether rounds are drawn at a point of the learning curve: at the last one and at the same distance before it.

    :param point: its number, from 1
    """
    points = count_points(config)
    moments = min(max(config.training.world_steps // WORLD_STEPS_BETWEEN, 1), MOMENTS, points)
    return point * moments // points > (point - 1) * moments // points


def add_picture(writer: Any, picture: Picture, steps: int) -> None:
    """Write a picture as it is: PyTorch's ``add_video`` needs moviepy, and not even its present version."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    image = Summary.Image(height=picture.height, width=picture.width, colorspace=3, encoded_image_string=picture.data)
    writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=picture.tag, image=image)]), steps)


class Shown(NamedTuple):
    """How many runs TensorBoard is given, by where their curves come from."""

    recorded: int
    """From ``progress.csv``."""
    own: int
    """From their own event files."""


def lay_out(runs: Path, folder: Path) -> Shown:
    """Lay all runs out for TensorBoard, named ``<method>/<setting>/seed<s>``.

    A run with event files of its own is linked to, so that one in training goes on being seen. Of one that has none, as
    those in the repository, the learning curve is written under the tags of a training.

    :param runs: folder of all runs
    :param folder: an empty one
    :raises DamagedFileError: for a finished run that is not what its record says
    """
    recorded = own = 0
    for run in run_folders(runs):
        shown = folder / run.relative_to(runs)
        if any((run / "tensorboard").glob("events.out.tfevents.*")):
            shown.parent.mkdir(parents=True, exist_ok=True)
            shown.symlink_to((run / "tensorboard").resolve(), target_is_directory=True)
            own += 1
        elif (run / RECORD).exists():
            _write_curve(run, shown)
            recorded += 1
    return Shown(recorded, own)


def _write_curve(run: Path, folder: Path) -> None:
    """Write the learning curve of a finished run as event files."""
    from torch.utils.tensorboard import SummaryWriter

    record = read_record(run)
    config = config_of(record, run / RECORD)
    data = files.read_bytes(run / CURVE, sha256=record["sha256"].get(CURVE), max_bytes=MAX_FILE)
    with SummaryWriter(folder) as writer:
        describe(writer, config, record["seed"], CURVES)
        try:
            for row in csv.DictReader(csv_lines(data.decode())):
                steps = int(row.pop("world_steps")) * config.scenario.pursuers
                for name, value in row.items():
                    if value:
                        writer.add_scalar(f"eval/{name}", float(value), steps)
        except (ValueError, KeyError, TypeError, csv.Error) as error:
            raise files.DamagedFileError(run / CURVE, f"no learning curve: {str(error)[:200]}") from error
