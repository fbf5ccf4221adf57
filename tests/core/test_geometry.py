"""The enclosure against exact arcs, against the paper's own words, and against what symmetry demands."""

import itertools
import math

import numpy as np
import pytest
from core_worlds import arranged, arranged_as
from exact_arcs import TURN, Layout, breakpoints, circles, exact, first_hit, ring, sampled
from hypothesis import assume, example, given
from hypothesis import strategies as st

from marl_encircle.core.geometry import NOBODY, half_circle

AREAS = [(1.1, 3, 1.617), (1.1, 4, 1.137), (1.1, 5, 1.015), (1.2, 4, 1.285), (1.4, 4, 1.672)]
COVERS = [(1.2, 0.941), (1.3, 0.838), (1.4, 0.760)]


@st.composite
def layouts(draw: st.DrawFn, *, least_ratio: float = 1.0, most_discs: int = 3) -> Layout:
    """Pursuers anywhere around the target, and discs that do not touch it."""
    # Off the sampled directions, where rounding decides; see is_clear_cut.
    angle = st.integers(0, 10**6).map(lambda i: 0.0123 + i * TURN / 10**6)
    pursuers = draw(st.lists(st.tuples(st.floats(0.05, 2), angle), min_size=1, max_size=6))
    discs = draw(st.lists(st.tuples(st.floats(0.01, 1), angle, st.floats(0.02, 0.5)), max_size=most_discs))
    ratio = draw(st.one_of(st.floats(least_ratio, 1.5), st.floats(1.5, 4)))
    return Layout(
        tuple((d * math.cos(a), d * math.sin(a)) for d, a in pursuers),
        tuple(((gap + r + 0.05) * math.cos(a), (gap + r + 0.05) * math.sin(a), r) for gap, a, r in discs),
        ratio,
    )


def is_clear_cut(layout: Layout, n_directions: int = 72) -> bool:
    """Whether no sampled direction lies where rounding decides about the owner, or the digits, near a tangent."""
    distances = []
    for k in range(n_directions):
        met = sorted(first_hit(c, k * TURN / n_directions) for c in near_circles(layout))
        distances.append(met[1] - met[0] if len(met) > 1 and met[0] < math.inf else math.inf)
    grid, half = TURN / n_directions, math.asin(1 / layout.speed_ratio)
    tangents = [math.atan2(y, x) + side for x, y in layout.pursuers for side in (-half, half)]
    ends = [abs((end / grid + 0.5) % 1 - 0.5) * grid for end in tangents + breakpoints(near_circles(layout))]
    return min(distances) > 1e-7 and min(ends) > 1e-3


def near_circles(layout: Layout) -> list:
    """The oracle's circles; where the ratio is so near 1 that they are lines, those of a ratio next to it."""
    return circles(layout._replace(speed_ratio=max(layout.speed_ratio, 1 + 1e-6)))


def turned(layout: Layout, angle: float) -> Layout:
    cos, sin = math.cos(angle), math.sin(angle)
    return layout._replace(
        pursuers=tuple((x * cos - y * sin, x * sin + y * cos) for x, y in layout.pursuers),
        discs=tuple((x * cos - y * sin, x * sin + y * cos, r) for x, y, r in layout.discs),
    )


def rule(layout: Layout, closure: str = "all", n_directions: int = 72):
    return arranged_as(layout, n_directions).measure.enclosure[closure]


# Numbers of the paper


@pytest.mark.parametrize(("ratio", "n", "area"), AREAS)
def test_exact_arcs_of_a_ring_enclose_the_known_area(ratio: float, n: int, area: float) -> None:
    for distance in (1.0, 0.2):
        arcs = exact(Layout(ring(n, distance, 0.3), (), ratio))
        assert arcs.movement_range / distance**2 == pytest.approx(area, abs=1e-3)
        assert arcs.occupied_angle == pytest.approx(TURN)


@pytest.mark.parametrize(("ratio", "cover"), COVERS)
def test_exact_arcs_of_three_cover_the_known_share_of_the_circle(ratio: float, cover: float) -> None:
    arcs = exact(Layout(ring(3, 0.4, 0.3), (), ratio))
    assert arcs.occupied_angle / TURN == pytest.approx(cover, abs=1e-3)
    assert arcs.occupied_angle == pytest.approx(6 * math.asin(1 / ratio))
    assert arcs.movement_range == math.inf


@pytest.mark.parametrize("ratio", [1.0, 1.1, 1.4, 2.0])
def test_a_pursuer_covers_arcsin_of_one_over_the_ratio_to_both_sides(ratio: float) -> None:
    enclosure = rule(Layout(((0.3, 0.1),), (), ratio), n_directions=3600)
    assert enclosure.occupied_angle[0] / 2 == pytest.approx(math.asin(1 / ratio), abs=TURN / 3600)


@given(turn=st.floats(0, TURN))
@pytest.mark.parametrize(("ratio", "n", "area"), AREAS)
def test_sampled_area_of_a_ring_is_right_at_any_rotation(ratio: float, n: int, area: float, turn: float) -> None:
    for n_directions, tolerance in ((360, 3e-3), (72, 0.03)):
        enclosure = rule(Layout(ring(n, 0.5, turn), (), ratio), n_directions=n_directions)
        assert enclosure.closed[0]
        assert enclosure.movement_range[0] / 0.5**2 == pytest.approx(area, rel=tolerance)


@given(turn=st.floats(0, TURN))
@pytest.mark.parametrize(("ratio", "cover"), COVERS)
def test_sampled_cover_of_three_is_right_to_three_directions_at_any_rotation(
    ratio: float, cover: float, turn: float
) -> None:
    for n_directions in (72, 360):
        enclosure = rule(Layout(ring(3, 0.5, turn), (), ratio), n_directions=n_directions)
        assert enclosure.occupied_angle[0] / TURN == pytest.approx(cover, abs=3 / n_directions)
        assert not enclosure.closed[0]
        assert enclosure.movement_range[0] == math.inf


@pytest.mark.parametrize(("n", "area"), [(3, 1.29904), (4, 1.0), (6, 0.86603)])
def test_at_equal_speeds_the_area_is_the_polygon_of_the_bisectors(n: int, area: float) -> None:
    # Each bisector is d/2 away, so a regular n-gon of inradius d/2: n (d/2)^2 tan(pi/n), at d = 1
    # 3/4 tan(60) = 1.29904, 4/4 tan(45) = 1, 6/4 tan(30) = 0.86603
    enclosure = rule(Layout(ring(n, 1.0, 0.01), (), 1.0), n_directions=4096)
    assert enclosure.movement_range[0] == pytest.approx(area, abs=1e-4)


# The ray form


def test_the_near_point_and_the_tangent_have_the_known_distance() -> None:
    # ratio 1.25, d = 0.9: ahead 1.25 x 0.9 / 2.25 = 0.5; tangent 1.25 x 0.9 / sqrt(1.5625 - 1) = 1.5 at arcsin(0.8)
    enclosure = rule(Layout(((0.9, 0.0),), (), 1.25), n_directions=4096)
    assert enclosure.distance[0, 0] == pytest.approx(0.5, rel=1e-12)
    last = int(math.asin(0.8) / TURN * 4096)
    assert enclosure.owner[0, last] == 0
    assert enclosure.owner[0, last + 1] == NOBODY
    assert enclosure.distance[0, last + 1] == math.inf
    assert enclosure.distance[0, last] < 1.5
    assert enclosure.distance[0, last] == pytest.approx(1.5, rel=0.06)


@example(x=0.3, y=0.4, ratio=1.0)
@example(x=0.3, y=0.4, ratio=1 + 1e-12)
@example(x=5e-324, y=1.0, ratio=1.0)
@given(x=st.floats(-2, 2), y=st.floats(0.01, 2), ratio=st.floats(1, 5))
def test_distances_have_twelve_digits_away_from_the_tangent(x: float, y: float, ratio: float) -> None:
    distance = rule(Layout(((x, y),), (), ratio), n_directions=360).distance[0]
    half = half_circle(360).astype(np.longdouble)
    rays = np.concatenate([half, -half], axis=1) / np.hypot(*half)[np.r_[:180, :180]]
    d = np.sqrt(np.longdouble(x) ** 2 + np.longdouble(y) ** 2)
    cos, sin = (rays[0] * x + rays[1] * y) / d, (rays[0] * y - rays[1] * x) / d
    inside = 1 - (ratio * sin) ** 2
    sure = (inside >= 1e-6) & (cos > 0)
    expected = ratio * d / (ratio * cos[sure] + np.sqrt(inside[sure]))
    assert sure.any()
    np.testing.assert_allclose(distance[sure], expected.astype(float), rtol=1e-12)


# Against the paper's own words


@pytest.mark.parametrize("closure", ["all", "pursuers"])
@given(layout=layouts())
def test_the_kernel_is_the_paper_word_by_word(closure: str, layout: Layout) -> None:
    assume(is_clear_cut(layout))
    plain = sampled(layout, 72, obstacles_count=closure == "all")
    fast = rule(layout, closure)
    assert fast.owner[0].tolist() == plain.owner
    np.testing.assert_allclose(fast.distance[0], plain.distance, rtol=1e-9)
    np.testing.assert_allclose(fast.contributing_angle[0], plain.contributing_angle, atol=1e-12)
    assert fast.occupied_angle[0] == pytest.approx(plain.occupied_angle, abs=1e-12)
    assert fast.movement_range[0] == pytest.approx(plain.movement_range, rel=1e-9)
    assert fast.closed[0] == (NOBODY not in plain.owner)


@given(layout=layouts(least_ratio=1.01))
def test_sampled_angles_and_areas_converge_to_the_exact_arcs(layout: Layout) -> None:
    # Of two bodies in one place rounding decides who is first.
    assume(all(math.dist(a, b) > 1e-6 for a, b in itertools.combinations(layout.pursuers, 2)))
    arcs = exact(layout)
    for n_directions in (72, 4096):
        enclosure = rule(layout, n_directions=n_directions)
        # An arc of length L holds the samples of L K / 2 pi directions, rounded up or down.
        slack = np.maximum(arcs.arcs, 1) * TURN / n_directions + 1e-9
        assert (np.abs(enclosure.contributing_angle[0] - arcs.contributing_angle) <= slack).all()
        if arcs.movement_range == math.inf:
            assert n_directions == 72 or not enclosure.closed[0] or TURN - arcs.occupied_angle < 0.01
    if arcs.movement_range < math.inf:
        assert enclosure.movement_range[0] == pytest.approx(arcs.movement_range, rel=0.01)


# What symmetry demands


@given(layout=layouts(), k=st.integers(0, 71))
def test_turning_everything_by_a_direction_turns_the_owners(layout: Layout, k: int) -> None:
    assume(is_clear_cut(layout))
    before, after = rule(layout), rule(turned(layout, k * TURN / 72))
    np.testing.assert_array_equal(after.owner[0], np.roll(before.owner[0], k))
    np.testing.assert_allclose(after.distance[0], np.roll(before.distance[0], k), rtol=1e-9)
    assert after.movement_range[0] == pytest.approx(before.movement_range[0], rel=1e-9)


@given(layout=layouts(), turn=st.floats(0, TURN))
def test_turning_by_any_angle_changes_no_contribution_by_more_than_two_directions(layout: Layout, turn: float) -> None:
    assume(layout.speed_ratio > 1.01)
    before, after = rule(layout).contributing_angle[0], rule(turned(layout, turn)).contributing_angle[0]
    # An entity that others cut into several arcs may gain or lose one direction in each.
    allowed = np.maximum(exact(layout).arcs, 2) * TURN / 72 + 1e-9
    assert (np.abs(after - before) <= allowed).all()


@given(layout=layouts())
def test_a_mirror_mirrors_the_owners(layout: Layout) -> None:
    assume(is_clear_cut(layout))
    mirrored = layout._replace(
        pursuers=tuple((x, -y) for x, y in layout.pursuers), discs=tuple((x, -y, r) for x, y, r in layout.discs)
    )
    before, after = rule(layout), rule(mirrored)
    np.testing.assert_array_equal(after.owner[0], np.roll(before.owner[0][::-1], 1))
    assert after.movement_range[0] == pytest.approx(before.movement_range[0], rel=1e-9)


@given(layout=layouts(), data=st.data())
def test_renumbering_bodies_renumbers_contributions(layout: Layout, data: st.DataObject) -> None:
    assume(is_clear_cut(layout))
    n, m = len(layout.pursuers), len(layout.discs)
    p, q = data.draw(st.permutations(range(n))), data.draw(st.permutations(range(m)))
    other = layout._replace(pursuers=tuple(layout.pursuers[i] for i in p), discs=tuple(layout.discs[j] for j in q))
    before, after = rule(layout), rule(other)
    order = [*p, *[n + j for j in q]]
    np.testing.assert_array_equal(after.contributing_angle[0], before.contributing_angle[0][order])
    assert after.movement_range[0] == pytest.approx(before.movement_range[0], rel=1e-12)


@given(layout=layouts(), scale=st.floats(0.01, 100))
def test_scaling_everything_keeps_angles_and_scales_the_area_by_the_square(layout: Layout, scale: float) -> None:
    assume(is_clear_cut(layout))
    scaled = layout._replace(
        pursuers=tuple((x * scale, y * scale) for x, y in layout.pursuers),
        discs=tuple((x * scale, y * scale, r * scale) for x, y, r in layout.discs),
        target_radius=layout.target_radius * scale,
    )
    before = rule(layout)
    after = arranged_as(scaled, half_width=200.0).measure.enclosure["all"]
    np.testing.assert_array_equal(after.owner, before.owner)
    np.testing.assert_allclose(after.distance, before.distance * scale, rtol=1e-9)
    assert after.movement_range[0] == pytest.approx(before.movement_range[0] * scale**2, rel=1e-9)


@given(layout=layouts(), x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_only_positions_relative_to_the_target_count(layout: Layout, x: float, y: float) -> None:
    assume(is_clear_cut(layout))
    there = arranged_as(layout, at=(x, y)).measure.enclosure["all"]
    np.testing.assert_array_equal(there.owner, rule(layout).owner)


# Rules


def test_obstacles_close_a_gap_under_one_rule_and_not_under_the_other() -> None:
    # Two pursuers left and right cover 2 x 2 arcsin(1/1.1) = 4.565; the gaps above and below are 0.859 each
    pursuers = ((0.1, 0.0), (-0.1, 0.0))
    sim = arranged(pursuers, discs=[(0.0, 0.3, 0.2), (0.0, -0.3, 0.2)])
    both = sim.measure.enclosure
    assert both["all"].closed[0]
    assert not both["pursuers"].closed[0]
    assert both["pursuers"].occupied_angle[0] == pytest.approx(4 * math.asin(1 / 1.1), abs=4 * TURN / 72)
    assert (both["pursuers"].contributing_angle[0, 2:] == 0).all()
    assert both["all"].contributing_angle[0, 2] == both["all"].contributing_angle[0, 3] > 0


def test_what_all_contribute_adds_up_to_what_is_occupied_and_never_to_more_than_the_circle() -> None:
    for n in (1, 3, 10):  # ten pursuers' own angles add up to 22.8
        enclosure = rule(Layout(ring(n, 0.3), ((0.5, 0.5, 0.2),), 1.1))
        assert enclosure.contributing_angle[0].sum() == pytest.approx(enclosure.occupied_angle[0])
        assert enclosure.occupied_angle[0] <= TURN + 1e-12


def test_the_disc_that_the_targets_centre_meets_is_larger_by_its_own_radius() -> None:
    # Half angle arcsin((R + r_T) / D) = arcsin(0.25 / 0.5) = 30 degrees: 60 of 360, ahead 0.5 - 0.25 away
    enclosure = rule(Layout(((-2.0, 0.0),), ((0.5, 0.001, 0.2),), 1.1), n_directions=360)
    assert enclosure.contributing_angle[0, 1] / TURN * 360 == pytest.approx(60, abs=1)
    assert enclosure.distance[0, 0] == pytest.approx(0.25, abs=1e-4)


def test_an_obstacle_in_contact_covers_half_the_circle() -> None:
    enclosure = rule(Layout(((-2.0, 0.0),), ((0.25 + 1e-9, 1e-4, 0.2),), 4.0), n_directions=360)
    assert enclosure.contributing_angle[0, 1] == pytest.approx(math.pi, abs=2 * TURN / 360)


def test_complete_means_closed_and_below_the_limit() -> None:
    # Area 1.137 d^2 for four at ratio 1.1: d = 0.2 gives 0.0455, d = 0.22 gives 0.0550
    for d, complete in ((0.2, True), (0.22, False)):
        enclosure = rule(Layout(ring(4, d, 0.1), (), 1.1))
        assert enclosure.closed[0]
        assert bool(enclosure.complete[0]) is complete
    area = rule(Layout(ring(4, 0.2, 0.1), (), 1.1)).movement_range[0]
    equal = arranged_as(Layout(ring(4, 0.2, 0.1), (), 1.1), movement_range_limit=float(area))
    assert not equal.measure.enclosure["all"].complete[0]
    assert not rule(Layout(ring(3, 0.01), (), 1.4)).complete[0], "an open one is never complete"


def test_a_composite_obstacle_is_one_contributor() -> None:
    for unit, size in ((True, 1), (False, 10)):
        sim = arranged([(0.8, 0.8)])
        sim = type(sim)(type(sim.scenario)(pursuers=1, obstacles=1, scene="tunnel", composite_unit=unit), 1, seed=3)
        angles = sim.reset().enclosure["all"].contributing_angle
        assert angles.shape == (1, 1 + size)
        owner = sim.measure.enclosure["all"].owner[0]
        assert (owner > 0).sum() * TURN / 72 == pytest.approx(angles[0, 1:].sum())
        assert angles[0, 1:].sum() > 0


def test_a_pursuer_on_the_target_and_a_target_in_an_obstacle_give_finite_numbers() -> None:
    sim = arranged([(0.0, 0.0), (0.3, 0.0)], discs=[(0.0, 0.0, 0.2), (0.05, 0.0, 0.2)])
    for enclosure in sim.measure.enclosure.values():
        assert np.isfinite(enclosure.nearness).all()
        assert np.isfinite(enclosure.contributing_angle).all()
        assert not np.isnan(enclosure.movement_range).any()


def test_a_pursuer_on_the_target_blocks_a_cone_around_the_x_axis() -> None:
    enclosure = rule(Layout(((0.0, 0.0),), (), 1.25), n_directions=360)
    assert enclosure.contributing_angle[0, 0] / 2 == pytest.approx(math.asin(0.8), abs=TURN / 360)
    assert enclosure.owner[0, 53] == enclosure.owner[0, -53] == 0  # arcsin(0.8) is 53.13 degrees
    assert enclosure.owner[0, 54] == enclosure.owner[0, -54] == NOBODY
    assert enclosure.distance[0, 0] < 1e-12


def test_a_share_is_occupied_from_itself_on() -> None:
    enclosure = rule(Layout(((0.3, 0.1),), (), 1.25))._replace(occupied_angle=np.array([0.3 * TURN]))
    assert [bool(enclosure.occupies(share)[0]) for share in (0.0, 0.29, 0.3, 0.31, 1.0)] == [True] * 3 + [False] * 2


# Distances and contacts


def test_contacts_count_each_kind_of_body_apart() -> None:
    # 0 touches 1 (0.09 < 0.1) and the target (0.09 < 0.1); 1 touches 0; 2 touches both discs (0.2 < 0.25)
    pursuers = [(0.09, 0.0), (0.18, 0.0), (-0.6, 0.0)]
    m = arranged(pursuers, discs=[(-0.6, 0.2, 0.2), (-0.6, -0.2, 0.2)]).measure
    np.testing.assert_allclose(m.target_distance[0], [0.09, 0.18, 0.6])
    assert m.contacts_pursuers.tolist() == [[1, 1, 0]]
    assert m.contacts_target.tolist() == [[1, 0, 0]]
    assert m.contacts_obstacles.tolist() == [[0, 0, 2]]


@pytest.mark.parametrize("seed", range(5))
def test_contacts_are_those_of_a_plain_count(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, t, discs = rng.uniform(-0.3, 0.3, (6, 2)), rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.3, 0.3, (4, 3))
    discs[:, 2] = rng.uniform(0.02, 0.2, 4)
    m = arranged(p, t, discs, pursuer_radius=0.09, target_radius=0.04).measure
    others = np.array([[math.dist(a, b) < 0.18 for a in p] for b in p]) & ~np.eye(6, dtype=bool)
    np.testing.assert_array_equal(m.contacts_pursuers[0], others.sum(axis=1))
    np.testing.assert_array_equal(m.contacts_target[0], [math.dist(a, t) < 0.13 for a in p])
    touched = [[math.dist(a, (x, y)) < 0.09 + r for x, y, r in discs] for a in p]
    np.testing.assert_array_equal(m.contacts_obstacles[0], np.sum(touched, axis=1))
    np.testing.assert_allclose(m.target_distance[0], [math.dist(a, t) for a in p])


def test_bodies_that_just_meet_are_no_contact() -> None:
    m = arranged([(0.125, 0.0), (0.375, 0.0)], discs=[(1.0, 0.0, 0.5)], pursuer_radius=0.125, target_radius=0.0).measure
    assert m.contacts_pursuers.tolist() == [[0, 0]]  # 0.25 = 2 x 0.125
    assert m.contacts_target.tolist() == [[0, 0]]  # 0.125 = 0.125 + 0
    assert m.contacts_obstacles.tolist() == [[0, 0]]  # 0.625 = 0.125 + 0.5


def test_directions_run_counter_clockwise_from_x() -> None:
    # Far away along x, y, -x: an obstacle that only direction 0, 18, 36 of 72 can meet
    for k, (x, y) in ((0, (1.0, 0.0)), (18, (0.0, 1.0)), (36, (-1.0, 0.0)), (54, (0.0, -1.0))):
        owner = rule(Layout(((x, y),), (), 100.0)).owner[0]
        assert np.flatnonzero(owner == 0).tolist() == [k]
