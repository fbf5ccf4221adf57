"""How bodies move, worked out by hand. Unless said otherwise dt = 0.1, damping 0.25, acceleration 5, v_P = 1."""

import math

import numpy as np
import pytest
from core_worlds import arranged, push, random_actions
from hypothesis import given
from hypothesis import strategies as st
from mpe2._mpe_utils.core import Agent, Landmark, World

from marl_encircle.core.dynamics import TARGETS
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

ALONE = {"target": "still", "contacts": "off", "acceleration": 5.0}


def one(
    velocity: tuple[float, float] = (0.0, 0.0), at: tuple[float, float] = (0.5, 0.5), **fields: object
) -> Simulator:
    return arranged([at], velocities=[velocity], **(ALONE | fields))


def position(sim: Simulator, i: int = 0) -> list[float]:
    return sim.state.pursuers[0, i].tolist()


def velocity(sim: Simulator, i: int = 0) -> list[float]:
    return sim.state.velocities[0, i].tolist()


def near(*values: float) -> object:
    return pytest.approx(list(values), abs=1e-12)


# Pursuers


def test_mpe_damps_then_accelerates_then_moves() -> None:
    # v' = 0.75 (0.2, -0.4) + 5 (1, 0.5) 0.1 = (0.15 + 0.5, -0.3 + 0.25); x' = 0.5 + 0.1 v'
    sim = push(one((0.2, -0.4)), (1.0, 0.5))
    assert velocity(sim) == near(0.65, -0.05)
    assert position(sim) == near(0.565, 0.495)


def test_mpe2_moves_with_the_old_velocity_first() -> None:
    # x' = 0.5 + 0.1 (0.2, -0.4); v' as in MPE
    sim = push(one((0.2, -0.4), integration="mpe2"), (1.0, 0.5))
    assert velocity(sim) == near(0.65, -0.05)
    assert position(sim) == near(0.52, 0.46)


def test_first_order_takes_the_action_for_the_velocity() -> None:
    sim = push(one((0.2, -0.4), dynamics="first_order", max_speed=0.8), (0.5, -0.25))
    assert velocity(sim) == near(0.4, -0.2)
    assert position(sim) == near(0.54, 0.48)


def test_the_speed_limit_keeps_the_direction() -> None:
    # 0.75 (0.8, 0.4) + 0.5 (1, 1) = (1.1, 0.8), of length 1.36015
    sim = push(one((0.8, 0.4)), (1.0, 1.0))
    assert velocity(sim) == near(1.1 / math.hypot(1.1, 0.8), 0.8 / math.hypot(1.1, 0.8))
    # First order: a diagonal of full actions would be sqrt(2) fast
    sim = push(one(dynamics="first_order"), (1.0, 1.0))
    assert velocity(sim) == near(math.sqrt(0.5), math.sqrt(0.5))


@pytest.mark.parametrize(("acceleration", "steps"), [(5.0, 3), (3.0, 7)])
def test_full_speed_takes_as_many_steps_as_the_notes_say(acceleration: float, steps: int) -> None:
    # 5: 0.5, 0.875, 1.156; 3: 0.3, 0.525, 0.694, 0.820, 0.915, 0.986, 1.040
    sim = one(at=(0.0, 0.0), acceleration=acceleration)
    speeds = [velocity(push(sim, (1.0, 0.0)))[0] for _ in range(steps)]
    assert speeds[-2] < 1.0
    assert speeds[-1] == 1.0


def test_actions_beyond_one_count_as_one() -> None:
    assert velocity(push(one(), (7.0, -1e9))) == velocity(push(one(), (1.0, -1.0)))
    assert velocity(push(one(), (-7.0, 1e9))) == velocity(push(one(), (-1.0, 1.0)))


def test_no_damping_and_full_damping() -> None:
    assert velocity(push(one((0.4, 0.0), damping=0.0))) == near(0.4, 0.0)
    assert velocity(push(one((0.4, 0.0), damping=1.0))) == near(0.0, 0.0)


@pytest.mark.parametrize("contacts", ["soft", "hard", "off"])
def test_the_edge_stops_the_velocity_across_it_and_leaves_the_one_along_it(contacts: str) -> None:
    # x' = 0.95 + 0.75 x 0.1 = 1.025, beyond 1; y' = 0.5 - 0.015
    sim = push(one((1.0, -0.2), at=(0.95, 0.5), contacts=contacts))
    assert position(sim) == near(1.0, 0.485)
    assert velocity(sim) == near(0.0, -0.15)
    sim = push(one((-0.2, -1.0), at=(0.5, -0.95), contacts=contacts))
    assert position(sim) == near(0.485, -1.0)
    assert velocity(sim) == near(-0.15, 0.0)


# Contacts. Force = 100 x 0.001 x log(1 + exp(penetration / 0.001)), and dv = 0.1 F / mass


def gap_of(distance: float, **fields: object) -> Simulator:
    """Two resting pursuers on the x axis, radius 0.05 each, away from the target."""
    return push(arranged([(0.5, 0.5), (0.5 + distance, 0.5)], target="still", **fields))


def test_a_soft_contact_pushes_with_the_force_of_mpe() -> None:
    # 0.09 apart: penetration 0.01, ten margins: F = 0.1 (10 + log(1 + e^-10)) = 1.0000045, dv = 0.10000045
    sim = gap_of(0.09)
    dv = 0.1 * 0.1 * (10 + math.log1p(math.exp(-10)))
    assert dv == pytest.approx(0.10000045, abs=1e-8)
    assert velocity(sim, 0) == near(-dv, 0.0)
    assert velocity(sim, 1) == near(dv, 0.0)
    assert position(sim, 0) == near(0.5 - 0.1 * dv, 0.5)


def test_bodies_that_just_touch_push_by_the_logarithm_of_two() -> None:
    # F = 0.1 log 2 = 0.0693147
    assert velocity(gap_of(0.1), 1) == near(0.00693147180559945, 0.0)
    assert velocity(gap_of(0.1, pursuer_mass=2.0), 1) == near(0.00693147180559945 / 2, 0.0)
    assert velocity(gap_of(0.1, contact_force=300.0), 1) == near(3 * 0.00693147180559945, 0.0)
    # First order: the same on top of the action's velocity
    assert velocity(gap_of(0.1, dynamics="first_order"), 1) == near(0.00693147180559945, 0.0)


def test_a_contact_of_many_margins_pushes_by_its_depth() -> None:
    # 0.09 / 1e-4 = 900 margins deep, where exp(900) overflows: F = 10 x 0.09 = 0.9
    assert velocity(gap_of(0.01, contact_margin=1e-4, contact_force=10.0), 1) == near(0.09, 0.0)


def test_a_force_of_contact_vanishes_where_it_is_cut_off() -> None:
    # 36 margins apart: 0.1 exp(-36) = 2e-17
    assert velocity(gap_of(0.1 + 0.0361), 1) == [0.0, 0.0]
    assert 0.0 < velocity(gap_of(0.1 + 0.03), 1)[0] < 1e-13


def test_target_and_obstacles_push_pursuers_and_do_not_yield() -> None:
    # Both at contact: pursuer 0 with the target (0.1), pursuer 1 with the obstacle (0.05 + 0.2)
    sim = arranged([(0.0, 0.1), (0.5, 0.25)], discs=[(0.5, 0.0, 0.2)], target="still")
    push(sim)
    assert velocity(sim, 0) == near(0.0, 0.00693147180559945)
    assert velocity(sim, 1) == near(0.0, 0.00693147180559945)
    assert sim.state.target.tolist() == [[0.0, 0.0]]
    assert sim.state.discs.tolist() == [[[0.5, 0.0, 0.2]]]


def test_without_contacts_bodies_pass_through_each_other() -> None:
    assert velocity(gap_of(0.01, contacts="off"), 1) == [0.0, 0.0]


def test_hard_contacts_separate_pursuers_half_and_half() -> None:
    # Overlap 0.02: each yields 0.01
    sim = gap_of(0.08, contacts="hard")
    assert position(sim, 0) == near(0.49, 0.5)
    assert position(sim, 1) == near(0.59, 0.5)


def test_hard_contacts_push_pursuers_out_of_target_and_obstacles() -> None:
    # 0.04 from the target goes to 0.1; 0.21 from an obstacle of 0.2 goes to 0.25
    sim = arranged([(0.0, 0.04), (0.6, 0.21)], discs=[(0.6, 0.0, 0.2)], target="still", contacts="hard")
    push(sim)
    assert position(sim, 0) == near(0.0, 0.1)
    assert position(sim, 1) == near(0.6, 0.25)
    assert sim.state.target.tolist() == [[0.0, 0.0]]


def test_hard_contacts_do_not_push_anybody_out_of_the_scene() -> None:
    sim = push(arranged([(0.99, 0.0), (0.97, 0.0)], target="still", contacts="hard"))
    assert np.abs(sim.state.pursuers).max() <= 1.0


@pytest.mark.parametrize("contacts", ["soft", "hard"])
def test_coincident_bodies_part_and_stay_finite(contacts: str) -> None:
    sim = arranged([(0.0, 0.0)] * 3, discs=[(0.0, 0.0, 0.1)], contacts=contacts)
    for _ in range(10):
        push(sim)
        assert np.isfinite(sim.state.pursuers).all()
        assert np.isfinite(sim.state.velocities).all()
    two = arranged([(0.5, 0.5)] * 2, contacts=contacts, target="still")
    push(two)
    assert abs(position(two, 0)[0] - position(two, 1)[0]) >= 0.1 - 1e-12
    assert position(two, 0)[1] == position(two, 1)[1] == 0.5, "along x"


@given(
    numbers=st.lists(st.floats(-0.2, 0.2), min_size=10, max_size=10),
    acceleration=st.floats(0.5, 6),
    speed=st.floats(0.1, 2),
)
def test_the_mpe2_order_is_mpe2(numbers: list[float], acceleration: float, speed: float) -> None:
    at, v, u = np.array(numbers[:4]).reshape(2, 2), np.array(numbers[4:8]).reshape(2, 2), np.array(numbers[8:])
    at += [[0.35, 0.0], [0.0, 0.35]]  # no two bodies in one place, where MPE divides by zero
    disc = (0.2, 0.2, 0.15)
    world = World()
    for i in range(2):
        agent = Agent()
        agent.size, agent.max_speed = 0.05, speed
        agent.state.p_pos, agent.state.p_vel, agent.state.c = at[i].copy(), v[i].copy(), np.zeros(0)
        agent.action.u = acceleration * u * (1 - 2 * i)
        agent.u_noise, agent.silent = None, True
        world.agents.append(agent)
    landmark = Landmark()
    landmark.size, landmark.collide, landmark.movable = disc[2], True, False
    landmark.state.p_pos, landmark.state.p_vel = np.array(disc[:2]), np.zeros(2)
    world.landmarks.append(landmark)
    ours = arranged(
        at, (-0.9, -0.9), [disc], v, target="still", integration="mpe2", acceleration=acceleration, max_speed=speed
    )
    for _ in range(3):
        world.step()
        push(ours, u, -u)
        np.testing.assert_allclose(ours.state.pursuers[0], [a.state.p_pos for a in world.agents], atol=1e-12)
        np.testing.assert_allclose(ours.state.velocities[0], [a.state.p_vel for a in world.agents], atol=1e-12)


CROWDS = {
    "soft": {},
    "first order, from the surface": {"dynamics": "first_order", "repulsion_from": "surface", "path_rule": "relaxed"},
    "mpe2, softened": {"integration": "mpe2", "repulsion_softening": 0.1, "turn_order": "simultaneous"},
    "hard, first power": {"contacts": "hard", "repulsion_power": 1, "path_rule": "relaxed"},
    "hard, first order": {"contacts": "hard", "dynamics": "first_order", "obstacle_margin": 0.02},
}


@pytest.mark.parametrize("fields", CROWDS.values(), ids=CROWDS)
@pytest.mark.parametrize("seed", range(8))
def test_x_and_y_and_their_signs_are_alike(fields: dict[str, object], seed: int) -> None:
    # A crowd in a corner, where bodies overlap and walls are near; one obstacle is farther off
    rng = np.random.default_rng(seed)
    bodies, v, actions = rng.uniform(0.6, 0.98, (6, 2)), rng.uniform(-1, 1, (3, 2)), rng.uniform(-1.5, 1.5, (3, 3, 2))
    discs = np.column_stack([bodies[4:] - [[0.0], [0.4]], [0.1, 0.15]])
    ends = []
    for turn in (np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])):
        turned_discs = [(*centre, radius) for centre, radius in zip(discs[:, :2] @ turn, discs[:, 2], strict=True)]
        sim = arranged(bodies[:3] @ turn, bodies[3] @ turn, turned_discs, v @ turn, safety_distance=0.05, **fields)
        for step in actions:
            push(sim, *(step @ turn))
        s = sim.state
        ends.append(np.concatenate([s.pursuers[0], s.velocities[0], s.target]) @ turn.T)
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-9)


# The target. One step is at most 1.1 x 1 x 0.1 = 0.11


def escaped(
    pursuers: list[tuple[float, float]],
    target: tuple[float, float] = (0.0, 0.0),
    discs: list[tuple[float, float, float]] | None = None,
    **fields: object,
) -> list[float]:
    """Where the target is after a step in which nobody else moves."""
    sim = arranged(pursuers, target, discs or [], **({"contacts": "off", "wall_weight": 0.0} | fields))
    return push(sim).state.target[0].tolist()


def along(x: float, y: float, length: float = 0.11) -> tuple[float, float]:
    return length * x / math.hypot(x, y), length * y / math.hypot(x, y)


def test_the_target_flees_from_a_pursuer_by_a_full_step() -> None:
    assert escaped([(-0.3, 0.0)]) == near(0.11, 0.0)
    assert escaped([(0.3, 0.4)], speed_ratio=1.3, max_speed=0.5) == near(*along(-3, -4, 1.3 * 0.5 * 0.1))


def test_repulsion_falls_with_the_square_of_the_distance_or_with_the_distance() -> None:
    # Left at 0.2, below at 0.4. Square: 1/0.04 = 25 and 1/0.16 = 6.25; first power: 5 and 2.5
    pursuers = [(-0.2, 0.0), (0.0, -0.4)]
    assert escaped(pursuers) == near(*along(25, 6.25))
    assert escaped(pursuers, repulsion_power=1) == near(*along(5, 2.5))


def test_softening_is_added_in_quadrature() -> None:
    # 0.2^2 + 0.3^2 = 0.13 and 0.4^2 + 0.3^2 = 0.25: 1/0.13 and 1/0.25
    pursuers = [(-0.2, 0.0), (0.0, -0.4)]
    assert escaped(pursuers, repulsion_softening=0.3) == near(*along(1 / 0.13, 4))
    assert escaped(pursuers, repulsion_softening=0.3, repulsion_power=1) == near(*along(0.13**-0.5, 2))


def test_distances_may_count_from_the_surface() -> None:
    # Pursuer 0.2 - 0.05 - 0.05 = 0.1: 100; obstacle 0.5 - 0.25 - 0.05 = 0.2: 25
    bodies = {"pursuers": [(-0.2, 0.0)], "discs": [(0.0, -0.5, 0.25)]}
    assert escaped(**bodies, repulsion_from="surface") == near(*along(100, 25))
    # By the centres 1/0.04 = 25 and 1/0.25 = 4
    assert escaped(**bodies) == near(*along(25, 4))


def test_the_walls_repel_from_their_foot_points() -> None:
    # T = (0.5, 0), pursuer 0.4 below: 6.25 up; walls 1/1.5^2 - 1/0.5^2 = 0.4444 - 4 = -3.5556 in x, 1 - 1 in y
    x, y = along(-32 / 9, 6.25)
    assert escaped([(0.5, -0.4)], (0.5, 0.0), wall_weight=1.0) == near(0.5 + x, y)
    x, y = along(-16 / 9, 6.25)
    assert escaped([(0.5, -0.4)], (0.5, 0.0), wall_weight=0.5) == near(0.5 + x, y)
    # T = (0, -0.6): 1/0.4^2 - 1/1.6^2 = 6.25 - 0.390625 up; the pursuer 0.4 to the right pushes 6.25 left
    x, y = along(-6.25, 5.859375)
    assert escaped([(0.4, -0.6)], (0.0, -0.6), wall_weight=1.0) == near(x, -0.6 + y)


def test_an_obstacle_of_many_discs_repels_as_much_as_one_of_one_disc() -> None:
    # A tiny tunnel at (-0.3, -0.4): 1/0.25 = 4 along (0.6, 0.8); the pursuer 0.2 to the right pushes 25 left
    sim = Simulator(Scenario(pursuers=1, scene="tunnel", obstacle_radius=1e-4, contacts="off", wall_weight=0.0), 1, 0)
    sim.reset()
    saved = sim.get_state()
    state = saved["state"]
    state["discs"][0, :, :2] += np.array([-0.3, -0.4]) - state["obstacles"][0, 0]
    state["pursuers"][0], state["target"][0] = (0.2, 0.0), (0.0, 0.0)
    sim.set_state(saved)
    assert push(sim).state.target[0].tolist() == pytest.approx(list(along(2.4 - 25, 3.2)), abs=1e-4)


def test_a_target_that_nothing_pushes_stays() -> None:
    # A pursuer exactly on it has no direction to push in
    assert escaped([(0.0, 0.0)], safety_distance=0.0) == [0.0, 0.0]


def test_a_still_target_never_moves() -> None:
    sim = arranged([(-0.2, 0.0)], target="still")
    for _ in range(5):
        push(sim)
    assert sim.state.target[0].tolist() == [0.0, 0.0]


def test_a_target_that_move_target_does_not_know_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TARGETS, "third", TARGETS["still"])
    with pytest.raises(ValueError, match="a name in TARGETS has no branch in move_target"):
        push(arranged([(-0.2, 0.0)], target="third"))


# The path. Samples at 0.011, 0.022, ... 0.11. One pursuer chases from behind (1/0.46^2 = 4.73, or 1/0.3^2 = 11.1),
# another body is 0.5 ahead (4)


def test_the_target_stops_at_the_farthest_sample_before_the_first_within_the_safety_distance() -> None:
    # Ahead 0.5 - s >= 0.45 up to s = 0.05: 0.044 is the last
    assert escaped([(-0.46, 0.0), (0.5, 0.0)], safety_distance=0.45) == near(0.044, 0.0)
    # 0.5 - s >= 0.405 up to s = 0.095: 0.088; and 0.38 lets all ten pass
    assert escaped([(-0.46, 0.0), (0.5, 0.0)], safety_distance=0.405) == near(0.088, 0.0)
    assert escaped([(-0.46, 0.0), (0.5, 0.0)], safety_distance=0.38) == near(0.11, 0.0)


def test_within_the_safety_distance_the_literal_rule_freezes_and_the_relaxed_one_lets_go() -> None:
    # The pursuer behind is 0.3 away: every sample is within 0.45 of it, though farther than now
    pursuers = [(-0.3, 0.0), (0.5, 0.0)]
    assert escaped(pursuers, safety_distance=0.45) == [0.0, 0.0]
    assert escaped(pursuers, safety_distance=0.45, path_rule="relaxed") == near(0.044, 0.0)
    # Moving towards a body within reach is invalid under both
    assert escaped([(-0.3, 0.0), (0.4, 0.0)], safety_distance=0.45, path_rule="relaxed") == [0.0, 0.0]


def test_the_target_stops_before_an_obstacle_and_its_margin() -> None:
    # Reach 0.4 + 0.05: as above with 0.45; with a margin of 0.01 only 0.5 - s >= 0.46: 0.033
    assert escaped([(-0.3, 0.0)], discs=[(0.5, 0.0, 0.4)]) == near(0.044, 0.0)
    assert escaped([(-0.3, 0.0)], discs=[(0.5, 0.0, 0.4)], obstacle_margin=0.01) == near(0.033, 0.0)


def test_the_target_stops_before_the_edge() -> None:
    # 0.95 + 0.044 = 0.994; the next sample would be 1.005
    assert escaped([(0.7, 0.0)], (0.95, 0.0)) == near(0.994, 0.0)
    assert escaped([(0.0, -0.7)], (0.0, -0.95)) == near(0.0, -0.994)


def test_what_lies_behind_the_first_invalid_sample_does_not_count() -> None:
    # A disc at 0.0385 that reaches 0.006: of the samples only 0.033 and 0.044 are within it
    thin = {
        "pursuers": [(-0.03, 0.0)],
        "discs": [(0.0385, 0.0, 0.001)],
        "target_radius": 0.005,
        "safety_distance": 0.01,
    }
    assert escaped(**thin) == near(0.022, 0.0)
    # A single sample sees only the end of the path
    assert escaped(**thin, path_samples=1) == near(0.11, 0.0)


def test_a_small_body_at_the_end_of_the_path_is_seen_from_its_start() -> None:
    # Reach 0.001 + 0.005 around 0.1045: the sample at 0.099 is within it, that at 0.11 too
    thin = {"target_radius": 0.005, "safety_distance": 0.01}
    assert escaped([(-0.03, 0.0)], discs=[(0.1045, 0.0, 0.001)], **thin) == near(0.088, 0.0)
    assert escaped([(0.0, -0.03)], discs=[(0.0, 0.1045, 0.001)], **thin) == near(0.0, 0.088)


def test_the_target_sees_the_pursuers_after_their_move_or_before() -> None:
    # The pursuer goes from (-0.2, 0) to (-0.2, 0.1)
    for order, x, y in (("pursuers_first", 0.2, -0.1), ("simultaneous", 1.0, 0.0)):
        sim = arranged([(-0.2, 0.0)], dynamics="first_order", contacts="off", wall_weight=0.0, turn_order=order)
        assert push(sim, (0.0, 1.0)).state.target[0].tolist() == near(*along(x, y))
        assert position(sim) == near(-0.2, 0.1)


@pytest.mark.compiled
@pytest.mark.parametrize("rule", ["literal", "relaxed"])
@pytest.mark.parametrize("scene", ["random", "concave", "tunnel"])
def test_a_target_that_moves_is_free_of_everything_afterwards(scene: str, rule: str) -> None:
    fields = {"obstacles": 2, "obstacle_radius": 0.15, "safety_distance": 0.12, "turn_order": "pursuers_first"}
    scenario = Scenario(scene=scene, path_rule=rule, **fields)
    sim, rng = Simulator(scenario, 64, seed=1), np.random.default_rng(1)
    sim.reset()
    moves = 0
    for _ in range(200):
        s = sim.state
        before, gap = s.target.copy(), s.discs[..., 2] + scenario.target_radius
        sim.step(random_actions(sim, rng))
        moved = (s.target != before).any(axis=1)
        moves += moved.sum()
        assert (np.linalg.norm(s.target[:, None] - s.discs[..., :2], axis=2) >= gap - 1e-12).all()
        assert (np.abs(s.target) <= 1.0).all()
        assert (np.linalg.norm(s.target - before, axis=1) <= 0.11 + 1e-12).all()
        if rule == "literal":
            assert (sim.measure.target_distance[moved] >= 0.12 - 1e-12).all()
    assert moves > 1000
