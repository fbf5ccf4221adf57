"""Worlds of several settings side by side are those that each setting has alone; what a world lacks is zero."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecMonitor

from marl_encircle.core.observations import layout
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.mixed_vec_env import MixedVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.maddpg import MADDPG

LARGEST = Scenario(pursuers=4, obstacles=2, speed_ratio=1.3, max_cycles=5, observe_extras=("speed_ratio",))
SETTINGS = [{"pursuers": 3, "obstacles": 0, "speed_ratio": 1.1}, {"pursuers": 2, "obstacles": 2}, {}]
SCENARIOS = [replace(LARGEST, **fields) for fields in SETTINGS]
EACH, N = 2, 4
B = EACH * len(SCENARIOS)


def make(seed: int | None = 7) -> MixedVecEnv:
    venv = MixedVecEnv(LARGEST, SCENARIOS, Reward(), B)
    venv.seed(seed)
    return venv


def alone(i: int, seed: int = 7) -> EncirclementVecEnv:
    """The worlds of the i-th setting by themselves."""
    return EncirclementVecEnv(SCENARIOS[i], Reward(), EACH, seed=world_seeds(seed, len(SCENARIOS))[i])


def by_world(values: Any) -> np.ndarray:
    return np.asarray(values).reshape(B, N, *np.shape(values)[1:])


def test_every_world_is_as_it_is_alone() -> None:
    venv, parts = make(), [alone(i) for i in range(len(SCENARIOS))]
    observations, own = by_world(venv.reset()), [part.reset() for part in parts]
    rng = np.random.default_rng(0)
    for step in range(1, 13):
        for i, part in enumerate(parts):
            there = observations[i * EACH : (i + 1) * EACH, : part.n_agents]
            assert_laid_out(there, own[i].reshape(EACH, part.n_agents, -1), i)
        actions = rng.uniform(-1, 1, (B, N, 2)).astype(np.float32)
        slots, rewards, dones, infos = venv.step(actions.reshape(-1, 2))
        observations = by_world(slots)
        for i, part in enumerate(parts):
            worlds, n = slice(i * EACH, (i + 1) * EACH), part.n_agents
            own[i], own_rewards, own_dones, own_infos = part.step(actions[worlds, :n].reshape(-1, 2))
            assert np.array_equal(by_world(rewards)[worlds, :n].ravel(), own_rewards)
            assert np.array_equal(by_world(dones)[worlds, :n].ravel(), own_dones)
            mixed_infos = [infos[(worlds.start + b) * N + p] for b in range(EACH) for p in range(n)]
            for here, mine in zip(mixed_infos, own_infos, strict=True):
                assert {k: v for k, v in here.items() if k != "terminal_observation"} == {
                    k: v for k, v in mine.items() if k != "terminal_observation"
                }
                if mine:
                    assert_laid_out(here["terminal_observation"], mine["terminal_observation"], i)
        if step % 5 == 0:
            assert dones.any()


def assert_laid_out(there: np.ndarray, mine: np.ndarray, i: int) -> None:
    """Observations of the i-th setting lie in those of the largest, and the rest is zero."""
    for name, columns in layout(SCENARIOS[i]).items():
        size, wide = columns.stop - columns.start, layout(LARGEST)[name]
        assert np.array_equal(there[..., wide][..., :size], mine[..., columns]), name
        assert not there[..., wide][..., size:].any(), name


def test_a_pursuer_that_is_not_there_sees_nothing_gets_nothing_and_does_nothing() -> None:
    one, other = make(), make()
    absent = np.zeros((B, N), bool)
    for i, scenario in enumerate(SCENARIOS):
        absent[i * EACH : (i + 1) * EACH, scenario.pursuers :] = True
    assert absent.sum() == EACH * (1 + 2)
    assert np.array_equal(one.reset(), other.reset())
    rng = np.random.default_rng(0)
    for _ in range(7):
        actions = rng.uniform(-1, 1, (B, N, 2)).astype(np.float32)
        observations, rewards, dones, infos = one.step(actions.reshape(-1, 2))
        actions[absent] = np.nan
        again = other.step(actions.reshape(-1, 2))
        assert np.array_equal(observations, again[0])
        assert not by_world(observations)[absent].any()
        assert not by_world(rewards)[absent].any()
        assert (by_world(dones) == by_world(dones)[:, :1]).all(), "all slots of a world end together"
        for slot in np.flatnonzero(absent & by_world(dones)):
            assert not infos[slot]["terminal_observation"].any()
            assert infos[slot]["is_success"] == infos[slot // N * N]["is_success"]
        assert [bool(info.get("absent")) for info in infos] == (absent & by_world(dones)).ravel().tolist()


def test_the_mean_return_of_a_round_is_that_of_the_pursuers_that_are_there() -> None:
    model = MADDPG("MlpPolicy", VecMonitor(make()), learning_starts=1000)
    rewards: list[np.ndarray] = []
    model.learn(5 * B * N, callback=lambda found, _: rewards.append(by_world(found["rewards"])) is None)
    returns = np.sum(rewards, axis=0)
    expected = [returns[b, : SCENARIOS[b // EACH].pursuers].mean() for b in range(B)]
    assert model.ep_info_buffer is not None
    assert [episode["r"] for episode in model.ep_info_buffer] == pytest.approx(expected, abs=1e-5)


def test_worlds_differ_and_a_seed_replays_them() -> None:
    first = by_world(make().reset())[:, 0, :2]
    assert len(np.unique(first, axis=0)) == B
    assert np.array_equal(make().reset(), make().reset())
    assert not np.array_equal(make(8).reset(), make().reset())
    assert len(set(map(tuple, by_world(make(None).reset())[:, 0, :2]))) == B
    venv = make()
    assert np.array_equal(by_world(venv.seed(7)), np.repeat(by_world(venv.seed(7))[:, :1], N, axis=1))


def test_no_world_gets_a_higher_ratio_than_its_own() -> None:
    venv = make()
    venv.set_difficulty({"speed_ratio": 1.2})
    assert_ratios(venv, [1.1, 1.2, 1.2])
    venv.set_difficulty({"speed_ratio": 1.3})
    assert_ratios(venv, [1.1, 1.3, 1.3])


def assert_ratios(venv: MixedVecEnv, expected: list[float]) -> None:
    seen = by_world(venv.reset())[::EACH, 0, layout(LARGEST)["speed_ratio"]]
    assert seen.ravel().tolist() == pytest.approx(expected)


def test_it_goes_on_from_a_saved_state() -> None:
    venv, rng = make(), np.random.default_rng(0)
    venv.reset()
    actions = rng.uniform(-1, 1, (12, B * N, 2)).astype(np.float32)
    for action in actions[:3]:
        last, *_ = venv.step(action)
    state = venv.get_state()
    rest = [venv.step(action)[0] for action in actions[3:]]
    other = make(99)
    assert np.array_equal(other.set_state(state), last)
    assert all(np.array_equal(other.step(action)[0], then) for action, then in zip(actions[3:], rest, strict=True))


def test_sb3s_monitor_accepts_it() -> None:
    venv = VecMonitor(make())
    venv.reset()
    for _ in range(5):
        _, _, dones, infos = venv.step(np.zeros((B * N, 2), np.float32))
    assert dones.all()
    assert all(info["episode"]["l"] == 5 for info in infos)


@pytest.mark.parametrize(("name", "value"), [("scenario", Scenario()), ("reward", Reward({"time": 100.0}))])
def test_rules_and_reward_are_read_but_not_set(name: str, value: Any) -> None:
    venv = make()
    with pytest.raises(AttributeError, match=f"'{name}' of 'MixedVecEnv' object has no setter"):
        venv.set_attr(name, value)
    assert (venv.scenario, venv.reward) == (LARGEST, Reward())


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e39])  # 1e39 is infinite in single precision
@pytest.mark.parametrize(("world", "pursuer"), [(0, 0), (3, 1), (5, 3)])  # of each setting, which have 3, 2 and 4
def test_a_number_that_is_not_finite_is_refused_by_name_and_no_world_moves(
    world: int, pursuer: int, number: float
) -> None:
    venv, twin = make(), make()
    venv.reset()
    twin.reset()
    still = np.zeros((B * N, 2), np.float32)
    actions = np.zeros((B, N, 2))
    actions[world, pursuer, 1] = number
    actions[:2, 3] = actions[2:4, 2:] = np.nan  # nobody is there
    with pytest.raises(ValueError, match=rf"the action of pursuer_{pursuer} in world {world} is not finite: \[ *0\."):
        venv.step(actions.reshape(-1, 2))
    assert np.array_equal(venv.step(still)[0], twin.step(still)[0])


def test_options_are_taken_and_forgotten() -> None:
    venv = make()
    venv.set_options({"anything": 1})
    venv.reset()
    assert venv._options == [{}] * 24
    assert venv.reset_infos == [{}] * 24


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="n_worlds must be a multiple of the 3 settings; got 4"):
        MixedVecEnv(LARGEST, SCENARIOS, Reward(), 4)
    venv = make()
    with pytest.raises(ValueError, match=r"actions must have shape \(24, 2\)"):
        venv.step(np.zeros((6, 2), np.float32))
    with pytest.raises(RuntimeError, match="call reset"):
        venv.step(np.zeros((24, 2), np.float32))
