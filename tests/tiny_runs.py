"""Trainings of a second or less, the command run in this process, and a training to be stopped from outside."""

import atexit
import multiprocessing
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import cache
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from marl_encircle.cli import main
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import executors
from marl_encircle.experiments import sweep as sweeps
from marl_encircle.experiments.choices import Engine
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.train import train

TINY = (
    "training.n_worlds=4",
    "training.world_steps=400",
    "training.curve_every=120",
    "training.curriculum.safety_distance={start: 0.3, world_steps: 300}",
    "algorithm.batch_size=32",
    "algorithm.net_arch=[16]",
    "algorithm.random_world_steps=60",
    "algorithm.buffer_world_steps=240",  # is full, and overwritten, before the end
    "evaluation.episodes=8",
    "evaluation.curve_episodes=4",
    "evaluation.n_directions=72",
    "scenario.max_cycles=20",  # whose clumsy pursuers succeed now and then:
    "scenario.movement_range_limit=2.0",
    "scenario.acceleration=5.0",
    "scenario.turn_order=pursuers_first",
)
IN_SEVERAL_SETTINGS = (
    "algorithm.features=set",
    "training.settings=[{speed_ratio: 1.05, pursuers: 2, obstacles: 1}, {speed_ratio: 1.1, pursuers: 3, obstacles: 0}]",
)
FILES = ("policy.safetensors", "progress.csv", "episodes.csv")


def tiny(reward: str = "ours", overrides: Sequence[str] = (), algorithm: str = "maddpg", **scenario: Any) -> Config:
    """A configuration whose training takes half a second."""
    overrides = [*TINY, *overrides]
    return load_config(reward, algorithm=algorithm, profile="smoke", fields=scenario, overrides=overrides)


def tiny_arguments(*more: str) -> list[str]:
    """The same on the command line."""
    return ["--profile", "smoke", *(part for text in TINY for part in ("--set", text)), *more]


@cache
def finished(engine: Engine = "native") -> Path:
    """A finished tiny run, to be read only."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder)
    return train(tiny(), 0, engine, folder)[0]


def copy_of_finished(folder: Path) -> Path:
    """A finished tiny run to be changed, in the folder of all runs ``folder``."""
    source = finished()
    target = folder.joinpath(*source.parts[-3:])
    shutil.copytree(source, target)
    return target


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a run that are the same whenever it is trained."""
    return {name: (folder / name).read_bytes() for name in FILES}


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def train_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare a sweep's workers the start of a process."""
    monkeypatch.setattr(executors, "_start", Trained)
    monkeypatch.setattr(sweeps, "POLL_SECONDS", 0.0)


class Trained:
    """A worker that trains in this process as soon as it is started."""

    def __init__(self, job: Job, out: Path) -> None:
        train(job.config, job.seed, "native", out)

    def poll(self) -> int:
        return 0

    def send_signal(self, number: int) -> None:
        pass

    def wait(self, timeout: float | None = None) -> int:
        return 0

    kill = wait


class Done(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Done:
    """Run ``marl-encircle`` in this process."""
    monkeypatch.setenv("MARL_ENCIRCLE_DEBUG", "")
    monkeypatch.setattr(sys, "argv", ["marl-encircle", *map(str, arguments)])
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main()
    code = ended.value.code
    assert isinstance(code, int)
    return Done(code, *capsys.readouterr())


def train_slowly(out: Path, engine: Engine, checkpoint_every: float) -> None:
    """The tiny training, slow enough to be stopped in its midst; nothing else differs."""
    step_wait = CurriculumVecEnv.step_wait

    def slow(self: CurriculumVecEnv) -> VecEnvStepReturn:
        time.sleep(0.004)
        return step_wait(self)

    CurriculumVecEnv.step_wait = slow  # type: ignore[method-assign]
    train(tiny(), 0, engine, out, checkpoint_every=checkpoint_every)


def in_another_process(function: Callable[..., None], *arguments: object) -> BaseProcess:
    """Start a function in a process that has imported the package and done nothing else."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["marl_encircle.cli", "marl_encircle.experiments.train"])
    process = context.Process(target=function, args=arguments)
    process.start()
    return process
