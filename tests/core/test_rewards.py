"""Each reward term by an example worked out by hand, and the rules by which they add up (Eq. 11-13)."""

import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from core_worlds import arranged, random_actions, transition
from exact_arcs import ring

from marl_encircle.core import rewards
from marl_encircle.core.geometry import NOBODY, Enclosure
from marl_encircle.core.rewards import OURS, TERMS, Reward, Transition
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

TURN = 2 * math.pi
QUARTERS = (TURN / 4, TURN / 8, TURN / 8, TURN / 16)


def told(
    contributing: tuple[float, ...] = QUARTERS,
    complete: bool = False,
    closure: str = "all",
    occupied: float | None = None,
    **measured: list[float],
) -> Transition:
    """Three pursuers and one obstacle that contribute so much, under both closure rules (pursuers: theirs alone)."""
    sim = arranged([(0.3, 0.0), (0.0, 0.4), (-0.5, 0.0)], discs=[(0.0, -0.5, 0.1)], n_directions=72)
    t = transition(sim, closure)

    def enclosure(angles: tuple[float, ...], done: bool) -> Enclosure:
        total = sum(angles) if occupied is None else occupied
        return Enclosure(
            owner=np.full((1, 72), NOBODY, np.int8),
            nearness=np.zeros((1, 72)),
            contributing_angle=np.array([angles]),
            occupied_angle=np.array([total]),
            movement_range=np.array([0.01 if done else np.inf]),
            complete=np.array([done]),
        )

    both = {"all": enclosure(contributing, complete), "pursuers": enclosure((*contributing[:3], 0.0), False)}
    fields = {name: np.array([values]) for name, values in measured.items()}
    return t._replace(measure=t.measure._replace(enclosure=both, **fields))


def term(name: str, t: Transition, **parameters: float) -> list[float]:
    value = TERMS[name](t, **parameters)
    assert value.shape == (t.state.pursuers.shape[0], t.pursuers)
    return value[0].tolist()


def near(*values: float) -> Any:
    return pytest.approx(list(values), abs=1e-12)


def test_the_registry_is_what_the_file_defines() -> None:
    def is_term(f: object) -> bool:
        return (
            inspect.isfunction(f)
            and f.__module__ == rewards.__name__
            and next(iter(inspect.signature(f).parameters)) == "t"
        )

    defined = {name: f for name, f in vars(rewards).items() if is_term(f) and not name.startswith("_")}
    assert defined == TERMS
    assert set(OURS) <= set(TERMS)
    assert set(TERMS) >= rewards.CONTRACTION_STAGE


def test_the_default_reward_is_that_of_the_notes() -> None:
    reward = Reward()
    assert (reward.closure, reward.two_stage, reward.scale) == ("all", True, 0.05)
    assert {name: weight for name, (weight, _) in reward.active.items()} == {
        "overall_angle": 1,
        "contributing_angle": 1,
        "obstacle_angle": 0.5,
        "contraction": 1,
        "collision": 0.5,
        "completion": 50,
        "time": 8,
    }


# Terms


def test_the_overall_angle_is_the_occupied_share_of_the_circle() -> None:
    assert term("overall_angle", told()) == near(9 / 16, 9 / 16, 9 / 16)
    assert term("overall_angle", told(closure="pursuers")) == near(1 / 2, 1 / 2, 1 / 2)


def test_the_contributing_angle_is_each_pursuers_share_times_their_number() -> None:
    assert term("contributing_angle", told()) == near(3 / 4, 3 / 8, 3 / 8)


def test_the_obstacle_angle_is_the_share_of_all_obstacles() -> None:
    assert term("obstacle_angle", told()) == near(1 / 16, 1 / 16, 1 / 16)
    assert term("obstacle_angle", told(closure="pursuers")) == near(0, 0, 0)


def test_contraction_is_the_inverse_distance_up_to_a_cap() -> None:
    # 1/0.5, 1/0.25, and 1/0.1 = 10 above the cap of 20/3
    t = told(target_distance=[0.5, 0.25, 0.1])
    assert term("contraction", t) == near(2, 4, 20 / 3)
    assert term("contraction", t, cap=3.0) == near(2, 3, 3)
    assert term("contraction", told(target_distance=[0.0, 0.0, 0.0]), cap=3.0) == near(3, 3, 3)


def test_collision_counts_every_touched_body() -> None:
    t = told(contacts_pursuers=[2, 0, 1], contacts_target=[1, 0, 0], contacts_obstacles=[0, 0, 3])
    assert term("collision", t) == [-3, 0, -4]


def test_completion_is_one_when_complete_under_the_methods_rule() -> None:
    assert term("completion", told(complete=False)) == [0, 0, 0]
    assert term("completion", told(complete=True)) == [1, 1, 1]
    assert term("completion", told(complete=True, closure="pursuers")) == [0, 0, 0]


def test_time_costs_one_a_step() -> None:
    assert term("time", told()) == [-1, -1, -1]


def test_the_encirclement_radius_is_the_distance_from_the_ring() -> None:
    t = told(target_distance=[0.15, 0.25, 0.05])
    assert term("encirclement_radius", t) == near(0, -0.1, -0.1)
    assert term("encirclement_radius", t, radius=0.25) == near(-0.1, 0, -0.2)


def test_the_phase_difference_is_the_way_from_the_middle_of_the_two_neighbours() -> None:
    # At 0, 90 and 180 degrees the gaps are 90, 90, 180: middles are |180 - 90| / 2, |90 - 90| / 2, |90 - 180| / 2
    # = 45, 0, 45 of 180 degrees
    assert term("phase_difference", told()) == near(-0.25, 0, -0.25)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_a_ring_in_any_order_has_no_phase_difference(n: int) -> None:
    corners = ring(n, 0.3, 0.4)
    order = np.random.default_rng(n).permutation(n)
    t = transition(arranged([(0.1 + corners[i][0], corners[i][1]) for i in order], (0.1, 0.0)))
    assert term("phase_difference", t) == near(*[0] * n)


def test_one_pursuer_has_no_phase_difference_and_two_on_one_side_have_the_most() -> None:
    assert term("phase_difference", transition(arranged([(0.2, 0.1)]))) == [0]
    # Gaps of 0 and 360 degrees: 180 of 180 off the middle
    assert term("phase_difference", transition(arranged([(0.2, 0.1), (0.4, 0.2)]))) == near(-1, -1)


@pytest.mark.compiled
def test_terms_stay_in_the_ranges_that_they_promise() -> None:
    sim, rng = Simulator(Scenario(pursuers=4, obstacles=2), 64, 1), np.random.default_rng(1)
    sim.reset()
    ranges = {
        "overall_angle": (0, 1),
        "contributing_angle": (0, 4),
        "obstacle_angle": (0, 1),
        "contraction": (0, 20 / 3),
    }
    ranges |= {"phase_difference": (-1, 0), "completion": (0, 1)}
    for _ in range(60):
        sim.step(random_actions(sim, rng))
        for name, (low, high) in ranges.items():
            value = TERMS[name](transition(sim))
            assert value.shape == (64, 4)
            assert value.min() >= low - 1e-12
            assert value.max() <= high + 1e-12


# Sums


def parts(reward: Reward, t: Transition) -> dict[str, list[float]]:
    return {name: share[0].tolist() for name, share in reward.parts(t).items()}


def test_a_part_is_scale_times_weight_times_term() -> None:
    reward = Reward({"overall_angle": 2.0, "contraction": {"weight": 3, "cap": 1.0}}, two_stage=False, scale=0.1)
    assert parts(reward, told()) == {
        "overall_angle": near(0.1 * 2 * 9 / 16, 0.1 * 2 * 9 / 16, 0.1 * 2 * 9 / 16),
        "contraction": near(0.3, 0.3, 0.3),
    }


@pytest.mark.parametrize("n_directions", [72, 100, 300, 360, 400])
@pytest.mark.parametrize("threshold", [0.93, 0.5, 1.0])
def test_contraction_and_completion_wait_for_the_threshold_and_begin_at_it(threshold: float, n_directions: int) -> None:
    needed = math.ceil(round(threshold * n_directions, 6))
    for count, open_ in ((needed - 1, False), (needed, True)):
        for occupied in (count * (TURN / n_directions), count * TURN / n_directions, count / n_directions * TURN):
            t = told(complete=True, occupied=occupied)
            t = t._replace(scenario=Scenario(stage_threshold=threshold))
            shares = parts(Reward(), t)
            for name in ("contraction", "completion"):
                assert (min(shares[name]) > 0) is open_
            assert min(shares["overall_angle"]) > 0
            assert shares["time"] == near(-0.4, -0.4, -0.4)
            assert min(parts(Reward(two_stage=False), t)["completion"]) > 0


def test_the_gate_opens_by_the_methods_own_enclosure() -> None:
    # With the obstacle 7/8 + 1/16 = 0.9375; pursuers alone 0.875
    t = told((TURN / 2, TURN / 4, TURN / 8, TURN / 16))
    assert min(parts(Reward(), t)["contraction"]) > 0
    assert parts(Reward(closure="pursuers"), t._replace(closure="pursuers"))["contraction"] == [0, 0, 0]


def test_a_term_without_weight_is_never_called(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(t: Transition) -> np.ndarray:
        raise AssertionError("called")

    for name in TERMS:
        monkeypatch.setitem(TERMS, name, never)
    assert Reward(dict.fromkeys(TERMS)).parts(told()) == {}
    assert Reward({"time": {"weight": None}}).parts(told()) == {}
    with pytest.raises(AssertionError, match="called"):
        Reward({"time": 0.0}).parts(told())


def test_a_term_of_ones_own_is_weighted_like_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def approach(t: Transition, *, limit: float = 0.1) -> np.ndarray:
        return np.minimum(t.former_measure.target_distance - t.measure.target_distance, limit)

    monkeypatch.setitem(TERMS, "approach", approach)
    t = told(target_distance=[0.4, 0.5, 0.25])
    t = t._replace(former_measure=t.measure._replace(target_distance=np.array([[0.45, 0.4, 0.75]])))
    parts = Reward({"time": 1.0, "approach": {"weight": 2.0, "limit": 0.3}}, scale=0.5).parts(t)
    assert list(parts) == ["time", "approach"]
    assert parts["approach"][0].tolist() == near(0.05, -0.1, 0.3)


@pytest.mark.parametrize("value", [np.zeros(3), np.zeros((1, 1)), np.zeros((2, 3)), 0.0, [[0.0, 0.0, 0.0]]])
def test_a_term_must_return_a_number_for_each_pursuer_of_each_world(
    monkeypatch: pytest.MonkeyPatch, value: object
) -> None:
    monkeypatch.setitem(TERMS, "wrong", lambda t: value)
    with pytest.raises(ValueError, match=r"terms\.wrong must return an array \(B, N\), here \(1, 3\); got "):
        Reward({"wrong": 1.0}).parts(told())


@pytest.mark.compiled
def test_without_obstacles_model_a_and_ours_earn_the_same() -> None:
    model_a = Reward({**OURS, "obstacle_angle": None}, closure="pursuers")
    sim, rng = Simulator(Scenario(obstacles=0), 64, 1), np.random.default_rng(1)
    sim.reset()
    for _ in range(60):
        sim.step(random_actions(sim, rng))
        ours, theirs = Reward().parts(transition(sim)), model_a.parts(transition(sim, "pursuers"))
        assert (ours.pop("obstacle_angle") == 0).all()
        assert list(ours) == list(theirs)
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name])


def test_with_obstacles_they_do_not() -> None:
    t = told()
    assert (
        parts(Reward(), t)["overall_angle"]
        != parts(Reward(closure="pursuers"), t._replace(closure="pursuers"))["overall_angle"]
    )


WRONG: dict[str, tuple[Callable[[], Reward], str]] = {
    "unknown term": (lambda: Reward({"contracton": 1.0}), r"terms\.contracton: unknown .*did you mean contraction\?"),
    "nothing like it": (lambda: Reward({"zzz": 1.0}), r"terms\.zzz: .*known: collision, completion"),
    "unknown parameter": (
        lambda: Reward({"contraction": {"weight": 1, "capp": 2}}),
        r"terms\.contraction\.capp: unknown parameter; did you mean cap\?",
    ),
    "no weight": (lambda: Reward({"contraction": {"cap": 2.0}}), r"terms\.contraction needs a weight"),
    "text": (lambda: Reward({"time": "8"}), r"terms\.time\.weight must be a finite number; got '8'"),  # type: ignore[dict-item]
    "yes": (lambda: Reward({"time": True}), r"terms\.time\.weight must be a finite number; got True"),
    "too large": (lambda: Reward({"time": 10**400}), r"terms\.time\.weight must be a finite number; got 1000"),
    "scale": (lambda: Reward(scale=math.nan), r"^scale must be a finite number; got nan"),
    "nan": (lambda: Reward({"time": math.nan}), r"terms\.time\.weight must be a finite number; got nan"),
    "null parameter": (
        lambda: Reward({"contraction": {"weight": 1, "cap": None}}),  # type: ignore[dict-item]
        r"terms\.contraction\.cap must be a finite number; got None",
    ),
    "closure": (lambda: Reward(closure="some"), r"closure must be one of all, pursuers; got 'some'"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize(("make", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_reward_is_an_error_that_says_where(make: Callable[[], Reward], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_numpys_numbers_are_pythons() -> None:
    terms: dict[str, Any] = {
        "time": np.int64(8),
        "contraction": {"weight": np.float32(0.5), "cap": np.uint8(3)},
        "collision": None,
    }
    rest: dict[str, Any] = {"closure": np.str_("pursuers"), "two_stage": np.False_, "scale": np.float32(0.25)}
    reward = Reward(terms, **rest)
    plain: dict[str, Any] = {"time": 8, "contraction": {"weight": 0.5, "cap": 3}, "collision": None}
    assert repr(reward) == repr(Reward(plain, closure="pursuers", two_stage=False, scale=0.25))
    assert repr(reward.active) == "{'contraction': (0.5, {'cap': 3}), 'time': (8.0, {})}"
    assert isinstance(terms["time"], np.int64), "what was given stays as it was"


@pytest.mark.parametrize("value", [np.float32("nan"), np.float64("inf"), np.True_, np.array(8), np.complex64(8)])
def test_numpys_other_values_are_no_weights(value: Any) -> None:
    for term in (value, {"weight": value}):
        with pytest.raises(ValueError, match=r"terms\.time\.weight must be a finite number; got "):
            Reward({"time": term})


def test_a_long_name_is_quoted_in_short() -> None:
    with pytest.raises(ValueError) as caught:
        Reward({"x" * 10_000: 1.0})
    assert len(str(caught.value)) < 400
