"""Promises that tests of ``make test`` show in full size, laws with 1,000 examples: they are run, and counted, here."""

import base64
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree

import pytest
from documents import ROOT
from test_hostile_files import PAYLOADS

EXAMPLES = 1000
LAWS = "tests/core/test_geometry.py tests/core/test_dynamics.py tests/core/test_simulator.py"
EXPERIMENTS = "tests/experiments/"


class Case(NamedTuple):
    """What became of a test."""

    name: str
    outcome: Literal["passed", "broken", "skipped"]
    seconds: float


class Shown(NamedTuple):
    """Tests that show a promise.

    :param broken: what would be broken
    :param files: names of their files
    :param words: some word is in the name of each of them
    """

    broken: str
    files: str
    words: str

    @property
    def command(self) -> str:
        """How to run them."""
        return f"pytest {self.files} -k '{self.any_word}'"

    @property
    def any_word(self) -> str:
        """For pytest's option -k."""
        return " or ".join(self.words.split())

    def is_shown_by(self, case: Case) -> bool:
        return any(file in case.name for file in self.files.split()) and any(w in case.name for w in self.words.split())


REFUSALS = Shown(
    "bad configurations that are not refused with exit code 2, or touch the disk",
    f"{EXPERIMENTS}test_refusals.py {EXPERIMENTS}test_yaml_files.py",
    "bad hostile memory",
)
PROMISES = [
    REFUSALS,
    Shown(
        "tests of actions that are not finite or of a wrong shape, and not refused by the agent's name",
        "tests/envs/test_encirclement_v0.py tests/envs/test_vec_env.py tests/core/test_simulator.py",
        "not_finite wrong_shape another_shape wrong_action missing_action",
    ),
    Shown(
        "tests of trainings that diverge and are not stopped, kept and shown",
        f"{EXPERIMENTS}test_divergence.py {EXPERIMENTS}test_train.py tests/study/test_reproduce.py",
        "diverg",
    ),
    Shown(
        "tests by which an update is not the one worked out by hand, 200 are not SB3's to 1e-9, or nothing is learnt",
        "tests/maddpg/test_maddpg.py",
        "worked_out_by_hand equal_sb3 identity",
    ),
    Shown(
        "tests of the VecEnv contract that an engine breaks",
        "tests/envs/test_engines.py tests/envs/test_vec_env.py tests/envs/test_supersuit_vec_env.py",
        "test_engines test_vec_env test_supersuit",
    ),
    Shown(
        "tests by which watching, logging, saving or a clock that jumps changes a training",
        f"{EXPERIMENTS}test_train.py {EXPERIMENTS}test_tensorboard.py {EXPERIMENTS}test_divergence.py",
        "does_not_change change_no_bit changes_no_bit clock_that_jumps",
    ),
    Shown(
        "tests of calls that fail while something is written, and cost the former state or are not told",
        "tests/test_writing.py tests/test_files.py tests/test_failing_disks.py",
        "test_writing test_files test_failing_disks",
    ),
    Shown(
        "tests of trainings that are stopped anywhere, and do not go on bit for bit",
        f"{EXPERIMENTS}test_train.py",
        "goes_on_bit_for_bit at_every_step goes_on_from costs_the_evaluation_only",
    ),
    Shown(
        "parts of a checkpoint that can be left out unnoticed",
        f"{EXPERIMENTS}test_train.py",
        "leaves_out generator_is_needed",
    ),
    Shown(
        "tests of runs that are resumed with a changed configuration",
        f"{EXPERIMENTS}test_train.py {EXPERIMENTS}test_sweep.py tests/cli/test_cli.py",
        "another_run another_configuration",
    ),
    Shown("tests of locks that let two in, or outlive their holder", "tests/test_locks.py", "test_locks"),
    Shown(
        "tests of second signals that do not stop at once, and of workers that are left behind",
        f"{EXPERIMENTS}test_train.py {EXPERIMENTS}test_sweep.py",
        "second_signal leaves_no_worker",
    ),
    Shown(
        f"doors at which one of {len(PAYLOADS)} kinds of payload is executed or let in",
        "tests/test_hostile_files.py",
        "does_not_run refuses_them_too place_of_a_run",
    ),
    Shown(
        "tests of archives, links, headers and names that lie, and do harm",
        "tests/test_hostile_files.py",
        "lies bomb test_a_link leads_nowhere waited trust vouches larger_than",
    ),
    Shown(
        "tests of archives that are read without being trusted, or in silence",
        f"{EXPERIMENTS}test_loading.py tests/maddpg/test_maddpg.py",
        "trusted can_run_code",
    ),
    Shown(
        "tests of files, each cut 100 times and with 500 flipped bits, whose damage goes unnoticed",
        f"tests/test_hostile_files.py {EXPERIMENTS}test_checkpoint.py",
        "flipped every_cut",
    ),
    Shown(
        "tests of edited, missing or diverged runs that tables do not show for what they are",
        f"{EXPERIMENTS}test_records.py tests/study/test_reproduce.py tests/study/test_verify.py "
        "tests/study/test_tables.py",
        "edited missing diverged without_a_result is_found not_run",
    ),
    Shown(
        "tests of intervals and differences that say more than is known",
        f"{EXPERIMENTS}test_metrics.py",
        "test_metrics",
    ),
    Shown(
        "tests by which Ray listens elsewhere than on loopback",
        f"{EXPERIMENTS}test_ray_executor.py",
        "loopback",
    ),
]


def run_tests(folder: Path, *arguments: str) -> tuple[list[Case], list[int]]:
    """Run tests in a process of their own.

    :return: what became of them, and the number of examples of each law
    """
    report = folder / "report.xml"
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "--junitxml", str(report), *arguments]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=ROOT, env={**os.environ, "HYPOTHESIS_PROFILE": "thorough", "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED), done.stdout + done.stderr
    sys.stdout.write(done.stdout)  # for pytest, which shows it where something is broken
    root = ElementTree.parse(report).getroot()
    laws = [each.attrib["value"] for each in root.iter("property") if "hypothesis" in each.attrib["name"]]
    return [_case(each) for each in root.iter("testcase")], [_examples(base64.b64decode(law).decode()) for law in laws]


def _case(element: ElementTree.Element) -> Case:
    found = {child.tag for child in element}
    outcome = "broken" if found & {"failure", "error"} else "skipped" if "skipped" in found else "passed"
    name = element.attrib["classname"].replace(".", "/") + ".py::" + element.attrib["name"]
    return Case(name, outcome, float(element.attrib["time"]))


def _examples(statistics: str) -> int:
    generated = re.search(r"during generate phase.*?(\d+) passing", statistics, flags=re.DOTALL)
    assert generated is not None, statistics
    return int(generated[1])


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    files = sorted({file for shown in PROMISES for file in shown.files.split()})
    wanted = [f"({Path(file).stem} and ({shown.any_word}))" for shown in PROMISES for file in shown.files.split()]
    return run_tests(tmp_path_factory.mktemp("report"), *files, "-k", " or ".join(wanted))[0]


@pytest.mark.timeout(2400)
@pytest.mark.parametrize("shown", PROMISES, ids=lambda shown: shown.words.partition(" ")[0])
def test_tests_show_it(cases: list[Case], shown: Shown, promise: Any) -> None:
    mine = [case for case in cases if shown.is_shown_by(case) and case.outcome != "skipped"]
    broken = [case.name for case in mine if case.outcome == "broken"]
    if not mine and any(map(shown.is_shown_by, cases)):
        pytest.skip("what it needs is not installed")
    promise(shown.broken, f"{len(broken)} of {len(mine)}", 0, shown.command)
    if shown == REFUSALS:
        slowest = max(case.seconds for case in mine)
        promise("seconds until the slowest of them is refused", f"{slowest:.2f}", "< 2", shown.command)
        assert len(mine) >= 80
        assert slowest < 20
    assert mine != []
    assert broken == []


@pytest.mark.timeout(2400)
def test_laws_hold_for_many_examples(tmp_path: Path, promise: Any) -> None:
    cases, examples = run_tests(tmp_path, *LAWS.split())
    broken = [case.name for case in cases if case.outcome != "passed"]
    enough = sum(number >= EXAMPLES for number in examples)
    command = f"HYPOTHESIS_PROFILE=thorough pytest --hypothesis-show-statistics {LAWS}"
    promise(
        f"laws of geometry, dynamics and seeds that hold for {EXAMPLES:,} examples",
        f"{enough} of {len(examples)}",
        "all",
        command,
    )
    promise("tests of geometry, dynamics and worlds that fail", f"{len(broken)} of {len(cases)}", 0, command)
    assert broken == []
    assert enough == len(examples) >= 15
