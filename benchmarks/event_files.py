"""Measure what TensorBoard's event files with drawn rounds cost a training, in per cent of its processor time.

Pairs of the same training, with and without event files, each in a process of its own, take turns; reported are the
median of the pairs and all of them.
"""

import argparse
import multiprocessing
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import process_time

from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.train import train


def seconds(world_steps: int, with_event_files: bool) -> float:
    """Return the processor seconds of a training, evaluation included."""
    config = load_config(overrides=[f"training.world_steps={world_steps}"])
    with TemporaryDirectory() as folder:
        started = process_time()
        draw = None
        if with_event_files:
            from marl_encircle.replays.thumbnails import thumbnails as draw
        train(config, 900, out=Path(folder), tensorboard=with_event_files, draw=draw)
        return process_time() - started


def take_turns(tasks: list[tuple[int, bool]]) -> list[float]:
    """Return the processor seconds of each training, made in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        return pool.starmap(seconds, tasks, chunksize=1)


def measure(world_steps: int, pairs: int) -> list[float]:
    """Return what the event files of each pair cost [per cent]."""
    taken = take_turns([(world_steps, False), (world_steps, True)] * pairs)
    return [100 * (logged / plain - 1) for plain, logged in zip(taken[::2], taken[1::2], strict=True)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--world-steps", type=int, default=100_000, help="length of the training")
    parser.add_argument("--pairs", type=int, default=5)
    arguments = parser.parse_args()
    shares = measure(arguments.world_steps, arguments.pairs)
    print(f"{median(shares):.1f} % ({', '.join(f'{share:.1f}' for share in sorted(shares))})")


if __name__ == "__main__":
    main()
