"""What is kept of a round, by a few steps whose numbers tell where they come from."""

import math

import numpy as np
import pytest

from marl_encircle.core.geometry import Enclosure, Measure
from marl_encircle.core.rounds import NEVER, Rounds
from marl_encircle.core.scenario import Scenario

SCENARIO = Scenario(pursuers=2, obstacles=1)


def measured(complete_all: list[bool], complete_pursuers: list[bool], step: int) -> Measure:
    """Two worlds: world b's numbers at a step are 10 b + step, and so on."""
    world = np.arange(2.0)[:, None]

    def enclosure(complete: list[bool], extra: float) -> Enclosure:
        angle = 10 * world + step + np.array([[0.0, 2.0, 0.5]]) + extra
        nothing = np.zeros((2, 72))
        done = np.array(complete)
        return Enclosure(nothing.astype(np.int8), nothing, angle, angle.sum(axis=1), np.where(done, 0.01, np.inf), done)

    count = (np.array([[1, 0]]) + np.arange(2)[:, None] + step).astype(np.int64)
    return Measure(
        enclosure={"all": enclosure(complete_all, 0.0), "pursuers": enclosure(complete_pursuers, 100.0)},
        target_distance=np.ones((2, 2)),
        contacts_pursuers=count,
        contacts_target=np.zeros((2, 2), np.int64),
        contacts_obstacles=10 * count,
    )


def shares(step: int) -> dict[str, np.ndarray]:
    return {
        "time": np.array([[-1.0, -1.0], [-2.0, -2.0]]),
        "contraction": np.array([[1.0, 4.0], [5.0, 7.0]]) * step,
    }


def played(closure: str = "all", steps: int = 4) -> Rounds:
    """World 0 completes under ``all`` at step 2 and under ``pursuers`` at step 4; world 1 never."""
    rounds = Rounds(SCENARIO, closure, 2)  # type: ignore[arg-type]
    for step in range(1, steps + 1):
        rounds.add(np.array([step, step]), measured([step in (2, 4), False], [step == 4, False], step), shares(step))
    return rounds


def test_a_success_step_is_the_first_under_each_rule() -> None:
    rounds = played()
    assert rounds.success_step["all"].tolist() == [2, NEVER]
    assert rounds.success_step["pursuers"].tolist() == [4, NEVER]
    assert rounds.complete.tolist() == [True, False]
    assert played(steps=1).complete.tolist() == [False, False]


def test_a_step_returns_the_sum_of_its_shares() -> None:
    rewards = Rounds(SCENARIO, "all", 2).add(np.ones(2, np.int64), measured([False] * 2, [False] * 2, 1), shares(3))
    assert rewards.tolist() == [[2.0, 11.0], [13.0, 19.0]]


def test_figures_grow_up_to_success_and_no_further() -> None:
    rounds = played()
    # World 0 counts steps 1 and 2, world 1 all four: contraction 1 + 2 = 3 and 1 + 2 + 3 + 4 = 10 times its number
    assert rounds.length.tolist() == [2, 4]
    assert rounds.returns.tolist() == [[-2 + 3, -2 + 12], [-8 + 50, -8 + 70]]
    # Contacts: world 0 (2 + 1) + (3 + 2), world 1 (3 + 2) + (4 + 3) + (5 + 4) + (6 + 5)
    assert rounds.contacts_pursuers.tolist() == [8, 32]
    assert rounds.contacts_obstacles.tolist() == [80, 320]


def test_under_the_other_rule_they_grow_up_to_its_success() -> None:
    rounds = played("pursuers")
    assert rounds.length.tolist() == [4, 4]
    assert rounds.complete.tolist() == [True, False]
    assert rounds.summary(0)["occupied_angle"] == pytest.approx(3 * 2.5 + 302.5)  # mean of 3 step + 2.5 + 300


def test_the_summary_holds_each_figure_by_its_name() -> None:
    assert played().summary(1) == {
        "success_all": 0.0,
        "success_pursuers": 0.0,
        "length": 4.0,
        "occupied_angle": 3 * 12.5 + 2.5,  # three entities at 10 + step, step 2.5 on average, and 2.5 more
        "sigma_c": 1.0,  # 12.5 and 14.5
        "contacts_pursuers": 32.0,
        "contacts_obstacles": 320.0,
        "reward/time": -8.0,
        "reward/contraction": 60.0,  # (5 + 7) / 2 x 10
    }
    assert played().summary(0)["reward/contraction"] == 7.5  # (1 + 4) / 2 x 3
    assert (played().summary(0)["success_all"], played().summary(0)["success_pursuers"]) == (1.0, 1.0)


def test_sigma_c_is_the_spread_over_pursuers_of_the_mean_over_steps() -> None:
    # Eq. 15. Pursuer 0: (1 + 3) / 2 = 2, pursuer 1: (2 + 6) / 2 = 4, pursuer 2: 0 and 9 / 2 = 4.5
    # mean 3.5, squares 2.25 + 0.25 + 1 = 3.5, population deviation sqrt(3.5 / 3)
    rounds = Rounds(Scenario(pursuers=3, obstacles=0), "all", 1)
    still_open = np.array([False])
    for step, angles in ((1, [1.0, 2.0, 0.0]), (2, [3.0, 6.0, 9.0])):
        nothing = np.zeros((1, 72))
        e = Enclosure(nothing.astype(np.int8), nothing, np.array([angles]), np.zeros(1), np.full(1, np.inf), still_open)
        counts = np.zeros((1, 3), np.int64)
        m = Measure({"all": e, "pursuers": e}, np.ones((1, 3)), counts, counts, counts)
        rounds.add(np.array([step]), m, {"time": np.zeros((1, 3))})
    assert rounds.contribution_spread.tolist() == [pytest.approx(math.sqrt(3.5 / 3))]
    assert rounds.summary(0)["sigma_c"] == pytest.approx(math.sqrt(3.5 / 3))


def test_a_new_round_forgets_the_former_one_in_its_world_only() -> None:
    rounds = played()
    kept = rounds.summary(0)
    rounds.start(np.array([1]))
    assert rounds.summary(0) == kept
    assert rounds.success_step["all"].tolist() == [2, NEVER]
    rounds.add(np.array([5, 1]), measured([False] * 2, [False, True], 1), shares(1))
    fresh = Rounds(SCENARIO, "all", 2)
    fresh.add(np.array([1, 1]), measured([False] * 2, [False, True], 1), shares(1))
    assert rounds.summary(1) == fresh.summary(1)
    assert rounds.success_step["pursuers"].tolist() == [4, 1]
    assert rounds.summary(0) == kept


def test_a_resumed_round_goes_on_exactly() -> None:
    rounds, other = played(steps=1), Rounds(SCENARIO, "all", 2)
    saved = rounds.get_state()
    for step in (2, 3):
        rounds.add(np.array([step] * 2), measured([step == 2, False], [False] * 2, step), shares(step))
    other.set_state(saved)
    for step in (2, 3):
        other.add(np.array([step] * 2), measured([step == 2, False], [False] * 2, step), shares(step))
    assert [rounds.summary(b) for b in (0, 1)] == [other.summary(b) for b in (0, 1)]
    assert rounds.returns.tolist() == other.returns.tolist()


def test_other_terms_within_a_round_are_an_error() -> None:
    with pytest.raises(ValueError, match="shares of time after shares of time, contraction"):
        played().add(np.ones(2, np.int64), measured([False] * 2, [False] * 2, 1), {"time": np.zeros((2, 2))})
