"""The runs of a grid that there are, each one what the grid asks for."""

from dataclasses import replace
from pathlib import Path

from marl_encircle.experiments.grid import Grid
from marl_encircle.experiments.records import Run, read_runs
from marl_encircle.experiments.train import check_same_run, run_folder


def read_grid_runs(grid: Grid, folder: str | Path) -> list[Run]:
    """Return the runs of a grid in the order of method, setting, seed.

    Other runs in the folder are left out, and rounds in settings in which the grid does not ask to play.

    :param folder: of all runs
    :raises OtherRunError: if a run has another configuration than the grid asks for, with the difference
    :raises DamagedFileError: if a run is not what its record says
    """
    asked = {(job.config.cell, job.seed): job.config for job in grid.jobs}
    runs = [run for run in read_runs(folder) if (run.cell, run.seed) in asked]
    for run in runs:
        if run.status != "unfinished":
            config = asked[run.cell, run.seed]
            check_same_run(run_folder(config, run.seed, folder), config, run.seed)
    for i, run in enumerate(runs):
        elsewhere = grid.elsewhere.get(run.cell, ())
        runs[i] = replace(run, elsewhere={each: run.elsewhere[each] for each in elsewhere if each in run.elsewhere})
    return runs
