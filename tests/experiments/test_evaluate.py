"""An evaluation round is one world with one seed, whoever plays it and however many are played."""

from typing import Any

import numpy as np
import pytest
import torch as th
from tiny_runs import finished, tiny

from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.experiments import evaluate
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import load_policy


def play(config: Config, episodes: int, seed: int = 5) -> list[Episode]:
    return play_rounds(load_policy(finished()), config, episodes, seed)


def test_fewer_rounds_are_the_first_of_more() -> None:
    rounds = play(tiny(), 230)
    for episodes in (1, 3, 99, 100, 101, 200):
        assert play(tiny(), episodes) == rounds[:episodes]
    assert [each.round for each in rounds] == list(range(230))
    assert [each.seed for each in rounds] == world_seeds(5, 230)


def test_another_seed_is_other_rounds() -> None:
    assert play(tiny(), 5, 5) != play(tiny(), 5, 6)


def test_the_methods_closure_changes_its_return_but_not_how_a_round_goes() -> None:
    ours, model_a = play(tiny("ours"), 60), play(tiny("model_a"), 60)
    for one, other in zip(ours, model_a, strict=True):
        assert (one.seed, one.step_all, one.step_pursuers) == (other.seed, other.step_all, other.step_pursuers)
        assert one.length == other.length
    assert {each.step_all for each in ours} > {None}
    assert any(each.step_all != each.step_pursuers for each in ours), "else the rules were never told apart"


def test_a_round_lasts_until_both_rules_have_held_or_time_is_up() -> None:
    for each in play(tiny(), 60):
        steps = (each.step_all, each.step_pursuers)
        assert each.length == (20 if None in steps else max(step for step in steps if step))
        assert each.step_all is None or each.step_pursuers is None or each.step_all <= each.step_pursuers


def test_a_round_is_what_the_environment_plays() -> None:
    policy, config = load_policy(finished()), tiny()
    rounds = play(config, 12)
    for each in rounds:
        env = parallel_env(config.scenario, config.reward.build())
        observations, _ = env.reset(seed=each.seed)
        infos: dict[str, Any] = {}
        while env.agents:
            actions, _ = policy.predict(np.stack(list(observations.values())), deterministic=True)
            observations, _, _, _, infos = env.step(dict(zip(env.agents, np.asarray(actions), strict=True)))
        figures = infos["pursuer_0"]["round"]
        assert figures["success_all"] == (each.step_all is not None)
        assert each.step_all is None or figures["length"] == each.step_all
        assert figures["sigma_c"] == pytest.approx(each.sigma_c, rel=1e-4)


def test_rounds_are_played_at_the_final_difficulty_without_noise_and_without_a_trace() -> None:
    policy = load_policy(finished())
    without = tiny(overrides=["training.curriculum.safety_distance=null", "algorithm.exploration_noise.start=9"])
    np.random.seed(3)  # noqa: NPY002 - SB3's generator
    expected, before = np.random.randint(1 << 30), th.get_rng_state()  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    assert play_rounds(policy, tiny(), 10, 5) == play_rounds(policy, without, 10, 5)
    assert np.random.randint(1 << 30) == expected  # noqa: NPY002
    assert th.equal(th.get_rng_state(), before)


def test_rounds_are_measured_in_the_evaluations_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    arena = evaluate.Arena

    def noting(scenario: Any, *rest: Any) -> Any:
        seen.append(scenario.n_directions)
        return arena(scenario, *rest)

    monkeypatch.setattr(evaluate, "Arena", noting)
    play(tiny(overrides=["evaluation.n_directions=180", "scenario.n_directions=36"]), 1)
    assert seen == [180]
