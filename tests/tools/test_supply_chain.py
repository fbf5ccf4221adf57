"""The lock is the constraints with hashes, and the check says so loudly where something is off."""

from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
HASH = "--hash=sha256:" + 64 * "a"


@pytest.fixture
def supply_chain(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return import_module("supply_chain")


def test_the_lock_is_the_constraints_with_hashes(supply_chain: Any) -> None:
    lock, constraints = (supply_chain.read_pins(path) for path in (supply_chain.LOCK, supply_chain.CONSTRAINTS))
    assert supply_chain.faults_of_lock(lock, constraints) == []
    assert len(lock) > 90


def test_no_machine_and_no_index_is_named_in_the_lock(supply_chain: Any) -> None:
    text = supply_chain.LOCK.read_text(encoding="utf-8")
    assert not any(part in text for part in ("://", "--index", "--find-links", " @ ", "file:", "/"))


def test_what_the_tests_run_on_is_locked(supply_chain: Any) -> None:
    installed = supply_chain.installed_versions()
    lock = supply_chain.read_pins(supply_chain.LOCK)
    known = {name: version for name, version in installed.items() if name in lock}
    assert supply_chain.faults_of_environment(lock, known) == []
    assert known.keys() >= {"numpy", "numba", "torch", "stable-baselines3", "gymnasium", "pettingzoo", "supersuit"}


def pins(supply_chain: Any, tmp_path: Path, text: str) -> Any:
    (tmp_path / "requirements.lock").write_text(text)
    return supply_chain.read_pins(tmp_path / "requirements.lock")


def test_a_pin_is_read_with_its_hashes_whatever_its_name_looks_like(supply_chain: Any, tmp_path: Path) -> None:
    text = f"# made by\nRuamel.Yaml==0.19 \\\n    {HASH} \\\n    {HASH}\ntorch==2.13.0+cpu {HASH}  # CPU\nbare==1\n"
    assert pins(supply_chain, tmp_path, text) == {"ruamel-yaml": ("0.19", 2), "torch": ("2.13.0", 1), "bare": ("1", 0)}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "nothing is pinned"),
        ("# only words\n", "nothing is pinned"),
        ("numpy>=2\n", "numpy has no single version: >=2"),
        ("numpy\n", "numpy has no single version"),
        (f"numpy==2 {HASH}\nNumPy==2 {HASH}\n", "numpy stands there twice"),
        ("numpy==2 --hash=sha256:short\n", "cannot be read"),
        ("<html>\n", "cannot be read"),
    ],
)
def test_a_lock_that_cannot_be_read_is_no_lock(supply_chain: Any, tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(supply_chain.CheckError, match=reason):
        pins(supply_chain, tmp_path, text)


def test_every_fault_is_told(supply_chain: Any) -> None:
    pin = supply_chain.Pin
    lock = {"a": pin("1", 2), "b": pin("1", 0), "c": pin("2", 1)}
    assert supply_chain.faults_of_lock(lock, {"a": pin("1", 0), "c": pin("1", 0), "d": pin("1", 0)}) == [
        "requirements.lock: b has no hash",
        "requirements.lock: b is 1, but missing in constraints.txt; run make lock",
        "requirements.lock: c is 2, but 1 in constraints.txt; run make lock",
        "requirements.lock: d is missing, but 1 in constraints.txt; run make lock",
    ]
    assert supply_chain.faults_of_environment(lock, {"a": "1", "c": "3", "e": "1"}) == [
        "environment: c is 3, but 2 in the lock",
        "environment: e is 1, but missing in the lock",
    ]


def test_the_command_ends_with_1_for_a_fault_and_2_where_it_could_not_look(
    supply_chain: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(supply_chain, "LOCK", tmp_path / "requirements.lock")
    assert supply_chain.main() == 2
    assert "requirements.lock" in capsys.readouterr().err
    (tmp_path / "requirements.lock").write_text(f"numpy==0.1 {HASH}\n")
    assert supply_chain.main() == 1
    assert "error: environment: numpy is " in capsys.readouterr().err
    installed = supply_chain.installed_versions()
    everything = "".join(f"{name}=={version} {HASH}\n" for name, version in installed.items())
    (tmp_path / "requirements.lock").write_text(everything)
    monkeypatch.setattr(supply_chain, "CONSTRAINTS", tmp_path / "requirements.lock")
    assert supply_chain.main() == 0
    monkeypatch.setattr(supply_chain, "OURS", {"marl-encircle", "no-such-distribution"})
    assert supply_chain.main() == 2
    assert "this environment does not hold the package" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("Metadata-Version: 2.1\nName: numpy\nVersion: 9.9\n", "numpy is there twice: 9.9 and "),
        ("Metadata-Version: 2.1\nVersion: 9.9\n", "a distribution without a name lies in "),
    ],
)
def test_a_distribution_that_hides_another_is_not_overlooked(
    supply_chain: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, reason: str
) -> None:
    (tmp_path / "numpy-9.9.dist-info").mkdir()
    (tmp_path / "numpy-9.9.dist-info" / "METADATA").write_text(content)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(supply_chain.CheckError, match=reason):
        supply_chain.installed_versions()


def test_a_lock_that_is_no_text_ends_with_2(
    supply_chain: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "requirements.lock").write_bytes(b"\xff\xfe")
    monkeypatch.setattr(supply_chain, "LOCK", tmp_path / "requirements.lock")
    assert supply_chain.main() == 2
    assert "error: " in capsys.readouterr().err
