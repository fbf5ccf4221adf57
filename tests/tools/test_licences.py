"""Whatever the package needs has a licence that is known and goes together with its own."""

import re
from email.message import Message
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def licences(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return import_module("licences")


def test_every_installed_dependency_has_a_known_licence_that_fits_and_is_listed(licences: Any) -> None:
    needed = licences.needed_by("marl-encircle")
    assert {"numpy", "torch", "pytest", "ruff", "sympy"} <= needed.keys()  # sympy by way of torch
    page = licences.read_page()
    for name, users in needed.items():
        licence = licences.licence_of(metadata.metadata(name))
        assert licences.fault_of(name, licence, users) is None
        assert page[name][0] == licence, f"{name}: run make licences"


def test_every_pinned_distribution_is_listed(licences: Any) -> None:
    pinned = re.findall(r"^([a-z0-9.-]+)==", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert licences.read_page().keys() == set(pinned)


def about(**fields: str | list[str]) -> Any:
    message = Message()
    for name, values in fields.items():
        for value in values if isinstance(values, list) else [values]:
            message[name.replace("_", "-")] = value
    return message


@pytest.mark.parametrize(
    ("fields", "licence"),
    [
        ({"License_Expression": "MIT OR GPL-3.0-only", "License": "proprietary"}, "MIT OR GPL-3.0-only"),
        ({"License": "BSD 3-Clause License"}, "BSD-3-Clause"),
        ({"License": "a long text\n" * 9, "Classifier": ["License :: OSI Approved :: MIT License"]}, "MIT"),
        ({"License": "UNKNOWN", "Classifier": ["Topic :: X", "License :: OSI Approved :: BSD License"]}, "BSD"),
        ({"License": "UNKNOWN"}, None),
        ({"Classifier": ["License :: Other/Proprietary License"]}, None),
        ({}, None),
    ],
)
def test_a_licence_is_what_the_metadata_say(licences: Any, fields: dict[str, Any], licence: str | None) -> None:
    assert licences.licence_of(about(**fields)) == licence


@pytest.mark.parametrize(
    ("licence", "users", "fault"),
    [
        ("MIT", ["package"], None),
        ("BSD-3-Clause AND 0BSD AND Zlib", ["package"], None),
        ("Apache-2.0 OR GPL-3.0-only", ["package"], None),
        ("MPL-2.0", ["render"], None),
        ("GPL-2.0-only", ["dev"], None),
        ("GPL-2.0-only", ["dev", "video"], "GPL-2.0-only does not go together"),
        ("GPL-2.0-only", ["package"], "does not go together with the MIT licence; needed by package"),
        ("MIT AND GPL-2.0-only", ["package"], "does not go together"),
        ("MIT AND GPL-3.0-only", ["dev"], "unknown licence: MIT AND GPL-3.0-only"),
        ("(MIT)", ["package"], "unknown licence"),
        ("", ["package"], "unknown licence"),
        (None, ["dev"], "unknown licence: None"),
    ],
)
def test_what_is_unknown_or_does_not_fit_is_a_fault(
    licences: Any, licence: str | None, users: list[str], fault: str | None
) -> None:
    found = licences.fault_of("thing", licence, users)
    assert found is None if fault is None else fault in found


def test_nothing_is_written_where_a_licence_is_unknown(
    licences: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "licences.md"
    page.write_text("| elsewhere | MIT | render |\n")
    monkeypatch.setattr(licences, "PAGE", page)
    monkeypatch.setattr(licences, "PERMISSIVE", licences.PERMISSIVE - {"MIT"})
    assert licences.main() == 1
    assert "unknown licence" in capsys.readouterr().err
    assert page.read_text() == "| elsewhere | MIT | render |\n"
    monkeypatch.undo()
    monkeypatch.setattr(licences, "PAGE", page)
    assert licences.main() == 0
    assert licences.read_page()["elsewhere"] == ("MIT", "render")  # not installed here
    assert licences.read_page()["numpy"][1] == "package"
    monkeypatch.setattr(licences, "PROJECT", "no-such-distribution")
    assert licences.main() == 2
