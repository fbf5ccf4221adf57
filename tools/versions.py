"""Test the package with the lowest or the newest versions it says it supports: ``python tools/versions.py lowest``.

uv resolves the dependencies and the extras ``render`` and ``video`` to the lowest versions of ``pyproject.toml``, or to
the newest there are, into an environment of its own under ``.cache/``. PyTorch stays the installed build, and the test
tools stay those of ``constraints.txt``. What the libraries warn of each other is no error here. Exit code 0: all tests
and a training passed; otherwise that of the first command that failed.
"""

import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESOLUTIONS = {"lowest": "lowest-direct", "newest": "highest"}
TEST_TOOLS = ("hypothesis", "mpe2", "pytest", "pytest-timeout", "pytest-xdist")
TESTS = (
    "core",
    "envs",
    "maddpg",
    "cli/test_configs.py",
    "experiments/test_config.py",
    "test_files.py",
)
OTHERS = "not bare_wrapper"
"""Not those that show what SuperSuit's own wrapper breaks: it breaks otherwise in other versions."""


def main() -> None:
    """Resolve, install, test, train."""
    if len(sys.argv) != 2 or sys.argv[1] not in RESOLUTIONS:
        sys.exit(f"usage: {sys.argv[0]} {'|'.join(RESOLUTIONS)}")
    which = sys.argv[1]
    folder = ROOT / ".cache" / "versions" / which
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if "PIP_FIND_LINKS" in os.environ:  # uv has settings of its own
        os.environ.setdefault("UV_FIND_LINKS", os.environ["PIP_FIND_LINKS"])
    uv, python = str(Path(sys.executable).with_name("uv")), str(folder / "venv" / "bin" / "python")

    pinned = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.split("==")[0] in TEST_TOOLS]
    (folder / "given.txt").write_text("\n".join([*pinned, f"torch=={version('torch')}"]))
    extras = ["--extra", "render", "--extra", "video"]
    resolution = ["--resolution", RESOLUTIONS[which], "--no-header", "--no-annotate", "--quiet"]
    wanted = folder / "requirements.txt"
    run(uv, "pip", "compile", "pyproject.toml", folder / "given.txt", *extras, *resolution, "-o", wanted)
    run(uv, "venv", "--quiet", "--python", sys.executable, folder / "venv")
    run(uv, "pip", "install", "--quiet", "--python", python, "-r", wanted)
    run(uv, "pip", "install", "--quiet", "--python", python, "--no-deps", "-e", ".")
    print((folder / "requirements.txt").read_text(), flush=True)
    tests = [f"tests/{name}" for name in TESTS]
    run(python, "-m", "pytest", "-n", "2", "-p", "no:cacheprovider", "-W", "default", "-k", OTHERS, *tests)
    run(python, "-m", "marl_encircle", "train", "--profile", "smoke", "--out", folder / "runs")


def run(*command: str | Path) -> None:
    """Run a command in the checkout; end with its exit code where it fails."""
    print("$", *command, flush=True)
    if code := subprocess.run(command, cwd=ROOT, check=False).returncode:
        sys.exit(code)


if __name__ == "__main__":
    main()
