"""What users build from names: worlds to train in, a model, and its policy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecMonitor
from tiny_runs import IN_SEVERAL_SETTINGS, tiny

from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.experiments.build import (
    NoiseSchedule,
    build_model,
    build_policy,
    build_vec_env,
    make_vec_env,
    policy_bytes,
)
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.sections import ScheduleConfig
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG, MATD3

# worlds


def curriculum(venv: Any) -> CurriculumVecEnv:
    inner = venv.venv
    assert isinstance(inner, CurriculumVecEnv)
    return inner


@pytest.mark.parametrize(("engine", "kind"), [("native", EncirclementVecEnv), ("supersuit", SuperSuitVecEnv)])
def test_worlds_are_slots_under_a_monitor_with_the_settings_curriculum(engine: Any, kind: type[Any]) -> None:
    venv = make_vec_env("model_b", 5, engine=engine, pursuers=4, obstacles=2, speed_ratio=1.2)
    assert isinstance(venv, VecMonitor)
    assert isinstance(venv.venv, CurriculumVecEnv)
    assert isinstance(venv.venv.venv, kind)
    assert (venv.num_envs, venv.n_agents) == (20, 4)
    assert venv.venv.difficulty == pytest.approx({"safety_distance": 0.3})
    hard = make_vec_env(n_worlds=2, engine=engine, pursuers=2)
    assert curriculum(hard).difficulty == pytest.approx({"obstacle_radius": 0.45, "speed_ratio": 1.1})


def test_without_a_curriculum_worlds_are_final_from_the_start() -> None:
    venv = make_vec_env(n_worlds=2, curriculum=False, pursuers=2)
    venv.reset()
    assert curriculum(venv).difficulty == {}
    state = venv.get_attr("simulator")[0].state
    assert (state.safety_distance == 0.11).all()
    assert (state.obstacle_radius == 0.2).all()


def test_equal_seeds_make_equal_worlds_and_none_makes_others() -> None:
    def first(seed: int | None, engine: Any = "native") -> np.ndarray:
        observations = make_vec_env(n_worlds=3, seed=seed, engine=engine).reset()
        assert isinstance(observations, np.ndarray)
        return observations

    assert np.array_equal(first(3), first(3))
    assert np.array_equal(first(3), first(3, "supersuit"))
    assert not np.array_equal(first(3), first(4))
    assert not np.array_equal(first(None), first(None))


def test_a_scenario_is_taken_as_it_is() -> None:
    scenario = Scenario(pursuers=4, obstacles=2, observe_extras=("stage",))
    assert make_vec_env(n_worlds=1, scenario=scenario).get_attr("scenario") == [scenario] * 4
    assert make_vec_env(n_worlds=1, scenario=scenario, pursuers=2).num_envs == 2


@pytest.mark.parametrize("ramp", ["obstacle_radius={start: 0.9, world_steps: 9}", "speed_ratio.start=0.5"])
def test_only_who_wants_the_curriculum_needs_one_that_can_be_played(ramp: str) -> None:
    how: dict[str, Any] = {"n_worlds": 1, "pursuers": 2, "overrides": [f"training.curriculum.{ramp}"]}
    assert curriculum(make_vec_env(curriculum=False, **how)).difficulty == {}
    with pytest.raises(ConfigError, match=r"^training\.curriculum\.\w+\.start: scenario"):
        make_vec_env(**how)


def test_a_users_file_and_overrides_reach_the_worlds(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("base: ours\nterms: {time: 3.0, contraction: null}\n")
    for given in (path, str(path)):
        venv = make_vec_env(given, 2, overrides=["reward.scale=0.5"], max_cycles=7)
        reward = venv.get_attr("reward")[0]
        assert (reward.scale, reward.terms["time"], venv.get_attr("scenario")[0].max_cycles) == (0.5, 3.0, 7)
        assert "contraction" not in reward.active


def test_an_environment_needs_no_memory_for_a_replay_buffer() -> None:
    assert make_vec_env(n_worlds=1, pursuers=64, pursuer_radius=0.01, obstacles=0).num_envs == 64
    assert make_vec_env(n_worlds=1, overrides=["training.world_steps=10000000000",
                                               "algorithm.buffer_world_steps=10000000000"]).num_envs == 3  # fmt: skip


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"overrides": "scenario.damping=0.3"}, "overrides must be a list of section.key=value; got 'scenario."),
        ({"profile": None}, "profile None: unknown profile; known: full, smoke"),
        ({"scenario": 3}, "scenario must be a name or the path of a YAML file; got 3"),
        ({"pursuer": 3}, "scenario.pursuer: unknown key; did you mean pursuers?"),
        ({"pursuers": "3"}, "scenario.pursuers must be an integer"),
        ({"reward": "our"}, "did you mean ours?"),
        ({"overrides": ["training.n_world=3"]}, "did you mean n_worlds?"),
        ({"overrides": ["training.n_worlds=3"]}, "training.n_worlds is an argument here: give n_worlds"),
        ({"overrides": None}, "overrides must be a list of section.key=value; got None"),
        ({"engine": "nativ"}, "engine 'nativ': unknown engine; did you mean native?"),
        ({"engine": None}, "engine None: unknown engine; known: native, supersuit"),
        ({"n_envs": 8}, "n_envs counts slots, one for each pursuer of each world: give n_worlds"),
        ({"n_worlds": "8"}, "n_worlds must be an integer of at least 1; got '8'"),
        ({"n_worlds": 0}, "n_worlds must be an integer of at least 1; got 0"),
        ({"n_worlds": 2.0}, "n_worlds must be an integer of at least 1; got 2.0"),
        (
            {"n_worlds": 5, "overrides": IN_SEVERAL_SETTINGS},
            "training.n_worlds: must be a multiple of the 2 settings; got 5",
        ),
        ({"seed": -1}, "seed must be an integer of at least 0; got -1"),
        ({"seed": "0"}, "seed must be an integer of at least 0; got '0'"),
    ],
)
def test_a_bad_argument_is_told_by_its_name(how: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_vec_env(**how)
    assert reason in str(caught.value)


def test_plain_maddpg_learns_in_these_worlds() -> None:
    venv = make_vec_env(n_worlds=4, seed=0)
    MADDPG("MlpPolicy", venv, learning_starts=60, batch_size=16, seed=0).learn(240)
    assert curriculum(venv).world_steps == 80


# models


def test_world_steps_become_the_pursuers_steps() -> None:
    config = load_config(fields={"pursuers": 4}, overrides=["algorithm.buffer_world_steps=1000"])
    model = build_model(config, build_vec_env(config, 8), 3)
    assert model.learning_starts == 4 * 5000
    assert model.buffer_size == 4000
    assert model.replay_buffer is not None
    assert model.replay_buffer.observations.shape[:2] == (125, 32)  # 125 steps of 8 worlds are 1,000 world steps
    assert (model.n_agents, model.gamma, model.tau, model.batch_size, model.seed) == (4, 0.9, 0.01, 1024, 3)
    assert (model.critic_kind, model.policy_delay, model.max_grad_norm) == ("shared", 2, None)
    assert str(model.device) == "cpu"


def test_training_frequency_and_gradient_steps_are_sb3s() -> None:
    config = tiny(overrides=["algorithm.train_freq=2", "algorithm.gradient_steps=3"])
    model = build_model(config, build_vec_env(config, 4), 0)
    assert isinstance(model.train_freq, TrainFreq)
    assert (model.train_freq.frequency, model.gradient_steps) == (2, 3)


def test_a_buffer_is_no_larger_than_its_training() -> None:
    config = tiny(overrides=["algorithm.buffer_world_steps=1000000"])
    assert build_model(config, build_vec_env(config, 4), 0).buffer_size == 3 * 404


def test_the_noise_follows_the_world_steps() -> None:
    noise = NoiseSchedule(ScheduleConfig(start=0.4, end=0.1, world_steps=500), world_steps=2000)
    assert noise(1.0) == pytest.approx(0.4)
    assert noise(1 - 250 / 2000) == pytest.approx(0.25)
    assert noise(1 - 500 / 2000) == noise(0.0) == noise(-0.1) == 0.1


def test_the_learning_rate_falls_over_the_whole_training() -> None:
    for end, halfway in ("null", 2e-3), ("1e-3", 1.5e-3):
        config = tiny(overrides=["algorithm.learning_rate=2e-3", f"algorithm.learning_rate_end={end}"])
        assert build_model(config, build_vec_env(config, 2), 0).lr_schedule(0.5) == pytest.approx(halfway)


def test_the_rewards_of_several_steps_are_summed_where_a_configuration_says_so() -> None:
    config = tiny(overrides=["algorithm.n_steps=3", "algorithm.gamma=0.8"])
    model = build_model(config, build_vec_env(config, 2), 0)
    assert model.replay_buffer is not None
    assert (model.n_steps, model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 3, 0.8)


def test_the_registry_has_what_a_configuration_may_name() -> None:
    assert ALGORITHMS == {"maddpg": MADDPG, "matd3": MATD3}
    for name, algorithm in ALGORITHMS.items():
        config = load_config(algorithm=name, profile="smoke")
        assert type(build_model(config, build_vec_env(config, 2), 0)) is algorithm


# policies


@pytest.mark.parametrize("algorithm", ["maddpg", "matd3"])
@pytest.mark.parametrize("critic", ["shared", "per_agent"])
def test_equal_weights_are_equal_bytes_whatever_the_algorithm(algorithm: str, critic: str) -> None:
    config = load_config(algorithm=algorithm, profile="smoke", overrides=[f"algorithm.critic={critic}"])
    one, other = (policy_bytes(build_model(config, build_vec_env(config, 2), 5).policy) for _ in range(2))
    assert one == other


def test_critics_that_are_not_read_cost_next_to_nothing() -> None:
    """Whatever a configuration says: 64 critics of this size would have 300 MB of weights."""
    large = tiny(pursuers=64, obstacles=0, pursuer_radius=0.01, overrides=["algorithm.net_arch=[100]"])
    policy = build_policy(large)
    critics = sum(weights.numel() for weights in policy.critic.parameters())
    assert critics < sum(weights.numel() for weights in policy.actor.parameters())
