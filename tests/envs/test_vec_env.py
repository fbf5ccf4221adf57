"""The native VecEnv keeps the contract that SB3 and its wrappers rely on."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator, world_seeds
from marl_encircle.envs.vec_env import EncirclementVecEnv

B, N = 4, 3


def make(n_worlds: int = B, seed: int | None = 0, **fields: Any) -> EncirclementVecEnv:
    return EncirclementVecEnv(Scenario(**fields), n_worlds=n_worlds, seed=seed)


def still(venv: Any) -> np.ndarray:
    return np.zeros((venv.num_envs, 2), np.float32)


def random_actions(venv: Any, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1, 1, (venv.num_envs, 2)).astype(np.float32)


# --- Slots ------------------------------------------------------------------------------------------------------------


def test_slots_stand_world_by_world_pursuer_by_pursuer() -> None:
    venv = make()
    observations = venv.reset()
    sim = Simulator(Scenario(), B, seed=0)
    sim.reset()
    assert venv.num_envs == B * N
    assert np.array_equal(observations[:, :2], sim.state.pursuers.reshape(-1, 2).astype(np.float32))
    actions = random_actions(venv, np.random.default_rng(1))
    observations, rewards, dones, infos = venv.step(actions)
    sim.step(actions.reshape(B, N, 2))
    assert np.array_equal(observations[:, :2], sim.state.pursuers.reshape(-1, 2).astype(np.float32))
    assert (observations.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, bool)
    assert (observations.shape[0], rewards.shape, dones.shape, len(infos)) == (12, (12,), (12,), 12)


def test_each_pursuer_gets_its_own_reward() -> None:
    venv = EncirclementVecEnv(Scenario(), Reward({"encirclement_radius": 2.0}, scale=1.0), B, seed=0)
    venv.reset()
    _, rewards, _, _ = venv.step(still(venv))
    distance = venv.simulator.measure.target_distance.ravel()
    assert rewards == pytest.approx(-2.0 * np.abs(distance - 0.15), rel=1e-6)


def test_a_round_ends_for_all_slots_of_its_world_and_the_next_begins() -> None:
    venv = make(max_cycles=3, contacts="off")
    venv.reset()
    for step in (1, 2, 3):
        before = venv.simulator.state.pursuers.copy()
        observations, _, dones, infos = venv.step(still(venv))
        assert list(dones) == [step == 3] * 12
    assert np.abs(observations[:, :2] - before.reshape(-1, 2)).max() > 0.1  # elsewhere at once
    for slot, info in enumerate(infos):
        assert info["terminal_observation"][:2] == pytest.approx(before[slot // N, slot % N], abs=1e-6)
        assert (info["is_success"], info["TimeLimit.truncated"], info["round"]["length"]) == (False, True, 3.0)
    assert list(venv.simulator.steps) == [0] * B
    assert not any(venv.step(still(venv))[3])


def test_worlds_end_apart() -> None:
    venv = make(max_cycles=5)
    venv.reset()
    venv.simulator.steps[1] = 3
    venv.step(still(venv))
    observations, _, dones, infos = venv.step(still(venv))
    assert list(np.flatnonzero(dones)) == [3, 4, 5]
    assert [slot for slot, info in enumerate(infos) if info] == [3, 4, 5]
    assert np.array_equal(observations[3:6, :2], venv.simulator.state.pursuers[1].astype(np.float32))


# --- Arrays -----------------------------------------------------------------------------------------------------------


def test_what_a_step_told_stays_as_it_was() -> None:
    venv = make(max_cycles=4)
    kept = [(venv.reset(), None)]
    rng = np.random.default_rng(0)
    copies = [kept[0][0].copy()]
    for _ in range(10):
        observations, rewards, _, infos = venv.step(random_actions(venv, rng))
        kept.append((observations, rewards))
        copies.append(observations.copy())
        for info in infos:
            if info:
                kept.append((info["terminal_observation"], None))
                copies.append(info["terminal_observation"].copy())
    for (observations, _), copy in zip(kept, copies, strict=True):
        assert np.array_equal(observations, copy)


def test_actions_may_be_overwritten_between_the_halves_of_a_step() -> None:
    venv, twin = make(), make()
    venv.reset()
    twin.reset()
    actions = np.ones((12, 2), np.float32)
    venv.step_async(actions)
    actions[:] = -1
    assert np.array_equal(venv.step_wait()[0], twin.step(np.ones((12, 2), np.float32))[0])


@pytest.mark.parametrize("kind", [np.float64, np.float32, list])
def test_actions_of_any_precision_move_alike(kind: Any) -> None:
    venv, twin = make(), make()
    venv.reset()
    twin.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (12, 2))
    given = actions.tolist() if kind is list else actions.astype(kind)
    assert np.array_equal(venv.step(given)[0], twin.step(actions.astype(np.float32))[0])


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e39])  # 1e39 is infinite in single precision
def test_a_number_that_is_not_finite_is_refused_by_name(number: float) -> None:
    venv = make()
    before = venv.reset()
    actions = still(venv).astype(np.float64)
    actions[7, 1] = number
    with pytest.raises(ValueError, match="the action of pursuer_1 in world 2 is not finite"):
        venv.step(actions)
    assert np.array_equal(venv.set_state(venv.get_state()), before)  # nothing has moved


@pytest.mark.parametrize("shape", [(11, 2), (13, 2), (12, 3), (12,), (4, 3, 2)])
def test_a_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    venv = make()
    venv.reset()
    with pytest.raises(ValueError, match=r"actions must have shape \(12, 2\), one row a slot; got"):
        venv.step(np.zeros(shape))


# --- Seeds ------------------------------------------------------------------------------------------------------------


def test_a_seed_decides_all_rounds() -> None:
    def play(venv: EncirclementVecEnv) -> list[np.ndarray]:
        rng = np.random.default_rng(0)
        return [venv.reset()] + [venv.step(random_actions(venv, rng))[0] for _ in range(130)]

    venv = make(seed=7)
    first = play(venv)
    goes_on = play(venv)
    venv.seed(7)
    again = play(venv)
    venv.seed(8)
    other = play(venv)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, goes_on)
    assert not np.isin(first[0][:, 0], other[0][:, 0]).any()


def test_seeds_are_told_slot_by_slot() -> None:
    venv = make()
    assert venv.seed(7) == [seed for seed in world_seeds(7, B) for _ in range(N)]


def test_without_a_seed_every_vec_env_plays_other_worlds() -> None:
    np.random.seed(0)  # noqa: NPY002 - the global stream must not matter
    first = make(seed=None).reset()
    np.random.seed(0)  # noqa: NPY002
    second = make(seed=None).reset()
    assert len(np.unique(np.concatenate([first, second])[:, 0])) == 2 * B * N


def test_a_world_plays_alone_as_it_plays_among_others() -> None:
    many, few = make(n_worlds=9), make(n_worlds=2)
    one, other = many.reset(), few.reset()
    rng = np.random.default_rng(0)
    for _ in range(130):
        assert np.array_equal(one[:6], other)
        actions = random_actions(many, rng)
        one, other = many.step(actions)[0], few.step(actions[:6])[0]


def test_a_saved_state_goes_on_as_if_never_stopped() -> None:
    venv = make(observe_extras=("speed_ratio",))
    venv.reset()
    rng = np.random.default_rng(0)
    for _ in range(35):
        venv.step(random_actions(venv, rng))
    venv.set_difficulty({"speed_ratio": 1.3})
    other = make(observe_extras=("speed_ratio",), seed=99)
    other.reset()
    saved = venv.get_state()
    other.set_state(saved)
    rounds = 0
    for _ in range(100):
        actions = random_actions(venv, rng)
        one, two = venv.step(actions), other.step(actions)
        for array, copy in zip(one[:3], two[:3], strict=True):
            assert np.array_equal(array, copy)
        for info, copy in zip(one[3], two[3], strict=True):
            assert info.get("round") == copy.get("round")
            rounds += "round" in info
    assert rounds >= B * N


# --- What SB3 asks for ------------------------------------------------------------------------------------------------


def test_attributes_and_methods_answer_for_every_slot_asked() -> None:
    venv = make()
    assert venv.get_attr("n_agents") == [N] * 12
    assert venv.get_attr("n_worlds", indices=[0, 5]) == [B, B]
    venv.set_attr("nickname", "x")
    assert venv.nickname == "x"
    assert venv.env_method("set_difficulty", {"speed_ratio": 1.5}, indices=0) == [None]
    assert venv.env_is_wrapped(VecMonitor) == [False] * 12
    assert venv.has_attr("simulator")
    assert not venv.has_attr("simulators")
    assert venv.render_mode is None


def test_there_is_one_simulator() -> None:
    venv = make()
    with pytest.raises(AttributeError, match="'simulator' of 'EncirclementVecEnv' object has no setter"):
        venv.set_attr("simulator", Simulator(Scenario(), B))


def test_options_are_taken_and_forgotten() -> None:
    venv = make()
    venv.set_options({"anything": 1})
    venv.reset()
    assert venv._options == [{}] * 12
    assert venv.reset_infos == [{}] * 12


def test_a_bad_difficulty_is_refused_and_changes_nothing() -> None:
    venv = make(observe_extras=("speed_ratio",))
    with pytest.raises(ValueError, match="speed_ratio must be between 1 and 100; got 0"):
        venv.env_method("set_difficulty", {"speed_ratio": 0})
    with pytest.raises(ValueError, match="too many bodies to place"):
        venv.set_difficulty({"obstacle_radius": 1.9})
    assert (venv.reset()[:, -1] == np.float32(1.1)).all()


def test_a_world_without_any_term_gives_no_reward() -> None:
    venv = EncirclementVecEnv(reward=Reward({}), n_worlds=2)
    venv.reset()
    assert (venv.step(still(venv))[1] == np.zeros(6)).all()


def test_no_world_is_refused() -> None:
    with pytest.raises(ValueError, match="n_worlds must be at least 1; got 0"):
        make(n_worlds=0)


def test_sb3_trains_and_evaluates_on_it() -> None:
    venv = VecMonitor(make(max_cycles=10))
    model = TD3("MlpPolicy", venv, seed=0, learning_starts=24, batch_size=8, policy_kwargs={"net_arch": [8]})
    model.learn(12 * 15)
    assert len(model.ep_info_buffer) == 12
    rewards, lengths = evaluate_policy(model, venv, n_eval_episodes=24, return_episode_rewards=True)
    assert lengths == [10] * 24
    assert np.isfinite(rewards).all()
