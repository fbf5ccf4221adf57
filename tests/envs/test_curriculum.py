"""Difficulty follows the world steps, acts at each world's next round, and ends exactly at the scenario's."""

from typing import Any

import numpy as np
import pytest

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.curriculum import CurriculumVecEnv, Ramp
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv

SCENARIO = Scenario(max_cycles=5)


def native(n_worlds: int = 3) -> EncirclementVecEnv:
    return EncirclementVecEnv(SCENARIO, Reward(), n_worlds)


def supersuit(n_worlds: int = 3) -> SuperSuitVecEnv:
    return SuperSuitVecEnv(lambda: parallel_env(SCENARIO), n_worlds)


def still(venv: Any) -> np.ndarray:
    return np.zeros((venv.num_envs, 2), np.float32)


def test_a_ramp_is_a_straight_line_that_ends_exactly() -> None:
    ramp = Ramp(0.3, 0.11, 100)
    assert ramp.at(0) == pytest.approx(0.3)
    assert ramp.at(25) == pytest.approx(0.2525)  # 0.3 - 0.19 / 4
    assert ramp.at(50) == pytest.approx(0.205)
    assert ramp.at(100) == ramp.at(101) == ramp.at(10**9) == 0.11
    assert Ramp(0.1, 0.4, 10).at(5) == pytest.approx(0.25)


@pytest.mark.parametrize("engine", [native, supersuit])
def test_difficulty_counts_every_worlds_steps(engine: Any) -> None:
    venv = CurriculumVecEnv(engine(), {"safety_distance": Ramp(0.3, 0.11, 30), "speed_ratio": Ramp(1.0, 1.1, 15)})
    venv.reset()
    for step in range(1, 12):
        venv.step(still(venv))
        assert venv.world_steps == 3 * step
        assert venv.difficulty["safety_distance"] == pytest.approx(max(0.11, 0.3 - 0.19 * 3 * step / 30))
        assert venv.difficulty["speed_ratio"] == pytest.approx(min(1.1, 1.0 + 0.1 * 3 * step / 15))


def test_a_world_takes_the_difficulty_of_the_step_in_which_its_round_starts() -> None:
    inner = native()
    venv = CurriculumVecEnv(inner, {"safety_distance": Ramp(0.3, 0.1, 30)})
    venv.reset()
    for step in range(1, 16):
        # rounds last 5 steps; the one that starts in step s sees the difficulty after 3 (s - 1) world steps
        started = 5 * (step // 5)
        venv.step(still(venv))
        expected = max(0.1, 0.3 - 0.2 * 3 * max(0, started - 1) / 30)
        assert inner.simulator.state.safety_distance == pytest.approx(expected)
    assert (inner.simulator.state.safety_distance == 0.1).all()


def test_worlds_hear_of_changes_only(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[dict[str, float]] = []
    monkeypatch.setattr(EncirclementVecEnv, "set_difficulty", lambda self, difficulty: heard.append(difficulty))
    venv = CurriculumVecEnv(native(), {"safety_distance": Ramp(0.3, 0.11, 12)})
    venv.reset()
    for _ in range(10):
        venv.step(still(venv))
    # at 0, 3, 6, 9, 12 world steps, at the reset for the first of them
    assert [each["safety_distance"] for each in heard] == pytest.approx([0.3, 0.2525, 0.205, 0.1575, 0.11])


def test_without_ramps_nothing_is_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EncirclementVecEnv, "set_difficulty", lambda *_: pytest.fail("nobody asked for it"))
    venv = CurriculumVecEnv(native(), {})
    venv.reset()
    venv.step(still(venv))
    assert venv.difficulty == {}
    assert venv.world_steps == 3


def test_what_the_worlds_tell_passes_through() -> None:
    venv = CurriculumVecEnv(native(), {})
    assert (venv.n_agents, venv.n_worlds, venv.num_envs) == (3, 3, 9)
    assert venv.observation_space == native().observation_space
