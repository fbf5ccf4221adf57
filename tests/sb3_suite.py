"""Run Stable-Baselines3's own tests on MADDPG and MATD3: ``python tests/sb3_suite.py``, behind ``make test-sb3``.

The tests are in SB3's source distribution only. It is downloaded, in the installed version, into ``.cache/``; copies of
the test files in which MADDPG takes the place of DDPG, and MATD3 that of TD3, are run from there. Both classes have one
agent here, since SB3's environments do. Exit code 0: all passed, 1: some failed.
"""

import os
import re
import subprocess
import sys
import tarfile
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")

REPOSITORY = Path(__file__).resolve().parent.parent
CACHE = REPOSITORY / ".cache" / "sb3"
FILES = ["test_save_load", "test_run", "test_deterministic", "test_predict", "test_callbacks", "test_vec_envs"]
OURS = {"MADDPG", "MATD3"}
IMPORT = """
from marl_encircle.maddpg import MADDPG as DDPG
from marl_encircle.maddpg import MATD3 as TD3
"""
# Tests that take our classes but ask for what they do not offer
NOT_OFFERED = {
    "CartPole": "Discrete actions",
    "use_sde": "gSDE is for stochastic policies",
}


def download(sb3_version: str) -> Path:
    """Return the path of SB3's source distribution, downloaded if it is not there."""
    name = f"stable_baselines3-{sb3_version}.tar.gz"
    if not (CACHE / name).exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        options = ["--no-deps", "--no-binary", ":all:", "--no-build-isolation", "--quiet", "--dest", str(CACHE)]
        subprocess.run(
            [sys.executable, "-m", "pip", "download", *options, f"stable_baselines3=={sb3_version}"], check=True
        )
    return CACHE / name


def patched(source: str) -> str:
    """Return a test file's source with MADDPG as DDPG and MATD3 as TD3, both wherever it has one of them."""
    lines = source.splitlines()
    last_import = max(i for i, line in enumerate(lines) if re.match(r"from stable_baselines3|import ", line))
    for i, line in enumerate(lines[last_import + 1 :], last_import + 1):
        if "DDPG" not in line:
            lines[i] = re.sub(r"\bTD3(?=[,\]}])", "TD3, DDPG", line)
            lines[i] = re.sub(r"== TD3\b", "in {TD3, DDPG}", lines[i])
    lines.insert(last_import + 1, IMPORT)
    return "\n".join(lines) + "\n"


def write_tests(archive: Path) -> list[str]:
    """Unpack and patch the test files; return their paths."""
    folder = CACHE / "tests"
    folder.mkdir(exist_ok=True)
    (folder / "pytest.ini").write_text("[pytest]\nfilterwarnings =\n    ignore\n")
    with tarfile.open(archive) as tar:
        for name in FILES:
            member = tar.extractfile(f"{archive.name.removesuffix('.tar.gz')}/tests/{name}.py")
            assert member is not None
            (folder / f"{name}.py").write_text(patched(member.read().decode()))
    return [str(folder / f"{name}.py") for name in FILES]


class OnlyOurClasses:
    """Deselects what does not concern MADDPG and MATD3, and counts what passes."""

    def __init__(self) -> None:
        self.deselected: dict[str, list[str]] = {}
        self.outcomes: Counter[str] = Counter()

    def reason(self, item: pytest.Function) -> str | None:
        """Why a test is not run; None: it is run."""
        params = item.callspec.params if hasattr(item, "callspec") else {}
        classes = {value.__name__ for value in params.values() if hasattr(value, "policy_aliases")}
        source = Path(item.path).read_text().splitlines()
        start = item.function.__code__.co_firstlineno - 1
        end = next((i for i in range(start + 1, len(source)) if source[i][:1] in {"@", "d", "c"}), len(source))
        if classes and not classes & OURS:
            return "another algorithm's case"
        if not classes and not re.search(r"\b(DDPG|TD3)\b", "\n".join(source[start:end])):
            return "a test without our classes: of SB3's environments, files or other algorithms"
        if params.get("env_id") == "CartPole-v1":
            return NOT_OFFERED["CartPole"]
        return NOT_OFFERED["use_sde"] if params.get("use_sde") else None

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Function]) -> None:
        kept = []
        for item in items:
            reason = self.reason(item)
            if reason is None:
                kept.append(item)
            else:
                self.deselected.setdefault(reason, []).append(item.nodeid.split("/")[-1])
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.skipped or report.failed:
            self.outcomes[report.outcome] += 1


def main() -> int:
    """Run the tests and print what passed and what was left out."""
    tests = write_tests(download(version("stable_baselines3")))
    ours = OnlyOurClasses()
    os.environ["PYTHONPATH"] = str(REPOSITORY)
    sys.path.insert(0, str(REPOSITORY))
    options = ["-q", "-p", "no:cacheprovider", "-c", str(CACHE / "tests" / "pytest.ini"), "--durations=5"]
    code = pytest.main([*options, *tests], plugins=[ours])
    lines = [f"SB3 {version('stable_baselines3')} tests on MADDPG and MATD3: {dict(ours.outcomes)}"]
    for reason, names in sorted(ours.deselected.items()):
        functions = Counter(name.split("[")[0] for name in names)
        lines.append(f"{len(names)} deselected, {reason}:")
        lines += [f"    {name} ({count})" for name, count in functions.items()]
    sys.stdout.write("\n".join(lines) + "\n")
    return int(code != pytest.ExitCode.OK)


if __name__ == "__main__":
    sys.exit(main())
