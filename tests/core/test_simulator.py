"""Worlds side by side: seeds, exact resume, difficulty, bad actions, and numbers that stay finite."""

import copy
import json
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from core_worlds import arranged, push, random_actions
from hypothesis import given
from hypothesis import strategies as st

from marl_encircle.core.observations import layout, observe
from marl_encircle.core.rewards import TERMS, Reward, Transition
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator, world_seeds

DENSE = Scenario(pursuers=4, obstacles=8)
"""Placement needs several draws in some worlds."""


def everything(sim: Simulator) -> dict[str, np.ndarray]:
    """Copies of all that a simulator tells about its worlds, world axis first."""
    m = sim.measure
    told = {**sim.state._asdict(), "steps": sim.steps}
    for closure, enclosure in m.enclosure.items():
        told |= {f"{closure}/{name}": array for name, array in enclosure._asdict().items()}
    told |= {name: getattr(m, name) for name in m._fields if name != "enclosure"}
    return {name: array.copy() for name, array in told.items()}


def assert_same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


# Seeds


@given(seed=st.integers(0, 2**63), n=st.integers(1, 50), more=st.integers(0, 50))
def test_the_first_worlds_have_the_same_seeds_whatever_the_number(seed: int, n: int, more: int) -> None:
    seeds = world_seeds(seed, n + more)
    assert seeds[:n] == world_seeds(seed, n)
    assert len(set(seeds)) == n + more
    assert all(0 <= s < 2**63 for s in seeds)


def test_the_seeds_of_worlds_never_change_from_release_to_release() -> None:
    first = np.random.SeedSequence(7).generate_state(2, np.uint64)
    assert world_seeds(7, 2) == [int(word) // 2 for word in first]


@pytest.mark.compiled
def test_a_world_is_the_same_alone_and_in_any_batch() -> None:
    together = Simulator(DENSE, 9, seed=4)
    alone = Simulator(DENSE, 1, seed=0)
    alone.seed([world_seeds(4, 9)[6]])
    rng = np.random.default_rng(0)
    for _ in range(5):
        together.reset(np.array([6, 2]))
        alone.reset()
        for _ in range(40):
            actions = random_actions(together, rng)
            together.step(actions)
            alone.step(actions[6:7])
            told = everything(together)
            assert_same({name: told[name][6:7] for name in told if name != "steps"}, everything(alone))


def test_seeding_again_starts_the_same_rounds_again() -> None:
    sim = Simulator(DENSE, 3, seed=11)
    sim.reset()
    first = everything(sim)
    sim.reset()
    assert (sim.state.target != first["target"]).all()
    sim.seed(11)
    sim.reset()
    assert_same(first, everything(sim))


def test_a_placement_draws_the_same_number_of_random_numbers_for_ever() -> None:
    # Eight times what is needed if all fits at once: 3 for each obstacle, 2 for each of four other bodies
    sim, stream = Simulator(Scenario(obstacles=2), 1), np.random.default_rng(7)
    sim.seed([7])
    sim.reset()
    stream.random(8 * (3 * 2 + 2 * 4))
    assert sim.get_state()["streams"] == [stream.bit_generator.state]


def test_the_seeds_of_worlds_may_be_an_array() -> None:
    seeds = world_seeds(4, 3)
    listed, array = Simulator(DENSE, 3, seed=0), Simulator(DENSE, 3, seed=0)
    listed.seed(seeds)
    array.seed(np.array(seeds))  # type: ignore[arg-type]  # typed as a sequence
    for sim in (listed, array):
        sim.reset()
    assert np.array_equal(listed.state.pursuers, array.state.pursuers)


def test_worlds_without_a_seed_differ_every_time() -> None:
    a, b = Simulator(Scenario(), 2), Simulator(Scenario(), 2)
    assert (a.reset().target_distance != b.reset().target_distance).all()


def test_the_number_of_seeds_and_of_worlds_is_checked() -> None:
    with pytest.raises(ValueError, match="3 worlds need 3 seeds; got 2"):
        Simulator(Scenario(), 3).seed([1, 2])
    with pytest.raises(ValueError, match="n_worlds must be at least 1; got 0"):
        Simulator(Scenario(), 0)
    assert Simulator(Scenario()).n_worlds == 1


# Resume


@pytest.mark.compiled
def test_a_resumed_simulator_goes_on_bit_for_bit() -> None:
    sim, rng = Simulator(DENSE, 5, seed=2), np.random.default_rng(3)
    sim.set_difficulty({"safety_distance": 0.2})
    sim.reset()
    for _ in range(17):
        sim.step(random_actions(sim, rng))
    saved = copy.deepcopy(sim.get_state())
    plan = [(random_actions(sim, rng), rng.random(5) < 0.05) for _ in range(500)]

    def play(s: Simulator) -> dict[str, np.ndarray]:
        for actions, over in plan:
            s.step(actions)
            if over.any():
                s.reset(np.flatnonzero(over))
        return everything(s)

    expected = play(sim)
    fresh = Simulator(DENSE, 5, seed=99)
    fresh.set_state(saved)
    assert_same(expected, play(fresh))
    sim.set_state(saved)
    assert_same(expected, play(sim))


def test_the_saved_state_is_a_copy_and_its_streams_are_plain_numbers() -> None:
    sim = Simulator(Scenario(), 2, seed=1)
    sim.reset()
    saved = sim.get_state()
    before = copy.deepcopy(saved["state"])
    push(sim, (1.0, 1.0))
    sim.reset()
    assert_same(before, saved["state"])
    assert json.loads(json.dumps(saved["streams"])) == saved["streams"]


def test_without_its_streams_a_resume_would_be_noticed() -> None:
    sim = Simulator(Scenario(), 2, seed=1)
    sim.reset()
    other = Simulator(Scenario(), 2, seed=7)
    saved = sim.get_state()
    other.set_state(saved | {"streams": other.get_state()["streams"]})
    assert (sim.reset().target_distance != other.reset().target_distance).all()


# Difficulty


def test_a_difficulty_acts_from_each_worlds_next_reset_on() -> None:
    sim = Simulator(Scenario(), 3, seed=1)
    sim.reset()
    sim.set_difficulty({"speed_ratio": 1.3, "obstacle_radius": 0.1})
    push(sim)
    assert sim.state.speed_ratio.tolist() == [1.1] * 3
    sim.reset(np.array([1]))
    assert sim.state.speed_ratio.tolist() == [1.1, 1.3, 1.1]
    assert sim.state.obstacle_radius.tolist() == [0.2, 0.1, 0.2]
    assert sim.state.discs[:, 0, 2].tolist() == [0.2, 0.1, 0.2]
    assert sim.state.safety_distance.tolist() == [0.11] * 3
    sim.set_difficulty({"safety_distance": 0.3})  # the others stay as they were set
    sim.reset(np.array([2]))
    assert sim.state.speed_ratio.tolist() == [1.1, 1.3, 1.3]
    assert sim.state.safety_distance.tolist() == [0.11, 0.11, 0.3]


def test_the_target_moves_by_the_safety_distance_and_the_ratio_of_its_world() -> None:
    # The pursuer behind is nearer; samples of 1.0 x 0.01: 0.5 - s >= 0.405 up to 0.09
    sim = arranged([(-0.46, 0.0), (0.5, 0.0)], contacts="off", wall_weight=0.0)
    sim.state.safety_distance[0] = 0.405
    sim.state.speed_ratio[0] = 1.0
    assert push(sim).state.target[0].tolist() == pytest.approx([0.09, 0.0])


@pytest.mark.parametrize(
    ("difficulty", "message"),
    [
        ({"speedratio": 1.2}, "speedratio"),
        ({"speed_ratio": 0.5}, "speed_ratio"),
        ({"obstacle_radius": np.nan}, "radius"),
    ],
)
def test_a_wrong_difficulty_is_refused_and_changes_nothing(difficulty: dict, message: str) -> None:
    sim = Simulator(Scenario(), 1, seed=1)
    with pytest.raises(ValueError, match=message):
        sim.set_difficulty(difficulty)
    assert sim.get_state()["difficulty"] == {}


# Steps


def test_a_reset_leaves_the_other_worlds_alone() -> None:
    sim, rng = Simulator(DENSE, 4, seed=1), np.random.default_rng(0)
    sim.reset()
    for _ in range(3):
        sim.step(random_actions(sim, rng))
    before = everything(sim)
    sim.reset(np.array([1, 3]))
    after = everything(sim)
    for name, array in before.items():
        np.testing.assert_array_equal(array[[0, 2]], after[name][[0, 2]], err_msg=name)
    assert after["steps"].tolist() == [3, 0, 3, 0]
    assert (before["velocities"][[1, 3]] != 0).any()
    assert (after["velocities"][[1, 3]] == 0).all()
    assert (after["target"][[1, 3]] != before["target"][[1, 3]]).all()


def test_the_former_measure_is_that_before_the_step() -> None:
    sim, rng = Simulator(Scenario(), 3, seed=1), np.random.default_rng(0)
    sim.reset()
    for step in range(6):
        now = sim.measure.target_distance.copy()
        angles = sim.measure.enclosure["all"].contributing_angle.copy()
        sim.step(random_actions(sim, rng))
        np.testing.assert_array_equal(sim.former_measure.target_distance, now)
        np.testing.assert_array_equal(sim.former_measure.enclosure["all"].contributing_angle, angles)
        assert (sim.measure.target_distance != now).all()
        if step == 3:
            sim.reset(np.array([0, 2]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_names_pursuer_and_world_and_nothing_moves(value: float) -> None:
    sim = Simulator(Scenario(), 4, seed=1)
    sim.reset()
    before = everything(sim)
    actions = np.zeros((4, 3, 2))
    actions[2, 1, 0] = value
    with pytest.raises(ValueError, match="action of pursuer_1 in world 2 is not finite"):
        sim.step(actions)
    assert_same(before, everything(sim))


@pytest.mark.parametrize("shape", [(3, 2), (4, 3), (4, 2, 2), (5, 3, 2), (4, 3, 3), (24,)])
def test_actions_of_another_shape_are_refused_and_nothing_moves(shape: tuple[int, ...]) -> None:
    sim = Simulator(Scenario(), 4, seed=1)
    sim.reset()
    before = everything(sim)
    with pytest.raises(ValueError, match=r"actions must have shape \(4, 3, 2\)"):
        sim.step(np.zeros(shape))
    assert_same(before, everything(sim))


def test_actions_of_any_kind_of_number_and_memory_do() -> None:
    def after(actions: object) -> np.ndarray:
        sim = Simulator(Scenario(), 2, seed=1)
        sim.reset()
        sim.step(actions)  # type: ignore[arg-type]
        return sim.state.pursuers

    ones = np.ones((2, 3, 2))
    for same in (
        ones.astype(np.float32),
        ones.astype(int),
        ones.tolist(),
        np.asfortranarray(ones),
        np.ones((4, 3, 4))[::2, :, ::2],
    ):
        np.testing.assert_array_equal(after(same), after(ones))


# Degenerate worlds

FUZZED = {
    "default": Scenario(obstacles=2, observe_extras=("occupied_angle", "stage", "speed_ratio")),
    "equal speeds": Scenario(speed_ratio=1.0, contacts="hard", repulsion_from="surface", path_rule="relaxed"),
    "nearly equal": Scenario(speed_ratio=1 + 1e-12, dynamics="first_order", repulsion_power=1, n_directions=8),
    "bodies without size": Scenario(pursuer_radius=0.0, target_radius=0.0, safety_distance=0.0, integration="mpe2"),
    "tunnel": Scenario(scene="tunnel", contacts="off", composite_unit=False, turn_order="simultaneous"),
    "a point and no obstacle": Scenario(pursuers=1, obstacles=0, repulsion_softening=0.1, placement="overlapping"),
}


def degenerate(sim: Simulator, rng: np.random.Generator) -> None:
    """Put bodies where they cannot be: on each other, in obstacles, out of the scene, almost on each other."""
    s, n = sim.state, sim.scenario.pursuers
    for b in rng.choice(sim.n_worlds, max(sim.n_worlds // 4, 1), replace=False):
        kind = rng.integers(7)
        i, j = rng.integers(n), rng.integers(n)
        if kind == 0:
            s.pursuers[b, i] = s.target[b]
        elif kind == 1:
            s.pursuers[b, i] = s.pursuers[b, j]
        elif kind == 2 and sim.scenario.discs:
            s.target[b] = s.discs[b, 0, :2]
        elif kind == 3 and sim.scenario.discs:
            s.target[b] = s.discs[b, 0, :2] + [s.discs[b, 0, 2] + sim.scenario.target_radius, 0.0]
            s.pursuers[b, :] = s.discs[b, 0, :2]
        elif kind == 4:
            s.pursuers[b, :] = s.target[b] = rng.choice([-1.0, 1.0], 2)
        elif kind == 5:
            s.pursuers[b, i] = s.target[b] + rng.choice([5e-324, 1e-300, 1e-160, 1e-13, 1e-9], 2)
        else:
            s.target[b] = [1.0, 1.0 + 1e-9]


@pytest.mark.compiled
@pytest.mark.parametrize("scenario", FUZZED.values(), ids=FUZZED)
def test_a_hundred_thousand_fuzzed_steps_are_finite(scenario: Scenario) -> None:
    # 6 scenarios x 64 worlds x 270 steps = 103,680
    sim, rng = Simulator(scenario, 64, seed=8), np.random.default_rng(8)
    sim.reset()
    size = max(part.stop for part in layout(scenario).values())
    observations = np.empty((64, scenario.pursuers, size), np.float32)
    reward = Reward(dict.fromkeys(TERMS, 1.0))
    for step in range(270):
        actions = random_actions(sim, rng) * rng.choice([1.0, 1.0, 1e300, 1e-300])
        sim.step(actions)
        told = everything(sim)
        for name, array in told.items():
            assert not np.isnan(array).any(), name
            assert name.endswith("movement_range") or np.isfinite(array).all(), name
        assert (np.abs(told["pursuers"]) <= scenario.half_width).all()
        assert (np.linalg.norm(told["velocities"], axis=2) <= scenario.max_speed * (1 + 1e-12)).all()
        observe(sim, observations)
        assert np.isfinite(observations).all()
        t = Transition(scenario, sim.state, actions, sim.measure, sim.former_measure, "all")
        for name, share in reward.parts(t).items():
            assert np.isfinite(share).all(), name
        if step % 3 == 0:
            degenerate(sim, rng)
        if step % 50 == 49:
            sim.reset(np.flatnonzero(rng.random(64) < 0.5))


def test_a_swarm_of_all_sizes_works() -> None:
    for n in (1, 2, 5, 10, 64):
        sim = Simulator(Scenario(pursuers=n, obstacles=0, pursuer_radius=0.02), 2, seed=1)
        sim.reset()
        push(sim, (1.0, 0.0))
        assert sim.measure.enclosure["all"].contributing_angle.shape == (2, n)


def test_the_builder_measures_what_it_arranges() -> None:
    assert arranged([(0.3, 0.4)]).measure.target_distance.tolist() == [[0.5]]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda sim: pickle.loads(pickle.dumps(sim))])
def test_a_copy_plays_on_as_the_original_and_apart_from_it(copied: Callable[[Simulator], Simulator]) -> None:
    original, rng = Simulator(Scenario(), 3, seed=4), np.random.default_rng(0)
    original.reset()
    original.step(random_actions(original, rng))
    twin = copied(original)
    for _ in range(5):
        actions = random_actions(original, rng)
        theirs, ours = original.step(actions), twin.step(actions)
        assert np.array_equal(theirs.target_distance, ours.target_distance)
        for rule in ("all", "pursuers"):
            for a, b in zip(theirs.enclosure[rule], ours.enclosure[rule], strict=True):
                assert np.array_equal(a, b)
    original.reset()
    twin.reset()
    assert np.array_equal(original.state.pursuers, twin.state.pursuers)
    twin.step(actions)
    assert not np.array_equal(original.state.pursuers, twin.state.pursuers)
