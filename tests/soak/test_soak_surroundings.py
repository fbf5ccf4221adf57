"""Commands as their users start them: without the network, without the optional parts."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import tiny_arguments

STARTUP = Path(__file__).with_name("startup")
GRID = """
profile: smoke
groups:
  - {methods: [ours], settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}], seeds: [900]}
shared: []
"""
RUN = "runs/ours/ratio1.1_n3_m1_random/seed0"
SWEPT = ["--grid", "grid.yaml", "--out", "swept"]
HIDDEN = "tensorboard torch.utils.tensorboard pygame imageio imageio_ffmpeg onnx onnxruntime ray optuna"
REFUSALS = {
    "train": ([*tiny_arguments("--out", "other", "--quiet")], "pip install 'tensorboard"),
    "watch": ([RUN, "--headless", "pictures"], "pip install 'marl-encircle[render]'"),
    "export": ([RUN], "pip install 'marl-encircle[export]'"),
    "sweep": (["grid.yaml", "--out", "other", "--executor", "ray"], "pip install 'marl-encircle[cluster]'"),
    "tune": (["--out", "other"], "pip install 'marl-encircle[tune]'"),
}
"""Command -> what asks for the optional part, and what the error says."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "grid.yaml").write_text(GRID)
    return tmp_path


def python(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(STARTUP), **environment},
    )  # fmt: skip


def test_no_command_asks_for_the_network(folder: Path, promise: Any) -> None:
    noted = folder / "sockets.txt"
    commands = [
        ["train", *tiny_arguments("--out", "runs", "--quiet")],
        ["evaluate", RUN],
        ["reproduce-tables", *SWEPT, "--jobs", "2"],
        ["tables", *SWEPT],
        ["figures", *SWEPT],
        ["report", *SWEPT],
        ["verify-results", *SWEPT],
    ]
    for command in commands:
        done = python(folder, "-m", "marl_encircle", *command, SOAK_SOCKETS=str(noted))
        assert done.returncode == 0, (command, done.stderr)
    sockets = noted.read_text().splitlines() if noted.exists() else []
    promise(f"sockets of {', '.join(command[0] for command in commands)}", len(sockets), 0)
    assert sockets == []
    python(folder, "-c", "import socket; socket.socket().close()", SOAK_SOCKETS=str(noted))
    assert noted.read_text().startswith("socket.__new__"), "the watch is asleep"


def test_the_core_needs_no_optional_part_and_the_others_name_theirs(folder: Path, promise: Any) -> None:
    commands = [
        ["train", *tiny_arguments("--out", "runs", "--quiet", "--no-tensorboard")],
        ["evaluate", RUN],
        ["train", "--profile", "smoke", "--seed", "900", "--out", "swept/runs", "--quiet", "--no-tensorboard"],
        ["tables", *SWEPT],
    ]
    failed, unhelpful = [], []
    for command in commands:
        done = python(folder, "-m", "marl_encircle", *command, SOAK_HIDDEN=HIDDEN)
        failed += [(command, done.stderr)] if done.returncode else []
    for command, (arguments, advice) in REFUSALS.items():
        done = python(folder, "-m", "marl_encircle", command, *arguments, SOAK_HIDDEN=HIDDEN)
        if done.returncode != 2 or advice not in done.stderr or "Traceback" in done.stderr:
            unhelpful.append((command, done.returncode, done.stderr))
    promise("commands of train, evaluate and tables that need an optional part", len(failed), 0)
    promise(f"commands, of {len(REFUSALS)} that need one, that do not name it", len(unhelpful), 0)
    assert failed == []
    assert unhelpful == []
    assert not (folder / "other").exists()
