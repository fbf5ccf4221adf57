"""Every bad configuration given to the command: exit code 2, one readable message, and nothing on disk is touched."""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml_cases
from tiny_runs import command

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = {
    "os.mkdir",
    "os.rename",
    "os.remove",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.chmod",
    "os.utime",
}
REACHES = {"subprocess.Popen", "os.fork", "os.posix_spawn", "socket.bind", "socket.connect"}

_watching: list[list[str]] = []


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if _watching and (event in CHANGES | REACHES or (event == "open" and arguments[2] & WRITES)):
        _watching[-1].append(f"{event} {arguments[0]}")


sys.addaudithook(_note)


@contextmanager
def untouched() -> Iterator[None]:
    """Fail where the block opens a file to write, changes a folder, starts a process or asks for the network."""
    touched: list[str] = []
    _watching.append(touched)
    try:
        yield
    finally:
        _watching.pop()
    assert touched == []


def test_the_watch_sees_what_is_touched(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"os\.mkdir"), untouched():
        (tmp_path / "folder").mkdir()
    with pytest.raises(AssertionError, match=r"open .*file"), untouched():
        (tmp_path / "file").write_text("x")
    with untouched():
        (tmp_path / "file").read_text()


def case_ids(cases: list[Any]) -> list[str]:
    return [f"{number}-{case[-1]:.30}" for number, case in enumerate(cases)]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Give the command what it must refuse; return what it says."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> str:
        with untouched():
            done = command(capsys, monkeypatch, *arguments)
        assert (done.code, done.out) == (2, "")
        assert done.err.startswith("error: ")
        assert "Traceback" not in done.err
        assert max(map(len, done.err.splitlines())) < 900
        return done.err

    return run


@pytest.mark.parametrize(("text", "reason"), yaml_cases.REWARD_FILES, ids=case_ids(yaml_cases.REWARD_FILES))
def test_a_bad_reward_file(refused: Any, tmp_path: Path, text: str | bytes, reason: str) -> None:
    (tmp_path / "case.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
    message = refused("train", "--reward", "case.yaml")
    assert reason in message
    assert "case.yaml" in message


@pytest.mark.parametrize(
    ("section", "text", "reason"), yaml_cases.SECTION_FILES, ids=case_ids(yaml_cases.SECTION_FILES)
)
def test_a_bad_file_of_another_section(refused: Any, tmp_path: Path, section: str, text: str, reason: str) -> None:
    (tmp_path / "case.yaml").write_text(text)
    message = refused("train", f"--{section}", "case.yaml")
    assert reason in message
    assert "case.yaml: " in message


@pytest.mark.parametrize(("override", "reason"), yaml_cases.OVERRIDES, ids=case_ids(yaml_cases.OVERRIDES))
def test_a_bad_override(refused: Any, override: str, reason: str) -> None:
    assert reason in refused("train", "--set", override)


def test_what_would_steer_a_terminal_is_written_out(refused: Any, tmp_path: Path) -> None:
    (tmp_path / "case.yaml").write_text('base: ours\n"\\e[2J\\u202e": 1\n')
    message = refused("train", "--reward", "case.yaml")
    assert r"reward.\x1b[2J\u202e: unknown key" in message
    assert message.replace("\n", "").isprintable()


def test_what_this_machines_memory_does_not_hold(refused: Any) -> None:
    message = refused(
        "train", "--set", "training.world_steps=9999999999", "--set", "algorithm.buffer_world_steps=9999999999"
    )
    assert re.search(r"algorithm.buffer_world_steps: needs [\d.]+ GB of memory, .* this machine has [\d.]+ GB", message)
