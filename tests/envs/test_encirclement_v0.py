"""The PettingZoo environment: PettingZoo's own tests, the checks that these leave out, and every error's words."""

import pickle
from dataclasses import replace
from typing import Any

import faulty_worlds
import numpy as np
import pettingzoo
import pytest
from pettingzoo_tests import api_test, max_cycles_test, parallel_api_test, parallel_seed_test, state_test
from world_checks import check_worlds, fingerprint, fingerprints_elsewhere, random_actions

import marl_encircle
from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.encirclement_v0 import parallel_env

ID = "marl_encircle/encirclement-v0"


def still(env: Any) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2, np.float32) for agent in env.agents}


# --- PettingZoo's own tests -------------------------------------------------------------------------------------------

VARIANTS: list[dict[str, Any]] = [
    {},
    {"pursuers": 1, "obstacles": 0},
    {"pursuers": 10, "obstacles": 3},
    {"scene": "concave", "obstacle_radius": 0.15, "composite_unit": False},
]


@pytest.mark.parametrize("fields", VARIANTS, ids=str)
def test_pettingzoo_accepts_the_parallel_environment(fields: dict[str, Any]) -> None:
    parallel_api_test(parallel_env(**fields), num_cycles=200)
    parallel_seed_test(lambda: parallel_env(**fields), num_cycles=60)


@pytest.mark.parametrize("fields", VARIANTS, ids=str)
def test_pettingzoo_accepts_the_turn_based_environment(fields: dict[str, Any]) -> None:
    api_test(encirclement_v0.env(**fields), num_cycles=200)
    api_test(encirclement_v0.raw_env(**fields), num_cycles=200)


def test_pettingzoo_accepts_the_time_limit_and_the_state() -> None:
    max_cycles_test(encirclement_v0)
    state_test(encirclement_v0.env(), parallel_env())


def test_both_kinds_are_registered() -> None:
    assert marl_encircle.__doc__
    parallel = pettingzoo.make("parallel", ID, max_cycles=7, speed_ratio=1.3)
    assert isinstance(parallel, encirclement_v0.EncirclementEnv)
    assert (parallel.scenario.max_cycles, parallel.scenario.speed_ratio) == (7, 1.3)
    in_turn = pettingzoo.make("aec", ID)
    assert isinstance(in_turn, pettingzoo.AECEnv)
    assert in_turn.possible_agents == ["pursuer_0", "pursuer_1", "pursuer_2"]
    assert str(in_turn) == str(parallel) == "encirclement_v0"


# --- What PettingZoo's tests leave out --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", faulty_worlds.SOUND)
def test_every_step_keeps_to_the_spaces(name: str) -> None:
    check_worlds(faulty_worlds.SOUND[name](), episodes=5)


@pytest.mark.parametrize("fault", faulty_worlds.SEEN_IN_ONE_RUN)
def test_the_check_of_every_step_finds(fault: Any) -> None:
    with pytest.raises(AssertionError):
        check_worlds(fault())


@pytest.fixture(scope="module")
def elsewhere() -> dict[str, str]:
    return fingerprints_elsewhere("faulty_worlds", "REPLAYED")


@pytest.mark.parametrize("name", faulty_worlds.SOUND)
def test_a_seed_replays_all_episodes_in_another_process(name: str, elsewhere: dict[str, str]) -> None:
    assert fingerprint(faulty_worlds.SOUND[name]) == elsewhere[name]


@pytest.mark.parametrize("fault", faulty_worlds.SEEN_IN_A_REPLAY)
def test_the_replay_finds(fault: Any, elsewhere: dict[str, str]) -> None:
    assert fingerprint(fault) != elsewhere[fault.__name__]


def check_seeds_differ(env: Any) -> None:
    firsts = [env.reset(seed=seed)[0]["pursuer_0"].tobytes() for seed in range(10)]
    firsts += [env.reset()[0]["pursuer_0"].tobytes() for _ in range(10)]
    assert len(set(firsts)) == 20


def test_every_seed_and_every_episode_begins_elsewhere() -> None:
    check_seeds_differ(parallel_env())
    with pytest.raises(AssertionError):
        check_seeds_differ(faulty_worlds.FirstWorldIsAlwaysTheSame())


@pytest.mark.parametrize("fault", faulty_worlds.MISSED_BY_PETTINGZOO)
def test_pettingzoo_misses(fault: Any) -> None:
    """When this fails, PettingZoo has learnt to find the fault."""
    parallel_api_test(fault(), num_cycles=200)
    parallel_seed_test(fault, num_cycles=60)


def test_a_round_starts_anew_after_a_seed_whatever_was_played_before() -> None:
    fresh, used = parallel_env(), parallel_env()
    used.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(17):
        used.step(random_actions(used, rng))
    for a, b in zip(fresh.reset(seed=7)[0].values(), used.reset(seed=7)[0].values(), strict=True):
        assert np.array_equal(a, b)


def test_without_a_seed_every_environment_plays_other_rounds() -> None:
    np.random.seed(0)  # noqa: NPY002 - the global stream must not matter
    first = parallel_env().reset()[0]["pursuer_0"]
    np.random.seed(0)  # noqa: NPY002
    assert not np.array_equal(first, parallel_env().reset()[0]["pursuer_0"])


# --- What a step tells ------------------------------------------------------------------------------------------------


def test_rewards_and_ends_are_those_of_the_simulator() -> None:
    env = parallel_env(reward={"time": 3.0}, max_cycles=2)
    env.reset(seed=0)
    for last in (False, True):
        _, rewards, terminations, truncations, infos = env.step(still(env))
        # weight 3, scale 0.05, -1 at every step: -0.15
        assert rewards == {agent: pytest.approx(-0.15) for agent in env.possible_agents}
        assert set(truncations.values()) == {last}
        assert set(terminations.values()) == {False}
    figures = infos["pursuer_0"]["round"]
    assert figures["length"] == 2.0
    assert figures["reward/time"] == pytest.approx(-0.30)
    assert (figures["success_all"], figures["success_pursuers"]) == (0.0, 0.0)
    assert all(info["round"] == figures for info in infos.values())


def test_success_terminates_also_at_the_time_limit() -> None:
    # Any area is small enough, and with twenty pursuers some round begins with the target in their midst.
    env = parallel_env(
        pursuers=20, obstacles=0, speed_ratio=1.0, movement_range_limit=100.0, max_cycles=1, reward={"completion": 1.0}
    )
    for seed in range(20):
        env.reset(seed=seed)
        _, rewards, terminations, truncations, infos = env.step(still(env))
        if terminations["pursuer_0"]:
            break
    assert set(terminations.values()) == {True}
    assert set(truncations.values()) == {False}
    assert all(info["is_success"] is True for info in infos.values())
    assert rewards["pursuer_0"] == pytest.approx(0.05)
    assert infos["pursuer_0"]["round"]["success_all"] == 1.0


def test_the_closure_rule_decides_what_counts_as_success() -> None:
    ends = {}
    for closure in ("all", "pursuers"):
        reward = Reward({"time": 1.0}, closure=closure)  # type: ignore[arg-type]
        env = parallel_env(reward=reward, obstacles=8, obstacle_radius=0.15, movement_range_limit=100.0, max_cycles=1)
        ends[closure] = 0
        for seed in range(40):
            env.reset(seed=seed)
            _, _, terminations, _, infos = env.step(still(env))
            ends[closure] += terminations["pursuer_0"]
            assert terminations["pursuer_0"] == (infos["pursuer_0"]["round"][f"success_{closure}"] == 1.0)
    assert ends["all"] > ends["pursuers"]


def test_the_state_is_the_whole_world() -> None:
    env = parallel_env(pursuers=2, obstacles=1)
    observations, _ = env.reset(seed=3)
    env.step({agent: np.array([1.0, -1.0], np.float32) for agent in env.agents})
    sim = Simulator(Scenario(pursuers=2, obstacles=1))
    sim.seed([3])
    sim.reset()
    sim.step(np.array([[[1.0, -1.0]] * 2]))
    expected = [
        *sim.state.pursuers.ravel(),
        *sim.state.velocities.ravel(),
        *sim.state.target[0],
        *sim.state.discs[0, 0],
    ]
    assert env.state() == pytest.approx(np.array(expected, np.float32), abs=0)
    assert env.state().shape == env.state_space.shape == (4 * 2 + 2 + 3,)
    assert env.state_space is env.state_space
    assert observations["pursuer_0"].shape == (4 + 4 * (1 + 1 + 1),)


def test_actions_beyond_their_space_are_clipped() -> None:
    env, twin = parallel_env(), parallel_env()
    env.reset(seed=1)
    twin.reset(seed=1)
    far = env.step(dict.fromkeys(env.agents, np.array([7.0, -1e30])))
    near = twin.step(dict.fromkeys(twin.agents, np.array([1.0, -1.0])))
    assert np.array_equal(list(far[0].values()), list(near[0].values()))


def test_actions_may_come_in_any_order_and_as_lists() -> None:
    env, twin = parallel_env(), parallel_env()
    env.reset(seed=1)
    twin.reset(seed=1)
    actions = random_actions(env, np.random.default_rng(0))
    one = env.step(actions)[0]
    other = twin.step({agent: actions[agent].tolist() for agent in reversed(twin.agents)})[0]
    assert np.array_equal(list(one.values()), list(other.values()))


def test_difficulty_changes_at_the_next_round_and_stays() -> None:
    env = parallel_env(observe_extras=("speed_ratio",))
    env.reset(seed=0)
    env.set_difficulty({"speed_ratio": 1.5})
    assert env.step(still(env))[0]["pursuer_0"][-1] == np.float32(1.1)
    for _ in range(2):
        assert env.reset()[0]["pursuer_0"][-1] == np.float32(1.5)
    env.set_difficulty({"obstacle_radius": 0.1})
    env.reset()
    assert env.state()[-1] == np.float32(0.1)
    assert env.reset()[0]["pursuer_0"][-1] == np.float32(1.5)


def test_an_environment_travels_to_another_process_as_it_is() -> None:
    env = parallel_env()
    env.reset(seed=4)
    env.step(still(env))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(100):
        if not env.agents:
            assert np.array_equal(env.reset()[0]["pursuer_0"], copy.reset()[0]["pursuer_0"])
        assert np.array_equal(list(env.step(still(env))[0].values()), list(copy.step(still(copy))[0].values()))


@pytest.mark.parametrize("steps", [0, 17, 60])
def test_a_saved_state_goes_on_as_if_never_stopped(steps: int) -> None:
    env, other = parallel_env(), parallel_env(render_mode="rgb_array")
    env.reset(seed=4)
    other.reset(seed=5)
    other.step(still(other))
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(random_actions(env, rng))
    other.set_state(env.get_state())
    assert other.agents == env.agents
    assert other._trail == []  # it has not seen this round's past
    for _ in range(100):
        if not env.agents:
            assert np.array_equal(env.reset()[0]["pursuer_0"], other.reset()[0]["pursuer_0"])
        actions = random_actions(env, rng)
        one, two = env.step(actions), other.step(actions)
        assert np.array_equal(list(one[0].values()), list(two[0].values()))
        assert one[1:] == two[1:]


def test_the_turn_based_environment_plays_the_same_round() -> None:
    env, in_turn = parallel_env(), encirclement_v0.env()
    env.reset(seed=9)
    in_turn.reset(seed=9)
    rng = np.random.default_rng(0)
    while env.agents:
        actions = random_actions(env, rng)
        observations, rewards, _, truncations, _ = env.step(actions)
        for agent in env.possible_agents:
            in_turn.step(actions[agent])
        for agent in env.possible_agents:
            assert np.array_equal(in_turn.observe(agent), observations[agent])
        assert in_turn.rewards == rewards
        assert in_turn.truncations == truncations


# --- Making one -------------------------------------------------------------------------------------------------------


def test_fields_change_the_scenario_given() -> None:
    scenario = Scenario(pursuers=4, speed_ratio=1.2)
    env = parallel_env(scenario, max_cycles=10, obstacles=0)
    assert env.scenario == replace(scenario, max_cycles=10, obstacles=0)
    assert parallel_env().scenario == Scenario()
    assert parallel_env().scenario.max_cycles == 60


def test_terms_are_weights_or_a_reward() -> None:
    assert parallel_env(reward={"time": 2.0}).reward == Reward({"time": 2.0})
    reward = Reward({"time": 2.0}, closure="pursuers", scale=1.0)
    assert parallel_env(reward=reward).reward is reward
    assert parallel_env().reward == Reward()


@pytest.mark.parametrize(("name", "value"), [("scenario", Scenario(pursuers=4)), ("reward", Reward({"time": 100.0}))])
def test_rules_and_reward_are_read_but_not_set(name: str, value: Any) -> None:
    env = parallel_env()
    with pytest.raises(AttributeError, match=f"'{name}' of 'EncirclementEnv' object has no setter"):
        setattr(env, name, value)
    assert getattr(env, name) == type(value)()


def test_spaces_are_kept_and_one_for_each_agent() -> None:
    env = parallel_env()
    for space in (env.observation_space, env.action_space):
        assert space("pursuer_0") is space("pursuer_0")
        assert space("pursuer_0") == space("pursuer_1")
        assert space("pursuer_0") is not space("pursuer_1")


def test_metadata_say_what_it_is() -> None:
    assert parallel_env().metadata == {
        "name": "encirclement_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
        "render_fps": 10,
    }


def test_an_unknown_field_is_an_error_that_names_the_nearest() -> None:
    with pytest.raises(TypeError, match="scenario must be a Scenario or None; got 'default'"):
        parallel_env("default")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"speed_rato: unknown scenario field; did you mean speed_ratio\?"):
        parallel_env(speed_rato=1.3)


def test_an_unknown_term_is_an_error_that_names_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"terms\.overal_angle: unknown reward term; did you mean overall_angle\?"):
        parallel_env(reward={"overal_angle": 1.0})
    with pytest.raises(ValueError, match=r"terms must be a mapping of terms to their weights; got \['time'\]"):
        parallel_env(reward=["time"])  # type: ignore[arg-type]


def test_a_value_out_of_range_is_an_error() -> None:
    with pytest.raises(ValueError, match="max_cycles must be between 1 and 100000; got 0"):
        parallel_env(max_cycles=0)
    with pytest.raises(ValueError, match="render_mode must be None or one of human, rgb_array; got 'ansi'"):
        parallel_env(render_mode="ansi")
    with pytest.raises(ValueError, match="speed_ratoi is no difficulty; known: speed_ratio, safety"):
        parallel_env().set_difficulty({"speed_ratoi": 1.1})  # type: ignore[typeddict-unknown-key]
    with pytest.raises(ValueError, match="speed_ratio must be between 1 and 100; got 0"):
        parallel_env().set_difficulty({"speed_ratio": 0})


# --- Bad actions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused_by_name_and_nothing_moves(number: float) -> None:
    env = parallel_env()
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match="the action of pursuer_1 in world 0 is not finite"):
        env.step(still(env) | {"pursuer_1": np.array([0.0, number])})
    assert np.array_equal(env.state(), before)
    env.step(still(env))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pursuer_1": np.zeros(3)}, r"the action of pursuer_1 must have shape \(2,\); got \(3,\)"),
        ({"pursuer_2": np.zeros((1, 2))}, r"the action of pursuer_2 must have shape \(2,\); got \(1, 2\)"),
        ({"pursuer_0": 0.5}, r"the action of pursuer_0 must have shape \(2,\); got \(\)"),
        ({"pursuer_0": None}, r"the action of pursuer_0 must have shape \(2,\); got \(\)"),
        ({"pursuer_0": ["left", "up"]}, r"the action of pursuer_0 must be 2 numbers; got \['left', 'up'\]"),
        ({"persuer_0": np.zeros(2)}, "action for unknown agent 'persuer_0'; did you mean pursuer_0"),
    ],
)
def test_a_wrong_action_is_refused_by_name(change: dict[str, Any], message: str) -> None:
    env = parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(still(env) | change)


def test_all_actions_of_a_wrong_shape_are_refused() -> None:
    env = parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"the action of pursuer_0 must have shape \(2,\); got \(1,\)"):
        env.step(dict.fromkeys(env.agents, np.zeros(1)))


def test_a_missing_action_is_refused_by_name() -> None:
    env = parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no action for pursuer_1; got actions for pursuer_0, pursuer_2"):
        env.step({"pursuer_0": np.zeros(2), "pursuer_2": np.zeros(2)})
    with pytest.raises(ValueError, match="no action for pursuer_0; got actions for nobody"):
        env.step({})


@pytest.mark.parametrize("actions", [np.zeros((3, 2)), [np.zeros(2)] * 3, None])
def test_actions_that_are_no_dict_are_refused(actions: Any) -> None:
    env = parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"actions must be a dict of agents; got {type(actions).__name__}"):
        env.step(actions)


def test_a_method_is_no_reward_and_told_where_its_reward_is() -> None:
    with pytest.raises(TypeError, match=r"a method's: load_config\('model_b'\)\.reward\.build\(\)"):
        parallel_env(reward="model_b")  # type: ignore[arg-type]


def test_a_step_outside_of_a_round_is_refused() -> None:
    env = parallel_env(max_cycles=1)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step({})
    env.reset()
    env.step(still(env))
    with pytest.raises(RuntimeError, match="call reset"):
        env.step({})
