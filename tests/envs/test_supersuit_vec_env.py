"""Each law holds for our SuperSuitVecEnv and is broken by SuperSuit's own SB3 wrapper, in the way that stands with it.

When a test of the bare wrapper fails, upstream has mended that defect and the workaround may go.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from gymnasium.spaces import MultiBinary
from mpe2 import simple_spread_v3
from pettingzoo.utils.wrappers import BaseParallelWrapper, OrderEnforcingWrapper
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecCheckNan, VecMonitor, VecNormalize
from supersuit import black_death_v3, concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1
from toy_envs import RecyclingEnv, SpoiltEnv, StaggeredEnv, TallyEnv, UnequalEnv, VanishingEnv

from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv

N = 3  # agents of a TallyEnv
NOT_RAISED = pytest.fail.Exception  # what pytest.raises raises when nothing was raised


def bare(env: Any, n_worlds: int = 1) -> Any:
    env = env() if callable(env) else env
    return concat_vec_envs_v1(pettingzoo_env_to_vec_env_v1(env), n_worlds, base_class="stable_baselines3")


def spread() -> Any:
    return simple_spread_v3.parallel_env(continuous_actions=True)


def still(venv: Any) -> np.ndarray:
    return np.zeros((venv.num_envs, *venv.action_space.shape), np.float32)


def play(venv: Any, n_steps: int) -> Any:
    """The outcome of the last of some steps without action."""
    for _ in range(n_steps):
        outcome = venv.step(still(venv))
    return outcome


# --- One law per row of defects ---------------------------------------------------------------------------------------


class Law(NamedTuple):
    check: Callable[[Any], None]
    bare_raises: type[BaseException]


LAWS: list[Law] = []


def law(*, bare_raises: type[BaseException]) -> Callable[[Callable[[Any], None]], None]:
    return lambda check: LAWS.append(Law(check, bare_raises))


@law(bare_raises=AttributeError)
def seed_decides_the_episodes(make: Any) -> None:
    venv = make(TallyEnv, 2)
    venv.seed(7)
    first = venv.reset()
    venv.seed(7)
    assert np.array_equal(venv.reset(), first)
    venv.seed(8)
    assert not np.isin(venv.reset()[:, 0], first[:, 0]).any()


@law(bare_raises=AttributeError)
def reset_takes_a_seed(make: Any) -> None:
    venv = make(TallyEnv, 2)
    assert np.array_equal(venv.reset(seed=7), venv.reset(seed=7))


@law(bare_raises=AttributeError)
def a_model_with_a_seed_learns(make: Any) -> None:
    TD3("MlpPolicy", make(spread, 2), seed=0, learning_starts=12, batch_size=8, policy_kwargs={"net_arch": [8]}).learn(
        60
    )


@law(bare_raises=AssertionError)
def worlds_of_a_used_environment_differ(make: Any) -> None:
    env = TallyEnv()
    env.reset(seed=7)
    assert len(np.unique(make(env, 5).reset()[:, 0])) == 5


@law(bare_raises=AssertionError)
def a_time_limit_is_a_truncation(make: Any) -> None:
    for ending, expected in (("truncation", True), ("termination", False), ("both", False)):
        venv = make(TallyEnv(ending=ending))
        venv.reset()
        _, _, dones, infos = play(venv, 4)
        assert dones.all()
        assert [info.get("TimeLimit.truncated") for info in infos] == [expected] * N


@law(bare_raises=AssertionError)
def dones_are_boolean(make: Any) -> None:
    venv = make(TallyEnv)
    venv.reset()
    assert play(venv, 1)[2].dtype == bool


@law(bare_raises=AssertionError)
def infos_of_the_last_step_win(make: Any) -> None:
    venv = make(TallyEnv)
    venv.reset()
    infos = play(venv, 4)[3]
    assert [info["is_success"] for info in infos] == [True] * N


@law(bare_raises=AssertionError)
def infos_of_a_reset_are_kept_apart(make: Any) -> None:
    venv = make(TallyEnv, 2)
    venv.reset()
    observations, _, _, infos = play(venv, 4)
    assert not any("start" in info for info in infos)
    assert [info["start"] for info in venv.reset_infos] == pytest.approx(observations[:, 0])


@law(bare_raises=AssertionError)
def terminal_observation_outlives_the_reset(make: Any) -> None:
    venv = make(RecyclingEnv)
    venv.reset()
    infos = play(venv, 4)[3]
    assert [list(info["terminal_observation"][1:]) for info in infos] == [[0, 4], [1, 4], [2, 4]]


@law(bare_raises=AssertionError)
def terminal_observation_stands_in_the_last_step_only(make: Any) -> None:
    venv = make(RecyclingEnv)
    venv.reset()
    assert not any("terminal_observation" in info for info in play(venv, 5)[3])


@law(bare_raises=NOT_RAISED)
def agents_that_end_apart_are_named(make: Any) -> None:
    venv = make(StaggeredEnv, 2)
    venv.reset()
    with pytest.raises(RuntimeError, match=r"world 0: \['agent_0'\] ended, \['agent_1', 'agent_2'\] did not"):
        play(venv, 3)


@law(bare_raises=AssertionError)  # raised by SuperSuit, without a name, and gone under python -O
def agents_that_vanish_are_named(make: Any) -> None:
    venv = make(VanishingEnv, 2)
    venv.reset()
    with pytest.raises(RuntimeError, match=r"world 0: no observation of \['agent_1'\]"):
        play(venv, 1)


@law(bare_raises=NOT_RAISED)
def a_late_end_is_refused(make: Any) -> None:
    with pytest.raises(ValueError, match="one step late"):
        make(black_death_v3(StaggeredEnv()))


@law(bare_raises=NOT_RAISED)
def numbers_that_are_not_finite_are_named(make: Any) -> None:
    for number in (np.nan, np.inf, -np.inf, 1e39):  # 1e39 is infinite in float32
        venv = make(TallyEnv, 2)
        venv.reset()
        actions = still(venv).astype(np.float64)
        actions[4, 1] = number
        with pytest.raises(ValueError, match="world 1, agent 'agent_1'"):
            venv.step(actions)


@law(bare_raises=NOT_RAISED)
def rewards_that_are_not_finite_are_named(make: Any) -> None:
    for number in (np.nan, np.float32("inf")):
        venv = make(lambda number=number: SpoiltEnv("reward", number), 2)
        venv.reset()
        play(venv, 1)
        with pytest.raises(RuntimeError, match=f"world 0, agent 'agent_1': reward is {number}; it must be finite"):
            play(venv, 1)


@law(bare_raises=NOT_RAISED)
def observations_that_are_not_finite_are_named(make: Any) -> None:
    told = np.array([1, -np.inf, np.nan], np.float32)
    place = r"world 0, agent 'agent_1': {}observation\[1\] is -inf; it must be finite"
    with pytest.raises(RuntimeError, match=place.format("")):
        make(lambda: SpoiltEnv("observation", told, since=0), 2).reset()
    for since, what in ((2, ""), (4, "last ")):  # an episode has four steps
        venv = make(lambda since=since: SpoiltEnv("observation", told, since), 2)
        venv.reset()
        play(venv, since - 1)
        with pytest.raises(RuntimeError, match=place.format(what)):
            play(venv, 1)


@law(bare_raises=NOT_RAISED)
def a_missing_reward_is_named(make: Any) -> None:
    venv = make(lambda: SpoiltEnv("reward", None), 2)
    venv.reset()
    with pytest.raises(RuntimeError, match=r"world 0: no reward of \['agent_1'\]; all must take part in every step"):
        play(venv, 2)


@law(bare_raises=ValueError)  # numpy's: "operands could not be broadcast together"
def a_missing_flag_is_named(make: Any) -> None:
    for flag in ("termination", "truncation"):
        venv = make(lambda flag=flag: SpoiltEnv(flag, None), 2)
        venv.reset()
        with pytest.raises(RuntimeError, match=rf"world 0: no {flag} of \['agent_1'\]"):
            play(venv, 2)


@law(bare_raises=ValueError)  # numpy's, without a name; where all are so, the rewards become (6, 2)
def a_reward_of_wrong_shape_is_named(make: Any) -> None:
    for told in (np.zeros(2), [0.0, 0.0], np.zeros(1)):
        venv = make(lambda told=told: SpoiltEnv("reward", told), 2)
        venv.reset()
        with pytest.raises(
            RuntimeError, match=r"world 0, agent 'agent_1': reward has shape .*, expected a single number"
        ):
            play(venv, 2)


@law(bare_raises=ValueError)  # numpy's "Output array is the wrong shape"
def an_observation_of_wrong_shape_is_named(make: Any) -> None:
    for told, shape in ((np.zeros(4, np.float32), r"\(4,\)"), ([0.0, 0.0], r"\(2,\)"), (0.0, r"\(\)")):
        venv = make(lambda told=told: SpoiltEnv("observation", told), 2)
        venv.reset()
        reason = rf"world 0, agent 'agent_1': observation has shape {shape}, its space has \(3,\)"
        with pytest.raises(RuntimeError, match=reason):
            play(venv, 2)


@law(bare_raises=NOT_RAISED)
def surplus_actions_are_refused(make: Any) -> None:
    venv = make(TallyEnv, 2)
    venv.reset()
    with pytest.raises(ValueError, match="7 actions for 6 slots; world 1, agent 'agent_2' is the last"):
        venv.step(np.zeros((7, 2), np.float32))


@law(bare_raises=AssertionError)  # refused by SuperSuit, without a name
def an_action_of_wrong_shape_is_named(make: Any) -> None:
    venv = make(TallyEnv, 2)
    venv.reset()
    with pytest.raises(ValueError, match=r"world 0, agent 'agent_0': action has shape \(1,\), expected \(2,\)"):
        venv.step(np.zeros((6, 1), np.float32))


@law(bare_raises=AssertionError)
def unequal_spaces_are_named_with_the_way_out(make: Any) -> None:
    for odd, way_out in (("observation", "pad_observations_v0"), ("action", "pad_action_space_v0")):
        with pytest.raises(ValueError, match=rf"agent 'agent_2' has .* supersuit.{way_out} makes spaces equal"):
            make(UnequalEnv(odd))


@law(bare_raises=AttributeError)
def the_number_of_agents_is_told(make: Any) -> None:
    venv = make(TallyEnv, 2)
    assert (venv.n_agents, venv.n_worlds, venv.num_envs) == (3, 2, 6)


@law(bare_raises=AttributeError)
def attributes_are_read(make: Any) -> None:
    assert make(TallyEnv, 2).get_attr("length") == [4] * 6


@law(bare_raises=AttributeError)
def attributes_are_set_in_the_world_of_the_slot(make: Any) -> None:
    venv = make(lambda: BaseParallelWrapper(TallyEnv()), 2)
    venv.set_attr("length", 1, indices=[4])
    venv.reset()
    assert list(play(venv, 1)[2]) == [False] * 3 + [True] * 3


@law(bare_raises=AttributeError)
def methods_are_called_once_per_world(make: Any) -> None:
    venv = make(TallyEnv, 3)
    draws = venv.reset()[:, 0]
    assert venv.env_method("count_call", 1, indices=[0, 1, -1]) == pytest.approx(draws[[0, 1, -1]])
    assert venv.get_attr("calls", indices=range(0, 9, 3)) == [1, 0, 1]


@law(bare_raises=AttributeError)
def options_reach_the_next_reset_only(make: Any) -> None:
    venv = make(TallyEnv, 2)
    venv.set_options([{"level": 1}] * 3 + [{"level": 2}] * 3)
    venv.reset()
    venv.reset()
    first, second = venv.get_attr("resets", indices=[0, 3])
    assert [options for _, options in first] == [{"level": 1}, None]
    assert [options for _, options in second] == [{"level": 2}, None]


@law(bare_raises=AssertionError)
def wrappers_are_found(make: Any) -> None:
    venv = make(BaseParallelWrapper(TallyEnv()), 2)
    assert venv.env_is_wrapped(BaseParallelWrapper, indices=0) == [True]
    assert venv.env_is_wrapped(RecyclingEnv, indices=0) == [False]


@law(bare_raises=UserWarning)
def every_world_is_drawn_once(make: Any) -> None:
    venv = make(lambda: TallyEnv(render_mode="rgb_array"), 4)
    draws = venv.reset()[::N, 0]
    corners = venv.render()[::2, ::2, 0].ravel()  # four pictures of 2 x 2 pixels, tiled
    assert list(corners) == [round(255 * float(draw)) for draw in draws]


@law(bare_raises=AttributeError)
def an_environment_without_render_mode_is_taken(make: Any) -> None:
    env = TallyEnv()
    del env.render_mode
    assert make(env).render_mode is None


@law(bare_raises=AttributeError)
def an_environment_without_metadata_is_taken(make: Any) -> None:
    class Bare(TallyEnv):
        @property
        def unwrapped(self) -> "Bare":
            return self

        def __getattribute__(self, name: str) -> Any:
            if name == "metadata" and "metadata" not in self.__dict__:
                raise AttributeError(name)
            return super().__getattribute__(name)

    assert make(Bare()).num_envs == N


@law(bare_raises=AttributeError)
def infos_that_are_none_hold_nothing(make: Any) -> None:
    class Silent(TallyEnv):
        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            return super().reset(seed, options)[0], None

        def step(self, actions: Any) -> Any:
            return (*super().step(actions)[:4], dict.fromkeys(self.possible_agents))

    venv = make(Silent())
    venv.reset()
    assert play(venv, 4)[2].all()


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.check.__name__)
def test_our_vec_env_keeps_the_law(law: Law) -> None:
    law.check(SuperSuitVecEnv)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.check.__name__)
def test_the_bare_wrapper_breaks_the_law(law: Law) -> None:
    with pytest.raises(law.bare_raises):
        law.check(bare)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_the_bare_wrapper_gives_two_workers_the_same_world() -> None:
    env = TallyEnv()
    workers = concat_vec_envs_v1(pettingzoo_env_to_vec_env_v1(env), 4, num_cpus=2, base_class="gymnasium")
    try:
        draws = workers.reset(seed=7)[0][::N, 0]  # seeds 7, 8 in the first worker, 8, 9 in the second
    finally:
        workers.close()
    assert draws[1] == draws[2]
    assert len(np.unique(SuperSuitVecEnv(env, 4).reset(seed=7)[::N, 0])) == 4


# --- Slots ------------------------------------------------------------------------------------------------------------


def test_observations_and_rewards_stand_world_by_world_agent_by_agent() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    starts = venv.reset(seed=7)[:, 0]
    draws = [np.float32(np.random.default_rng(seed).random()) for seed in world_seeds(7, 2)]
    assert list(starts) == [draws[0]] * 3 + [draws[1]] * 3
    for step in (1, 2, 3):
        observations, rewards, dones, _ = venv.step(still(venv))
        assert np.array_equal(observations[:, 0], starts)
        assert list(observations[:, 1]) == [0, 1, 2, 0, 1, 2]
        assert list(observations[:, 2]) == [step] * 6
        assert list(rewards) == [step, 100 + step, 200 + step] * 2
        assert not dones.any()
    assert (observations.dtype, rewards.dtype) == (np.float32, np.float32)


def test_each_agent_gets_the_action_of_its_slot() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    venv.reset()
    actions = np.arange(12, dtype=np.float32).reshape(6, 2)
    for given in (actions, actions.tolist()):
        infos = venv.step(given)[3]
        assert np.array_equal([info["action"] for info in infos], actions)


def test_actions_may_be_overwritten_between_the_halves_of_a_step() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    venv.reset()
    actions = np.ones((6, 2), np.float32)
    venv.step_async(actions)
    actions[:] = 9
    assert all((info["action"] == 1).all() for info in venv.step_wait()[3])


def test_observations_may_be_lists_and_rewards_numbers_of_any_type() -> None:
    for what, told in (("observation", [1.0, 2.0, 3.0]), ("reward", 7), ("reward", np.float32(7)), ("reward", True)):
        venv = SuperSuitVecEnv(lambda what=what, told=told: SpoiltEnv(what, told), 2)
        venv.reset()
        observations, rewards, _, _ = play(venv, 2)
        assert np.array_equal(observations[4] if what == "observation" else rewards[4], told)


def test_missing_actions_are_named() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    venv.reset()
    with pytest.raises(ValueError, match="world 1, agent 'agent_2': no action; 5 given for 6 slots"):
        venv.step(np.zeros((5, 2), np.float32))
    with pytest.raises(ValueError, match=r"world 0, agent 'agent_2': action has shape \(3,\)"):
        venv.step([np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(2), np.zeros(2), np.zeros(2)])


def test_a_world_that_ends_goes_on_with_its_next_episode_alone() -> None:
    lengths = iter((2, 4))
    venv = SuperSuitVecEnv(lambda: TallyEnv(length=next(lengths)), 2)
    starts = venv.reset()
    reset_infos = venv.reset_infos
    observations, rewards, dones, infos = play(venv, 2)
    assert list(dones) == [True] * 3 + [False] * 3
    assert list(rewards) == [2, 102, 202] * 2
    assert list(observations[:, 2]) == [0, 0, 0, 2, 2, 2]
    assert [list(info["terminal_observation"]) for info in infos[:3]] == [[starts[0, 0], i, 2] for i in range(3)]
    assert not any("terminal_observation" in info for info in infos[3:])
    assert observations[0, 0] != starts[0, 0]
    assert observations[3, 0] == starts[3, 0]
    assert venv.reset_infos[3:] == reset_infos[3:]
    assert venv.reset_infos[:3] != reset_infos[:3]


def test_infos_of_a_reset_outlive_the_next_steps() -> None:
    venv = SuperSuitVecEnv(RecyclingEnv, 2)
    venv.reset()
    play(venv, 1)
    assert [sorted(info) for info in venv.reset_infos] == [["is_success", "start"]] * 6


def test_attributes_and_wrappers_are_found_below_a_converted_turn_based_environment() -> None:
    venv = SuperSuitVecEnv(spread, 2)
    venv.set_attr("max_cycles", 2, indices=[0])
    assert venv.get_attr("max_cycles") == [2] * 3 + [25] * 3
    assert venv.env_is_wrapped(OrderEnforcingWrapper) == [True] * 6
    venv.reset()
    assert list(play(venv, 2)[2]) == [True] * 3 + [False] * 3


# --- Seeds and worlds -------------------------------------------------------------------------------------------------


def test_a_world_is_seeded_once_and_then_goes_on_with_its_stream() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    first, second = world_seeds(7, 2)
    assert venv.seed(7) == [first] * 3 + [second] * 3
    venv.reset()
    play(venv, 8)  # two episodes
    venv.reset()
    seeds = [[seed for seed, _ in resets] for resets in venv.get_attr("resets", indices=[0, 3])]
    assert seeds == [[first, None, None, None], [second, None, None, None]]


def test_a_seed_set_within_an_episode_waits_for_reset() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 1)
    venv.reset()
    venv.seed(7)
    play(venv, 4)
    venv.reset()
    assert [seed for seed, _ in venv.get_attr("resets")[0]][1:] == [None, world_seeds(7, 1)[0]]


def test_without_a_seed_every_vec_env_plays_other_worlds() -> None:
    np.random.seed(0)  # noqa: NPY002 - the global stream must not matter
    first = SuperSuitVecEnv(TallyEnv(), 3).reset()
    np.random.seed(0)  # noqa: NPY002
    second = SuperSuitVecEnv(TallyEnv(), 3).reset()
    assert len(np.unique([first[:, 0], second[:, 0]])) == 6


def test_a_world_plays_alone_as_it_plays_among_others() -> None:
    venv = SuperSuitVecEnv(spread, 3)
    alone = spread()
    observations, _ = alone.reset(seed=world_seeds(7, 3)[1])
    assert np.array_equal(venv.reset(seed=7)[3:6], list(observations.values()))
    rng = np.random.default_rng(0)
    for _ in range(60):  # two ends, after 25 and 50 steps
        actions = rng.random((9, 5), dtype=np.float32)
        slots, slot_rewards, dones, infos = venv.step(actions)
        observations, rewards, *_ = alone.step(dict(zip(alone.possible_agents, actions[3:6], strict=True)))
        if dones[3]:
            last = [info["terminal_observation"] for info in infos[3:6]]
            assert np.array_equal(last, list(observations.values()))
            observations, _ = alone.reset()
        assert np.array_equal(slots[3:6], list(observations.values()))
        assert np.array_equal(slot_rewards[3:6], np.float32(list(rewards.values())))


def test_equal_seeds_give_equal_trajectories_from_a_function_and_from_an_environment() -> None:
    used = spread()
    used.reset(seed=1)
    trajectories = []
    for env in (spread, used):
        venv = SuperSuitVecEnv(env, 3)
        rng = np.random.default_rng(0)
        first = venv.reset(seed=7)
        assert len(np.unique(first[::N], axis=0)) == 3
        steps = [venv.step(rng.random((9, 5), dtype=np.float32))[:2] for _ in range(55)]
        trajectories.append([first, *(array for step in steps for array in step)])
    for left, right in zip(*trajectories, strict=True):
        assert np.array_equal(left, right)


def test_the_given_environment_is_left_alone() -> None:
    env = TallyEnv()
    venv = SuperSuitVecEnv(env, 2)
    venv.reset()
    play(venv, 2)
    assert (env.resets, env.step_count) == ([], 0)


# --- Refusals ---------------------------------------------------------------------------------------------------------


def test_what_is_no_parallel_env_is_refused() -> None:
    for env in (simple_spread_v3.env, simple_spread_v3.env()):
        with pytest.raises(TypeError, match="aec_to_parallel"):
            SuperSuitVecEnv(env, 2)


def test_one_world_made_twice_is_refused() -> None:
    env = TallyEnv()
    with pytest.raises(ValueError, match="returned one world twice"):
        SuperSuitVecEnv(lambda: env, 2)


def test_worlds_with_other_agents_are_refused() -> None:
    numbers = iter((3, 2))
    with pytest.raises(ValueError, match=r"world 1 has the agents \['agent_0', 'agent_1'\]"):
        SuperSuitVecEnv(lambda: TallyEnv(n_agents=next(numbers)), 2)


def test_spaces_that_are_no_boxes_are_refused() -> None:
    class BinaryEnv(TallyEnv):
        def observation_space(self, agent: str) -> Any:
            return MultiBinary(3)

    with pytest.raises(ValueError, match=r"observations MultiBinary\(3\), .* supported are Box"):
        SuperSuitVecEnv(BinaryEnv)


def test_no_world_is_refused() -> None:
    with pytest.raises(ValueError, match="n_worlds = 0"):
        SuperSuitVecEnv(TallyEnv, 0)


def test_an_attribute_that_no_layer_has_is_refused() -> None:
    venv = SuperSuitVecEnv(spread, 2)
    assert not venv.has_attr("duration")
    with pytest.raises(AttributeError, match=r"no layer of .* 'duration'"):
        venv.set_attr("duration", 1)


def test_options_go_to_all_worlds_or_fit_them() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    venv.set_options({"level": 3})
    venv.reset()
    assert venv.get_attr("resets", indices=3)[0][0][1] == {"level": 3}
    with pytest.raises(ValueError, match="2 options for 6 slots"):
        venv.set_options([{}, {}])
    with pytest.raises(ValueError, match="world 1, agent 'agent_1'"):
        venv.set_options([{}] * 4 + [{"level": 1}] * 2)


# --- With SB3 ---------------------------------------------------------------------------------------------------------


def test_the_monitor_counts_episodes_and_wins_of_each_slot() -> None:
    venv = VecMonitor(VecCheckNan(SuperSuitVecEnv(TallyEnv, 2), raise_exception=True), info_keywords=("is_success",))
    venv.reset()
    infos = play(venv, 4)[3]
    # 1 + 2 + 3 + 4 = 10 for agent 0, 400 more per number of the agent
    assert [info["episode"]["r"] for info in infos] == [10, 410, 810] * 2
    assert [info["episode"]["l"] for info in infos] == [4] * 6
    assert [info["episode"]["is_success"] for info in infos] == [True] * 6
    assert venv.n_agents == 3


def test_normalisation_reaches_the_terminal_observation() -> None:
    venv = VecNormalize(SuperSuitVecEnv(TallyEnv, 2), clip_obs=1.0)
    assert np.abs(venv.reset()).max() <= 1.0
    infos = play(venv, 4)[3]
    assert max(np.abs(info["terminal_observation"]).max() for info in infos) <= 1.0
    assert venv.n_agents == 3


def test_the_replay_buffer_stores_time_limits_as_such() -> None:
    venv = SuperSuitVecEnv(TallyEnv, 2)
    buffer = ReplayBuffer(6, venv.observation_space, venv.action_space, n_envs=6)
    observations = venv.reset()
    play(venv, 3)
    following, rewards, dones, infos = venv.step(still(venv))
    buffer.add(observations, following, still(venv), rewards, dones, infos)
    assert buffer.dones.all()
    assert not buffer.sample(6).dones.any()


def test_evaluate_policy_counts_the_episodes_of_the_slots() -> None:
    venv = VecMonitor(SuperSuitVecEnv(TallyEnv, 2))
    model = TD3("MlpPolicy", venv, seed=0, buffer_size=60, policy_kwargs={"net_arch": [8]})
    rewards, lengths = evaluate_policy(model, venv, n_eval_episodes=12, return_episode_rewards=True)
    assert sorted(rewards) == [10] * 4 + [410] * 4 + [810] * 4
    assert lengths == [4] * 12


def test_discrete_actions_work() -> None:
    venv = SuperSuitVecEnv(simple_spread_v3.parallel_env, 2)
    PPO("MlpPolicy", venv, seed=0, n_steps=30, batch_size=90, n_epochs=1, device="cpu").learn(180)
    with pytest.raises(ValueError, match="world 0, agent 'agent_0'"):
        venv.step(np.full(6, np.nan))


def test_pictures_carry_the_frame_rate_of_the_environment() -> None:
    venv = SuperSuitVecEnv(lambda: TallyEnv(render_mode="rgb_array"), 2)
    assert (venv.render_mode, venv.metadata["render_fps"]) == ("rgb_array", 7)
    assert SuperSuitVecEnv(TallyEnv, 2).get_images() == [None, None]


def test_all_worlds_are_closed_once() -> None:
    closed = []

    class ClosingEnv(TallyEnv):
        def close(self) -> None:
            closed.append(self)

    SuperSuitVecEnv(ClosingEnv, 3).close()
    assert len({id(env) for env in closed}) == len(closed) == 3
