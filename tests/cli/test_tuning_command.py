"""``tune``: what it prints, what it leaves, how it stops and goes on, in processes of its own too."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from search_files import search_file
from tiny_runs import TINY, Done, Trained, everything_in, train_in_this_process

from marl_encircle.experiments import executors
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.records import read_record

Run = Callable[..., Done]

pytest.importorskip("optuna", reason="Optuna is not installed; it is the extra 'tune'")


def test_it_prints_the_trials_and_the_command_that_trains_the_best(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_in_this_process(monkeypatch)
    done = run("tune", search_file(tmp_path), "--trials", 2, "--out", "found")
    assert done.code == 0, done.err
    assert [line.split(",")[0] for line in done.err.splitlines()] == [
        "trial 0: running after 0 points",
        "trial 0: complete after 4 points",
        "trial 1: running after 0 points",
        "trial 1: complete after 4 points",
    ]
    *table, last = done.out.splitlines()
    assert "learning_rate" in "".join(table)
    assert last == "marl-encircle train --algorithm found/best.yaml"
    overrides = [part for text in ("training.world_steps=100", "training.curve_every=100") for part in ("--set", text)]
    trained = run(*shlex.split(last)[1:], "--profile", "smoke", *overrides, "--set", "algorithm.random_world_steps=20")
    assert trained.code == 0, trained.err


def test_as_json_it_is_one_object(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train_in_this_process(monkeypatch)
    done = run("tune", search_file(tmp_path), "--trials", 1, "--out", "found", "--json")
    found = json.loads(done.out)
    assert found["trials"] == {"complete": 1, "pruned": 0, "fail": 0}
    assert found["best"]["values"] == {"algorithm.learning_rate": 0.002}
    assert found["files"] == {"algorithm": "found/best.yaml"}


def test_a_training_that_fails_ends_it_with_1(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Failed(Trained):
        def __init__(self) -> None:
            pass

        def poll(self) -> int:
            return 1

    train_in_this_process(monkeypatch)
    monkeypatch.setattr(executors, "_start", lambda *_: Failed())
    done = run("tune", search_file(tmp_path), "--trials", 1)
    assert done.code == 1
    assert "failed: 1 of the trials" in done.err
    assert "trial 0: fail" in done.err


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"search": "{algorithm: {gama: {low: 0.8, high: 0.9}}}"}, "gama: unknown key; did you mean gamma?"),
        ({"seeds": "[0]"}, "seed 0 is no tuning seed"),
    ],
)
def test_a_bad_search_ends_with_2_and_leaves_nothing(
    run: Run, tmp_path: Path, changes: dict[str, str], reason: str
) -> None:
    path = search_file(tmp_path, **changes)
    before = everything_in(tmp_path)
    done = run("tune", path)
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith(f"error: {path}: ")
    assert reason in done.err
    assert everything_in(tmp_path) == before


def test_a_search_without_optuna_ends_with_2_and_names_the_extra(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = search_file(tmp_path)
    before = everything_in(tmp_path)
    monkeypatch.setitem(sys.modules, "optuna", None)
    done = run("tune", path)
    assert done.code == 2
    assert "pip install 'marl-encircle[tune]'" in done.err
    assert everything_in(tmp_path) == before


@pytest.mark.slow
def test_a_search_in_processes_stops_cleanly_and_goes_on(run: Run, tmp_path: Path) -> None:
    """The training takes long enough to be stopped in its midst."""
    longer = ("training.world_steps=1500", "training.curve_every=50")
    overrides = ", ".join(f'"{text}"' for text in (*TINY, *longer))
    long = search_file(tmp_path, overrides=f"[{overrides}]")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "marl_encircle", "tune", long, "--trials", "1", "--out", str(out)]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=os.environ) as search:
        curve = wait_for(out, search)
        search.send_signal(signal.SIGTERM)
        _, said = search.communicate(timeout=60)
    assert search.returncode == 128 + signal.SIGTERM
    assert said.splitlines()[-1] == "stopped by SIGTERM; run the same command again to resume"
    assert (curve.parent / "checkpoint.safetensors").exists()
    assert not (curve.parent / "run.json").exists()
    points = curve.read_text()
    done = run("tune", long, "--trials", 1, "--out", out)
    assert done.code == 0, done.err
    assert done.err.startswith("trial 0: running after ")
    assert "\ntrial 0: complete after 30 points" in done.err
    assert curve.read_text().startswith(points), "it went on, it did not begin again"
    record = read_record(curve.parent)
    assert record["config"]["evaluation"]["seed"] != load_config().evaluation.seed


def wait_for(out: Path, search: "subprocess.Popen[str]") -> Path:
    """Wait for a learning curve with a point."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and search.poll() is None:
        for path in out.glob("trials/*/*/*/*/progress.csv"):
            if path.read_text().count("\n") > 1:
                return path
        time.sleep(0.05)
    raise AssertionError(f"no point of a learning curve; exit code {search.poll()}")
