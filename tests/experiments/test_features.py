"""What the networks read: every body as the target sees it, obstacles in an order of their own."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th

from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.experiments.build import build_model, build_policy, build_vec_env
from marl_encircle.experiments.config import count_weights, load_config
from marl_encircle.experiments.features import RelativeFeatures
from marl_encircle.maddpg.gradients import is_plain

RELATIVE = ("algorithm.features=relative",)


def observed(scenario: Scenario) -> tuple[th.Tensor, Any]:
    """Observations of the first round's pursuers (N, O), and the environment."""
    env = parallel_env(scenario)
    observations, _ = env.reset(seed=3)
    return th.from_numpy(np.stack(list(observations.values()))), env


def features_of(scenario: Scenario, observations: th.Tensor) -> th.Tensor:
    env = parallel_env(scenario)
    extractor = RelativeFeatures(env.observation_space("pursuer_0"), scenario)
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


def test_the_order_of_the_obstacles_means_nothing() -> None:
    scenario = Scenario(obstacles=3)
    observations, _ = observed(scenario)
    others = observations.clone()
    for name in ("obstacles", "obstacle_directions"):
        part = layout(scenario)[name]
        others[:, part] = observations[:, part].reshape(-1, 3, 2)[:, [2, 0, 1]].flatten(1)
    assert not th.equal(others, observations)
    assert th.equal(features_of(scenario, others), features_of(scenario, observations))


@pytest.mark.parametrize(
    "fields",
    [{"obstacles": 0}, {"pursuers": 2}, {"observe_directions": False}, {"observe_extras": ("speed_ratio",)}],
    ids=str,
)
def test_any_setting_has_features(fields: dict[str, Any]) -> None:
    scenario = replace(Scenario(), **fields)
    assert features_of(scenario, observed(scenario)[0]).isfinite().all()


def test_a_configuration_that_asks_for_them_trains_and_plays_with_them() -> None:
    config = load_config(algorithm="matd3", profile="smoke", fields={"obstacles": 2}, overrides=RELATIVE)
    model = build_model(config, build_vec_env(config, 2), 0)
    model.learn(600)
    assert is_plain(model.actor)
    assert is_plain(model.critic)
    policy = build_policy(config)
    policy.actor.load_state_dict(model.actor.state_dict())
    observations = np.random.default_rng(0).uniform(-1, 1, (6, *model.observation_space.shape)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], model.predict(observations)[0])
    assert count_weights(config)["actors"] == sum(weights.numel() for weights in model.actor.parameters())
