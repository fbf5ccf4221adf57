"""Curves in TensorBoard: served to this machine alone, and gone with the command."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from stable_baselines3.common import logger
from tiny_runs import Done, contents, copy_of_finished, finished, tiny_arguments

Run = Callable[..., Done]


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@pytest.mark.slow
def test_it_serves_all_runs_to_this_machine_until_it_is_stopped(tmp_path: Path) -> None:
    copy_of_finished(tmp_path / "results" / "runs")
    (tmp_path / "temporary").mkdir()
    port = free_port()
    command = [sys.executable, "-m", "marl_encircle", "tensorboard", "--out", "results", "--port", str(port)]
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as server:
        try:
            served = wait_for(f"http://127.0.0.1:{port}/data/runs", server)
            with pytest.raises(OSError, match="refused"), socket.create_connection(("127.0.0.2", port), timeout=5):
                pass
        finally:
            server.send_signal(signal.SIGTERM)
        _, said = server.communicate(timeout=30)
    assert served == ["ours/ratio1.1_n3_m1_random/seed0"]
    assert "runs: 1 from learning curves, 0 from their own event files" in said
    assert not list((tmp_path / "temporary").glob("marl-encircle-*"))


def wait_for(address: str, server: subprocess.Popen[str]) -> object:
    """Ask until there are runs."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and server.poll() is None:
        try:
            with urllib.request.urlopen(address) as answer:
                runs = json.load(answer)
        except OSError:
            runs = []
        if runs:
            return runs
        time.sleep(0.2)
    raise AssertionError(f"it served nothing; exit code {server.poll()}")


def test_no_runs_and_no_tensorboard_are_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = run("tensorboard", "--out", tmp_path / "empty")
    assert (done.code, done.out) == (2, "")
    runs = tmp_path / "empty" / "runs"
    advice = f"train one with --out {runs}, or give the folder that holds runs/ by --results"
    assert done.err == f"error: {runs}: no runs to show; {advice}\n"
    monkeypatch.setattr(logger, "SummaryWriter", None)
    done = run("tensorboard", "--out", tmp_path)
    assert done.code == 2
    assert "pip install 'tensorboard>=2.18'" in done.err


def test_a_training_without_the_extra_render_has_no_pictures_and_one_note(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "marl_encircle.replays.thumbnails", None)
    done = run("train", *tiny_arguments("--out", str(tmp_path / "runs")))
    assert done.code == 0
    assert contents(Path(done.out.splitlines()[-1])) == contents(finished())
    assert done.err.count("no pictures of rounds in the event files: pip install 'marl-encircle[render]'") == 1
