"""Placement: what a scene promises whatever the seed, and an end in bounded time."""

import os
import time
from typing import Any, NamedTuple

import numpy as np
import pytest

from marl_encircle.core import scenes
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.scenes import SCENES
from marl_encircle.core.simulator import PlacementError, Simulator, State

SEEDS = 1000 if os.environ.get("HYPOTHESIS_PROFILE") == "thorough" else 100
SHAPES = {
    "random": Scenario(obstacles=3),
    "concave": Scenario(scene="concave", obstacles=2, obstacle_radius=0.15),
    "tunnel": Scenario(scene="tunnel", obstacles=2, obstacle_radius=0.15),
    "ten": Scenario(pursuers=10, obstacles=5),
    "none": Scenario(pursuers=1, obstacles=0),
}


def drawn(scenario: Scenario, n_worlds: int = 200, seed: int = 5) -> Simulator:
    sim = Simulator(scenario, n_worlds, seed)
    sim.reset()
    return sim


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, :, None, :2] - b[:, None, :, :2], axis=3)


def test_the_registry_is_what_the_file_defines() -> None:
    defined = {
        name: f
        for name, f in vars(scenes).items()
        if getattr(f, "__module__", None) == scenes.__name__ and not name.startswith("_")
    }
    del defined["place"], defined["discs_of"]
    assert defined == SCENES


def test_a_scene_of_ones_own_is_placed_like_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENES, "pair", lambda: np.array([[-1.0, 0.0, 0.5], [1.0, 0.0, 0.25]]))
    s = drawn(Scenario(scene="pair", obstacles=2, obstacle_radius=0.1)).state
    assert s.discs.shape == (200, 4, 3)
    assert s.discs[:, :, 2] == pytest.approx(np.tile([0.05, 0.025, 0.05, 0.025], (200, 1)))
    assert distances(s.discs, s.discs)[:, 0, 1] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("discs", "message"),
    [
        ([[0.0, 0.0]], r"scene 'wrong' must return discs \(x, y, radius\), \(L, 3\); got shape \(1, 2\)"),
        ([0.0, 0.0, 1.0], r"scene 'wrong' .* got shape \(3,\)"),
        (np.zeros((0, 3)), r"scene 'wrong' .* got shape \(0, 3\)"),
        ([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], r"scene 'wrong' must return finite discs .* got \[1\. 0\. 0\.\]"),
        ([[0.0, np.nan, 1.0]], r"scene 'wrong' must return finite discs"),
    ],
)
def test_a_scene_that_returns_no_discs_is_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, discs: object, message: str
) -> None:
    monkeypatch.setitem(SCENES, "wrong", lambda: discs)
    with pytest.raises(ValueError, match=message):
        Scenario(scene="wrong")


class Placed(NamedTuple):
    fits: bool
    pursuers: list[list[float]]
    target: list[float]
    discs: list[list[float]]
    centres: list[list[float]]


def placed(uniforms: list[float], obstacles: int = 1, separated: bool = True) -> Placed:
    """One world of two pursuers (radius 1/8), a target (1/4), and obstacles of two discs, in a scene 4 wide."""
    shape = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, 0.25]])
    world = np.zeros((1, 2, 2)), np.zeros((1, 2)), np.zeros((1, 2 * obstacles, 3)), np.zeros((1, obstacles, 2))
    rules = {"pursuer_radius": 0.125, "target_radius": 0.25, "half_width": 2.0, "obstacle_limit": 0.8}
    numbers, radii = np.array([uniforms]), np.array([0.4])
    fits = scenes.place(np.array([0]), numbers, shape, radii, *rules.values(), separated, *world)
    return Placed(bool(fits[0]), *(array[0].tolist() for array in world))


def near(values: list[list[float]]) -> Any:
    return [pytest.approx(row, abs=1e-12) for row in values]


def test_placement_uses_up_its_random_numbers_in_order() -> None:
    # Obstacle: 0.8 x 2 x (0.5, -0.25) = (0.8, -0.4), a quarter turned: (1, 0) lies along y, (0, 2) along -x
    drawn = [*(0.75, 0.375, 0.25), *(0.25, 0.5), *(0.5, 0.75), *(0.375, 0.25)]
    by_hand = Placed(
        True,
        pursuers=near([[0.0, 1.0], [-0.5, -1.0]]),
        target=pytest.approx([-1.0, 0.0]),
        discs=near([[0.8, 0.0, 0.2], [0.0, -0.4, 0.1]]),
        centres=near([[0.8, -0.4]]),
    )
    assert placed(drawn) == placed(drawn, separated=False) == by_hand
    assert not placed(drawn[:-1]).fits
    assert not placed(drawn[:4], obstacles=2).fits


def test_what_does_not_fit_is_drawn_again() -> None:
    centre, beside = (0.75, 0.375, 0.25), (0.75, 0.5)  # beside: (1, 0), of which the disc at (0.8, 0) is 0.2 away
    outside = (1.0, 0.375, 0.0)  # the first disc lies at 1.6 + 0.4
    target, on_it, above = (0.25, 0.5), (0.25, 0.57), (0.5, 0.75)  # on it: 0.28 from the target, which reaches 3/8
    on_another, below = (0.54, 0.75), (0.375, 0.25)  # 0.16 from the pursuer above, which reaches 1/4
    fitting = [*centre, *target, *above, *below]
    retried = [*outside, *centre, *beside, *target, *beside, *on_it, *above, *on_another, *below]
    assert placed(retried) == placed(fitting)
    assert not placed(retried[:-2]).fits
    assert placed([*outside, *fitting], separated=False) == placed(fitting)
    assert placed([*centre, *beside, *beside, *beside], separated=False).pursuers == [[1.0, 0.0]] * 2


def test_obstacles_keep_clear_of_each_other_and_bodies_may_touch() -> None:
    # Both unturned: discs at (0.4, 0) and (0, 0.8) beside the centre, of radius 0.2 and 0.1
    first, too_near, other = (0.25, 0.5, 0.0), (0.3, 0.6, 0.0), (0.75, 0.5, 0.0)
    bodies = (0.5, 0.1, 0.9, 0.9, 0.1, 0.9)
    assert placed([*first, *too_near, *other, *bodies], obstacles=2) == placed([*first, *other, *bodies], obstacles=2)
    # A pursuer 3/8 from the target and another 1/4 from the first: their radii, without rounding
    touching = placed([*first, 0.75, 0.5, 0.75, 0.5 - 3 / 32, 0.75, 0.5 - 5 / 32])
    assert touching.fits
    assert touching.pursuers == [[1.0, -0.375], [1.0, -0.625]]


@pytest.fixture(scope="module", params=SHAPES.values(), ids=list(SHAPES))
def shape(request: pytest.FixtureRequest) -> tuple[Scenario, State]:
    return request.param, drawn(request.param).state


def test_nothing_overlaps_at_the_start(shape: tuple[Scenario, State]) -> None:
    scenario, s = shape
    n, length = scenario.pursuers, scenario.discs // max(scenario.obstacles, 1)
    assert (distances(s.pursuers, s.pursuers)[:, ~np.eye(n, dtype=bool)] >= 2 * scenario.pursuer_radius).all()
    target = s.target[:, None]
    assert (distances(s.pursuers, target) >= scenario.pursuer_radius + scenario.target_radius).all()
    for bodies, radius in ((s.pursuers, scenario.pursuer_radius), (target, scenario.target_radius)):
        assert (distances(bodies, s.discs) >= radius + s.discs[:, None, :, 2]).all()
    unit = np.arange(scenario.discs) // max(length, 1)
    others = unit[:, None] != unit
    reach = s.discs[:, :, None, 2] + s.discs[:, None, :, 2]
    assert (distances(s.discs, s.discs)[:, others] >= reach[:, others]).all()


def test_everything_starts_within_the_limits_and_at_rest(shape: tuple[Scenario, State]) -> None:
    _, s = shape
    assert (np.abs(s.pursuers) <= 1.0).all()
    assert (np.abs(s.target) <= 1.0).all()
    assert (np.abs(s.discs[..., :2]) <= 0.9).all()
    assert (s.velocities == 0).all()
    assert not np.shares_memory(s.obstacles, s.discs)


@pytest.mark.compiled
def test_positions_are_uniform_over_the_scene() -> None:
    s = drawn(Scenario(obstacles=2, placement="overlapping", half_width=2.0), 4000).state
    for points, width in ((s.pursuers[:, 0], 2.0), (s.target, 2.0), (s.obstacles[:, 1], 1.8)):
        # Uniform on [-w, w]: mean 0, mean square w^2 / 3, standard errors of 4,000 are w / 110 and w^2 / 212
        np.testing.assert_allclose(points.mean(axis=0), 0, atol=width / 110 * 4)
        np.testing.assert_allclose((points**2).mean(axis=0), width**2 / 3, atol=width**2 / 212 * 4)
        np.testing.assert_allclose((points[:, 0] * points[:, 1]).mean(), 0, atol=width**2 / 190 * 4)


def test_overlapping_placement_takes_every_draw() -> None:
    s = drawn(Scenario(obstacles=3, placement="overlapping"), 500).state
    assert (distances(s.pursuers, s.target[:, None]) < 0.1).any()
    assert (distances(s.discs, s.discs)[:, ~np.eye(3, dtype=bool)] < 0.4).any()


def test_a_seed_draws_the_same_scene_again_and_another_seed_another_one() -> None:
    first, again, other = (drawn(SHAPES["tunnel"], 8, seed).state for seed in (5, 5, 6))
    for name in first._fields:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert (first.target != other.target).any(axis=1).all()
    assert len(np.unique(first.target, axis=0)) == 8


@pytest.mark.parametrize("scene", ["concave", "tunnel"])
def test_a_composite_obstacle_is_rigid_and_scales_with_the_radius(scene: str) -> None:
    scenario = SHAPES[scene]
    shape = SCENES[scene]()
    s = drawn(scenario, 50).state
    expected = np.linalg.norm(shape[:, None, :2] - shape[None, :, :2], axis=2) * 0.15
    for unit in range(2):
        part = s.discs[:, unit * len(shape) : (unit + 1) * len(shape)]
        np.testing.assert_allclose(distances(part, part), np.broadcast_to(expected, (50, *expected.shape)), atol=1e-12)
        np.testing.assert_allclose(part[..., :2].mean(axis=1), s.obstacles[:, unit], atol=1e-12)
        np.testing.assert_allclose(part[..., 2], np.broadcast_to(shape[:, 2] * 0.15, part.shape[:2]))
    first = s.discs[:, 0, :2] - s.obstacles[:, 0]
    quadrant = np.floor(np.arctan2(first[:, 1], first[:, 0]) / (np.pi / 2))
    assert len(np.unique(quadrant)) == 4, "at any angle"


# The last discs of R = 0.2 have radius 0.08 and are met at 0.13. Concave: they lie at 0.3 on both sides and cover
# arcsin(0.13 / 0.3) = 25.7 degrees each of the open 180: 128.7 are free. Tunnel: they lie at (0.3, 0.25), bearing 39.8,
# distance 0.3905, and cover down to 39.8 - arcsin(0.13 / 0.3905) = 20.4 degrees: twice 40.7 are free.
@pytest.mark.parametrize(("scene", "gaps", "free"), [("concave", 1, 128.7), ("tunnel", 2, 81.5)])
def test_from_inside_a_concave_obstacle_is_open_to_one_side_and_a_tunnel_at_both_ends(
    scene: str, gaps: int, free: float
) -> None:
    sim = drawn(Scenario(pursuers=1, scene=scene, speed_ratio=100.0, n_directions=3600), 1)
    saved = sim.get_state()
    s = saved["state"]
    # Inside: between the ends of the half circle, where its discs' centre is not; in the middle of a tunnel
    s["target"][0] = s["discs"][0, [0, -1], :2].mean(axis=0)
    s["pursuers"][0, 0] = 50.0
    sim.set_state(saved)
    owner = sim.measure.enclosure["all"].owner[0]
    is_open = (owner != 1).astype(int)
    assert (np.diff(is_open, append=is_open[0]) == 1).sum() == gaps
    assert is_open.mean() * 360 == pytest.approx(free, abs=0.3)
    assert (np.linalg.norm(s["discs"][0, :, :2] - s["target"][0], axis=1) > s["discs"][0, :, 2] + 0.05).all(), "it fits"


@pytest.mark.compiled
def test_nearly_half_cover_can_be_placed_whatever_the_seed() -> None:
    # 14 x 0.04 + 4 x 0.0025 = 0.57 of 4 / pi: 44.8 %
    scenario = Scenario(obstacles=14)
    assert scenario.cover == pytest.approx(0.45, abs=0.005)
    for seed in range(SEEDS):
        drawn(scenario, 1, seed)
    pursuers = Scenario(obstacles=0, pursuers=56, pursuer_radius=0.1)
    assert pursuers.cover == pytest.approx(0.44, abs=0.01)
    drawn(pursuers, SEEDS, 0)


INFEASIBLE = {
    "two in one place": Scenario(obstacles=2, obstacle_limit=0.0),
    "crowded": Scenario(obstacles=64, obstacle_radius=0.08, obstacle_limit=0.3),
    "too long": Scenario(pursuers=1, scene="tunnel", obstacle_radius=0.6),
    "many discs": Scenario(obstacles=64, scene="tunnel", obstacle_radius=0.06),
}


@pytest.mark.compiled
@pytest.mark.parametrize("n_worlds", [1, 256])
@pytest.mark.parametrize("scenario", INFEASIBLE.values(), ids=INFEASIBLE)
def test_an_infeasible_scene_is_a_clear_error_within_a_second(scenario: Scenario, n_worlds: int) -> None:
    sim = Simulator(scenario, n_worlds, 0)
    drawn(Scenario())  # compiled by now
    start = time.process_time()  # other jobs of the machine do not count
    with pytest.raises(PlacementError, match=f"{scenario.obstacles} obstacles .* could not be placed"):
        sim.reset()
    assert time.process_time() - start < 1.0
