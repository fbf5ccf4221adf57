"""Which kind of file of ours a name or a path means, and how each kind is checked."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.faults import section_of
from marl_encircle.experiments.grid import GridConfig, load_grid, naming_file
from marl_encircle.experiments.library import Kind, files_of, find_file, is_path, load_section
from marl_encircle.experiments.overrides import SECTION_KEYS
from marl_encircle.experiments.records import run_path
from marl_encircle.experiments.search_space import SearchFile, load_space
from marl_encircle.experiments.sections import EvaluationConfig, TrainingConfig
from marl_encircle.experiments.yaml_files import ConfigError, read_yaml
from marl_encircle.spelling import nearest
from marl_encircle.study.protocol import Protocol, load_protocol

KINDS: tuple[Kind, ...] = get_args(Kind)

KEYS: Mapping[str, Collection[str]] = {
    **SECTION_KEYS,
    "grid": GridConfig.model_fields,
    "protocol": Protocol.model_fields,
    "tuning": SearchFile.model_fields,
}
"""What may stand in a file of each kind, beside ``base``."""


def find_kinds(name: str) -> list[Kind]:
    """Return what a name or the path of a YAML file may mean; a name may be that of several files.

    :raises ConfigError: if it means nothing
    """
    if is_path(name):
        return [_kind_of(Path(name))]
    kinds = [kind for kind in KINDS if name in files_of(kind)]
    if not kinds:
        known = {other for kind in KINDS for other in files_of(kind)}
        raise ConfigError(f"{name!r:.80}: neither a known name nor a .yaml path{nearest(name, known)}")
    return kinds


def _kind_of(path: Path) -> Kind:
    """Return the kind of a file: by its place in the installation, else by its base and its keys."""
    values = read_yaml(path)
    for kind in KINDS:
        if path.resolve() in (known.resolve() for known in files_of(kind).values()):
            return kind
    base = values.get("base")
    if isinstance(base, str) and base != str(path):
        candidates = [_kind_of(path.parent / base)] if is_path(base) else find_kinds(base)
    else:
        candidates = list(KINDS)
    shares = {kind: len(values.keys() & set(KEYS[kind])) for kind in candidates}
    best = [kind for kind in candidates if shares[kind] == max(shares.values())]
    if len(best) > 1:
        raise ConfigError(f"{path}: cannot tell which it is, {' or '.join(best)}; say so by --kind")
    return best[0]


def check(kind: Kind, name: str) -> dict[str, Any]:
    """Return what a file amounts to as plain data, checked.

    A method, a scenario and an algorithm are given as the whole configuration that they make with the usual others; a
    grid as its seeds by run folder.

    :raises ConfigError: naming file and key
    """
    return _CHECKS[kind](name)


def _grid(name: str) -> dict[str, Any]:
    grid = load_grid(name)
    seeds: dict[str, list[int]] = {}
    for job in grid.jobs:
        seeds.setdefault(str(run_path(job.config.cell, job.seed).parent), []).append(job.seed)
    first = grid.jobs[0]
    return {"scenario": first.scenario, "profile": first.profile, "frozen": grid.frozen, "seeds": seeds}


def _section(kind: Kind, model: type[BaseModel]) -> Callable[[str], dict[str, Any]]:
    def checked(name: str) -> dict[str, Any]:
        values = load_section(kind, name)
        with naming_file(find_file(name, kind)):
            return {kind: section_of(model, values, within=kind).model_dump()}

    return checked


_CHECKS: Mapping[Kind, Callable[[str], dict[str, Any]]] = {
    "reward": lambda name: load_config(name).with_defaults(),
    "scenario": lambda name: load_config(scenario=name).with_defaults(),
    "algorithm": lambda name: load_config(algorithm=name).with_defaults(),
    "training": _section("training", TrainingConfig),
    "evaluation": _section("evaluation", EvaluationConfig),
    "grid": _grid,
    "protocol": lambda name: load_protocol(name).model_dump(),
    "tuning": lambda name: load_space(name).to_dict(),
}
