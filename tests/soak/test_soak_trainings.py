"""Trainings that are killed, stopped with much to save, or many in one process."""

import gc
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args

import pytest
from tiny_runs import contents, everything_in, tiny

from marl_encircle.experiments import checkpoint
from marl_encircle.experiments.choices import Engine
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.train import run_folder, train

KILLS = 10
RUNS = 250


def start(*arguments: str | Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "marl_encircle", "train", *map(str, arguments), "--quiet"]
    return subprocess.Popen(command, env=environment, start_new_session=True)


def saved_at(folder: Path) -> int:
    try:
        return (folder / checkpoint.NAME).stat().st_mtime_ns
    except FileNotFoundError:
        return 0


@pytest.mark.parametrize("engine", get_args(Engine))
def test_kills_at_random_change_no_bit_of_a_training(tmp_path: Path, engine: Engine, promise: Any) -> None:
    overrides = ["training.world_steps=30000", "training.curve_every=4000"]
    config = load_config("ours", profile="smoke", overrides=overrides)
    whole, _ = train(config, 0, engine, tmp_path / "whole")
    rng = random.Random(engine)
    folder = run_folder(config, 0, tmp_path / "parts")
    arguments = [part for text in overrides for part in ("--set", text)]
    resumed = 0
    for _ in range(KILLS):
        process = start(
            "--profile", "smoke", *arguments, "--out", tmp_path / "parts", "--checkpoint-every", "1", "--engine", engine
        )  # fmt: skip
        former = saved_at(folder)
        while process.poll() is None and saved_at(folder) <= former:
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 1))
        process.send_signal(signal.SIGKILL)
        process.wait()
        if (folder / "run.json").exists():
            break
        resumed += 1
    train(config, 0, engine, tmp_path / "parts")
    differ = [name for name, data in contents(folder).items() if data != contents(whole)[name]]
    text = f"files of a training on {engine} that {resumed} resumes after SIGKILLs change"
    promise(text, len(differ), 0)
    assert differ == []
    assert resumed >= 3
    kept = [name for name in everything_in(folder) if not name.startswith("tensorboard")]
    assert kept == everything_in(whole)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_training_with_much_to_save_stops_in_time(tmp_path: Path, number: int, promise: Any) -> None:
    # Five pursuers and a full buffer, the most that the study has; random actions fill it fast.
    arguments = [
        "--pursuers",
        "5",
        "--set",
        "algorithm.random_world_steps=900000",
        "--set",
        "training.curve_every=20000",
    ]
    process = start(*arguments, "--out", tmp_path, "--checkpoint-every", "10000")
    config = load_config("ours", fields={"pursuers": 5})
    progress = run_folder(config, 0, tmp_path) / "progress.csv"
    while not progress.exists() or len(progress.read_text().splitlines()) < 27:
        assert process.poll() is None
        time.sleep(0.1)
    started = time.monotonic()
    process.send_signal(number)
    process.wait()
    seconds = time.monotonic() - started
    saved = checkpoint.load(progress.parent)
    assert saved is not None
    size = (progress.parent / checkpoint.NAME).stat().st_size
    promise(
        f"seconds from {signal.Signals(number).name} to the end with {size // 10**6} MB to save",
        f"{seconds:.1f}",
        "< 10",
    )
    assert saved["training"]["world_steps"] >= 500_000
    assert process.returncode == 128 + number
    assert processes_of_group(process.pid) == []
    assert seconds < 60


def processes_of_group(group: int) -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, pgrp, *_ = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(pgrp) == group and state != "Z":
            found.append(path.parent.name)
    return found


def test_many_runs_in_one_process_leak_nothing(tmp_path: Path, promise: Any) -> None:
    config = tiny(overrides=["training.world_steps=48", "algorithm.random_world_steps=16"])

    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    def memory() -> int:
        fields = Path("/proc/self/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")

    figures = []
    for seed in range(RUNS):
        train(config, 3000 + seed, "native", tmp_path, tensorboard=True)
        gc.collect()
        figures.append((descriptors(), memory()))
    (fds, first), (_, most) = figures[19], max(figures[19:], key=lambda figure: figure[1])
    grown = most / first - 1
    spread = max(fd for fd, _ in figures[19:]) - fds
    promise(f"memory gained from run 20 to {RUNS} in one process", f"{100 * grown:.1f} %", "<= 5 %")
    promise(f"file descriptors gained from run 20 to {RUNS} in one process", spread, 0)
    assert grown <= 0.05
    assert spread == 0
