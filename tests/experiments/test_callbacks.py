"""What TensorBoard shows, and the small guards beside a training."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_runs import contents, finished, tiny

from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import train
from marl_encircle.experiments.callbacks import Checkpointer, ended_rounds
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.signals import Stopped, stop_signals

EASY = tiny(pursuers=5, overrides=["scenario.movement_range_limit=3.0"])
"""A setting in which beginners succeed now and then."""

Scalars = dict[str, list[tuple[int, float]]]


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scalars, list[dict[str, Any]]]:
    """A tiny training with a log every 10 rounds: what its event files hold, and the rounds that ended."""
    out = tmp_path_factory.mktemp("logged")
    rounds: list[dict[str, Any]] = []

    class Notebook(train.RoundLogger):
        def _on_step(self) -> bool:
            n = self.curriculum.n_agents
            worlds = np.flatnonzero(self.locals["dones"][::n])
            for world, info in zip(worlds, ended_rounds(self, self.curriculum), strict=True):
                slots = self.locals["infos"][world * n : (world + 1) * n]
                rounds.append({**info, "return_mean": np.mean([slot["episode"]["r"] for slot in slots])})
            return super()._on_step()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "ROUNDS_PER_LOG", 10)
        patch.setattr(train, "RoundLogger", Notebook)
        folder, _ = train.train(EASY, 0, "native", out, tensorboard=True)
    return read_events(folder), rounds


def read_events(folder: Path) -> Scalars:
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {tag: [(each.step, each.value) for each in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_every_figure_is_there(logged: Any) -> None:
    scalars, _ = logged
    terms = load_config("ours").reward.build().active
    expected = {f"reward/{name}" for name in terms}
    expected |= {
        f"rounds/{name}"
        for name in (
            "success_all",
            "success_pursuers",
            "length",
            "mean_episode_length",
            "occupied_angle",
            "sigma_c",
            "contacts_pursuers",
            "contacts_obstacles",
        )
    }
    expected |= {"curriculum/safety_distance", "train/actor_loss", "train/critic_loss"}
    expected |= {"time/update_ms", "time/world_steps", "time/world_steps_per_second", "time/fps"}
    expected |= {"rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate"}
    expected |= {
        f"eval/{name}" for name in ("success", "mean_episode_length", "success_all", "success_pursuers", "sigma_c")
    }
    assert expected <= scalars.keys()
    assert all(value == value for points in scalars.values() for _, value in points)  # no nan  # fmt: skip


def test_the_mean_episode_length_is_over_successful_rounds_only(logged: Any) -> None:
    scalars, rounds = logged
    assert {each["is_success"] for each in rounds} == {True, False}
    assert len(scalars["rounds/length"]) >= 2
    # every round belongs to one log, in the order in which they ended
    ends = [step for step, _ in scalars["rounds/length"]]
    assert ends[-1] == 5 * 400
    lengths = [each["round"]["length"] for each in rounds if each["is_success"]]
    for _, value in scalars["rounds/mean_episode_length"]:
        assert min(lengths) <= value <= max(lengths)
    assert max(each["round"]["length"] for each in rounds) == 20
    assert max(lengths) < 20
    assert all(length > min(lengths) for _, length in scalars["rounds/length"])
    assert scalars["rounds/mean_episode_length"] != scalars["rounds/length"]


def test_a_round_counts_once_however_many_pursuers_it_has(logged: Any) -> None:
    scalars, rounds = logged
    assert 20 <= len(rounds) <= 80  # 4 worlds of 100 steps, at most 20 a round
    share = [value for _, value in scalars["rounds/success_all"]]
    assert all(0 <= value <= 1 for value in share)


def test_the_reward_terms_add_up_to_the_return(logged: Any) -> None:
    _, rounds = logged
    for each in rounds:
        terms = sum(value for name, value in each["round"].items() if name.startswith("reward/"))
        assert terms == pytest.approx(each["return_mean"], rel=1e-5)


def test_the_curriculum_goes_down_to_its_end(logged: Any) -> None:
    values = [value for _, value in logged[0]["curriculum/safety_distance"]]
    assert values == sorted(values, reverse=True)
    assert values[0] > values[-1] == pytest.approx(0.11)


def test_times_are_those_of_this_training(logged: Any) -> None:
    scalars, _ = logged
    assert scalars["time/world_steps"][-1] == (2000, 400)
    assert all(0 < value < 1000 for _, value in scalars["time/update_ms"]), "without start-up and compilation"
    assert all(value > 0 for _, value in scalars["time/world_steps_per_second"])


def test_a_training_shorter_than_a_log_still_leaves_one(tmp_path: Path) -> None:
    folder, _ = train.train(tiny(overrides=["training.world_steps=100"]), 0, "native", tmp_path, tensorboard=True)
    assert [step for step, _ in read_events(folder)["eval/success"]] == [300]


# signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_is_kept_and_the_second_acts_as_usual(number: int) -> None:
    acted: list[int] = []
    former = signal.signal(number, lambda n, _: acted.append(n))
    try:
        with stop_signals() as caught:
            os.kill(os.getpid(), number)
            assert (caught, acted) == ([number], [])
            os.kill(os.getpid(), number)
            assert (caught, acted) == ([number], [number])
        os.kill(os.getpid(), number)
        assert (caught, acted) == ([number], [number, number])
    finally:
        signal.signal(number, former)


def test_the_handlers_come_back_whatever_happens() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(ZeroDivisionError), stop_signals():
        raise ZeroDivisionError
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_training_in_another_thread_is_the_same_one(tmp_path: Path) -> None:
    """Python leaves signals to the main thread."""
    with ThreadPoolExecutor(max_workers=1) as threads:
        folder, _ = threads.submit(train.train, tiny(), 0, out=tmp_path).result()
    assert contents(folder) == contents(finished())


def started(callback: BaseCallback) -> BaseCallback:
    callback.init_callback(SimpleNamespace(get_env=lambda: None, logger=None))  # type: ignore[arg-type]
    return callback


def test_checkpoints_come_at_their_interval_and_before_an_end() -> None:
    saved: list[int] = []
    caught: list[int] = []
    never = started(Checkpointer(lambda: saved.append(1), 1e9, caught))
    always = started(Checkpointer(lambda: saved.append(2), 0.0, caught))
    for callback in (never, always, always):
        callback.on_rollout_start()
    assert saved == [2, 2]
    caught.append(signal.SIGTERM)
    with pytest.raises(Stopped) as stopped:
        never.on_rollout_start()
    assert saved == [2, 2, 1]
    assert stopped.value.signum == signal.SIGTERM


@pytest.mark.parametrize("cost", [0.01, 0.8, 5.0, 30.0])
def test_checkpoints_take_less_than_three_in_a_hundred_of_the_time(cost: float) -> None:
    now, spent, ends = 0.0, 0.0, [0.0]

    def save() -> None:  # takes longer as the replay buffer fills, up to twice as long
        nonlocal now, spent
        seconds = cost * (1 + min(1, now / 400))
        now, spent = now + seconds, spent + seconds
        ends.append(now)

    checkpointer = started(Checkpointer(save, None, [], lambda: now))
    while now < 6 * 3600:
        checkpointer.on_rollout_start()
        now += 1.0
        if len(ends) > 2 or now > 100 * cost:  # the first one has to show how long it takes
            assert spent <= 0.03 * now
    gaps = np.diff(ends)
    assert gaps.min() >= 60
    assert gaps[-1] <= max(62, 51 * 2 * cost), "seldom, but not more seldom than that"


def test_a_training_that_cannot_save_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "not saved: No space left on device", "checkpoint.safetensors")

    monkeypatch.setattr(train.checkpoint, "save_tree", full)
    step_wait = CurriculumVecEnv.step_wait
    with pytest.raises(OSError, match="No space left"):
        train.train(tiny(), 0, "native", tmp_path, checkpoint_every=0.0)
    assert CurriculumVecEnv.step_wait is step_wait
    assert not (train.run_folder(tiny(), 0, tmp_path) / "run.json").exists()
