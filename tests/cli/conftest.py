"""The command, run in this process."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_runs import Done, command


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Done]:
    """Run a command in this process, in an empty folder."""
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    return lambda *arguments: command(capsys, monkeypatch, *arguments)
