"""What the networks read: bodies as the target sees them, in an order of their own or as sets."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th

from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.experiments.build import build_model, build_policy, build_vec_env, fit_policy
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.features import RelativeFeatures, SetFeatures
from marl_encircle.experiments.sizes import count_weights, observation_size
from marl_encircle.maddpg.gradients import is_plain


def observed(scenario: Scenario) -> tuple[th.Tensor, Any]:
    """Observations of the first round's pursuers (N, O), and the environment."""
    env = parallel_env(scenario)
    observations, _ = env.reset(seed=3)
    return th.from_numpy(np.stack(list(observations.values()))), env


def features_of(
    scenario: Scenario, observations: th.Tensor, kind: type[RelativeFeatures | SetFeatures] = RelativeFeatures
) -> th.Tensor:
    env = parallel_env(scenario)
    th.manual_seed(0)
    extractor = kind(env.observation_space("pursuer_0"), scenario)
    features: th.Tensor = extractor(observations)
    assert features.shape[1] == extractor.features_dim
    return features


def test_bodies_are_seen_from_the_target_the_nearest_obstacle_first() -> None:
    scenario = Scenario(pursuers=3, obstacles=4)
    observations, env = observed(scenario)
    features = features_of(scenario, observations)
    state = env.unwrapped.simulator.state
    obstacles = state.obstacles[0] - state.target[0]
    obstacles = obstacles[np.argsort(np.linalg.norm(obstacles, axis=1))]
    assert not np.allclose(obstacles, state.obstacles[0] - state.target[0]), "another order than theirs"
    seen = features[:, -16:].reshape(3, 2, 4, 2).numpy()
    for pursuer in range(3):
        np.testing.assert_allclose(seen[pursuer, 0], obstacles, atol=1e-6)
        lengths = np.linalg.norm(obstacles, axis=1, keepdims=True)
        np.testing.assert_allclose(seen[pursuer, 1], obstacles / (lengths + 0.1), atol=1e-6)
        others = np.delete(state.pursuers[0], pursuer, axis=0) - state.target[0]
        np.testing.assert_allclose(features[pursuer, -24:-20].reshape(2, 2), others, atol=1e-6)
    # What is not an obstacle's stays where it was
    parts = layout(scenario)
    for name in parts.keys() - {"obstacles", "obstacle_directions"}:
        assert th.equal(features[:, parts[name]], observations[:, parts[name]])


@pytest.mark.parametrize("kind", [RelativeFeatures, SetFeatures])
def test_the_order_of_the_obstacles_means_nothing(kind: type[RelativeFeatures | SetFeatures]) -> None:
    scenario = Scenario(obstacles=3)
    observations, _ = observed(scenario)
    others = observations.clone()
    for name in ("obstacles", "obstacle_directions"):
        part = layout(scenario)[name]
        others[:, part] = observations[:, part].reshape(-1, 3, 2)[:, [2, 0, 1]].flatten(1)
    assert not th.equal(others, observations)
    assert th.allclose(features_of(scenario, others, kind), features_of(scenario, observations, kind), atol=1e-6)


def test_the_order_of_the_other_pursuers_means_nothing_to_sets() -> None:
    scenario = Scenario(pursuers=4)
    observations, _ = observed(scenario)
    others = observations.clone()
    for name in ("pursuers", "pursuer_directions"):
        part = layout(scenario)[name]
        others[:, part] = observations[:, part].reshape(-1, 3, 2)[:, [2, 0, 1]].flatten(1)
    features = features_of(scenario, observations, SetFeatures)
    assert th.allclose(features_of(scenario, others, SetFeatures), features, atol=1e-6)
    assert not th.allclose(features[0], features[1]), "they do say where the others are"


def test_a_set_says_where_each_body_is() -> None:
    scenario = Scenario(pursuers=4, obstacles=2)
    observations, _ = observed(scenario)
    features = features_of(scenario, observations, SetFeatures)
    for name in ("pursuers", "obstacles", "target", "velocity"):
        moved = observations.clone()
        moved[:, layout(scenario)[name].start] += 0.1
        assert not th.allclose(features_of(scenario, moved, SetFeatures), features, atol=1e-4), name


def test_a_set_shows_the_bodies_that_are_nearest_to_the_target_and_no_others() -> None:
    """Four of six other pursuers and three of five obstacles, each as seen from the pursuer and from the target."""
    scenario = Scenario(pursuers=7, obstacles=5, obstacle_radius=0.1)
    observations, env = observed(scenario)
    features = features_of(scenario, observations, SetFeatures)
    state = env.unwrapped.simulator.state
    target = state.target[0]
    for pursuer, position in enumerate(state.pursuers[0]):
        kinds = np.delete(state.pursuers[0], pursuer, axis=0), state.obstacles[0]
        sets = features[pursuer, -56:].numpy().reshape(7, 8)
        for bodies, shown, most in zip(kinds, (sets[:4], sets[4:]), (4, 3), strict=True):
            order = np.argsort(np.linalg.norm(bodies - target, axis=1))[:most]
            np.testing.assert_allclose(shown[:, :2], bodies[order] - position, atol=1e-6)
            np.testing.assert_allclose(shown[:, 2:4], bodies[order] - target, atol=1e-6)
            lengths = np.linalg.norm(shown[:, :2], axis=1, keepdims=True)
            np.testing.assert_allclose(shown[:, 4:6], shown[:, :2] / (lengths + 0.1), atol=1e-6)
            lengths = np.linalg.norm(shown[:, 2:4], axis=1, keepdims=True)
            np.testing.assert_allclose(shown[:, 6:], shown[:, 2:4] / (lengths + 0.1), atol=1e-6)


def test_sets_read_how_much_faster_the_target_is_in_tenths_of_the_pursuers_speed() -> None:
    ratios = th.tensor([1.1, 1.4])
    scenario = Scenario(speed_ratio=1.4, observe_extras=("speed_ratio",))
    observations = observed(scenario)[0][:2].clone()
    where = layout(scenario)["speed_ratio"]
    observations[:, where] = ratios[:, None]
    features = features_of(scenario, observations, SetFeatures)
    assert th.isclose(features[0], th.tensor(1.0), atol=1e-5).any()
    assert th.isclose(features[1], th.tensor(4.0), atol=1e-5).any()


def padded(observations: th.Tensor, scenario: Scenario, largest: Scenario) -> th.Tensor:
    out = th.zeros(len(observations), observation_size(largest))
    for name, part in layout(scenario).items():
        start = layout(largest)[name].start
        out[:, start : start + part.stop - part.start] = observations[:, part]
    return out


def test_a_body_that_is_not_there_changes_nothing() -> None:
    """As ``MixedVecEnv`` pads: zeros in the place of a fourth pursuer and of two obstacles."""
    scenario, largest = Scenario(obstacles=0), Scenario(pursuers=4, obstacles=2)
    observations, _ = observed(scenario)
    features = features_of(scenario, observations, SetFeatures)
    assert th.allclose(features_of(largest, padded(observations, scenario, largest), SetFeatures), features, atol=1e-6)


@pytest.mark.parametrize(
    "fields",
    [{"obstacles": 0}, {"pursuers": 2}, {"observe_directions": False}, {"observe_extras": ("speed_ratio",)}],
    ids=str,
)
def test_any_setting_has_features(fields: dict[str, Any]) -> None:
    scenario = replace(Scenario(), **fields)
    for kind in (RelativeFeatures, SetFeatures):
        assert features_of(scenario, observed(scenario)[0], kind).isfinite().all()


@pytest.mark.parametrize("features", ["relative", "set"])
def test_a_configuration_that_asks_for_them_trains_and_plays_with_them(features: str) -> None:
    overrides = (f"algorithm.features={features}", "algorithm.random_world_steps=20")
    config = load_config(algorithm="matd3", profile="smoke", fields={"obstacles": 2}, overrides=overrides)
    model = build_model(config, build_vec_env(config, 2), 0)
    before = model.policy.actor_state_dict()
    before = {name: weights.clone() for name, weights in before.items()}
    model.learn(600)
    assert not any(th.equal(weights, before[name]) for name, weights in model.policy.actor_state_dict().items())
    assert is_plain(model.actor)
    assert is_plain(model.critic)
    policy = build_policy(config)
    policy.actor.load_state_dict(model.actor.state_dict())
    observations = np.random.default_rng(0).uniform(-1, 1, (6, *model.observation_space.shape)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.predict(observations)[0])
    counted = count_weights(config.scenario, config.algorithm)["actors"]
    assert counted == sum(weights.numel() for weights in model.actor.parameters())


def test_weights_of_sets_serve_any_number_of_bodies() -> None:
    config = load_config(fields={"obstacles": 2}, overrides=("algorithm.features=set",))
    policy = build_policy(config)
    for fields in ({"pursuers": 2, "obstacles": 0}, {"pursuers": 7, "obstacles": 5}):
        in_setting = config.in_setting(config.cell.setting._replace(**fields))
        scenario = in_setting.scenario
        observations, _ = observed(scenario)
        actions, _ = fit_policy(policy, in_setting).predict(observations.numpy())
        assert actions.shape == (scenario.pursuers, 2)
        assert len(np.unique(actions, axis=0)) == scenario.pursuers


def test_a_policy_acts_for_fewer_bodies_as_where_the_others_are_not_there() -> None:
    config = load_config(fields={"pursuers": 5, "obstacles": 2}, overrides=("algorithm.features=set",))
    policy = build_policy(config)
    fewer = config.in_setting(config.cell.setting._replace(pursuers=3, obstacles=1))
    observations, _ = observed(fewer.scenario)
    in_all_slots = np.zeros((5, observation_size(config.scenario)), np.float32)
    in_all_slots[:3] = padded(observations, fewer.scenario, config.scenario)
    actions, _ = fit_policy(policy, fewer).predict(observations.numpy())
    np.testing.assert_allclose(actions, policy.predict(in_all_slots)[0][:3], atol=1e-6)
