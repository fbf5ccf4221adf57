"""The same seed gives the same bytes wherever and however it is run, and tables can be derived again."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from documents import ROOT
from tiny_runs import FILES

GRID = """
profile: smoke
groups:
  - {methods: [ours], settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}], seeds: [900, 901]}
shared: []
"""
DERIVED = ("tables", "figures")
CIRCUMSTANCES: dict[str, dict[str, str]] = {
    "another number of jobs": {"jobs": "2"},
    "another locale, time zone, hash seed and working directory": {
        "LC_ALL": "C", "LANG": "tr_TR.UTF-8", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0",
        "TZ": "Asia/Kathmandu", "PYTHONHASHSEED": "4711", "cwd": "elsewhere",
    },
}  # fmt: skip
"""Environment of the command; ``jobs`` and ``cwd`` are not part of it."""


def marl_encircle(cwd: Path, *arguments: str | Path, **environment: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "marl_encircle", *map(str, arguments)], cwd=cwd, capture_output=True, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def contents(out: Path, *folders: str) -> dict[str, bytes]:
    """What must be the same: files of runs but for times and versions, and what is derived from them."""
    paths = [path for folder in folders for path in (out / folder).rglob("*") if path.is_file()]
    wanted = [path for path in paths if path.name in FILES or path.relative_to(out).parts[0] in DERIVED]
    return {str(path.relative_to(out)): path.read_bytes() for path in wanted}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two runs and what is derived from them."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "grid.yaml").write_text(GRID)
    reproduce(folder / "grid.yaml", folder / "out", folder)
    return folder / "out"


def reproduce(grid: Path, out: Path, cwd: Path, jobs: str = "1", **environment: str) -> None:
    swept = ["--grid", grid, "--out", out]
    marl_encircle(cwd, "reproduce-tables", *swept, "--jobs", jobs, **environment)
    marl_encircle(cwd, "figures", *swept, **environment)


@pytest.mark.parametrize("circumstance", CIRCUMSTANCES)
def test_the_same_seed_gives_the_same_bytes(out: Path, tmp_path: Path, circumstance: str, promise: Any) -> None:
    how = dict(CIRCUMSTANCES[circumstance])
    cwd = tmp_path / how.pop("cwd", "")
    cwd.mkdir(exist_ok=True)
    reproduce(out.parent / "grid.yaml", tmp_path / "out", cwd, **how)
    wanted, found = (contents(folder, "runs", *DERIVED) for folder in (out, tmp_path / "out"))
    differ = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    promise(f"files, of {len(wanted)} of a sweep, that another process with {circumstance} changes", len(differ), 0)
    assert len(wanted) > 20
    assert differ == []


def test_tables_and_figures_can_be_derived_again(out: Path, tmp_path: Path, promise: Any) -> None:
    shutil.copytree(out / "runs", tmp_path / "swept" / "runs")
    for name in ("runs", "former"):
        shutil.copytree(ROOT / "results" / name, tmp_path / "committed" / name)
    for command in DERIVED:
        marl_encircle(tmp_path, command, "--grid", out.parent / "grid.yaml", "--out", tmp_path / "swept")
    marl_encircle(tmp_path, "tables", "--grid", "study", "--out", tmp_path / "committed")
    pairs = [(contents(out, *DERIVED), contents(tmp_path / "swept", *DERIVED))]
    pairs += [(contents(ROOT / "results", "tables"), contents(tmp_path / "committed", "tables"))]
    differ = [name for one, other in pairs for name in one.keys() | other.keys() if one.get(name) != other.get(name)]
    number = sum(len(wanted) for wanted, _ in pairs)
    promise(f"tables and figures, of {number} files, that differ when they are derived again", len(differ), 0)
    assert number > 20
    assert differ == []
