"""The Makefile is the door for people and CI: every target is listed, sets up first, and passes its variables on."""

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS = re.findall(r"^([a-z][a-z0-9-]*):", TEXT, flags=re.MULTILINE)


def make(*arguments: str, folder: Path = ROOT) -> str:
    """Output of make; ``-n`` among the arguments shows the commands without running them."""
    command = ["make", "--no-print-directory", *arguments]
    environment = {"PATH": os.environ["PATH"]}  # not the variables of the make that runs the tests
    result = subprocess.run(
        command, cwd=folder, env=environment, check=True, capture_output=True, text=True, timeout=60
    )
    return result.stdout


def test_help_is_the_default_and_lists_every_target() -> None:
    listed = re.findall(r"^  ([a-z][a-z0-9-]*)  +\w", make(), flags=re.MULTILINE)
    assert listed == TARGETS
    assert {"setup", "test", "test-sb3", "check", "bench", "reproduce-tables"} <= set(listed)
    assert make() == make("help")


def test_every_target_is_phony() -> None:
    [names] = re.findall(r"^\.PHONY: ((?:.*\\\n)*.*)$", TEXT, flags=re.MULTILINE)
    assert set(names.replace("\\", "").split()) == set(TARGETS)


@pytest.mark.parametrize("target", sorted(set(TARGETS) - {"help", "clean"}))
def test_every_target_sets_up_first(target: str) -> None:
    commands = make("-n", "-W", "pyproject.toml", "PIP_ARGS=--offered", target)
    assert "-m pip install --offered -c constraints.txt -e '.[dev,render]'" in commands


def test_setup_adds_extras_to_what_is_there_and_else_does_nothing(tmp_path: Path) -> None:
    interpreter = tmp_path / ".venv" / "bin" / "python"
    interpreter.parent.mkdir(parents=True)
    interpreter.write_text('#!/bin/sh\necho "$@" >> calls\n')
    interpreter.chmod(0o755)
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).symlink_to(ROOT / name)
    for arguments in ([], [], ["EXTRAS=tune"], ["EXTRAS=tune"]):
        make("setup", "BASE_PYTHON=true", *arguments, folder=tmp_path)
    calls = (tmp_path / "calls").read_text().splitlines()
    assert calls == [f"-m pip install -c constraints.txt -e .[{extras}]" for extras in ("dev,render", "tune")]


def test_variables_reach_the_command() -> None:
    shown = make(
        "-n", "train", "REWARD=my/own.yaml", "SPEED_RATIO=1.3", "PURSUERS=4", "OBSTACLES=2", "SCENE=tunnel", "SEED=7"
    )
    command = " ".join(shown.replace("\\\n", " ").split())
    assert command.endswith(
        "train --reward my/own.yaml --speed-ratio 1.3 --pursuers 4 --obstacles 2"
        " --scene tunnel --seed 7 --out results/runs"
    )
    shown = make("-n", "evaluate", "RUN=elsewhere/seed7")
    assert shown.strip().endswith("evaluate elsewhere/seed7")
    shown = " ".join(make("-n", "evaluate", "SPEED_RATIO=1.10", "RESULTS=elsewhere").split())
    assert "--speed-ratio 1.10" in shown  # the command knows where that run lies
    assert shown.endswith('--out elsewhere/runs)" && .venv/bin/marl-encircle evaluate "$run"')
    for target in ("tables", "figures", "verify-results"):
        shown = make("-n", target, "GRID=smoke", "RESULTS=elsewhere")
        assert shown.strip().endswith(f"{target} --grid smoke --out elsewhere")
    shown = make("-n", "reproduce-tables", "GRID=smoke", "RESULTS=elsewhere", "JOBS=3")
    assert "reproduce-tables --grid smoke --out elsewhere --jobs 3\n" in shown
    assert shown.strip().endswith("figures --grid smoke --out elsewhere")
