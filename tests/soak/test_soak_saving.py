"""Kills and failing disks while something is saved."""

import itertools
import os
import random
import signal
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import ERRNOS, failing_disk, temporary_files
from tiny_runs import command, contents, finished, in_another_process, tiny_arguments

from marl_encircle.experiments import checkpoint

KILLS = 200


def tree(number: int) -> dict[str, Any]:
    return {"number": number, "arrays": [np.full(200_000, number + i) for i in range(4)]}


def save_for_ever(folder: Path, first: int, done: Connection) -> None:
    for number in itertools.count(first):
        started = time.monotonic()
        checkpoint.save(folder, tree(number))
        done.send((number, time.monotonic() - started))


def test_no_kill_costs_a_checkpoint(tmp_path: Path, promise: Any) -> None:
    rng = random.Random(1)
    unloadable = older = left_over = first = 0
    for _ in range(KILLS):
        receiving, sending = Pipe(duplex=False)
        process = in_another_process(save_for_ever, tmp_path, first, sending)
        sending.close()
        confirmed, seconds = receiving.recv()  # it is at work
        time.sleep(rng.uniform(0, 2 * seconds))
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        while receiving.poll():
            try:
                confirmed, _ = receiving.recv()
            except EOFError:
                break
        try:
            saved = checkpoint.load(tmp_path)
            assert saved is not None
        except Exception:
            unloadable += 1
            continue
        older += saved["number"] < confirmed
        assert all((array == saved["number"] + i).all() for i, array in enumerate(saved["arrays"]))
        left_over += len(temporary_files(tmp_path)) > 1
        first = saved["number"] + 1
    checkpoint.save(tmp_path, tree(0))
    left_over += len(temporary_files(tmp_path))
    promise(
        f"checkpoints lost, aged or left over by {KILLS} SIGKILLs while saving",
        (unloadable, older, left_over),
        (0, 0, 0),
    )
    assert (unloadable, older, left_over) == (0, 0, 0)


def test_no_failing_call_of_a_training_costs_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], promise: Any
) -> None:
    wanted = contents(finished())
    failed, bad = 0, []
    for call in itertools.count():
        folder = tmp_path / str(call)
        folder.mkdir()
        arguments = [
            "train",
            *tiny_arguments("--out", str(folder), "--checkpoint-every", "1", "--no-tensorboard", "--quiet"),
        ]
        with failing_disk(folder, call, ERRNOS[call % len(ERRNOS)]) as fault:
            done = command(capsys, monkeypatch, *arguments)
        failed += done.code == 1
        said = done.code == 0 or (done.code == 1 and done.err.startswith("error: ") and str(folder) in done.err)
        clean = temporary_files(folder) == []
        again = command(capsys, monkeypatch, *arguments)
        if not (said and clean and again.code == 0 and contents(folder.joinpath(*finished().parts[-3:])) == wanted):
            bad.append((call, fault.calls[call : call + 1], done, again))
        if not fault.struck:
            break
    promise(f"calls of a training, of {call}, whose failure is not told or loses something", len(bad), 0)
    assert bad == []
    assert failed > call / 2
