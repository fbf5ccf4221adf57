"""Are the committed results those of this code? Every policy plays its rounds again, tables and figures are made again.

On the processor that a run was made on every round must be equal in every figure. Another one rounds differently, and a
round may then take another course: there 99.5 % of the rounds must end alike, every cell's S must lie within the 99 %
binomial interval of the S that is recorded, and pictures are not compared.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from marl_encircle import files
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.metrics import wilson_interval
from marl_encircle.experiments.provenance import cpu_model
from marl_encircle.experiments.records import RECORD, Cell, Setting, episodes_name, read_episodes
from marl_encircle.experiments.train import run_folder
from marl_encircle.study.reproduce import render

EQUAL_SHARE = 0.995
CELL_CONFIDENCE = 0.99


class Verification(NamedTuple):
    """What was found.

    :param rounds: rounds played again
    :param equal: those that ended as recorded; on the run's own processor also with the same figures
    :param unequal_here: those of runs made on this processor that are not equal
    :param cells_off: cells whose S lies outside the interval
    :param exact: whether all runs were made on this processor, so that every round must be equal
    :param changed: tables, cards and figures that are not what the runs give
    """

    rounds: int
    equal: int
    unequal_here: int
    cells_off: int
    exact: bool
    changed: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether there are results and they are those of this code."""
        enough = not self.unequal_here and self.equal >= EQUAL_SHARE * self.rounds
        return self.rounds > 0 and enough and not self.cells_off and not self.changed


def verify(grid: Grid, results: str | Path, report: Callable[[int, int], None] | None = None) -> Verification:
    """Play every finished run of a grid again and make its tables, and its figures if there are any; write nothing.

    :param results: folder of ``runs/``, ``tables/`` and ``figures/``
    :param report: called with the number of runs verified and of all
    :raises DamagedFileError: if a run is not what its record says
    """
    texts = render(grid, results)  # and with that, whether every run is what its record says
    folders = [run_folder(job.config, job.seed, Path(results) / "runs") for job in grid.jobs]
    folders = [folder for folder in folders if (folder / RECORD).exists() and files.is_kept(folder / episodes_name())]
    rounds = equal = unequal_here = 0
    exact = True
    successes: dict[tuple[Cell, Setting | None], list[tuple[bool, bool]]] = defaultdict(list)
    for done, folder in enumerate(folders, start=1):
        policy, config, record = load_run(folder)
        same_processor = record.get("cpu") == cpu_model()
        exact &= same_processor
        closure = config.reward.closure
        for setting in (None, *grid.elsewhere.get(config.cell, ())):
            name = episodes_name(setting)
            if name not in record["sha256"]:
                continue
            recorded = read_episodes(folder, record, setting)
            played = play_rounds(policy, config, len(recorded), config.evaluation.seed, setting)
            same = count_equal(recorded, played, same_processor)
            rounds += len(recorded)
            equal += same
            unequal_here += len(recorded) - same if same_processor else 0
            successes[config.cell, setting] += [
                (then.success_step(closure) is not None, now.success_step(closure) is not None)
                for then, now in zip(recorded, played, strict=True)
            ]
        if report is not None:
            report(done, len(folders))
    off = sum(is_off(*zip(*pairs, strict=True)) for pairs in successes.values())
    contents = {name: text.encode() for name, text in texts.items()}
    if exact and (Path(results) / "figures").is_dir():
        from marl_encircle.study.figures.write import encode_figures

        contents |= encode_figures(grid, results)
    changed = [name for name, data in contents.items() if _read(Path(results) / name) != data]
    return Verification(rounds, equal, unequal_here, off, exact, tuple(changed))


def count_equal(recorded: Sequence[Episode], played: Sequence[Episode], exact: bool) -> int:
    """Count the rounds that ended alike.

    :param exact: all figures must be the same, not only the steps at which the closure rules held
    """
    pairs = zip(recorded, played, strict=True)
    if exact:
        return sum(then == now for then, now in pairs)
    return sum((then.step_all, then.step_pursuers) == (now.step_all, now.step_pursuers) for then, now in pairs)


def is_off(recorded: Sequence[bool], played: Sequence[bool]) -> bool:
    """Whether a cell's S now lies outside the 99 % binomial interval of the S that is recorded."""
    interval = wilson_interval(sum(recorded) / len(recorded), len(recorded), CELL_CONFIDENCE)
    return not interval.low <= sum(played) / len(played) <= interval.high


def _read(path: Path) -> bytes | None:
    return files.read_bytes(path) if path.exists() else None
