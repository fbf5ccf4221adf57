"""``info``: what it tells of an installation, and what it keeps to itself."""

import json
import os
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, get_args

import pytest
from tiny_runs import Done, copy_of_finished

from marl_encircle.experiments.library import Kind, files_of
from marl_encircle.experiments.provenance import cpu_model, git_commit, versions

Run = Callable[..., Done]


@pytest.fixture
def found(run: Run) -> dict[str, Any]:
    copy_of_finished(Path("results/runs"))
    (copy_of_finished(Path("results/runs/other")) / "run.json").unlink()
    (copy_of_finished(Path("broken/runs")) / "run.json").write_text("{")
    done = run("info", "--json")
    assert (done.code, done.err) == (0, "")
    result: dict[str, Any] = json.loads(done.out)
    return result


def test_versions_and_commit_are_those_that_runs_record(found: dict[str, Any]) -> None:
    expected = {"marl-encircle": metadata.version("marl-encircle"), "commit": git_commit(), **versions()}
    assert found["versions"] == expected


def test_the_machine_is_this_one(found: dict[str, Any]) -> None:
    machine = found["machine"]
    assert (machine["cpu"], machine["cores"]) == (cpu_model(), os.cpu_count())
    assert machine["memory_gb"] > 0


def test_every_kind_of_configuration_is_listed_with_its_place(found: dict[str, Any]) -> None:
    assert list(found["configurations"]) == list(get_args(Kind))
    for kind, places in found["configurations"].items():
        assert places == {name: str(path) for name, path in files_of(kind).items()}
    assert "ours" in found["configurations"]["reward"]


def test_runs_are_counted_by_method_and_end(run: Run, found: dict[str, Any]) -> None:
    assert found["runs"]["results/runs"] == {"ours": {"finished": 1}}
    counted = json.loads(run("info", "--out", "broken", "--json").out)["runs"]
    assert counted["broken/runs"] == {"ours": {"damaged": 1}}


def test_runs_are_those_of_the_folder_that_was_named(run: Run, found: dict[str, Any]) -> None:
    assert list(json.loads(run("info", "--results", "broken", "--json").out)["runs"]) == ["broken/runs"]
    done = run("info", "--results", "results/runs")
    assert (done.code, done.out) == (2, "")
    assert done.err == "error: results/runs/runs: no such folder; --results is the folder that holds runs/\n"


def test_an_extra_is_installed_if_all_that_it_needs_is(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    needs = [
        "numpy>=2.0",
        "numpy>=2; extra == 'there'",
        "numpy>=99; extra == 'older'",
        "no-such-package>=1.5; extra == 'absent'",
    ]
    known = {"Provides-Extra": ["there", "older", "absent"]}
    monkeypatch.setattr(metadata, "requires", lambda _: needs)
    monkeypatch.setattr(metadata, "metadata", lambda _: Headers(known))
    assert json.loads(run("info", "--json").out)["extras"] == {
        "absent": {"installed": False, "missing": ["no-such-package>=1.5"]},
        "older": {"installed": False, "missing": ["numpy>=99"]},
        "there": {"installed": True, "missing": []},
    }
    assert "absent  needs no-such-package>=1.5\n" in run("info").out


class Headers:
    """A distribution's metadata."""

    def __init__(self, values: dict[str, list[str]]) -> None:
        self.get_all = values.get


def test_nothing_of_the_environment_is_told(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_API_KEY", "a-secret-of-mine")
    monkeypatch.setenv("MARL_ENCIRCLE_CACHE", "/somewhere/a-secret-of-mine")
    for arguments in ((), ("--json",)):
        assert "a-secret-of-mine" not in run("info", *arguments).out


def test_people_read_the_same(run: Run, found: dict[str, Any]) -> None:
    lines = run("info").out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == list(found)
    assert ["results/runs", "ours", "1", "finished"] in [line.split() for line in lines]
    assert any(line.startswith("  grid") and "smoke, study in " in line for line in lines)
