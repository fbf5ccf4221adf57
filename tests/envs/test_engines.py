"""The native engine and the SuperSuit road are one world: for equal seeds, every number they tell is the same bit."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, VecMonitor, VecNormalize

from marl_encircle.core.observations import layout
from marl_encircle.core.rewards import TERMS, Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv

EVERY_TERM = dict.fromkeys(TERMS, 0.7)
EASY = {"movement_range_limit": 0.6}
"""Fields with which a clumsy chase often succeeds."""


def native(scenario: Scenario, reward: Reward, n_worlds: int) -> EncirclementVecEnv:
    return EncirclementVecEnv(scenario, reward, n_worlds)


def supersuit(scenario: Scenario, reward: Reward, n_worlds: int) -> SuperSuitVecEnv:
    return SuperSuitVecEnv(lambda: parallel_env(scenario, reward), n_worlds)


ENGINES = (native, supersuit)


class Chase:
    """Runs at the target, now and then to a side: a policy that both fails and succeeds."""

    def __init__(self, scenario: Scenario, seed: int = 0) -> None:
        self.target = layout(scenario)["target"]
        self.rng = np.random.default_rng(seed)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        wish = 4 * observations[:, self.target] + self.rng.normal(0, 0.7, (len(observations), 2))
        return np.clip(wish, -1, 1).astype(np.float32)

    def predict(self, observations: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self(observations), None


def play(venv: VecEnv, policy: Chase, n_steps: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, list[Any]]]:
    observations = venv.reset()
    yield observations, np.zeros(venv.num_envs), np.zeros(venv.num_envs, bool), venv.reset_infos
    for _ in range(n_steps):
        outcome = venv.step(policy(observations))
        observations = outcome[0]
        yield outcome


@pytest.mark.parametrize("make", ENGINES)
def test_no_step_comes_before_the_first_reset(make: Any) -> None:
    venv = make(Scenario(), Reward(), 2)
    actions = np.zeros((6, 2), np.float32)
    with pytest.raises(RuntimeError, match=r"no round is running: call reset\(\) first"):
        venv.step(actions)
    venv.reset()
    venv.step(actions)


@pytest.mark.parametrize(("name", "value"), [("scenario", Scenario(pursuers=4)), ("reward", Reward({"time": 100.0}))])
@pytest.mark.parametrize("make", ENGINES)
def test_rules_and_reward_are_read_but_not_set(make: Any, name: str, value: Any) -> None:
    venv = VecMonitor(CurriculumVecEnv(make(Scenario(), Reward(), 2), {}))
    with pytest.raises(AttributeError, match=f"'{name}' of 'Encirclement(Vec)?Env' object has no setter"):
        venv.set_attr(name, value)
    assert venv.get_attr(name) == [type(value)()] * 6


def assert_equal_infos(native_info: dict[str, Any], info: dict[str, Any], done: bool) -> None:
    if not done:
        # The native engine does not spend time on saying that nothing has happened.
        assert native_info == {}
        assert not any(info.values())
        return
    assert native_info.keys() == info.keys() == {"is_success", "TimeLimit.truncated", "terminal_observation", "round"}
    last, other_last = native_info.pop("terminal_observation"), info.pop("terminal_observation")
    assert last.dtype == other_last.dtype
    assert np.array_equal(last, other_last)
    assert native_info == info
    assert all(type(info[key]) is type(native_info[key]) is bool for key in ("is_success", "TimeLimit.truncated"))


CASES: list[tuple[int, Scenario, Reward]] = [
    (4, Scenario(**EASY), Reward()),
    (3, Scenario(pursuers=4, obstacles=3, **EASY), Reward(EVERY_TERM, closure="pursuers")),
    (2, Scenario(pursuers=3, obstacles=0, max_cycles=7), Reward(EVERY_TERM, two_stage=False, scale=1.0)),
    (1, Scenario(pursuers=2, obstacles=2, turn_order="simultaneous", contacts="hard"), Reward()),
    (2, Scenario(pursuers=1, obstacles=1, dynamics="first_order"), Reward(EVERY_TERM)),
    (2, Scenario(pursuers=10, obstacles=1, scene="concave", obstacle_radius=0.15, integration="mpe2"), Reward()),
    (
        3,
        Scenario(
            pursuers=5,
            obstacles=1,
            scene="tunnel",
            obstacle_radius=0.12,
            composite_unit=False,
            placement="overlapping",
            observe_extras=("occupied_angle", "stage", "speed_ratio"),
            **EASY,
        ),
        Reward({"overall_angle": 1.0}),
    ),
]


@pytest.mark.parametrize(("n_worlds", "scenario", "reward"), CASES)
def test_equal_seeds_give_equal_bits(n_worlds: int, scenario: Scenario, reward: Reward) -> None:
    fast, slow = native(scenario, reward, n_worlds), supersuit(scenario, reward, n_worlds)
    assert fast.observation_space == slow.observation_space
    assert fast.action_space == slow.action_space
    assert (fast.num_envs, fast.n_agents, fast.n_worlds) == (slow.num_envs, slow.n_agents, slow.n_worlds)
    assert list(fast.agents) == list(slow.agents)
    assert fast.seed(11) == slow.seed(11)
    ends = 0
    both = zip(play(fast, Chase(scenario), 320), play(slow, Chase(scenario), 320), strict=True)
    for step, (one, other) in enumerate(both):
        if step in (50, 130, 131):
            for venv in (fast, slow):
                venv.env_method("set_difficulty", {"speed_ratio": 1.0 + step / 1000, "safety_distance": step / 500})
        for array, other_array in zip(one[:3], other[:3], strict=True):
            assert array.dtype == other_array.dtype
            assert np.array_equal(array, other_array)
        for native_info, info, done in zip(one[3], other[3], one[2], strict=True):
            assert_equal_infos(native_info, info, done)
        ends += one[2].sum()
    assert one[1].dtype == np.float32
    assert ends >= n_worlds * scenario.pursuers * 5


def test_the_cases_above_know_success_and_failure() -> None:
    won = lost = 0
    for n_worlds, scenario, reward in CASES:
        venv = native(scenario, reward, n_worlds)
        venv.seed(11)
        for _, _, dones, infos in play(venv, Chase(scenario), 320):
            for slot in np.flatnonzero(dones):
                won += infos[slot]["is_success"]
                lost += infos[slot]["TimeLimit.truncated"]
    assert won > 50
    assert lost > 50


def test_reseeding_within_a_round_acts_on_both_at_the_next_reset() -> None:
    scenario, reward = Scenario(), Reward()
    fast, slow = native(scenario, reward, 3), supersuit(scenario, reward, 3)
    for seed in (1, 2):
        fast.seed(seed)
        slow.seed(seed)
        for one, other in zip(play(fast, Chase(scenario), 70), play(slow, Chase(scenario), 70), strict=True):
            assert np.array_equal(one[0], other[0])


def test_a_world_of_the_vec_env_is_the_environment_with_its_seed() -> None:
    venv = native(Scenario(), Reward(), 5)
    venv.seed(3)
    policy = Chase(venv.scenario)
    env = parallel_env()
    alone, _ = env.reset(seed=world_seeds(3, 5)[2])
    observations = venv.reset()
    for _ in range(150):
        assert np.array_equal(observations[6:9], list(alone.values()))
        actions = policy(observations)
        observations = venv.step(actions)[0]
        alone, *_ = env.step(dict(zip(env.agents, actions[6:9], strict=True)))
        if not env.agents:
            alone, _ = env.reset()


@pytest.mark.parametrize("engine", ENGINES)
def test_time_limits_are_stored_as_truncations(engine: Any) -> None:
    scenario = Scenario(pursuers=4, max_cycles=20, **EASY)
    venv = engine(scenario, Reward(), 4)
    venv.seed(0)
    buffer = ReplayBuffer(16 * 150, venv.observation_space, venv.action_space, n_envs=16)
    policy = Chase(scenario)
    observations, successes, limits = venv.reset(), 0, 0
    for _ in range(150):
        actions = policy(observations)
        following, rewards, dones, infos = venv.step(actions)
        buffer.add(observations, following, actions, rewards, dones, infos)
        observations = following
        successes += sum(info["is_success"] for info, done in zip(infos, dones, strict=True) if done)
        limits += sum(info["TimeLimit.truncated"] for info, done in zip(infos, dones, strict=True) if done)
    assert successes > 0
    assert limits > 0
    assert buffer.timeouts.sum() == limits
    assert (buffer.dones * (1 - buffer.timeouts)).sum() == successes


@pytest.mark.parametrize("engine", ENGINES)
def test_worlds_begin_apart(engine: Any) -> None:
    venv = engine(Scenario(), Reward(), 40)
    for seed in (None, 0):
        venv.seed(seed)
        assert len(np.unique(venv.reset()[::3], axis=0)) == 40


@pytest.mark.parametrize("engine", ENGINES)
def test_the_monitor_sums_up_rewards_and_steps(engine: Any) -> None:
    scenario = Scenario(max_cycles=12, **EASY)
    venv = VecMonitor(engine(scenario, Reward(EVERY_TERM), 3), info_keywords=("is_success",))
    venv.seed(0)
    totals, lengths, episodes = np.zeros(9), np.zeros(9, int), 0
    for step, (_, rewards, dones, infos) in enumerate(play(venv, Chase(scenario), 100)):
        totals += rewards
        lengths += step > 0
        for slot in np.flatnonzero(dones):
            episode, figures = infos[slot]["episode"], infos[slot]["round"]
            assert episode["r"] == pytest.approx(totals[slot], rel=1e-5)
            assert episode["l"] == lengths[slot] == figures["length"]
            totals[slot], lengths[slot] = 0.0, 0
            episodes += 1
        for b in np.unique(np.flatnonzero(dones) // 3):
            shares = [value for key, value in figures_of(infos, b).items() if key.startswith("reward/")]
            returns = [infos[slot]["episode"]["r"] for slot in range(3 * b, 3 * b + 3)]
            assert sum(shares) == pytest.approx(np.mean(returns), rel=1e-4)
    assert episodes >= 9 * 8


def figures_of(infos: list[dict[str, Any]], world: int) -> dict[str, float]:
    figures: dict[str, float] = infos[3 * world]["round"]
    return figures


def test_normalised_worlds_are_equal() -> None:
    scenario, reward = Scenario(**EASY), Reward()
    pair = [VecNormalize(VecMonitor(engine(scenario, reward, 2))) for engine in ENGINES]
    for venv in pair:
        venv.seed(5)
    for one, other in zip(*(play(venv, Chase(scenario), 200) for venv in pair), strict=True):
        assert np.array_equal(one[0], other[0])
        assert np.array_equal(one[1], other[1])
        for slot in np.flatnonzero(one[2]):
            last, other_last = (infos[slot]["terminal_observation"] for infos in (one[3], other[3]))
            assert np.array_equal(last, other_last)
            assert np.abs(last).max() <= 10.0  # VecNormalize clips


def test_evaluations_are_equal() -> None:
    scenario, reward = Scenario(**EASY), Reward()
    results = []
    for engine in ENGINES:
        venv = VecMonitor(engine(scenario, reward, 4))
        venv.seed(1)
        results.append(evaluate_policy(Chase(scenario), venv, n_eval_episodes=24, return_episode_rewards=True))
    assert results[0] == results[1]
    assert len(results[0][0]) == 24


# --- Nothing that is not finite ---------------------------------------------------------------------------------------

WORST: list[dict[str, Any]] = [
    {},
    {"placement": "overlapping", "contacts": "off", "pursuers": 8, "obstacles": 6, "obstacle_radius": 0.15},
    {"placement": "overlapping", "contacts": "hard", "pursuers": 8, "obstacles": 6, "obstacle_radius": 0.15},
    {"placement": "overlapping", "half_width": 0.2, "obstacle_radius": 0.04, "obstacles": 4, "pursuers": 4},
    {"speed_ratio": 1.0, "safety_distance": 0.0, "obstacles": 0, "contacts": "off"},
    {"speed_ratio": 1.0 + 1e-12, "repulsion_from": "surface", "path_rule": "relaxed"},
    {"speed_ratio": 100.0, "max_speed": 1e-6},
    {"dynamics": "first_order", "turn_order": "simultaneous", "integration": "mpe2", "contact_force": 1e6},
    {"pursuer_radius": 0.0, "target_radius": 0.0, "obstacle_radius": 1e-6, "direction_softening": 1e-9},
    {"target": "still", "damping": 1.0, "pursuers": 1, "scene": "concave", "obstacle_radius": 0.15},
]


def fuzz(venv: VecEnv, n_steps: int, seed: int) -> None:
    """Play actions of every size; raises if any number told is not finite or out of its space."""
    rng = np.random.default_rng(seed)
    venv = VecCheckNan(venv, raise_exception=True)
    venv.seed(seed)
    venv.reset()
    space = venv.observation_space
    toward = rng.uniform(-1, 1, (venv.num_envs, 2))
    for step in range(n_steps):
        if step % 10 == 0:
            toward = rng.uniform(-1, 1, (venv.num_envs, 2)) * 10.0 ** rng.integers(-30, 30)
        observations, rewards, dones, infos = venv.step(toward.astype(np.float32))
        assert np.isfinite(rewards).all()
        assert (np.abs(observations) <= space.high).all()
        for slot in np.flatnonzero(dones):
            assert np.isfinite(infos[slot]["terminal_observation"]).all()
            assert np.isfinite(list(infos[slot]["round"].values())).all()


@pytest.mark.parametrize("fields", WORST, ids=str)
def test_the_native_engine_stays_finite(fields: dict[str, Any]) -> None:
    scenario = Scenario(**fields)
    fuzz(native(scenario, Reward(EVERY_TERM), 64), 160, seed=0)  # 10 x 10,240 world-steps


@pytest.mark.parametrize("fields", WORST, ids=str)
def test_the_supersuit_road_stays_finite(fields: dict[str, Any]) -> None:
    scenario = Scenario(**fields)
    fuzz(supersuit(scenario, Reward(EVERY_TERM), 4), 130, seed=0)  # 10 x 520 world-steps


@pytest.mark.parametrize("overlap", ["pursuer on target", "all on one point", "target in an obstacle"])
def test_bodies_on_one_point_give_finite_numbers(overlap: str) -> None:
    venv = native(Scenario(contacts="soft"), Reward(EVERY_TERM), 4)
    venv.reset()
    state = venv.simulator.state
    if overlap == "pursuer on target":
        state.pursuers[:, 0] = state.target
    elif overlap == "all on one point":
        state.target[:] = state.discs[:, 0, :2]
        state.pursuers[:] = state.target[:, None]
    else:
        state.target[:] = state.discs[:, 0, :2]
    for _ in range(50):
        observations, rewards, _, _ = venv.step(np.zeros((venv.num_envs, 2)))
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
