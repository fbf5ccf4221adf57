"""What is installed from a wheel or an sdist: policies found by name, with their cards, and no more of the results."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import pytest
from made_up import episode, write_run

from hatch_build import PretrainedHook
from marl_encircle.experiments.pretrained import USUAL_SETTING, find_run
from marl_encircle.experiments.records import Cell, Setting, read_record

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "results" / "runs"
FILES = ("README.md", "policy.safetensors", "run.json")


def build(root: Path, target: str, folder: Path) -> Path:
    """Build what is in a source tree, without the network."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    subprocess.run(command, cwd=root, check=True, capture_output=True)
    [made] = folder.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    with zipfile.ZipFile(build(ROOT, "wheel", folder / "built")) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def contents(runs: Path) -> dict[str, bytes]:
    return {path.relative_to(runs).as_posix(): path.read_bytes() for path in runs.rglob("*") if path.is_file()}


def first_runs() -> dict[str, bytes]:
    """What the first training seed of every cell of the repository has to take along."""
    folders = [min(cell.glob("seed*"), key=lambda path: int(path.name[4:])) for cell in RUNS.glob("*/*")]
    paths = [folder / name for folder in folders for name in taken_along(folder)]
    return {path.relative_to(RUNS).as_posix(): path.read_bytes() for path in paths}


def taken_along(run: Path) -> tuple[str, ...]:
    return FILES if read_record(run)["status"] == "finished" else ("run.json",)


def test_a_wheel_has_the_first_policy_of_every_cell_and_its_card(wheel: Path) -> None:
    found = contents(wheel / "marl_encircle" / "pretrained")
    assert found == first_runs()
    assert len(found) >= 24
    assert sum(map(len, found.values())) <= 15_000_000


def test_of_a_first_seed_that_diverged_only_the_record_goes_along(tmp_path: Path) -> None:
    runs, target = tmp_path / "results" / "runs", tmp_path / "built"
    setting = Setting(1.1, 3, 1)
    for method, status in {"ours": "finished", "ma2019": "diverged"}.items():
        for seed in (0, 1):
            write_run(runs, Cell(method, setting), seed, (episode(0, 10),), status=status if seed == 0 else "finished")
    data: dict[str, Any] = {"force_include": {}}
    PretrainedHook(str(tmp_path), {}, None, None, str(target), "wheel").initialize("standard", data)
    cell = "marl_encircle/pretrained/{}/ratio1.1_n3_m1_random/seed0/"
    ours, ma2019 = (cell.format(method) for method in ("ours", "ma2019"))
    assert sorted(data["force_include"].values()) == [
        f"{ma2019}run.json", f"{ours}policy.safetensors", f"{ours}run.json",
    ]  # fmt: skip


def test_a_wheel_built_from_the_sdist_has_the_same(tmp_path: Path, wheel: Path) -> None:
    with tarfile.open(build(ROOT, "sdist", tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path, filter="data")
    [source] = [path for path in tmp_path.iterdir() if path.name.startswith("marl_encircle-")]
    assert not (source / "results").exists()
    with zipfile.ZipFile(build(source, "wheel", tmp_path / "wheel")) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names == {name for name in contents(wheel) if ".dist-info/" not in name}


PROGRAM = """
import marl_encircle
from marl_encircle.replays.watch import find_side
print(marl_encircle.__file__)
print(find_side("ours").folder)
"""


@pytest.mark.slow
def test_an_installed_policy_is_found_by_name_and_plays_the_round_of_its_card(wheel: Path, tmp_path: Path) -> None:
    installed = wheel / "marl_encircle" / "pretrained"
    card = (find_run("ours", USUAL_SETTING, [installed]) / "README.md").read_text()
    [play] = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", play + PROGRAM],
        cwd=tmp_path,
        # Plain Python is slow, but to compile everything for one round is slower
        env={**os.environ, "PYTHONPATH": str(wheel), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    success, package, folder = done.stdout.splitlines()
    assert success in ("True", "False")
    assert Path(package).parent == wheel / "marl_encircle"
    assert Path(folder).is_relative_to(installed)
