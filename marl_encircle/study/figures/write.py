"""From the runs of a grid to the files of all figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from marl_encircle import files
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.grid_runs import read_grid_runs
from marl_encircle.experiments.learning_curve import Curve, read_curve
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.metrics import CellSummary, summarise_cell
from marl_encircle.experiments.records import CURVE, Cell, Run, read_record, run_path
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays.replay import record_round
from marl_encircle.study.cells import NOT_RUN, absences, gather
from marl_encircle.study.figures import contributions, curves
from marl_encircle.study.figures.canvas import encode
from marl_encircle.study.figures.contributions import draw_figure5
from marl_encircle.study.figures.curves import Band, band_of, draw_figure4, in_order
from marl_encircle.study.figures.rounds import METHOD, PLACES, Column, Place, choose_round, draw_figure6
from marl_encircle.study.figures.situations import draw_figure1, draw_figure3

COMPUTED = frozenset({"figure1", "figure3", "figure6"})
"""Figures of geometry or rounds that are computed when they are drawn; the others show recorded numbers alone."""


def write_figures(grid: Grid, results: str | Path) -> list[Path]:
    """Draw Figures 1 and 3 to 6 from the runs of a grid into ``results/figures``, as SVG, PDF and PNG.

    What the grid does not ask for is not shown; what it asks for and is not there, is "not run".

    :return: the files written
    :raises OtherRunError: if a run has another configuration than the grid asks for, with the difference
    :raises DamagedFileError: if a run there is not what its record says
    """
    contents = encode_figures(grid, results)
    for name, data in contents.items():
        files.write_bytes(Path(results) / name, data)
    return [Path(results) / name for name in contents]


def encode_figures(grid: Grid, results: str | Path) -> dict[str, bytes]:
    """Return the files of all figures: path below ``results`` -> bytes. Nothing is written."""
    figures = draw_figures(grid, Path(results) / "runs")
    return {
        f"figures/{name}.{suffix}": data for name, figure in figures.items() for suffix, data in encode(figure).items()
    }


def draw_figures(grid: Grid, folder: Path) -> dict[str, Figure]:
    """Return every figure by name.

    :param folder: of all runs
    """
    runs = read_grid_runs(grid, folder)
    bands = read_bands([run for run in runs if run.cell.setting in curves.SETTINGS], folder)
    by_cell = gather(runs, grid.aliases)
    absent = absences(by_cell)
    methods = {cell.method for cell in grid.cells if cell.setting in curves.SETTINGS}
    return {
        "figure1": draw_figure1(),
        "figure3": draw_figure3(),
        "figure4": draw_figure4(bands, absent=absent),
        "figure4_all": draw_figure4(bands, in_order(methods), absent),
        "figure5": draw_figure5(_summaries(runs), absent),
        "figure6": draw_figure6([_column(place, runs, absent, folder) for place in PLACES]),
    }


def read_bands(runs: Sequence[Run], folder: Path) -> dict[Cell, Band]:
    """Read the learning curves of the finished runs.

    :param folder: of all runs
    :raises DamagedFileError: for a curve that is not what its run wrote
    """
    by_cell: dict[Cell, list[Curve]] = {}
    rounds: dict[Cell, int] = {}
    for run in runs:
        if run.status == "finished":
            path = folder / run_path(run.cell, run.seed)
            record = read_record(path)
            curve = read_curve(path, record["sha256"].get(CURVE))
            by_cell.setdefault(run.cell, []).append(curve)
            rounds[run.cell] = record["config"]["evaluation"]["curve_episodes"]
    return {cell: _band_of(cell, found, rounds[cell], folder) for cell, found in by_cell.items()}


def _band_of(cell: Cell, found: Sequence[Curve], rounds: int, folder: Path) -> Band:
    """Gather the curves of a cell; raise a DamagedFileError that names its folder where they do not fit together."""
    try:
        return band_of(found, rounds)
    except ValueError as error:
        raise files.DamagedFileError((folder / run_path(cell, 0)).parent, str(error)) from error


def _summaries(runs: Sequence[Run]) -> Mapping[Cell, CellSummary]:
    """Summarise the finished runs of Figure 5's cells under each method's own rule."""
    summaries = {}
    for cell in (Cell(method, setting) for method in contributions.METHODS for setting in contributions.SETTINGS):
        found = [run for run in runs if run.cell == cell and run.status == "finished"]
        closure = found[0].closure if found else None
        if closure is not None:
            summaries[cell] = summarise_cell({run.seed: run.episodes for run in found}, closure)
    return summaries


def _column(place: Place, runs: Sequence[Run], absent: Mapping[Cell, str], folder: Path) -> Column:
    """Replay the round of a place: of the first finished training seed, chosen by rule.

    Where no policy was trained in a scene, that of single discs is put there as it is.
    """
    cells = [Cell(METHOD, place.setting), Cell(METHOD, place.setting._replace(scene="random"))]
    found = [run for cell in cells for run in runs if run.cell == cell and run.status == "finished"]
    if not found:
        reasons = [absent[cell] for cell in cells if cell in absent]
        return Column(place.title, None, note=reasons[0] if reasons else NOT_RUN)
    run = found[0]
    try:
        policy, config, _ = load_run(folder / run_path(run.cell, run.seed), {"scene": place.setting.scene})
    except ConfigError:
        return Column(place.title, None, note="several obstacles")
    rounds, evaluation, notes = run.episodes, config.evaluation, []
    if run.cell.setting != place.setting:
        rounds = run.elsewhere.get(place.setting) or tuple(
            play_rounds(policy, config, evaluation.episodes, evaluation.seed)
        )
        notes.append("(trained with discs)")
    choice = choose_round(rounds, config.reward.closure)
    if choice is None:
        return Column(place.title, None, note="no round solved")
    replay = record_round(policy, config, choice.round, evaluation.seed)
    recorded = rounds[choice.round].success_step(config.reward.closure)
    if replay.success_step != recorded:  # evaluated on a processor that rounds otherwise
        notes.append(f"(step {recorded} when evaluated)")
    return Column(place.title, replay, choice, "\n".join(notes))
