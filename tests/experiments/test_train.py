"""A run is the same however often it is stopped, whatever is logged, on either engine; and says so in its folder."""

import gc
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch as th
from made_up import compress
from stable_baselines3.common import logger
from tiny_runs import (
    FILES,
    IN_SEVERAL_SETTINGS,
    TINY,
    contents,
    copy_of_finished,
    everything_in,
    finished,
    in_another_process,
    tiny,
    tiny_arguments,
    train_slowly,
)

from marl_encircle import files, locks
from marl_encircle.core.simulator import PlacementError
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import callbacks, checkpoint, train
from marl_encircle.experiments.choices import Engine
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import episodes_from_csv
from marl_encircle.experiments.records import config_hash, read_record, read_runs
from marl_encircle.experiments.signals import Stopped
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import MADDPG, maddpg

ENGINES = get_args(Engine)
KEYS = [
    "schema", "status", "method", "config", "config_hash", "source_hash", "seed", "engine", "git_commit", "versions",
    "cpu", "wall_seconds", "cpu_seconds", "world_steps", "updates", "sha256",
]  # fmt: skip


# what is left behind


def test_a_finished_folder_holds_the_record_and_what_it_vouches_for() -> None:
    folder = finished()
    assert everything_in(folder) == ["episodes.csv", "policy.safetensors", "progress.csv", "run.json"]
    assert folder.parts[-3:] == ("ours", "ratio1.1_n3_m1_random", "seed0")
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert list(record) == KEYS
    assert record["schema"] == 1
    assert (record["status"], record["method"], record["seed"], record["engine"]) == ("finished", "ours", 0, "native")
    assert Config.from_dict(record["config"]) == tiny()
    assert record["config_hash"] == config_hash(tiny().to_dict())
    assert record["world_steps"] == 400
    assert record["updates"] == 85  # 100 steps of 4 worlds, but for the 15 with random actions
    assert record["cpu_seconds"] > 0
    assert record["wall_seconds"] > 0
    assert record["sha256"] == {name: files.sha256_bytes((folder / name).read_bytes()) for name in sorted(FILES)}
    assert {"python", "numpy", "torch", "stable-baselines3"} <= record["versions"].keys()
    assert len(record["source_hash"]) == 64


def test_the_learning_curve_has_its_points_and_no_clock() -> None:
    lines = (finished() / "progress.csv").read_text().splitlines()
    assert lines[0] == "world_steps,success,mean_episode_length,success_all,success_pursuers,sigma_c"
    assert [int(line.split(",")[0]) for line in lines[1:]] == [120, 240, 360, 400]


def test_the_rounds_are_those_of_the_evaluation_section() -> None:
    rounds = episodes_from_csv((finished() / "episodes.csv").read_text())
    assert [each.round for each in rounds] == list(range(8))
    assert {each.step_all for each in rounds} != {None}, "with nothing but failures equal rounds would say little"


def test_the_tables_read_what_the_training_wrote() -> None:
    (run,) = read_runs(finished().parents[2])
    assert (run.cell, run.seed, run.status, run.closure) == (tiny().cell, 0, "finished", "all")


def test_event_files_without_tensorboard_are_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logger, "SummaryWriter", None)
    with pytest.raises(ConfigError, match=r"pip install 'tensorboard>=2\.18', or train without .*--no-tensorboard"):
        train.train(tiny(), 0, "native", tmp_path, tensorboard=True)
    assert everything_in(tmp_path) == []


# again, and another one


def test_a_finished_run_is_not_trained_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = copy_of_finished(tmp_path)
    monkeypatch.setattr(train, "_Run", lambda *_: pytest.fail("it was trained again"))
    assert train.train(tiny(), 0, "native", tmp_path) == (folder, False)


def test_a_run_that_takes_the_place_of_a_former_one_leaves_nothing_of_it(tmp_path: Path) -> None:
    folder = copy_of_finished(tmp_path)
    for name in FILES:
        compress(folder / name)
    (folder / "run.json").unlink()
    train.train(tiny(), 0, "native", tmp_path)
    assert everything_in(folder) == everything_in(finished())


@pytest.mark.parametrize(
    ("config", "engine", "line"),
    [
        (["reward.scale=0.1"], "native", "config.reward.scale: 0.1 here, 0.05 there"),
        (["reward.terms.time=null"], "native", "config.reward.terms.time: None here, 8.0 there"),
        ([], "supersuit", "engine: supersuit here, native there"),
    ],
)
def test_a_folder_with_another_run_is_left_alone(tmp_path: Path, config: list[str], engine: Any, line: str) -> None:
    folder = copy_of_finished(tmp_path)
    before = contents(folder), (folder / "run.json").read_bytes()
    with pytest.raises(train.OtherRunError) as caught:
        train.train(tiny(overrides=config), 0, engine, tmp_path)
    message = str(caught.value)
    assert str(folder) in message
    assert [text.strip() for text in message.splitlines()[1:]] == [line]
    assert (contents(folder), (folder / "run.json").read_bytes()) == before


def test_an_unfinished_run_of_another_configuration_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_at(monkeypatch, 20)
    with pytest.raises(Stopped):
        train.train(tiny(), 0, "native", tmp_path)
    monkeypatch.undo()
    with pytest.raises(train.OtherRunError, match=r"reward\.scale: 0\.1 here, 0\.05 there"):
        train.train(tiny(overrides=["reward.scale=0.1"]), 0, "native", tmp_path)


def test_two_trainings_do_not_share_a_folder(tmp_path: Path) -> None:
    with locks.folder_lock(train.run_folder(tiny(), 0, tmp_path)), pytest.raises(locks.FolderLockedError):
        train.train(tiny(), 0, "native", tmp_path)


@pytest.mark.parametrize(("first", "final"), [(0.3, 0.3), (0.3, 0.05), (0.05, 0.3)])
def test_bodies_that_cannot_be_placed_are_told_before_anything_is_written(
    tmp_path: Path, first: float, final: float
) -> None:
    # two discs whose centres lie in a square of side 0.2
    crowded = ["scenario.obstacle_limit=0.1", f"scenario.obstacle_radius={final}"]
    ramp = f"training.curriculum.obstacle_radius={{start: {first}, world_steps: 300}}"
    config = tiny(obstacles=2, overrides=[*crowded, ramp])
    with pytest.raises(PlacementError):
        train.train(config, 0, "native", tmp_path)
    assert everything_in(tmp_path) == []


@pytest.mark.parametrize(
    ("overrides", "seed", "engine", "reason"),
    [
        ([], 4000, "native", r"seed must differ from evaluation\.seed"),
        ([], 2000, "native", r"seed must differ from evaluation\.curve_seed"),
        ([], -1, "native", "seed must be an integer"),
        ([], 0, "nativ", "did you mean native?"),
        (IN_SEVERAL_SETTINGS, 0, "supersuit", r"training\.settings: only the native engine trains in several"),
        (["algorithm.random_world_steps=400"], 0, "native", "or nothing is learnt"),
        (["training.world_steps=10000000000", "algorithm.buffer_world_steps=10000000000"], 0, "native", "GB of memory"),
    ],
)
def test_what_cannot_be_trained_is_told_before_anything_is_written(
    tmp_path: Path, overrides: list[str], seed: int, engine: Any, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        train.train(tiny(overrides=overrides), seed, engine, tmp_path)
    assert everything_in(tmp_path) == []


# the same bits


@pytest.mark.parametrize("overrides", [[], ["algorithm.name=matd3", "algorithm.critic=per_agent"]])
def test_both_engines_train_the_same_policy(tmp_path: Path, overrides: list[str]) -> None:
    if overrides:
        config = tiny(overrides=overrides)
        native, supersuit = (train.train(config, 1, engine, tmp_path / engine)[0] for engine in ENGINES)
    else:
        native, supersuit = map(finished, ENGINES)
    assert contents(native) == contents(supersuit)


def test_without_obstacles_model_a_and_ours_are_one(tmp_path: Path) -> None:
    for seed in (0, 1):
        ours, model_a = (
            train.train(tiny(name, obstacles=0), seed, "native", tmp_path)[0] for name in ("ours", "model_a")
        )
        for name in ("policy.safetensors", "episodes.csv", "progress.csv"):
            assert (ours / name).read_bytes() == (model_a / name).read_bytes(), name


def test_with_obstacles_model_a_and_ours_are_not(tmp_path: Path) -> None:
    model_a = train.train(tiny("model_a"), 0, "native", tmp_path)[0]
    assert contents(model_a)["policy.safetensors"] != contents(finished())["policy.safetensors"]


def test_another_process_writes_the_same_bytes(tmp_path: Path) -> None:
    arguments = ["train", *tiny_arguments("--out", str(tmp_path), "--quiet", "--no-tensorboard")]
    done = subprocess.run(
        [sys.executable, "-m", "marl_encircle", *arguments],
        env={**os.environ, "PYTHONHASHSEED": "7"}, cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert contents(Path(done.stdout.splitlines()[-1])) == contents(finished())


def test_another_seed_writes_other_bytes(tmp_path: Path) -> None:
    other = contents(train.train(tiny(), 1, "native", tmp_path)[0])
    assert all(other[name] != contents(finished())[name] for name in FILES)


@pytest.mark.parametrize(
    ("overrides", "how"),
    [
        (["training.curve_every=400"], {}),
        (["training.curve_every=20"], {}),
        (["evaluation.curve_episodes=50", "evaluation.curve_seed=3"], {}),
        ([], {"checkpoint_every": 0.0}),
        ([], {"tensorboard": True, "progress_bar": True}),
    ],
)
def test_watching_a_training_does_not_change_it(tmp_path: Path, overrides: list[str], how: dict[str, Any]) -> None:
    folder, _ = train.train(tiny(overrides=overrides), 0, "native", tmp_path, **how)
    for name in ("policy.safetensors", "episodes.csv"):
        assert contents(folder)[name] == contents(finished())[name]


def test_nor_does_watching_one_in_several_settings_with_an_algorithm_that_draws_numbers(tmp_path: Path) -> None:
    policies = {
        contents(train.train(config, 0, out=tmp_path / every)[0])["policy.safetensors"]
        for every in ("20", "400")
        for config in [tiny(algorithm="matd3", overrides=[*IN_SEVERAL_SETTINGS, f"training.curve_every={every}"])]
    }
    assert len(policies) == 1


# stopped, and gone on


def stop_at(monkeypatch: pytest.MonkeyPatch, vec_step: int, number: int = signal.SIGTERM) -> None:
    """Have a signal come in that step of the worlds, counted from the start of the training."""
    step_wait = CurriculumVecEnv.step_wait

    def stopping(self: CurriculumVecEnv) -> Any:
        if self.world_steps == vec_step * 4:
            os.kill(os.getpid(), number)
        return step_wait(self)

    monkeypatch.setattr(CurriculumVecEnv, "step_wait", stopping)


def keep_the_end(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Keep everything that a further training would depend on, at the end of each training."""
    ends: list[dict[str, Any]] = []
    record = train._Run.record

    def keeping(self: Any, *arguments: Any) -> None:
        ends.append(checkpoint.capture(self.model, self.curriculum))
        record(self, *arguments)

    monkeypatch.setattr(train._Run, "record", keeping)
    return ends


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Where two trees differ in any bit."""
    if isinstance(one, th.Tensor):
        one, other = one.numpy(), other.numpy()
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        return [found for key in one for found in differences(one[key], other[key], f"{path}/{key}")]
    if isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        return [found for i in range(len(one)) for found in differences(one[i], other[i], f"{path}/{i}")]
    if isinstance(one, np.ndarray):
        return [] if one.tobytes() == other.tobytes() else [path]
    return [] if one == other else [path]


@pytest.mark.parametrize(
    ("engine", "changes", "vec_step"),
    # before the first step; among random actions; before and after the buffer is full; in the midst of rounds
    [
        *(("native", {}, step) for step in (0, 7, 33, 71)),
        *(("native", {"algorithm": algorithm}, 50) for algorithm in ("matd3", "matd3_relative")),
        ("native", {"overrides": IN_SEVERAL_SETTINGS}, 50),
        ("supersuit", {}, 50),
    ],
)
def test_a_stopped_training_goes_on_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: Engine, changes: dict[str, Any], vec_step: int
) -> None:
    config = tiny(**changes)
    ends = keep_the_end(monkeypatch)
    whole, _ = train.train(config, 0, engine, tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, vec_step)
        with pytest.raises(Stopped, match="stopped by SIGTERM; run the same command again to resume"):
            train.train(config, 0, engine, tmp_path / "parts")
    folder = train.run_folder(config, 0, tmp_path / "parts")
    assert (folder / checkpoint.NAME).exists()
    assert not (folder / "run.json").exists()
    assert train.train(config, 0, engine, tmp_path / "parts") == (folder, True)
    assert differences(*ends) == []
    assert contents(folder) == contents(whole)
    assert everything_in(folder) == everything_in(whole)
    one, other = read_record(folder), read_record(whole)
    assert {key for key in one if one[key] != other[key]} <= {"wall_seconds", "cpu_seconds", "git_commit"}


def test_a_round_that_a_stop_cuts_in_two_has_its_whole_return(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rounds: list[tuple[int, float, int]] = []

    class Notebook(train.RoundLogger):
        def _on_step(self) -> bool:
            ended = callbacks.ended_rounds(self, self.curriculum)
            rounds.extend((self.num_timesteps, info["episode"]["r"], info["episode"]["l"]) for info in ended)
            return super()._on_step()

    monkeypatch.setattr(train, "RoundLogger", Notebook)
    train.train(tiny(), 0, "native", tmp_path / "whole")
    whole = rounds.copy()
    rounds.clear()
    with monkeypatch.context() as patch:
        stop_at(patch, 50)
        with pytest.raises(Stopped):
            train.train(tiny(), 0, "native", tmp_path / "parts")
    train.train(tiny(), 0, "native", tmp_path / "parts")
    assert rounds == whole
    assert len(whole) >= 20


def test_a_training_may_be_stopped_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny(overrides=["training.world_steps=40", "algorithm.random_world_steps=8", "training.curve_every=20"])
    whole, _ = train.train(config, 0, "native", tmp_path / "whole")
    for step in range(9):
        with monkeypatch.context() as patch:
            stop_at(patch, step, (signal.SIGINT, signal.SIGTERM)[step % 2])
            with pytest.raises(Stopped):
                train.train(config, 0, "native", tmp_path / "parts")
    folder, _ = train.train(config, 0, "native", tmp_path / "parts")
    assert contents(folder) == contents(whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("module", [train, callbacks], ids=["last rounds", "last point of the curve"])
def test_a_signal_during_the_evaluation_costs_the_evaluation_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, number: int
) -> None:
    step_wait, play_rounds, world_steps = CurriculumVecEnv.step_wait, module.play_rounds, 0

    def counting(self: CurriculumVecEnv) -> Any:
        nonlocal world_steps
        outcome = step_wait(self)
        world_steps = self.world_steps
        return outcome

    def stopping(*arguments: Any) -> Any:
        if world_steps == 400:
            os.kill(os.getpid(), number)
        return play_rounds(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(CurriculumVecEnv, "step_wait", counting)
        patch.setattr(module, "play_rounds", stopping)
        with pytest.raises(Stopped, match="run the same command again to resume"):
            train.train(tiny(), 0, "native", tmp_path, tensorboard=True)
    folder = train.run_folder(tiny(), 0, tmp_path)
    assert sorted(path.name for path in folder.iterdir() if path.is_file()) == [checkpoint.NAME, "progress.csv"]
    with monkeypatch.context() as patch:
        patch.setattr(CurriculumVecEnv, "step_wait", lambda _: pytest.fail("it was trained again"))
        assert train.train(tiny(), 0, "native", tmp_path, tensorboard=True, progress_bar=True) == (folder, True)
    assert contents(folder) == contents(finished())
    assert not (folder / checkpoint.NAME).exists()


def test_an_evaluation_that_fails_costs_the_evaluation_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(train, "play_rounds", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train.train(tiny(), 0, "native", tmp_path)
    monkeypatch.setattr(CurriculumVecEnv, "step_wait", lambda _: pytest.fail("it was trained again"))
    assert contents(train.train(tiny(), 0, "native", tmp_path)[0]) == contents(finished())


FORGETFUL: dict[str, Callable[[dict[str, Any]], object]] = {
    "exploration": lambda saved: saved["random"]["exploration"]["state"].update(state=1),
    "replay sampling": lambda saved: saved["random"]["numpy"].__setitem__(2, 3),
    "worlds": lambda saved: saved["worlds"][0]["simulator"]["streams"][0]["state"].update(state=1),
    "curriculum": lambda saved: saved.update(world_steps=saved["world_steps"] - 4),
    "targets": lambda saved: saved["parameters"]["policy"].update(
        {key: value * 0 for key, value in saved["parameters"]["policy"].items() if "actor_target" in key}
    ),
    "optimiser": lambda saved: [state.update(exp_avg=state["exp_avg"] * 0)
                                for state in saved["parameters"]["actor.optimizer"]["state"].values()],
    "buffer": lambda saved: saved["replay"]["rewards"].fill(0),
    "updates": lambda saved: saved["counters"].update(_n_updates=saved["counters"]["_n_updates"] + 1),
}  # fmt: skip


def checkpoint_of_stopped(out: Path, monkeypatch: pytest.MonkeyPatch, step: int) -> Path:
    """Return the checkpoint of a training that was stopped."""
    with monkeypatch.context() as patch:
        stop_at(patch, step)
        with pytest.raises(Stopped):
            train.train(tiny(), 0, "native", out)
    return train.run_folder(tiny(), 0, out) / checkpoint.NAME


@pytest.mark.parametrize("forgotten", FORGETFUL)
def test_what_a_resume_leaves_out_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forgotten: str) -> None:
    path = checkpoint_of_stopped(tmp_path, monkeypatch, 50)
    saved = checkpoint.load_tree(path)
    FORGETFUL[forgotten](saved["training"])
    checkpoint.save_tree(path, saved)
    folder, _ = train.train(tiny(), 0, "native", tmp_path)
    assert contents(folder)["policy.safetensors"] != contents(finished())["policy.safetensors"]


def test_where_target_noise_is_drawn_its_generator_is_needed_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny(overrides=["algorithm.name=matd3"])
    whole, _ = train.train(config, 0, "native", tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, 50)
        with pytest.raises(Stopped):
            train.train(config, 0, "native", tmp_path / "parts")
    path = train.run_folder(config, 0, tmp_path / "parts") / checkpoint.NAME
    saved = checkpoint.load_tree(path)
    saved["training"]["random"]["torch"] = th.Generator().manual_seed(7).get_state().numpy()
    checkpoint.save_tree(path, saved)
    folder, _ = train.train(config, 0, "native", tmp_path / "parts")
    assert contents(folder)["policy.safetensors"] != contents(whole)["policy.safetensors"]


def test_a_clock_that_jumps_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = itertools.cycle([0, 4e8, -3e8, 7, -86_400])  # seconds: years ahead, years back
    now, now_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + int(1e9 * next(jumps)))
    folder, _ = train.train(tiny(), 0, "native", tmp_path, tensorboard=True, progress_bar=True)
    assert contents(folder) == contents(finished())
    record = read_record(folder)
    assert 0 < record["cpu_seconds"] < 300
    assert 0 < record["wall_seconds"] < 300


def train_and_save_for_ever(out: Path) -> None:
    """A training whose checkpoints take as long as one waits."""

    def save(folder: Path, _tree: Any) -> None:
        (folder / "saving").touch()
        time.sleep(600)

    checkpoint.save = save
    train_slowly(out, "native", 1e9)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_stops_a_training_at_once(tmp_path: Path, number: int) -> None:
    process = in_another_process(train_and_save_for_ever, tmp_path)
    folder = train.run_folder(tiny(), 0, tmp_path)
    for wanted in ("progress.csv", "saving"):
        deadline = time.monotonic() + 60
        while not (folder / wanted).exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(process.pid or 0, number)
    process.join(30)
    assert process.exitcode == (-number if number == signal.SIGTERM else 1), "an uncaught KeyboardInterrupt ends with 1"


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_a_process_stopped_by_a_signal_leaves_what_the_next_goes_on_from(
    tmp_path: Path, engine: Engine, number: int
) -> None:
    checkpoint_every = 0.05 if number == signal.SIGKILL else 120.0
    process = in_another_process(train_slowly, tmp_path, engine, checkpoint_every)
    folder = train.run_folder(tiny(), 0, tmp_path)
    deadline = time.monotonic() + 60
    while not (folder / "progress.csv").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(process.pid or 0, number)
    process.join(10)
    assert process.exitcode == (-number if number == signal.SIGKILL else 1), "an uncaught Stopped ends a process with 1"
    assert not (folder / "run.json").exists()
    saved = checkpoint.load(folder)
    assert saved is not None
    assert 0 < saved["training"]["world_steps"] < 400
    train.train(tiny(), 0, engine, tmp_path)
    assert contents(folder) == contents(finished())
    assert everything_in(folder) == everything_in(finished())


@pytest.mark.parametrize("change", ["cut", "flip", "other"])
def test_a_damaged_checkpoint_is_named_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    path = checkpoint_of_stopped(tmp_path, monkeypatch, 20)
    data = bytearray(path.read_bytes())
    if change == "cut":
        path.write_bytes(data[:-1])
    elif change == "flip":
        data[-5] ^= 1
        path.write_bytes(data)
    else:
        saved = checkpoint.load_tree(path)
        saved["training"]["parameters"]["policy"].popitem()
        checkpoint.save_tree(path, saved)
    before = path.read_bytes()
    with pytest.raises(files.DamagedFileError, match=r"checkpoint\.safetensors"):
        train.train(tiny(), 0, "native", tmp_path)
    assert path.read_bytes() == before


def test_a_checkpoint_of_another_version_is_named_and_not_a_record_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = checkpoint_of_stopped(tmp_path, monkeypatch, 20)
    saved = checkpoint.load_tree(path)
    saved["plan"]["config"]["algorithm"]["later"] = 1
    checkpoint.save_tree(path, saved)
    with pytest.raises(files.DamagedFileError, match=r"checkpoint\.safetensors: config: algorithm\.later: unknown key"):
        train.train(tiny(), 0, "native", tmp_path)


# diverged


@pytest.mark.parametrize("when", [40, 99])
@pytest.mark.parametrize("what", ["loss", "weights"])
def test_a_diverged_training_is_kept_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: int, what: str
) -> None:
    update = when + 1 - 15  # random actions come first
    if what == "loss":
        calls = itertools.count(1)
        gradients = maddpg.critic_gradients

        def late(*arguments: Any) -> th.Tensor:
            return gradients(*arguments) * (1 if next(calls) < update else th.nan)

        monkeypatch.setattr(maddpg, "critic_gradients", late)
    else:
        step = MADDPG._step

        def diverging(self: MADDPG, network: Any) -> None:
            step(self, network)
            if self._n_updates >= update:
                with th.no_grad():
                    next(self.actor.parameters()).fill_(th.inf)

        monkeypatch.setattr(MADDPG, "_step", diverging)
    folder, worked = train.train(tiny(), 0, "native", tmp_path)
    assert worked
    record = read_record(folder)
    assert list(record) == KEYS
    assert record["status"] == "diverged"
    assert record["world_steps"] == 4 * (when + 1)
    assert everything_in(folder) == ["divergence.safetensors", "policy.safetensors", "progress.csv", "run.json"]
    assert record["sha256"] == {
        name: files.sha256_bytes((folder / name).read_bytes()) for name in ("policy.safetensors", "progress.csv")
    }
    (run,) = read_runs(tmp_path)
    assert run.status == "diverged"
    assert train.train(tiny(), 0, "native", tmp_path) == (folder, False)


def test_a_real_learning_rate_that_is_too_large_diverges_or_ends(tmp_path: Path) -> None:
    overrides = ["algorithm.learning_rate=1.0", "algorithm.gamma=1.0", "algorithm.tau=1.0", "reward.scale=1e30"]
    folder, _ = train.train(tiny(overrides=overrides), 0, "native", tmp_path)
    assert read_record(folder)["status"] == "diverged"


def test_many_runs_leave_no_open_files_and_no_threads(tmp_path: Path) -> None:
    config = tiny(overrides=["training.world_steps=16", "algorithm.random_world_steps=8"])

    def count() -> tuple[int, int]:
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    train.train(config, 99, "native", tmp_path, tensorboard=True)
    gc.collect()
    gc.disable()  # which would close in the end what nobody else closes
    try:
        before = count()
        for seed in range(3):
            train.train(config, seed, "native", tmp_path, tensorboard=True)
        after = count()
    finally:
        gc.enable()
    assert after == before


def test_the_tiny_training_is_what_these_tests_take_it_for() -> None:
    config = tiny()
    assert len(TINY) > 5
    assert config.training.curriculum["safety_distance"] is not None
    assert config.algorithm.buffer_world_steps < config.training.world_steps
