"""The README and the pages of docs/: what stands in them, and running it from top to bottom, small enough for a test.

A page is a session in an empty folder: a YAML block that begins with ``# name.yaml`` becomes that file, Python blocks
share one namespace, and commands run in this process. A diff block is applied to a copy of the package, where the rest
runs. ``<!-- not run: reason -->`` above a block says why it is left out.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from stable_baselines3.common.base_class import BaseAlgorithm
from test_makefile import make
from tiny_runs import command, tiny_arguments, train_in_this_process

from marl_encircle.core.rewards import TERMS
from marl_encircle.core.scenes import SCENES
from marl_encircle.experiments import grid, library
from marl_encircle.experiments.yaml_files import merge
from marl_encircle.maddpg import ALGORITHMS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

NOT_RUN = {
    "make setup": "makes the environment that runs this test",
    "source .venv/bin/activate": "enters it",
    "make test": "runs this test",
    "make check": "other tools, which CI runs",
    "make soak": "takes longer than all tests",
    "marl-encircle tensorboard": "serves until it is stopped; tests/cli/test_tensorboard_command.py has one",
    "pip install ": "installs elsewhere",
    "ray start ": "starts a cluster; tests/experiments/test_ray_executor.py has one",
    "marl-encircle sweep study --jobs 64 --executor ray": "needs that cluster",
    "marl-encircle tune ": "trains for hours; tests/experiments/test_tuning.py has small ones",
}
"""Beginnings of the commands that are not run, and why."""

SMALL = {
    "training": {"n_worlds": 4, "world_steps": 400, "curve_every": 200},
    "algorithm": {"batch_size": 32, "random_world_steps": 60},
    "evaluation": {"episodes": 8, "curve_episodes": 4},
}
FEW = """
profile: full
groups:
  - {methods: [ours], settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}], seeds: [900]}
shared: []
"""
"""In the place of the grids of the study."""

MOST_STEPS = 400
"""Of ``learn``."""

UNCOMPILED = (
    "training.world_steps=60",
    "training.curve_every=60",
    "algorithm.random_world_steps=20",
    "evaluation.episodes=2",
    "evaluation.curve_episodes=1",
    "evaluation.n_directions=8",
    "scenario.n_directions=8",
)
"""Less still, of a training in plain Python."""


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    text: str
    line: int
    """Of its first line in the page, from 1."""
    not_run: str
    """Why not, or nothing."""


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page in their order."""
    text = page.read_text(encoding="utf-8")
    fence = re.compile(r"^(?:<!-- not run: ([^>]+) -->\n+)?```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    return [
        Block(match[2], match[3], text.count("\n", 0, match.start(3)) + 1, match[1] or "")
        for match in fence.finditer(text)
    ]


def lines_of(block: Block) -> list[str]:
    """The commands of a shell block, without comments."""
    joined = block.text.replace("\\\n", " ")
    return [shlex.join(words) for line in joined.splitlines() if (words := shlex.split(line, comments=True))]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Trainings of a second or less, in an empty folder; what a page registers is gone afterwards."""
    load_section, setup_learn = library.load_section, BaseAlgorithm._setup_learn

    def small_section(section: library.Kind, name: str) -> dict[str, Any]:
        return merge(load_section(section, name), SMALL.get(section, {}))

    def short(self: BaseAlgorithm, total_timesteps: int, *arguments: Any, **keywords: Any) -> Any:
        return setup_learn(self, min(total_timesteps, MOST_STEPS), *arguments, **keywords)

    monkeypatch.setattr(library, "load_section", small_section)
    monkeypatch.setattr(BaseAlgorithm, "_setup_learn", short)
    train_in_this_process(monkeypatch)
    monkeypatch.chdir(tmp_path)
    registries: tuple[dict[str, Any], ...] = (TERMS, SCENES, ALGORITHMS)
    before = [dict(registry) for registry in registries]
    grid.forget_configs()
    yield
    grid.forget_configs()
    for registry, entries in zip(registries, before, strict=True):
        registry.clear()
        registry.update(entries)


class Session:
    """Runs the blocks of one page in the present folder."""

    def __init__(self, page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self.page, self.capsys, self.monkeypatch = page, capsys, monkeypatch
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self.changed: Path | None = None
        self.later: list[str] = []
        """Of a changed package: what runs there, in a process of its own."""

    def run(self, block: Block) -> None:
        """Run a block, or whatever its language asks for."""
        getattr(self, f"_{block.language or 'text'}")(block)

    def finish(self) -> None:
        """Run what a changed package was changed for."""
        if self.changed is not None:
            environment = {**os.environ, "PYTHONPATH": str(self.changed), "NUMBA_DISABLE_JIT": "1"}
            script = "\n".join(self.later)
            subprocess.run([sys.executable, "-c", script], cwd=self.changed, env=environment, check=True, timeout=250)

    def know(self, line: str) -> None:
        """See that a ``marl-encircle`` command and its options are there, without running it."""
        done = command(self.capsys, self.monkeypatch, *shlex.split(line)[1:], "--help")
        assert done.code == 0, f"{self.page}: {line}\n{done.err}"

    def _text(self, block: Block) -> None:
        """To be read only."""

    def _yaml(self, block: Block) -> None:
        name = re.match(r"# ([\w.-]+\.yaml)\n", block.text)
        assert name, f"{self.page}:{block.line}: the first line must be '# name.yaml'"
        Path(name[1]).write_text(block.text, encoding="utf-8")

    def _python(self, block: Block) -> None:
        if self.changed is not None:
            self.later.append(block.text)
            return
        code = compile("\n" * (block.line - 1) + block.text, str(self.page), "exec")
        exec(code, self.names)

    def _diff(self, block: Block) -> None:
        self.changed = Path("changed").absolute()
        for name in ("marl_encircle", "ablations", "baselines"):
            shutil.copytree(ROOT / name, self.changed / name, ignore=shutil.ignore_patterns("__pycache__"))
        patch = ["patch", "-p0", "--fuzz=0"]
        subprocess.run(patch, cwd=self.changed, input=block.text, text=True, check=True, capture_output=True)

    def _bash(self, block: Block) -> None:
        for each in lines_of(block):
            line = each.removeprefix(".venv/bin/")
            if line.startswith("marl-encircle "):
                self.know(line)
            if not line.startswith(tuple(NOT_RUN)):
                self._command(line)

    def _command(self, line: str) -> None:
        program, *words = shlex.split(line)
        if program == "make":
            shown = make("-n", *words).replace("\\\n", " ").splitlines()
            commands = [each for each in shown if each.startswith(".venv/bin/marl-encircle ")]
            assert commands, f"{self.page}: {line} is neither run nor in NOT_RUN"
            for each in commands:
                self._command(each.removeprefix(".venv/bin/"))
            return
        assert program == "marl-encircle", f"{self.page}: {line} is neither run nor in NOT_RUN"
        Path("few.yaml").write_text(FEW, encoding="utf-8")
        words = ["few.yaml" if word == "study" else word for word in words]
        if words[0] == "watch" and not {"--save", "--headless"} & set(words):
            words += ["--save", "window.gif"]
        if self.changed is not None and words[0] == "train":
            less = [part for text in UNCOMPILED for part in ("--set", text)]
            arguments = ["marl-encircle", *words, *tiny_arguments("--quiet", "--no-tensorboard", *less)]
            self.later += ["import sys", "from marl_encircle.cli import main", f"sys.argv = {arguments}", "main()"]
            return
        done = command(self.capsys, self.monkeypatch, *words)
        assert done.code == 0, f"{self.page}: {line}\n{done.err}"
