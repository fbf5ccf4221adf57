"""What is installed and found here."""

import json
import os
import platform
from collections import Counter
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from packaging.requirements import Requirement

from marl_encircle.cli.options import OUTPUT, AsJson
from marl_encircle.cli.printing import print_pairs
from marl_encircle.experiments.library import Kind, files_of
from marl_encircle.experiments.yaml_files import ConfigError

NAME = "marl-encircle"


def info(
    out: Annotated[
        Path | None,
        typer.Option(
            "--results",
            "--out",
            metavar="DIR",
            rich_help_panel=OUTPUT,
            help="Folder of runs/.",
            show_default="results, and the package's own",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print what is installed and found here: for a report of a fault, or to see what there is.

    Versions and commit, the machine, optional parts, configurations, runs. None of your environment variables.
    """
    found = {
        "versions": _versions(),
        "machine": _machine(),
        "extras": _extras(),
        "configurations": {kind: {name: str(path) for name, path in files_of(kind).items()} for kind in get_args(Kind)},
        "runs": {str(folder): _runs(folder) for folder in _run_folders(out)},
    }
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    extras = [(name, part["missing"]) for name, part in found["extras"].items()]
    for title, pairs in {
        **found,
        "extras": {name: "installed" if not missing else f"needs {', '.join(missing)}" for name, missing in extras},
        "configurations": {kind: _by_folder(places) for kind, places in found["configurations"].items()},
        "runs": {folder: _in_words(methods) for folder, methods in found["runs"].items()},
    }.items():
        typer.secho(title, bold=True)
        print_pairs({f"  {name}": value for name, value in pairs.items()})


def _versions() -> dict[str, str | None]:
    from marl_encircle.experiments.provenance import git_commit, versions

    return {NAME: metadata.version(NAME), "commit": git_commit(), **versions()}


def _machine() -> dict[str, Any]:
    import torch as th

    from marl_encircle.experiments.memory import available_memory
    from marl_encircle.experiments.provenance import cpu_model

    devices = [th.cuda.get_device_name(number) for number in range(th.cuda.device_count())]
    return {
        "system": platform.platform(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "memory_gb": round(available_memory() / 1e9),
        "cuda": ", ".join(devices) or None,
    }


def _extras() -> dict[str, dict[str, Any]]:
    """Return whether each optional part is installed, else what it needs."""
    extras = metadata.metadata(NAME).get_all("Provides-Extra") or []
    missing: dict[str, list[str]] = {extra: [] for extra in sorted(extras)}
    for requirement in map(Requirement, metadata.requires(NAME) or ()):
        marker = requirement.marker
        if marker is None or marker.evaluate({"extra": ""}) or _is_there(requirement):
            continue
        for extra, names in missing.items():
            if marker.evaluate({"extra": extra}):
                names.append(f"{requirement.name}{requirement.specifier}")
    return {extra: {"installed": not names, "missing": names} for extra, names in missing.items()}


def _is_there(requirement: Requirement) -> bool:
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return False
    return bool(requirement.specifier.contains(version, prereleases=True))


def _run_folders(results: Path | None) -> list[Path]:
    """Return where there are runs: in the folder that was named, else in ``results`` and with the package.

    :raises ConfigError: if what was named holds none
    """
    from marl_encircle.experiments.pretrained import pretrained_runs

    if results is not None:
        if not (results / "runs").is_dir():
            raise ConfigError(f"{results / 'runs'}: no such folder; --results is the folder that holds runs/")
        return [results / "runs"]
    folders = {folder.resolve(): folder for folder in (pretrained_runs(), Path("results/runs"))}
    return [folder for folder in folders.values() if folder.is_dir()]


def _runs(folder: Path) -> dict[str, dict[str, int]]:
    """Return how many runs of each method have which end."""
    from marl_encircle.experiments.records import RECORD, read_record, run_folders
    from marl_encircle.files import DamagedFileError

    ends: dict[str, Counter[str]] = {}
    for run in run_folders(folder):
        if not (run / RECORD).exists():
            continue
        try:
            status = read_record(run)["status"]
        except DamagedFileError:
            status = "damaged"
        ends.setdefault(run.parents[1].name, Counter())[status] += 1
    return {method: dict(counts) for method, counts in ends.items()}


def _by_folder(places: dict[str, str]) -> str:
    """Return names, and in which folder they lie."""
    folders: dict[Path, list[str]] = {}
    for name, path in places.items():
        folders.setdefault(Path(path).parent, []).append(name)
    return "; ".join(f"{', '.join(names)} in {folder}" for folder, names in folders.items())


def _in_words(methods: dict[str, dict[str, int]]) -> str:
    counts = {name: ", ".join(f"{count} {end}" for end, count in ends.items()) for name, ends in methods.items()}
    return "; ".join(f"{name} {words}" for name, words in counts.items()) or "none"
