"""Trainings that were made again: how docs/trained_again.py compares them, and what it found."""

import csv
import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from documents import ROOT
from tiny_runs import copy_of_finished

from marl_encircle import files
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.records import read_record, run_path

RUN = "ours/ratio1.1_n3_m1_random/seed0"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    module = import_module("trained_again")
    monkeypatch.setattr(module, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(module, "FOUND", tmp_path / "results" / "trained_again.csv")
    return module


@pytest.fixture
def repeat(tmp_path: Path) -> Path:
    """The folder of a tiny run that was trained twice, with the same outcome."""
    for folder in ("results/runs", "again"):
        copy_of_finished(tmp_path / folder)
    change(tmp_path / "again" / RUN, cpu_seconds=1.0)
    return tmp_path / "again" / RUN


def change(run: Path, **changed: object) -> None:
    files.write_json(run / "run.json", json.loads((run / "run.json").read_text()) | changed)


def verdicts(script: Any, repeat: Path) -> list[tuple[str, str]]:
    return [(row["run"], row["same"]) for row in script.compared(repeat.parents[2])]


def test_a_training_with_the_same_outcome_is_the_same(script: Any, repeat: Path) -> None:
    assert verdicts(script, repeat) == [(RUN, "True")]


@pytest.mark.parametrize("name", ["policy.safetensors", "progress.csv", "episodes.csv"])
def test_another_outcome_is_found_in_each_file(script: Any, repeat: Path, name: str) -> None:
    other = script.RESULTS / "runs" / RUN
    change(other, sha256=read_record(other)["sha256"] | {name: "0" * 64})
    assert verdicts(script, repeat) == [(RUN, "False")]


@pytest.mark.parametrize("name", ["progress.csv", "episodes.csv"])
def test_a_file_that_only_one_of_them_has_is_another_outcome(script: Any, repeat: Path, name: str) -> None:
    hashes = read_record(repeat)["sha256"]
    (repeat / name).unlink()
    change(repeat, sha256={file: value for file, value in hashes.items() if file != name})
    assert verdicts(script, repeat) == [(RUN, "False")]


def test_a_file_that_is_not_what_the_training_wrote_is_refused(script: Any, repeat: Path) -> None:
    (repeat / "policy.safetensors").write_bytes(b"")
    with pytest.raises(files.DamagedFileError, match=r"policy\.safetensors"):
        verdicts(script, repeat)


def test_neither_a_copy_nor_an_unfinished_training_nor_one_without_its_like_counts(script: Any, repeat: Path) -> None:
    change(repeat, cpu_seconds=read_record(script.RESULTS / "runs" / RUN)["cpu_seconds"])
    assert verdicts(script, repeat) == []
    (repeat / "run.json").rename(repeat / "record")
    assert verdicts(script, repeat) == []
    (repeat / "record").rename(repeat / "run.json")
    change(repeat, cpu_seconds=1.0, seed=1)
    repeat.rename(repeat.with_name("seed1"))
    assert verdicts(script, repeat) == []


def test_what_was_found_stays(script: Any, repeat: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["trained_again.py", str(repeat.parents[2])])
    script.main()
    [row] = script.found()
    assert (row["run"], row["same"], row["cpu_seconds"]) == (RUN, "True", "1.0")
    change(repeat, cpu_seconds=0.5)
    script.main()
    assert script.found() == [row]


def test_the_trainings_of_the_study_came_out_the_same() -> None:
    with (ROOT / "results" / "trained_again.csv").open(newline="") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    runs = {run_path(job.config.cell, job.seed).as_posix() for job in load_grid("study").jobs}
    study = {run for run in runs if not run.startswith(("ours_plus", "generalist"))}
    assert (len(study), study <= set(rows) <= runs) == (183, True)
    for run, row in rows.items():
        assert row["same"] == "True", run
        recorded = read_record(ROOT / "results" / "runs" / run)["cpu_seconds"]
        assert row["recorded_cpu_seconds"] == f"{recorded:.1f}" != row["cpu_seconds"]
