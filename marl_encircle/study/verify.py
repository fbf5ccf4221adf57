"""Are the committed results those of this code? Every policy plays its rounds again, tables and figures are made again.

On the processor that a run was made on every round must be equal in every number. Another one rounds differently, and a
round may then take another course: there 99.5 % of the rounds must end alike, every cell's S must lie within the 99 %
binomial interval of the S that is recorded, and only figures of recorded numbers are compared.
"""

from collections import Counter, defaultdict
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
    :param equal: those that ended as recorded; on the run's own processor also with the same numbers
    :param rounds_here: rounds of runs that were made on this processor
    :param equal_here: those of them that are equal
    :param cells_off: cells whose S lies outside the interval
    :param changed: tables, cards and figures that are not what the runs give
    """

    rounds: int
    equal: int
    rounds_here: int
    equal_here: int
    cells_off: int
    changed: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether all runs were made on this processor, so that every round must be equal."""
        return self.rounds_here == self.rounds

    @property
    def passed(self) -> bool:
        """Whether there are results and they are those of this code."""
        elsewhere, equal_elsewhere = self.rounds - self.rounds_here, self.equal - self.equal_here
        enough = self.equal_here == self.rounds_here and equal_elsewhere >= EQUAL_SHARE * elsewhere
        return self.rounds > 0 and enough and not self.cells_off and not self.changed


def verify(
    grid: Grid, results: str | Path, report: Callable[[int, int], None] | None = None, *, exact: bool = False
) -> Verification:
    """Play every finished run of a grid again and make its tables, and its figures if there are any; write nothing.

    :param results: folder of ``runs/``, ``tables/`` and ``figures/``
    :param report: called with the number of runs verified and of all
    :param exact: take every run as made on this processor
    :raises DamagedFileError: if a run is not what its record says
    """
    texts = render(grid, results)  # and with that, whether every run is what its record says
    folders = [run_folder(job.config, job.seed, Path(results) / "runs") for job in grid.jobs]
    folders = [folder for folder in folders if (folder / RECORD).exists() and files.is_kept(folder / episodes_name())]
    rounds, equal = Counter[bool](), Counter[bool]()  # by whether the run was made on this processor
    successes: dict[tuple[Cell, Setting | None], list[tuple[bool, bool]]] = defaultdict(list)
    for done, folder in enumerate(folders, start=1):
        policy, config, record = load_run(folder)
        here = exact or record.get("cpu") == cpu_model()
        closure = config.reward.closure
        for setting in (None, *grid.elsewhere.get(config.cell, ())):
            name = episodes_name(setting)
            if name not in record["sha256"]:
                continue
            recorded = read_episodes(folder, record, setting)
            played = play_rounds(policy, config, len(recorded), config.evaluation.seed, setting)
            rounds[here] += len(recorded)
            equal[here] += count_equal(recorded, played, here)
            successes[config.cell, setting] += [
                (then.success_step(closure) is not None, now.success_step(closure) is not None)
                for then, now in zip(recorded, played, strict=True)
            ]
        if report is not None:
            report(done, len(folders))
    off = sum(is_off(*zip(*pairs, strict=True)) for pairs in successes.values())
    contents = {name: text.encode() for name, text in texts.items()}
    if (Path(results) / "figures").is_dir():
        from marl_encircle.study.figures.write import COMPUTED, encode_figures

        for name, data in encode_figures(grid, results).items():
            if not (rounds[False] and Path(name).stem in COMPUTED):
                contents[name] = data
    changed = [name for name, data in contents.items() if _read(Path(results) / name) != data]
    return Verification(rounds.total(), equal.total(), rounds[True], equal[True], off, tuple(changed))


def count_equal(recorded: Sequence[Episode], played: Sequence[Episode], exact: bool) -> int:
    """Count the rounds that ended alike.

    :param exact: all numbers must be the same, not only the steps at which the closure rules held
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
