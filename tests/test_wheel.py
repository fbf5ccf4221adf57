"""What is installed from a wheel or an sdist: policies found by name, with their cards, and no more of the results."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from marl_encircle.experiments.pretrained import USUAL_SETTING, find_run
from marl_encircle.experiments.records import read_setting

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
    folders = {find_run(path.parents[2].name, read_setting(path.parents[1]), [RUNS]) for path in RUNS.rglob("run.json")}
    paths = [folder / name for folder in folders for name in FILES]
    return {path.relative_to(RUNS).as_posix(): path.read_bytes() for path in paths}


def test_a_wheel_has_the_first_policy_of_every_cell_and_its_card(wheel: Path) -> None:
    found = contents(wheel / "marl_encircle" / "pretrained")
    assert found == first_runs()
    assert len(found) >= 24
    assert sum(map(len, found.values())) <= 15_000_000


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
