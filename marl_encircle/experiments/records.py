"""What a run leaves behind: run folders, their names and their records, hashes checked."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from marl_encircle import files
from marl_encircle.core.geometry import Closure
from marl_encircle.core.simulator import world_seeds
from marl_encircle.experiments.episodes import Episode, episodes_from_csv

RECORD = "run.json"
"""What a run folder says of its run; written last."""
CURVE = "progress.csv"
"""The learning curve in a run folder."""
POLICY = "policy.safetensors"
"""The actors' weights in a run folder."""

SCHEMA = 1
"""Which fields a record has; another number is for another version of this package."""

Status = Literal["finished", "diverged", "unfinished", "not evaluated"]
MAX_RUN_JSON = 1 << 20
MAX_FILE = 1 << 28
_RECORD_KEYS = ("status", "method", "seed", "config", "config_hash", "sha256")


class Setting(NamedTuple):
    """What a cell of a table is about, apart from the method.

    :param speed_ratio: lambda, target speed / pursuer speed
    :param pursuers: n
    :param obstacles: m
    :param scene: name of the scene
    """

    speed_ratio: float
    pursuers: int
    obstacles: int
    scene: str = "random"

    @property
    def numbers(self) -> tuple[str, str, str]:
        """Speed ratio, pursuers and obstacles as they stand in tables."""
        return f"{self.speed_ratio:g}", str(self.pursuers), str(self.obstacles)

    @property
    def symbols(self) -> str:
        """The same on one line: ``ratio 1.1, n=3, m=1``."""
        return "ratio {}, n={}, m={}".format(*self.numbers)


class Cell(NamedTuple):
    """One method in one setting."""

    method: str
    setting: Setting


@dataclass(frozen=True)
class Run:
    """One run folder.

    :param cell: its method and setting
    :param seed: its training seed
    :param status: what became of it; only a finished one has rounds
    :param closure: the method's own closure rule; None for an unfinished run
    :param episodes: its evaluation rounds
    :param elsewhere: rounds of its policy in settings that it was not trained in
    """

    cell: Cell
    seed: int
    status: Status
    closure: Closure | None = None
    episodes: Sequence[Episode] = ()
    elsewhere: Mapping[Setting, Sequence[Episode]] = field(default_factory=dict)


def run_path(cell: Cell, seed: int) -> Path:
    """Where a run lies in the folder of all runs: ``<method>/ratio<lambda>_n<n>_m<m>_<scene>/seed<s>``."""
    return Path(cell.method, setting_name(cell.setting), f"seed{seed}")


def run_folders(folder: Path) -> list[Path]:
    """Return what lies where runs do, ``<method>/<setting>/seed<s>``; names that start with a dot are not ours."""
    return sorted(folder.glob("[!.]*/[!.]*/seed*"))


def setting_name(setting: Setting) -> str:
    """How folders and files spell a setting: ``ratio<lambda>_n<n>_m<m>_<scene>``."""
    ratio, pursuers, obstacles, scene = setting
    return f"ratio{float(ratio)!r}_n{pursuers}_m{obstacles}_{scene}"


def episodes_name(setting: Setting | None = None) -> str:
    """File of the rounds in a setting that the run was not trained in; by default of those in its own."""
    return "episodes.csv" if setting is None else f"episodes_{setting_name(setting)}.csv"


def read_runs(folder: str | Path, *, policies: bool = True) -> list[Run]:
    """Read every run folder below a folder, hashes checked.

    :param folder: e.g. ``results/runs``; a missing one has no runs
    :param policies: whether every run must still have its policy, which its rounds do not need
    :return: runs in the order of method, setting, seed
    :raises files.DamagedFileError: for a folder that is no run folder or a file that is not what the run wrote, by name
    """
    runs = [
        _read_run(seed_folder, Cell(method_folder.name, read_setting(setting_folder)), _seed(seed_folder), policies)
        for method_folder in _subfolders(Path(folder))
        for setting_folder in _subfolders(method_folder)
        for seed_folder in _subfolders(setting_folder)
    ]
    return sorted(runs, key=lambda run: (run.cell, run.seed))


def _subfolders(folder: Path) -> list[Path]:
    """Folders in a folder; names that start with a dot are not ours."""
    if not folder.is_dir():
        return []
    return [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]


def read_setting(path: Path) -> Setting:
    """Return what the name of a folder says; another spelling of its numbers would be a second folder of one cell.

    :raises files.DamagedFileError: for another name
    """
    setting = _setting_of(path.name)
    if setting is None:
        raise files.DamagedFileError(path, "a setting's folder must be named ratio<lambda>_n<n>_m<m>_<scene>")
    _check_spelling(path, setting_name(setting))
    return setting


def _setting_of(name: str) -> Setting | None:
    match = re.fullmatch(r"ratio(\d+(?:\.\d+)?)_n(\d+)_m(\d+)_(\w+)", name)
    return match and Setting(float(match[1]), int(match[2]), int(match[3]), match[4])


def _seed(folder: Path) -> int:
    match = re.fullmatch(r"seed(\d+)", folder.name)
    if match is None:
        raise files.DamagedFileError(folder, "a run's folder must be named seed<number>")
    _check_spelling(folder, f"seed{int(match[1])}")
    return int(match[1])


def _check_spelling(folder: Path, name: str) -> None:
    if folder.name != name:
        raise files.DamagedFileError(folder, f"the folder must be named {name}")


def _read_run(folder: Path, cell: Cell, seed: int, policies: bool) -> Run:
    """Read one run folder; without ``run.json``, which is written last, the run is unfinished."""
    if not (folder / RECORD).exists():
        return Run(cell, seed, "unfinished")
    record = read_record(folder)
    _check_place(folder / RECORD, record, cell, seed)
    closure: Closure = record["config"]["reward"]["closure"]
    hashes = sorted(record["sha256"].items())
    if not policies:
        hashes = [(name, value) for name, value in hashes if name != POLICY]
    contents = {name: files.read_bytes(folder / name, sha256=value, max_bytes=MAX_FILE) for name, value in hashes}
    if record["status"] == "diverged":
        return Run(cell, seed, "diverged", closure)
    own = folder / episodes_name()
    if own.name not in contents:
        if files.is_kept(own):
            raise files.DamagedFileError(own, f"its hash is not in {RECORD}")
        return Run(cell, seed, "not evaluated", closure)
    asked = record["config"]["evaluation"]
    episodes = _episodes_of(own, contents[own.name], asked)
    elsewhere = {}
    for name in contents:
        setting = _setting_of(name.removeprefix("episodes_").removesuffix(".csv"))
        if setting is not None and name == episodes_name(setting):
            elsewhere[setting] = _episodes_of(folder / name, contents[name], asked)
    return Run(cell, seed, "finished", closure, episodes, elsewhere)


def read_episodes(folder: Path, record: Mapping[str, Any], setting: Setting | None = None) -> tuple[Episode, ...]:
    """Return the evaluation rounds of a run folder that its record vouches for.

    :param record: content of its ``run.json``, see :func:`read_record`
    :param setting: where the rounds were played; by default where the run was trained
    :raises files.DamagedFileError: if they are not what the run wrote
    """
    path = folder / episodes_name(setting)
    data = files.read_bytes(path, sha256=record["sha256"][path.name], max_bytes=MAX_FILE)
    return _episodes_of(path, data, record["config"]["evaluation"])


def _episodes_of(path: Path, data: bytes, asked: Mapping[str, int]) -> tuple[Episode, ...]:
    """Return the rounds of a file, which must be those that the run's evaluation section asks for."""
    try:
        episodes = episodes_from_csv(data.decode("utf-8"))
    except ValueError as error:
        raise files.DamagedFileError(path, str(error)) from error
    n, seed = asked["episodes"], asked["seed"]
    if not _are_rounds(episodes, n, seed):
        reason = f"its {len(episodes)} rounds are not rounds 0 to {n - 1} of evaluation seed {seed}"
        raise files.DamagedFileError(path, f"{reason}, which the run's configuration asks for")
    return tuple(episodes)


def _are_rounds(episodes: Sequence[Episode], n: int, seed: int) -> bool:
    """Whether these are the first n rounds of an evaluation seed, in order."""
    if len(episodes) != n:  # first, since n may be as large as somebody likes
        return False
    return [(episode.round, episode.seed) for episode in episodes] == list(enumerate(world_seeds(seed, n)))


def _check_place(path: Path, record: Mapping[str, Any], cell: Cell, seed: int) -> None:
    """Raise a DamagedFileError unless a ``run.json`` belongs where it lies."""
    scenario = record["config"]["scenario"]
    recorded = {f"config.scenario.{key}": (scenario.get(key), value) for key, value in cell.setting._asdict().items()}
    for key, (value, expected) in {
        "method": (record["method"], cell.method),
        "seed": (record["seed"], seed),
        **recorded,
    }.items():
        if value != expected:
            raise files.DamagedFileError(path, f"{key} is {value!r:.80}, but its folder says {expected!r}")


def read_record(folder: Path) -> dict[str, Any]:
    """Return the ``run.json`` of a run folder, its fields and the hash of its configuration checked.

    The configuration itself is only checked as far as the tables depend on it: an older one may lack fields that were
    added since.

    :raises files.DamagedFileError: if it is missing (the run is unfinished), changed, or not what a run writes
    """
    path = folder / RECORD
    data = files.read_bytes(path, max_bytes=MAX_RUN_JSON)
    try:
        record = json.loads(data)
        reason = _fault(record)
    except (ValueError, RecursionError) as error:
        raise files.DamagedFileError(path, f"not valid JSON: {error}") from error
    if reason is not None:
        raise files.DamagedFileError(path, reason)
    return cast(dict[str, Any], record)


def config_hash(config: Mapping[str, Any]) -> str:
    """sha256 of a resolved configuration as plain data, in hexadecimal."""
    return files.sha256_bytes(json.dumps(config, sort_keys=True).encode())


def _fault(record: Any) -> str | None:
    """Say what is wrong with the content of a ``run.json``; None if nothing is."""
    if not isinstance(record, dict):
        return "not a JSON object"
    if record.get("schema") != SCHEMA:
        return f"schema is {record.get('schema')!r:.80}, not {SCHEMA}: no record that this version can read"
    missing = [key for key in _RECORD_KEYS if key not in record]
    if missing:
        return f"missing {', '.join(missing)}"
    if record["status"] not in ("finished", "diverged"):
        return f"status is {record['status']!r:.80}, not finished or diverged"
    if not _is_count(record["seed"], 0):
        return f"seed is {record['seed']!r:.80}, not an integer of at least 0"
    return _fault_of_config(record["config"], record["config_hash"]) or _fault_of_hashes(record["sha256"])


def _fault_of_config(config: Any, recorded_hash: Any) -> str | None:
    if not isinstance(config, dict):
        return f"config is {config!r:.80}, not an object"
    if config_hash(config) != recorded_hash:
        return f"config has changed since it was written: its hash is {config_hash(config)}, not {recorded_hash!r:.80}"
    for name in ("reward", "scenario", "evaluation"):
        if not isinstance(config.get(name), dict):
            return f"config.{name} is {config.get(name)!r:.80}, not an object"
    closure, evaluation = config["reward"].get("closure"), config["evaluation"]
    if closure not in ("all", "pursuers"):
        return f"config.reward.closure is {closure!r:.80}, not all or pursuers"
    for key, least in (("episodes", 1), ("seed", 0)):
        if not _is_count(evaluation.get(key), least):
            return f"config.evaluation.{key} is {evaluation.get(key)!r:.80}, not an integer of at least {least}"
    return None


def _fault_of_hashes(hashes: Any) -> str | None:
    if not isinstance(hashes, dict) or not all(isinstance(value, str) for value in hashes.values()):
        return f"sha256 is {hashes!r:.80}, not an object of file names and hashes"
    for name in hashes:
        if re.fullmatch(r"\w[\w.-]*", name) is None:
            return f"sha256 has {name!r:.80}, not a plain file name"
    return None if POLICY in hashes else f"sha256 has no {POLICY}"


def _is_count(value: Any, least: int) -> bool:
    """Whether a value is a whole number from ``least``; Python counts True and False among them."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
