"""What the README's two lines learn, what checkpoints cost them, and Stable-Baselines3's own tests."""

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch as th

from marl_encircle import MADDPG, make_vec_env
from marl_encircle.experiments import callbacks
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.metrics import summarise_run
from marl_encircle.experiments.train import _Run, train

SUITE = Path(__file__).parents[1] / "sb3_suite.py"


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    th.set_num_threads(1)


def test_plain_maddpg_learns_to_encircle(promise: Any) -> None:
    model = MADDPG("MlpPolicy", make_vec_env("ours", pursuers=3)).learn(1_000_000)
    config = load_config("ours", fields={"pursuers": 3})
    rounds = play_rounds(model.policy, config, config.evaluation.episodes, config.evaluation.seed)
    success = summarise_run(rounds, config.reward.closure).success
    promise(
        f'success in {len(rounds)} rounds after MADDPG("MlpPolicy", make_vec_env("ours", pursuers=3)).learn(1_000_000)',
        f"{success:.1%}",
        ">= 80 %",
    )
    assert success >= 0.8


def test_checkpoints_cost_little(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, promise: Any) -> None:
    monkeypatch.setattr(callbacks, "SECONDS_BETWEEN_CHECKPOINTS", 1.0)  # so that the share alone decides
    save, seconds = _Run.save_checkpoint, []

    def timed(run: _Run) -> None:
        started = time.monotonic()
        save(run)
        seconds.append(time.monotonic() - started)

    monkeypatch.setattr(_Run, "save_checkpoint", timed)
    started = time.monotonic()
    train(load_config("ours", overrides=["training.world_steps=100000"]), 0, "native", tmp_path)
    share = sum(seconds) / (time.monotonic() - started)
    promise(f"share of a training that its {len(seconds)} checkpoints take", f"{share:.1%}", "< 3 %")
    assert len(seconds) >= 3
    assert share < 0.06


def test_sb3_accepts_our_classes(promise: Any) -> None:
    done = subprocess.run([sys.executable, str(SUITE)], capture_output=True, text=True, check=False)
    counts = re.search(r"tests on MADDPG and MATD3: \{(.*)\}", done.stdout)
    promise("Stable-Baselines3's own tests on MADDPG and MATD3", counts and counts[1], "none failed", "make test-sb3")
    assert done.returncode == 0, done.stdout + done.stderr
    assert counts is not None
    assert int(counts[1].removeprefix("'passed': ").partition(",")[0]) >= 30
