"""One run: from a configuration and a seed to a run folder, resumable at any moment.

A finished run folder holds ``run.json`` (written last: without it the run is unfinished), ``policy.safetensors`` (the
actors), ``progress.csv`` (the learning curve) and ``episodes.csv`` (the evaluation rounds). Equal configuration, seed,
machine and versions give equal files, save the times and versions in ``run.json``.
"""

import logging
import time
from pathlib import Path
from typing import Any, cast

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger

from marl_encircle import files, locks
from marl_encircle.core.simulator import Difficulty, Simulator
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import checkpoint, divergence
from marl_encircle.experiments.allocator import keep_freed_memory
from marl_encircle.experiments.build import build_model, build_vec_env, check_engine, policy_bytes
from marl_encircle.experiments.callbacks import Checkpointer, LearningCurve, RoundLogger, ended_rounds
from marl_encircle.experiments.choices import Engine
from marl_encircle.experiments.config import Config, difference
from marl_encircle.experiments.divergence import Diverged, DivergenceGuard
from marl_encircle.experiments.episodes import Episode, episodes_to_csv
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import config_of
from marl_encircle.experiments.progress import ProgressBar
from marl_encircle.experiments.provenance import cpu_model, git_commit, source_hash, versions
from marl_encircle.experiments.records import (
    CURVE,
    POLICY,
    RECORD,
    SCHEMA,
    Setting,
    config_hash,
    episodes_name,
    read_record,
    run_path,
)
from marl_encircle.experiments.signals import Stopped, stop_signals
from marl_encircle.experiments.tensorboard import Draw, EventFiles, check_tensorboard
from marl_encircle.experiments.trainable import check_seed, check_training
from marl_encircle.experiments.yaml_files import ConfigError

ROUNDS_PER_LOG = 500

logger = logging.getLogger(__name__)


class OtherRunError(ConfigError):
    """The folder holds a run of another configuration."""


def run_folder(config: Config, seed: int, out: str | Path) -> Path:
    """Return ``OUT/<method>/ratio<lambda>_n<n>_m<m>_<scene>/seed<seed>``."""
    return Path(out) / run_path(config.cell, seed)


def train(
    config: Config,
    seed: int,
    engine: Engine = "native",
    out: str | Path = "results/runs",
    *,
    checkpoint_every: float | None = None,
    progress_bar: bool = False,
    tensorboard: bool = False,
    draw: Draw | None = None,
) -> tuple[Path, bool]:
    """Train, evaluate and record one run; go on where an interrupted one stopped.

    The last policy is the result. Uses one thread.

    :param out: folder of runs
    :param checkpoint_every: seconds between checkpoints; by default chosen by the time that one takes
    :param tensorboard: write event files into the run folder
    :param draw: how rounds are drawn into them, for example by :mod:`marl_encircle.replays.thumbnails`
    :return: the run folder, and whether anything was left to do
    :raises ConfigError: for a seed or a configuration that cannot be trained, before anything is written
    :raises OtherRunError: if the folder holds a run of another configuration or engine, with the difference
    :raises PlacementError: if the bodies cannot be placed, before anything is written
    :raises Stopped: after SIGINT or SIGTERM, with a checkpoint written
    """
    check_seed(config, seed)
    check_engine(engine, config)
    folder = run_folder(config, seed, out)
    if ended_run(folder, config, seed, engine) is not None:
        return folder, False
    plan = _plan(config, seed, engine)
    check_training(config)
    if tensorboard:
        check_tensorboard()
    _check_placement(config)
    with locks.folder_lock(folder):
        if ended_run(folder, config, seed, engine) is not None:  # by whoever had the lock until now
            return folder, False
        files.remove_temporary(folder)
        th.set_num_threads(1)
        keep_freed_memory()
        _Run(config, seed, engine, folder, plan).play(checkpoint_every, progress_bar, tensorboard, draw)
    return folder, True


class _Run:
    """The objects of one training and what they write."""

    def __init__(self, config: Config, seed: int, engine: Engine, folder: Path, plan: dict[str, Any]) -> None:
        self.config, self.folder, self.plan = config, folder, plan
        self.wall_seconds = self.cpu_seconds = 0.0
        self.rows: list[list[float | None]] = []
        saved = checkpoint.load(folder)
        if saved is not None:
            _check_same(folder / checkpoint.NAME, plan, saved.get("plan", {}))
        self.env = build_vec_env(config, config.training.n_worlds, engine)
        self.curriculum = cast(CurriculumVecEnv, self.env.venv)  # type: ignore[attr-defined]  # the outermost is a VecMonitor
        self.model = build_model(config, self.env, seed)
        if saved is not None:
            try:
                checkpoint.restore(self.model, self.curriculum, saved["training"])
                self.wall_seconds, self.cpu_seconds = map(float, saved["seconds"])
                self.rows = [list(row) for row in saved["rows"]]
            except checkpoint.MISFIT as error:
                path = folder / checkpoint.NAME
                raise files.DamagedFileError(path, f"does not fit this training: {str(error)[:200]}") from error
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def play(self, checkpoint_every: float | None, progress_bar: bool, tensorboard: bool, draw: Draw | None) -> None:
        """Train to the end, then evaluate and record."""
        model, curriculum, total = self.model, self.curriculum, self.config.training.world_steps
        events = None
        if tensorboard:
            folder, steps = self.folder / "tensorboard", model.num_timesteps
            events = EventFiles(folder, self.config, self.plan["seed"], steps, draw)
        model.set_logger(Logger(None, [events] if events else []))
        add_pictures = events.add_pictures if events else None
        curve = LearningCurve(self.config, curriculum, self.folder / CURVE, self.rows, add_pictures)
        guard = DivergenceGuard(self.plan, self.folder / divergence.NAME)
        callbacks: list[BaseCallback] = [RoundLogger(curriculum), guard, curve]
        bar = ProgressBar(
            total,
            lambda: curriculum.world_steps,
            lambda step: (info["is_success"] for info in ended_rounds(step, curriculum)),
            "success {:.0%}",
        )
        if progress_bar:
            callbacks.append(bar)
        status = "finished"
        with stop_signals() as caught:
            checkpointer = Checkpointer(self.save_checkpoint, checkpoint_every, caught)
            try:
                model.learn(
                    (total - curriculum.world_steps) * self.config.scenario.pursuers,
                    callback=CallbackList([*callbacks, checkpointer]),
                    log_interval=ROUNDS_PER_LOG,
                    reset_num_timesteps=not curriculum.world_steps,
                )
                guard.check()
                self.save_checkpoint()  # whatever stops what follows, the next start has only that to do
                curve.add_point()
            except Diverged as error:
                logger.warning("%s", error)
                status = "diverged"
            else:
                if "time/world_steps" in model.logger.name_to_value:  # else this very step has been logged
                    model.dump_logs()
            finally:
                bar.close()
                model.logger.close()
                self.env.close()
            curve.write()
            self.record(status, caught)

    def save_checkpoint(self) -> None:
        """Write everything that the rest depends on."""
        is_trained = self.curriculum.world_steps >= self.config.training.world_steps
        tree = {
            "plan": self.plan,
            "rows": self.rows,
            "seconds": self.seconds(),
            "training": checkpoint.capture(self.model, self.curriculum, with_replay=not is_trained),
        }
        checkpoint.save(self.folder, tree)

    def seconds(self) -> tuple[float, float]:
        """Wall-clock and processor seconds so far, those before a resume included."""
        wall, cpu = time.monotonic() - self._wall, time.process_time() - self._cpu
        return self.wall_seconds + wall, self.cpu_seconds + cpu

    def record(self, status: str, caught: list[int]) -> None:
        """Write the policy, its evaluation rounds and, last, the record of the run.

        :param caught: signals so far, see :func:`stop_signals`
        :raises Stopped: if there is one after the rounds; nothing is written then
        """
        wall, cpu = self.seconds()
        contents = {POLICY: policy_bytes(self.model.policy)}
        if status == "finished":
            e = self.config.evaluation
            episodes = play_rounds(self.model.policy, self.config, e.episodes, e.seed)
            if caught:
                raise Stopped(caught[0])
            contents[episodes_name()] = episodes_to_csv(episodes).encode()
        for name, data in contents.items():
            files.write_bytes(self.folder / name, data)
        contents[CURVE] = (self.folder / CURVE).read_bytes()
        for name in contents:
            files.remove(files.compressed(self.folder / name))  # of a former run here
        record = {
            "schema": SCHEMA,
            "status": status,
            "method": self.config.reward.name,
            "config": self.plan["config"],
            "config_hash": config_hash(self.plan["config"]),
            "source_hash": source_hash(),
            "seed": self.plan["seed"],
            "engine": self.plan["engine"],
            "git_commit": git_commit(),
            "versions": versions(),
            "cpu": cpu_model(),
            "wall_seconds": round(wall, 3),
            "cpu_seconds": round(cpu, 3),
            "world_steps": self.curriculum.world_steps,
            "updates": self.model._n_updates,
            "sha256": {name: files.sha256_bytes(data) for name, data in sorted(contents.items())},
        }
        files.write_json(self.folder / RECORD, record)
        if status == "finished":
            checkpoint.remove(self.folder)


def write_episodes(folder: Path, episodes: list[Episode], setting: Setting | None = None) -> None:
    """Write evaluation rounds of a finished run and their hash into its record; former ones are replaced.

    :param setting: where the rounds were played; by default where the run was trained
    """
    name, data = episodes_name(setting), episodes_to_csv(episodes).encode()
    record = read_record(folder)
    record["sha256"] = dict(sorted({**record["sha256"], name: files.sha256_bytes(data)}.items()))
    files.write_bytes(folder / name, data)
    files.remove(files.compressed(folder / name))
    files.write_json(folder / RECORD, record)


def ended_run(folder: Path, config: Config, seed: int, engine: Engine | None = None) -> dict[str, Any] | None:
    """Return the record of the run in ``folder``, None if there is none; checkpoints that it does not need any more go.

    A process that was killed just after it had written the record has left them.

    :param engine: None: either will do, since both train the same policy
    :raises OtherRunError: if it is of another configuration, seed or engine
    """
    if not (folder / RECORD).exists():
        return None
    record = check_same_run(folder, config, seed, engine)
    if record["status"] == "finished":
        checkpoint.remove(folder)
    return record


def check_same_run(folder: Path, config: Config, seed: int, engine: Engine | None = None) -> dict[str, Any]:
    """Return the record of the run that has ended in ``folder``.

    :param engine: None: either will do, since both train the same policy
    :raises OtherRunError: if it is of another configuration, seed or engine
    """
    record = read_record(folder)
    _check_same(folder / RECORD, _plan(config, seed, engine or record.get("engine", "native")), record)
    return record


def _check_placement(config: Config) -> None:
    """Place bodies at the first and at the final difficulty; raise a PlacementError where they do not fit."""
    first = {name: ramp.start for name, ramp in config.training.curriculum.items() if ramp is not None}
    for difficulty in (first, {}):
        simulator = Simulator(config.scenario, n_worlds=16, seed=0)
        simulator.set_difficulty(cast(Difficulty, difficulty))
        simulator.reset()


def _plan(config: Config, seed: int, engine: Engine) -> dict[str, Any]:
    return {"config": config.to_dict(), "seed": seed, "engine": engine}


def _check_same(path: Path, plan: dict[str, Any], record: dict[str, Any]) -> None:
    """Compare with what a run or a checkpoint was made with; fields that were added since have their defaults.

    :param path: of the file that holds it
    """
    other = _plan(config_of(record, path), record.get("seed"), record.get("engine"))  # type: ignore[arg-type]  # only compared, so may be anything
    lines = difference(plan, other)
    if lines:
        listing = "\n  ".join(lines)
        advice = "choose another --seed, --out or reward name"
        raise OtherRunError(f"{path.parent} already holds a different run; {advice}:\n  {listing}")
