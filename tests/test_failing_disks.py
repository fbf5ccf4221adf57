"""A command whose disk fails says so in one line, ends with 1, and leaves what the same command goes on from."""

import itertools
from pathlib import Path

import pytest
from faults import ERRNOS, failing_disk, temporary_files
from tiny_runs import command, contents, finished, tiny_arguments

RUN = Path(*finished().parts[-3:])


def arguments_of(name: str, folder: Path) -> list[object]:
    """A command that writes into an empty folder."""
    if name == "train":
        return [
            "train",
            *tiny_arguments("--out", str(folder), "--checkpoint-every", "1", "--no-tensorboard", "--quiet"),
        ]
    return [name, "--grid", "smoke", "--out", folder]


def files_of(folder: Path) -> dict[str, bytes]:
    """What a command leaves, but for times and versions."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".lock")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.parametrize(("name", "every"), [("train", 13), ("tables", 9)])
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
            (line,) = [line for line in done.err.splitlines() if line]
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
