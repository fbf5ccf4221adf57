"""A clock that is set back or forward decides nothing: the package asks the monotonic ones only.

What a training and a sweep do while it jumps stands in ``tests/experiments/test_train.py`` and ``tests/soak``.
"""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "marl_encircle"
MONOTONIC = {"monotonic", "perf_counter", "process_time", "sleep"}
OF_FILES = {"st_mtime", "st_ctime", "st_atime", "st_mtime_ns", "st_ctime_ns", "st_atime_ns", "getmtime", "getctime"}
OF_DATES = {"now", "utcnow", "today", "fromtimestamp"}


def wall_clocks(source: str) -> list[str]:
    """What a module asks that may jump: the wall clock, a date, the age of a file."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Attribute(ast.Name("time"), name) if name not in MONOTONIC:
                found.append(f"time.{name}")
            case ast.ImportFrom(module="time"):
                found += [f"time.{alias.name}" for alias in node.names if alias.name not in MONOTONIC]
            case ast.Attribute(_, name) if name in OF_FILES | OF_DATES:
                found.append(name)
    return found


def test_nothing_asks_a_clock_that_may_jump() -> None:
    found = {
        path.relative_to(PACKAGE).as_posix(): wall_clocks(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py")
    }
    assert {name: clocks for name, clocks in found.items() if clocks} == {}


@pytest.mark.parametrize(
    "source",
    [
        "time.time()", "time.time_ns()", "time.localtime()", "from time import time", "datetime.datetime.now()",
        "date.today()", "path.stat().st_mtime", "os.path.getmtime(path)",
    ],
)  # fmt: skip
def test_a_clock_that_may_jump_would_be_found(source: str) -> None:
    assert len(wall_clocks(source)) == 1
    assert wall_clocks("time.monotonic() + time.perf_counter(); from time import sleep") == []
