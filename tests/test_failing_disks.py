"""A command whose disk fails says so in one line, ends with 1, and leaves what the same command goes on from."""

import itertools
import json
import threading
from pathlib import Path

import pytest
from faults import ERRNOS, failing_disk, largest_file, temporary_files
from tiny_runs import TINY, command, contents, copy_of_finished, finished, tiny, tiny_arguments

from marl_encircle.experiments.tensorboard import EventFiles

RUN = Path(*finished().parts[-3:])


GRID = f"""
profile: smoke
groups:
  - methods: [ours]
    settings: [{{speed_ratio: 1.1, pursuers: 3, obstacles: 1}}]
    seeds: [0]
    overrides: {json.dumps(TINY)}
shared: []
"""


def arguments_of(name: str, folder: Path) -> list[object]:
    """A command that writes into an empty folder, or into one with the run that it is about."""
    if name == "train":
        return [
            "train",
            *tiny_arguments("--out", str(folder), "--checkpoint-every", "1", "--no-tensorboard", "--quiet"),
        ]
    copy_of_finished(folder / "runs")
    grid = folder.with_name("grid.yaml")  # on a disk that works
    grid.write_text(GRID)
    return [name, "--grid", grid, "--out", folder]


def files_of(folder: Path) -> dict[str, bytes]:
    """What a command leaves, but for times and versions."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".lock")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.parametrize(("name", "every"), [("train", 29), ("tables", 17)])
def test_a_failing_call_ends_the_command_with_1_and_its_repetition_with_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, every: int
) -> None:
    failed = 0
    for call in itertools.count(0, every):
        folder = tmp_path / str(call)
        folder.mkdir()
        arguments = arguments_of(name, folder)
        number = ERRNOS[call // every % len(ERRNOS)]
        with failing_disk(folder, call, number) as fault:
            done = command(capsys, monkeypatch, *arguments)
        assert done.code in (0, 1), done.err
        if done.code:
            failed += 1
            (line,) = [line for line in done.err.splitlines() if line and not line.startswith("warning: ")]
            assert line.startswith("error: ")
            assert str(folder) in line
        assert temporary_files(folder) == []
        assert command(capsys, monkeypatch, *arguments).code == 0
        if name == "train":
            assert contents(folder / RUN) == contents(finished())
        assert sorted(files_of(folder)) == sorted(files_of(tmp_path / "0"))
        if not fault.struck:
            break
    assert failed > 3


def test_event_files_that_find_no_room_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", *tiny_arguments("--out", str(tmp_path), "--quiet")]
    with largest_file(2000):
        done = command(capsys, monkeypatch, *arguments)
    assert done == (1, "", f"error: [Errno 27] not saved: File too large: '{tmp_path / RUN / 'tensorboard'}'\n")
    assert command(capsys, monkeypatch, *arguments).code == 0
    assert contents(tmp_path / RUN) == contents(finished())


def test_a_log_that_finds_no_room_names_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)  # the command does so too
    events = EventFiles(tmp_path / "events", tiny(), 0, 0)

    def write_for_ever() -> None:
        for step in itertools.count():
            events.write({"x": 1.0}, {"x": ()}, step)

    for action in (write_for_ever, events.close):
        with largest_file(8000), pytest.raises(OSError, match="not saved: File too large") as caught:
            action()
        assert caught.value.filename == str(tmp_path / "events")
