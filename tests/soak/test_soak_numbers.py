"""Numbers that stay finite, placements that end, and intervals that cover."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv
from test_engines import EVERY_TERM, WORST, native, supersuit
from test_metrics import covered, independent_study, shared_study
from test_scenes import INFEASIBLE, drawn
from test_simulator import degenerate

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import PlacementError, Simulator
from marl_encircle.experiments import metrics

SEEDS = 1000
COVER = 0.45
STUDIES = 2000


def fuzz(venv: VecEnv, simulators: list[Simulator], n_steps: int, rng: np.random.Generator) -> tuple[int, int]:
    """Play actions of every size, with bodies put where they cannot be.

    :return: how many numbers were told, and how many of them were not finite
    """
    venv.seed(int(rng.integers(2**31)))
    observations = venv.reset()
    told = bad = 0
    for step in range(n_steps):
        if step % 10 == 0:
            toward = rng.uniform(-1, 1, (venv.num_envs, 2)) * 10.0 ** rng.integers(-30, 30)
        if step % 3 == 0:
            for simulator in simulators:
                degenerate(simulator, rng)
        observations, rewards, dones, infos = venv.step(toward.astype(np.float32))
        ends = [infos[slot] for slot in np.flatnonzero(dones)]
        figures = [np.concatenate([info["terminal_observation"], list(info["round"].values())]) for info in ends]
        for array in (observations, rewards, *figures):
            told, bad = told + array.size, bad + int((~np.isfinite(array)).sum())
    return told, bad


@pytest.mark.parametrize(
    ("make", "n_worlds", "world_steps"),
    [(native, 250, 10**6), (supersuit, 4, 10**5)],
    ids=["native", "supersuit"],
)
def test_fuzzed_steps_are_finite(make: Callable[..., VecEnv], n_worlds: int, world_steps: int, promise: Any) -> None:
    rng = np.random.default_rng(13)
    told = bad = 0
    for fields in WORST:
        venv = make(Scenario(**fields), Reward(EVERY_TERM), n_worlds)
        simulators = list(dict.fromkeys(venv.get_attr("simulator")))
        assert sum(simulator.n_worlds for simulator in simulators) == n_worlds
        here, wrong = fuzz(venv, simulators, world_steps // n_worlds // len(WORST), rng)
        told, bad = told + here, bad + wrong
    promise(
        f"numbers, of {told:,}, that are not finite in {world_steps:,} fuzzed steps of worlds on {make.__name__}, "
        "with bodies put on each other",
        bad,
        0,
    )
    assert bad == 0


def test_what_covers_45_percent_is_placed(promise: Any) -> None:
    scenario = Scenario(obstacles=14)
    assert scenario.cover == pytest.approx(COVER, abs=0.005)
    placed = 0
    for seed in range(SEEDS):
        try:
            drawn(scenario, 1, seed)
        except PlacementError:
            continue
        placed += 1
    promise(f"seeds, of {SEEDS}, that place bodies on {scenario.cover:.0%} of the scene", placed, SEEDS)
    assert placed == SEEDS


def test_what_cannot_be_placed_is_refused_in_time(promise: Any) -> None:
    drawn(Scenario())  # compiled by now
    seconds = []
    for scenario in INFEASIBLE.values():
        for n_worlds in (1, 256):
            simulator = Simulator(scenario, n_worlds, 0)
            started = time.process_time()  # other jobs of the machine do not count
            with pytest.raises(PlacementError):
                simulator.reset()
            seconds.append(time.process_time() - started)
    promise(
        f"seconds until a scene of {len(INFEASIBLE)} kinds that has no room is refused", f"{max(seconds):.2f}", "< 1"
    )
    assert max(seconds) < 5


def test_intervals_of_cells_cover(promise: Any) -> None:
    shares = {}
    for seeds in (3, 5):
        for share in (0.75, 0.9, 0.98):
            for spread in (0.0, 0.005, 0.01):
                for study, studies in ((independent_study, STUDIES), (shared_study, STUDIES // 4)):
                    for rounds in (200, 1000):
                        simulated = study(share, spread, seeds, rounds, studies).tolist()
                        intervals = [metrics.share_interval(row, rounds) for row in simulated]
                        shares[study.__name__, seeds, share, spread, rounds] = covered(intervals, share)
    worst = min(shares, key=shares.__getitem__)
    promise(
        f"least share of intervals that cover the truth, of {len(shares)} kinds of simulated studies",
        f"{shares[worst]:.1%}",
        ">= 93 %",
    )
    assert shares[worst] >= 0.93, worst
