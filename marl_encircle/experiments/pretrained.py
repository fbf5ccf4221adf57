"""Trained policies by name: the first training seed of a method in a setting, never the best one.

Some come with the package: in a checkout they are the runs of ``results/``, in an installation copies of their records,
policies and cards.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from marl_encircle.core.scenario import plain
from marl_encircle.core.scenes import SCENES
from marl_encircle.experiments.faults import section_of
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.library import PACKAGE, reward_names
from marl_encircle.experiments.records import RECORD, Cell, Setting, read_record, read_setting, run_path
from marl_encircle.experiments.sections import SettingConfig
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.spelling import nearest

USUAL_SETTING = Setting(1.1, 3, 1)
"""What is meant where nothing else is said."""


def pretrained_runs() -> Path:
    """Return the folder of the runs that come with the package."""
    installed = PACKAGE / "pretrained"
    return installed if installed.is_dir() else PACKAGE.parent / "results" / "runs"


def is_run_path(what: str) -> bool:
    """Whether a path is meant rather than the name of a method."""
    path = Path(what)
    return len(path.parts) > 1 or path.is_file() or (path / RECORD).exists()


def setting_of(fields: Mapping[str, Any]) -> Setting:
    """Return the setting that differs from the usual one by some fields.

    :raises ConfigError: for an unknown field or scene, naming the nearest, and for a value of another type
    """
    chosen = {name: plain(value) for name, value in fields.items()}
    setting = section_of(SettingConfig, {**USUAL_SETTING._asdict(), **chosen}).build()
    if setting.scene not in SCENES:
        raise ConfigError(f"scene {setting.scene!r:.80}: unknown scene{nearest(setting.scene, SCENES)}")
    return setting


def find_run(method: str, setting: Setting, folders: Sequence[Path]) -> Path:
    """Return the run of a method's first training seed in a setting, else one whose policy serves any setting.

    :param folders: of runs, the one to prefer first
    :raises ConfigError: naming what there is, the nearest, and the command that trains it; or that it diverged
    """
    found = first_run(Cell(method, setting), folders)
    if found is not None:
        return found
    methods = {path.name for folder in folders for path in folder.glob("[!.]*") if path.is_dir()}
    if method not in {*methods, *reward_names()}:
        raise ConfigError(f"{method!r:.80}: no method and no run folder{nearest(method, methods)}")
    found = _run_of_sets(method, folders)
    if found is not None:
        return found
    there = {path.parents[1] for folder in folders for path in (folder / method).glob(f"*/seed*/{RECORD}")}
    known = "it has none at all"
    if there:
        closest = min(map(read_setting, sorted(there)), key=lambda other: _distance(other, setting))
        names = ", ".join(sorted({path.name for path in there}))
        known = f"the nearest is {in_words(closest)}; there are {names}"
    options = f"--speed-ratio {setting.speed_ratio:g} --pursuers {setting.pursuers} --obstacles {setting.obstacles}"
    if setting.scene != USUAL_SETTING.scene:
        options += f" --scene {setting.scene}"
    where = ", ".join(dict.fromkeys(str(folder.resolve()) for folder in folders))
    raise ConfigError(
        f"{where}: no run of {method} {in_words(setting)}; {known}. Train one: marl-encircle train --reward {method} "
        f"{options}"
    )


def first_run(cell: Cell, folders: Sequence[Path]) -> Path | None:
    """Return the run of a cell's first training seed, or of the cell whose runs it shares; None without one.

    :param folders: of runs, the one to prefer first
    :raises ConfigError: if it diverged: another seed in its place would be one that was chosen
    :raises DamagedFileError: if its record is not what a run writes
    """
    for folder in folders:
        found = _first_seed(folder, cell) or _first_seed(folder, load_grid("study").aliases.get(cell, cell))
        if found is not None:
            _check_not_diverged(found, cell)
            return found
    return None


def _check_not_diverged(run: Path, cell: Cell) -> None:
    if read_record(run)["status"] == "diverged":
        raise ConfigError(
            f"{run}: the first training seed of {cell.method} {in_words(cell.setting)} diverged, so the name stands "
            "for no policy; give the folder of a run"
        )


def _run_of_sets(method: str, folders: Sequence[Path]) -> Path | None:
    """Return a method's first run whose policy serves any setting, since it reads sets; None without one.

    :raises ConfigError: if it diverged
    """
    for folder in folders:
        for path in sorted({path.parents[1] for path in (folder / method).glob(f"*/seed*/{RECORD}")}):
            cell = Cell(method, read_setting(path))
            first = _first_seed(folder, cell)
            algorithm = read_record(first)["config"].get("algorithm") if first else None
            if first and isinstance(algorithm, dict) and algorithm.get("features") == "set":
                _check_not_diverged(first, cell)
                return first
    return None


def in_words(setting: Setting) -> str:
    """Return a setting in words."""
    pursuers = f"{setting.pursuers} pursuer{'s' if setting.pursuers != 1 else ''}"
    obstacles = f"{setting.obstacles} obstacle{'s' if setting.obstacles != 1 else ''}"
    scene = f" in the scene {setting.scene}" if setting.scene != USUAL_SETTING.scene else ""
    return f"with {pursuers} and {obstacles} at speed ratio {setting.speed_ratio:g}{scene}"


def _first_seed(folder: Path, cell: Cell) -> Path | None:
    numbers = [
        int(number)
        for path in (folder / run_path(cell, 0)).parent.glob(f"seed*/{RECORD}")
        if (number := path.parent.name.removeprefix("seed")).isdigit()
    ]
    return folder / run_path(cell, min(numbers)) if numbers else None


def _distance(one: Setting, other: Setting) -> float:
    """How far apart two settings are; a tenth of speed ratio counts as a body."""
    bodies = abs(one.pursuers - other.pursuers) + abs(one.obstacles - other.obstacles)
    return bodies + 10 * abs(one.speed_ratio - other.speed_ratio) + (one.scene != other.scene)
