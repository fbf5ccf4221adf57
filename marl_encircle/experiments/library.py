"""Names -> files -> plain values: where methods, sections and grids lie, each file on top of the ``base`` it names.

``reward`` comes from ``ablations/``, ``baselines/`` or a path; the other sections from the package's
``configs/<section>/`` or a path.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from marl_encircle.experiments.yaml_files import ConfigError, holds, merge, read_yaml
from marl_encircle.spelling import nearest

PACKAGE = Path(__file__).parent.parent

PROTOCOLS = ("calibration",)
"""Files of ``configs/paper/`` that are protocols; the others are grids."""

MAX_BASES = 20


def reward_names() -> list[str]:
    """Return the names of the methods that the installation carries."""
    return sorted(path.stem for folder in _reward_folders() for path in folder.glob("*.yaml"))


def load_reward(name: str) -> dict[str, Any]:
    """Return the values of a method's file, named after the file unless it says otherwise.

    :param name: a name in ``ablations/`` or ``baselines/``, or the path of a YAML file
    :raises ConfigError: naming the file, and the nearest name
    """
    return {"name": Path(name).stem, **load_section("reward", name)}


def load_section(section: str, name: str) -> dict[str, Any]:
    """Return the values of a section's file.

    :param section: a folder of ``configs/``
    :param name: a name in that folder, or the path of a YAML file
    :raises ConfigError: naming the file, and the nearest name
    """
    folders = _folders(section)
    return _load(find_file(name, folders, section), folders, section)


def file_of(section: str, name: str, keys: Sequence[str]) -> Path | None:
    """Return the file in which a key stands: the last one of a chain of bases that has it, or None.

    :param section: ``reward`` or a folder of ``configs/``
    :param name: what :func:`load_reward` or :func:`load_section` was called with
    :param keys: path of the key below the section
    """
    folders = _folders(section)
    chain = _chain(find_file(name, folders, section), folders, section)
    return next((path for path, values in chain if holds(values, keys)), None)


def find_file(name: str, folders: Iterable[Path], kind: str) -> Path:
    """Return the file of that name in one of the folders, or of that path.

    :raises ConfigError: naming the nearest name
    """
    return _choose(name, (path for folder in folders for path in folder.glob("*.yaml")), kind)


def find_plan(name: str, kind: Literal["grid", "protocol"]) -> Path:
    """Return the file of that name in ``configs/paper/``, where grids and protocols lie, or of that path.

    :raises ConfigError: naming the nearest name of that kind
    """
    paths = (PACKAGE / "configs" / "paper").glob("*.yaml")
    return _choose(name, (path for path in paths if (path.stem in PROTOCOLS) == (kind == "protocol")), kind)


def _choose(name: str, paths: Iterable[Path], kind: str) -> Path:
    if is_path(name):
        return Path(name)
    known = {path.stem: path for path in paths}
    if name not in known:
        raise ConfigError(f"{kind} {name!r:.80}: neither a known name nor a .yaml path{nearest(name, known)}")
    return known[name]


def is_path(name: str) -> bool:
    """Whether a configuration is given by the path of its file, not by name."""
    return name.lower().endswith((".yaml", ".yml")) or os.sep in name


def _folders(section: str) -> list[Path]:
    return _reward_folders() if section == "reward" else [PACKAGE / "configs" / section]


def _reward_folders() -> list[Path]:
    """``ablations`` and ``baselines``: in the package of a built install, beside it in a checkout."""
    roots = (PACKAGE, PACKAGE.parent)
    return [root / name for name in ("ablations", "baselines") for root in roots if (root / name).is_dir()]


def _load(path: Path, folders: Iterable[Path], kind: str) -> dict[str, Any]:
    """Read a file on top of its base's."""
    values: dict[str, Any] = {}
    for _, below in reversed(_chain(path, folders, kind)):
        if kind == "reward":  # a changed method is another one: without a name of its own, its file's
            values.pop("name", None)
        values = merge(values, below)
    return values


def _chain(path: Path, folders: Iterable[Path], kind: str) -> list[tuple[Path, dict[str, Any]]]:
    """Return a file, its base, that one's base and so on, each with the values that stand in it."""
    chain: list[tuple[Path, dict[str, Any]]] = []
    seen: list[str] = []
    while True:
        real = os.path.realpath(path)
        if real in seen:
            raise ConfigError(f"{path}: circular base; it leads back to this file")
        if len(seen) > MAX_BASES:
            raise ConfigError(f"{path}: more than {MAX_BASES} nested bases")
        seen.append(real)
        values = read_yaml(path)
        base = values.pop("base", None)
        chain.append((path, values))
        if base is None:
            return chain
        if not isinstance(base, str) or not base.isprintable() or len(base) > 1000:
            raise ConfigError(f"{path}: base must be a name or a path; got {base!r:.80}")
        try:
            path = path.parent / base if is_path(base) else find_file(base, folders, kind)
        except ConfigError as error:
            raise ConfigError(f"{path}: base: {error}") from error
