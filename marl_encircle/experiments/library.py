"""Names -> files -> plain values: where methods, sections and grids lie, each file on top of the ``base`` it names.

``reward`` comes from ``ablations/``, ``baselines/`` or a path, a grid from the package's ``configs/paper/`` or a path,
the other kinds from ``configs/<kind>/`` or a path.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from marl_encircle.experiments.yaml_files import ConfigError, holds, merge, read_yaml
from marl_encircle.spelling import nearest

PACKAGE = Path(__file__).parent.parent

Kind = Literal["reward", "scenario", "algorithm", "training", "evaluation", "grid", "protocol", "tuning"]
"""What a YAML file of ours may be: a section of a configuration, or a plan of many runs."""

MAX_BASES = 20
MAX_NAME = 1000
"""Characters of a name or path."""


def files_of(kind: Kind) -> dict[str, Path]:
    """Return the files of a kind that the installation carries, by name."""
    own = PACKAGE / "configs" / ("paper" if kind == "grid" else kind)
    folders = _reward_folders() if kind == "reward" else [own]
    return dict(sorted((path.stem, path) for folder in folders for path in folder.glob("*.yaml")))


def reward_names() -> list[str]:
    """Return the names of the methods that the installation carries."""
    return list(files_of("reward"))


def load_reward(name: str) -> dict[str, Any]:
    """Return the values of a method's file, named after the file unless it says otherwise.

    :param name: a name in ``ablations/`` or ``baselines/``, or the path of a YAML file
    :raises ConfigError: naming the file, and the nearest name
    """
    return {"name": Path(name).stem, **load_section("reward", name)}


def load_section(section: Kind, name: str) -> dict[str, Any]:
    """Return the values of a section's file on top of its base's.

    :param name: a name of that kind, or the path of a YAML file
    :raises ConfigError: naming the file, and the nearest name
    """
    values: dict[str, Any] = {}
    for _, below in reversed(_chain(name, section)):
        if section == "reward":  # a changed method is another one: without a name of its own, its file's
            values.pop("name", None)
        values = merge(values, below)
    return values


def file_of(section: Kind, name: str, keys: Sequence[str]) -> Path | None:
    """Return the file in which a key stands: the last one of a chain of bases that has it, or None.

    :param name: what :func:`load_reward` or :func:`load_section` was called with
    :param keys: path of the key below the section
    """
    return next((path for path, values in _chain(name, section) if holds(values, keys)), None)


def find_file(name: str | Path, kind: Kind) -> Path:
    """Return the file of that kind and name, or of that path.

    :raises ConfigError: naming the nearest name of that kind
    """
    name = str(name)
    if not name.isprintable() or len(name) > MAX_NAME:
        raise ConfigError(f"{kind} must be a name or the path of a YAML file; got {name!r:.80}")
    if is_path(name):
        return Path(name)
    known = files_of(kind)
    if name not in known:
        raise ConfigError(f"{kind} {name!r:.80}: neither a known name nor a .yaml path{nearest(name, known)}")
    return known[name]


def is_path(name: str) -> bool:
    """Whether a configuration is given by the path of its file, not by name."""
    return name.lower().endswith((".yaml", ".yml")) or os.sep in name


def _reward_folders() -> list[Path]:
    """``ablations`` and ``baselines``: in the package of a built install, beside it in a checkout."""
    roots = (PACKAGE, PACKAGE.parent)
    return [root / name for name in ("ablations", "baselines") for root in roots if (root / name).is_dir()]


def _chain(name: str, kind: Kind) -> list[tuple[Path, dict[str, Any]]]:
    """Return a file, its base, that one's base and so on, each with the values that stand in it."""
    path = find_file(name, kind)
    chain: list[tuple[Path, dict[str, Any]]] = []
    seen: list[str] = []
    while True:
        real = os.path.realpath(path)
        if real in seen:
            raise ConfigError(f"{path}: circular base; it leads back to this file")
        if len(seen) > MAX_BASES:
            raise ConfigError(f"{path}: more than {MAX_BASES} nested bases")
        seen.append(real)
        try:
            values = read_yaml(path)
        except ConfigError as error:
            raise ConfigError(f"{error}; the base of {chain[-1][0]}" if chain else str(error)) from error
        base = values.pop("base", None)
        chain.append((path, values))
        if base is None:
            return chain
        if not isinstance(base, str) or not base.isprintable() or len(base) > MAX_NAME:
            raise ConfigError(f"{path}: base must be a name or a path; got {base!r:.80}")
        try:
            path = path.parent / base if is_path(base) else find_file(base, kind)
        except ConfigError as error:
            raise ConfigError(f"{path}: base: {error}") from error
