"""YAML is plain data here: numbers are numbers, words are words, and nothing else gets in."""

import time
from pathlib import Path
from typing import Any

import pytest

from marl_encircle.experiments.yaml_files import ConfigError, holds, merge, parse_yaml, read_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("2e3", 2000.0),
        ("-1.5", -1.5),
        ("007", 7),
        ("0x10", 16),
        ("true", True),
        ("null", None),
        ("~", None),
        ("", None),
        ("no", "no"),
        ("off", "off"),
        ("12:30", "12:30"),
        ("'2020-01-01'", "2020-01-01"),
        ("[1, 2.0, x]", [1, 2.0, "x"]),
        ("{a: {b: null}}", {"a": {"b": None}}),
        ("λ", "λ"),
        ("'<<'", "<<"),
    ],
)
def test_a_value_is_what_yaml_1_2_says(text: str, value: Any) -> None:
    read = parse_yaml(text)
    assert read == value
    assert type(read) is type(value)


def test_what_a_caller_changes_is_not_seen_by_the_next() -> None:
    parse_yaml("{a: {b: [1]}}")["a"]["b"].append(2)
    assert parse_yaml("{a: {b: [1]}}") == {"a": {"b": [1]}}


def test_comments_order_and_a_byte_order_mark_are_no_matter(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_bytes("# first\nb: 1  # λ\na: 2\n".encode("utf-8-sig"))
    assert list(read_yaml(tmp_path / "f.yaml").items()) == [("b", 1), ("a", 2)]


@pytest.mark.parametrize(
    "text",
    ["[" * 120_000, "a: [" + "1," * 60_000 + "]", "a: 'x\n\n" * 18_000, "".join(f"k{i}: 1\n" for i in range(13_800)),
     "a:\n" * 40_000, "? " * 60_000, "a: {" + "b: {" * 30_000, "\n" * 127_000 + "a"],
)  # fmt: skip
def test_a_hostile_file_is_refused_in_two_seconds(tmp_path: Path, text: str) -> None:
    assert len(text) <= 128_000
    (tmp_path / "f.yaml").write_text(text)
    started = time.process_time()
    with pytest.raises(ConfigError):
        read_yaml(tmp_path / "f.yaml")
    assert time.process_time() - started < 2


def test_a_file_may_be_128_kb_and_no_larger(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text("a: 1\n#" + "x" * (128_000 - 6))
    assert read_yaml(path) == {"a": 1}
    path.write_text("a: 1\n#" + "x" * (128_000 - 5))
    with pytest.raises(ConfigError, match=r"f\.yaml: larger than 128 kB"):
        read_yaml(path)


def test_a_merge_goes_mapping_by_mapping_and_changes_neither() -> None:
    base, override = {"a": {"b": 1, "c": [1]}, "d": {"e": 1}, "f": 1}, {"a": {"b": None}, "d": 3, "f": {"g": 1}}
    assert merge(base, override) == {"a": {"b": None, "c": [1]}, "d": 3, "f": {"g": 1}}
    assert base == {"a": {"b": 1, "c": [1]}, "d": {"e": 1}, "f": 1}
    assert override == {"a": {"b": None}, "d": 3, "f": {"g": 1}}
    assert merge({}, {}) == {}


def test_there_is_a_value_at_a_path_even_if_it_is_null() -> None:
    values = {"a": {"b": None}}
    assert [holds(values, path) for path in ([], ["a"], ["a", "b"])] == [True] * 3
    assert [holds(values, path) for path in (["b"], ["a", "c"], ["a", "b", "c"])] == [False] * 3
