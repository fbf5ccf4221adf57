"""What is counted when the code is changed in one place; cosmic-ray itself is not needed here."""

import ast
import json
import signal
import subprocess
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def mutation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    module = import_module("mutation")
    monkeypatch.setattr(module, "RESULTS", tmp_path / "results.jsonl")
    return module


def mutants(mutation: Any, module: str, number: int) -> list[Any]:
    return [mutation.Mutant(module, "core/NumberReplacer", "{}", i) for i in range(number)]


def results(mutation: Any, wanted: list[Any], survivors: int) -> dict[Any, Any]:
    return {
        m: mutation.Result(m, "hash", i >= survivors, "-a\n+b", "test_law" * (i >= survivors), 1.5)
        for i, m in enumerate(wanted)
    }


def test_every_module_of_the_core_and_the_algorithm_is_covered_by_tests_that_exist(mutation: Any) -> None:
    package = ROOT / "marl_encircle"
    numbers = {f"{f}/{p.name}" for f in ("core", "maddpg") for p in (package / f).glob("*.py")}
    assert numbers - set(mutation.MODULES) == {"core/__init__.py", "maddpg/__init__.py"}
    assert {"experiments/config.py", "files.py"} < set(mutation.MODULES)
    for module in mutation.MODULES:
        assert (package / module).is_file()
        assert all((ROOT / test).is_file() for test in mutation.tests_of(module)), module


def test_a_sample_is_seeded_large_enough_and_has_some_of_every_module(mutation: Any) -> None:
    found = {"large": mutants(mutation, "large", 3000), "small": mutants(mutation, "small", 30)}
    found["tiny"] = mutants(mutation, "tiny", 2)
    wanted = mutation.sample(found, 300, seed=0)
    assert len(wanted) >= 300
    assert len(set(wanted)) == len(wanted)
    counts = {name: sum(m.module == name for m in wanted) for name in found}
    assert counts == {"large": 297, "small": 25, "tiny": 2}  # 300 x 3000 / 3032, 300 / (4 x 3), all there are
    assert wanted == mutation.sample(found, 300, seed=0)
    assert wanted != mutation.sample(found, 300, seed=1)


def test_annotations_are_found_where_they_stand(mutation: Any) -> None:
    text = "def f(a: int | None = 1 | 2) -> str | None:\n    b: float = 3 | 4\n"
    places = sorted(mutation.annotations(ast.parse(text)))
    assert [text.splitlines()[s[0] - 1][s[1] : e[1]] for s, e in places] == ["int | None", "str | None", "float"]


def test_bits_of_floats_are_left_out_and_masks_are_not(mutation: Any) -> None:
    senseless = mutation.SENSELESS.fullmatch
    assert senseless("core/ReplaceBinaryOperator_Mul_LShift")
    assert not senseless("core/ReplaceBinaryOperator_Mul_Div")
    assert not senseless("core/ReplaceBinaryOperator_BitOr_BitAnd")


@pytest.mark.parametrize(("survivors", "code"), [(0, 0), (3, 0), (4, 1)])
def test_under_85_percent_fails_and_survivors_are_shown(
    mutation: Any, capsys: pytest.CaptureFixture[str], survivors: int, code: int
) -> None:
    wanted = mutants(mutation, "files.py", 20)  # 3 of 20 is 85 %
    assert mutation.report({"files.py": wanted}, wanted, results(mutation, wanted, survivors)) == code
    out = capsys.readouterr().out
    assert out.count("survived: files.py") == survivors
    assert out.count("-a\n+b") == survivors
    assert f"score: {1 - survivors / 20:.1%}" in out


def test_what_time_alone_killed_is_shown_too(mutation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = mutants(mutation, "files.py", 2)
    found = {wanted[0]: mutation.Result(wanted[0], "hash", True, "-a\n+b", "", 60.0)} | results(mutation, wanted[1:], 0)
    assert mutation.report({"files.py": wanted}, wanted, found) == 0
    out = capsys.readouterr().out
    assert out.count("killed by time alone: files.py") == out.count("-a\n+b") == 1
    assert out.splitlines()[-2].split() == ["total", "2", "2", "2", "1", "0", "1.0"]  # 61.5 s


def test_an_endless_loop_is_ended_by_its_processor_time(
    mutation: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    Path(tmp_path, "test_loop.py").write_text("def test_loop():\n    while True:\n        pass\n")
    monkeypatch.setattr(mutation, "tests_of", lambda module: [str(tmp_path)])
    done = subprocess.run(mutation.command_of("files.py", limit=1), capture_output=True, text=True, check=False)
    assert -done.returncode in (signal.SIGKILL, signal.SIGXCPU)
    assert not mutation.FAILED.search(done.stdout)


def test_the_test_that_noticed_is_read_from_the_summary(mutation: Any) -> None:
    assert mutation.FAILED.search("1 failed\nFAILED tests/a.py::test_b - assert 1").group(1) == "tests/a.py::test_b"
    assert mutation.FAILED.search("ERROR tests/a.py\n1 error").group(1) == "tests/a.py"
    assert not mutation.FAILED.search("1 passed")


def test_a_module_without_a_mutant_fails(mutation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = mutants(mutation, "files.py", 20)
    assert mutation.report({"files.py": wanted, "locks.py": []}, wanted, results(mutation, wanted, 0)) == 1
    assert "no mutant of locks.py was tested" in capsys.readouterr().err


def test_what_was_not_tested_in_time_fails(mutation: Any, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = mutants(mutation, "files.py", 20)
    assert mutation.report({"files.py": wanted}, wanted, results(mutation, wanted[:19], 0)) == 1
    assert "1 mutants were not tested in time" in capsys.readouterr().err


def test_a_second_run_takes_what_the_first_one_found(mutation: Any) -> None:
    wanted = mutants(mutation, "files.py", 2)
    lines = [
        [*wanted[0], mutation.hash_of("files.py"), True, "diff", "test_law", 1.5],
        [*wanted[1], "of other sources", True, "diff", "test_law", 1.5],
    ]
    mutation.RESULTS.write_text("".join(json.dumps(line) + "\n" for line in lines))
    known = mutation.test_all(wanted[:1], jobs=1, deadline=0.0)
    assert [known[m].killed for m in wanted[:1]] == [True]
    assert len(list(mutation.former_results())) == 2
    assert wanted[1] not in known
