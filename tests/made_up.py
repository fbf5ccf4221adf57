"""Made-up evaluation rounds, runs and run folders, written through the package's own writer, and tables read back."""

import gzip
from collections.abc import Sequence
from pathlib import Path

from marl_encircle import files
from marl_encircle.core.simulator import world_seeds
from marl_encircle.experiments import records
from marl_encircle.experiments.episodes import Episode, episodes_to_csv
from marl_encircle.experiments.records import Cell, Closure, Run, Setting, config_hash

SEEDS = world_seeds(1000, 1000)
"""Of the rounds of evaluation seed 1000."""


def episode(number: int, step_all: int | None, step_pursuers: int | None = None, **other: float) -> Episode:
    """A round; everything that a test does not name has a plain value."""
    values = {"length": 60, "return_mean": -1.5, "sigma_c": 0.25, "contacts_pursuers": 2, "contacts_obstacles": 0}
    seeded = {"seed": SEEDS[number], **values, **other}
    return Episode(number, step_all=step_all, step_pursuers=step_pursuers, **seeded)  # type: ignore[arg-type]


def rounds(successes: int, total: int, step: int = 20, offset: int = 0) -> list[Episode]:
    """A run with so many successes under both rules; ``offset`` makes its rounds other ones."""
    steps = [step if number < successes else None for number in range(total)]
    return [episode(offset + number, at, at) for number, at in enumerate(steps)]


def finished(method: str, setting: Setting, seed: int, successes: int, step: int = 20, closure: Closure = "all") -> Run:
    """A finished run of 100 rounds."""
    return Run(Cell(method, setting), seed, "finished", closure, rounds(successes, 100, step))


def markdown_rows(text: str) -> list[list[str]]:
    """Cells of the rows of a Markdown table, without its head."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def markdown_row(text: str, *start: str) -> list[str]:
    """The only row that starts with these cells, without them."""
    [row] = [row for row in markdown_rows(text) if row[: len(start)] == list(start)]
    return row[len(start) :]


def compress(path: Path) -> None:
    """Keep a file compressed, as those of ``results/`` are."""
    files.compressed(path).write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()


def write_run(
    folder: Path,
    cell: Cell,
    seed: int,
    episodes: Sequence[Episode] | None,
    closure: Closure = "all",
    status: str = "finished",
    n_rounds: int | None = None,
) -> Path:
    """Write a run folder; None leaves the rounds out, ``n_rounds`` asks for other ones. Returns the run's folder."""
    run = folder / records.run_path(cell, seed)
    texts = {"policy.safetensors": f"weights {seed}\n", "progress.csv": "world_steps,success\n0,0.0\n"}
    if episodes is not None:
        texts["episodes.csv"] = episodes_to_csv(episodes)
    for name, text in texts.items():
        files.write_text(run / name, text)
    config = {
        "reward": {"name": cell.method, "closure": closure},
        "scenario": cell.setting._asdict(),
        "evaluation": {"episodes": n_rounds or len(episodes or ()) or 1, "seed": 1000},
    }
    record = {
        "schema": 1,
        "status": status,
        "method": cell.method,
        "config": config,
        "config_hash": config_hash(config),
        "seed": seed,
        "sha256": {name: files.sha256_bytes((run / name).read_bytes()) for name in texts},
    }
    files.write_json(run / "run.json", record)
    return run
