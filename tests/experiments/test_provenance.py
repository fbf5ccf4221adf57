"""A run tells the sources, the commit and the machine that it was made with."""

import subprocess
from pathlib import Path

import pytest

from marl_encircle.experiments import provenance


def test_the_source_hash_covers_code_and_configs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    before = provenance.source_hash()
    for name in ("a.py", "b/c.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1\n")
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path)
    here = provenance.source_hash()
    assert here != before
    for name in ("a.py", "b/c.yaml"):
        (tmp_path / name).write_text("2\n")
        assert provenance.source_hash() != here
        (tmp_path / name).write_text("1\n")
    assert provenance.source_hash() == here


def test_an_installation_does_not_take_a_strangers_commit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for arguments in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "theirs"]):
        subprocess.run([*git, *arguments], check=True)
    inside = tmp_path / "venv" / "site-packages" / "marl_encircle"
    inside.mkdir(parents=True)
    monkeypatch.setattr(provenance, "PACKAGE", inside)
    assert provenance.git_commit() is None


def test_without_git_there_is_no_commit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    monkeypatch.setattr(provenance, "PACKAGE", tmp_path / "marl_encircle")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance.git_commit() is None
