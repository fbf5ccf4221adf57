"""The step that all engines share."""

import numpy as np
import pytest
from gymnasium.spaces import Box

from marl_encircle.core.observations import bounds
from marl_encircle.core.rewards import TERMS, Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.arena import Arena, spaces_of


def test_an_outcome_stays_as_it_was() -> None:
    arena = Arena(Scenario(pursuers=6, obstacles=4, movement_range_limit=100.0, max_cycles=3), Reward(), 32)
    arena.simulator.seed(0)
    arena.reset()
    rng = np.random.default_rng(0)
    kept, copies = [], []
    for _ in range(12):
        outcome = arena.step(rng.uniform(-1, 1, (32, 6, 2)))
        kept.append(outcome)
        copies.append([array.copy() for array in outcome])
        over = np.flatnonzero(outcome.terminated | outcome.truncated)
        arena.restart(over, outcome.observations.copy())
    assert any(outcome.terminated.any() for outcome in kept)
    for outcome, copy in zip(kept, copies, strict=True):
        for array, before in zip(outcome, copy, strict=True):
            assert np.array_equal(array, before)


def test_no_world_is_both_terminated_and_truncated() -> None:
    arena = Arena(Scenario(pursuers=6, obstacles=4, movement_range_limit=100.0, max_cycles=1), Reward(), 64)
    arena.simulator.seed(0)
    arena.reset()
    outcome = arena.step(np.zeros((64, 6, 2)))
    assert np.array_equal(outcome.terminated, ~outcome.truncated)
    assert outcome.terminated.any()
    assert outcome.truncated.any()


def test_a_reward_term_sees_the_actions_as_the_pursuers_did_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TERMS, "effort", lambda t: np.abs(t.actions).sum(axis=2))
    arena = Arena(Scenario(), Reward({"effort": -1.0}, scale=1.0), 1)
    arena.reset()
    given = np.array([[[5.0, -0.25], [-1.5, 1.0], [0.0, 0.5]]])
    kept = given.copy()
    # 1 + 0.25, 1 + 1, 0 + 0.5
    assert arena.step(given).rewards[0].tolist() == [-1.25, -2.0, -0.5]
    assert np.array_equal(given, kept)


def test_a_pursuer_sees_within_its_bounds_and_acts_along_two_axes() -> None:
    scenario = Scenario(pursuers=4, obstacles=2)
    spaces = spaces_of(scenario)
    low, high = bounds(scenario)
    assert np.array_equal(spaces.observation.low, low)
    assert np.array_equal(spaces.observation.high, high)
    assert spaces.action == Box(-1.0, 1.0, (2,), np.float32)
    assert spaces.observation is not spaces_of(scenario).observation
