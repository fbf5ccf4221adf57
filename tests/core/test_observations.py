"""What each number of an observation is, and between which bounds it lies."""

import math

import numpy as np
import pytest
from core_worlds import arranged, random_actions

from marl_encircle.core.observations import bounds, layout, observe
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator

EXTRAS = ("occupied_angle", "stage", "speed_ratio")


def seen(sim: Simulator) -> np.ndarray:
    size = max(part.stop for part in layout(sim.scenario).values())
    out = np.full((sim.n_worlds, sim.scenario.pursuers, size), np.nan, np.float32)
    observe(sim, out)
    return out


@pytest.mark.parametrize("directions", [True, False])
@pytest.mark.parametrize("extras", [(), EXTRAS, ("stage",)])
@pytest.mark.parametrize(("n", "m", "scene"), [(3, 2, "random"), (1, 0, "random"), (2, 1, "tunnel")])
def test_the_layout_covers_the_observation_without_gap(
    n: int, m: int, scene: str, extras: tuple, directions: bool
) -> None:
    scenario = Scenario(pursuers=n, obstacles=m, scene=scene, observe_directions=directions, observe_extras=extras)
    at = 0
    for part in layout(scenario).values():
        assert part.start == at
        at = part.stop
    entities = 1 + (n - 1) + m
    assert at == 4 + 2 * entities * (1 + directions) + len(extras)
    low, high = bounds(scenario)
    assert low.shape == high.shape == (at,)
    sim = Simulator(scenario, 2, 0)
    sim.reset()
    assert np.isfinite(seen(sim)).all(), "every number is written"


def test_the_bounds_by_hand() -> None:
    scenario = Scenario(pursuers=2, half_width=3.0, max_speed=1.7, observe_extras=EXTRAS)
    low, high = bounds(scenario)
    # Two bodies are at most 6 apart along an axis; a direction is at most 1, as are a share and a stage
    expected = [3, 3, 1.7, 1.7, *[6] * 6, *[1] * 6, 1, 1, math.inf]
    np.testing.assert_allclose(high, expected, rtol=2e-6)
    assert (high >= np.float32(expected)).all(), "rounding included"
    np.testing.assert_array_equal(low, -high)


def test_three_pursuers_and_one_obstacle_have_the_papers_twelve_numbers() -> None:
    # 2 position + 2 velocity + 2 target + 2 x 2 pursuers + 2 obstacle
    assert max(p.stop for p in layout(Scenario(observe_directions=False)).values()) == 12


def test_the_values_by_hand() -> None:
    sim = arranged(
        [(0.1, 0.2), (0.4, 0.6), (-0.3, 0.2)],
        (0.1, -0.3),
        [(-0.5, 0.2, 0.1), (0.9, 0.8, 0.1)],
        [(0.01, 0.02), (0.03, 0.04), (0.05, 0.06)],
        direction_softening=0.5,
    )
    part, row = layout(sim.scenario), seen(sim)[0]
    expected = {
        "position": [0.4, 0.6],
        "velocity": [0.03, 0.04],
        "target": [-0.3, -0.9],
        "pursuers": [-0.3, -0.4, -0.7, -0.4],  # 0, then 2
        "obstacles": [-0.9, -0.4, 0.5, 0.2],
        "target_direction": [-0.3 / (math.sqrt(0.9) + 0.5), -0.9 / (math.sqrt(0.9) + 0.5)],
        "pursuer_directions": [-0.3, -0.4, -0.7 / (math.sqrt(0.65) + 0.5), -0.4 / (math.sqrt(0.65) + 0.5)],
        "obstacle_directions": [
            *(-0.9 / (math.sqrt(0.97) + 0.5), -0.4 / (math.sqrt(0.97) + 0.5)),
            *(0.5 / (math.sqrt(0.29) + 0.5), 0.2 / (math.sqrt(0.29) + 0.5)),
        ],
    }
    assert list(expected) == list(part)
    for name, values in expected.items():
        np.testing.assert_allclose(row[1, part[name]], values, rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(row[0, part["pursuers"]], [0.3, 0.4, -0.4, 0.0], atol=1e-7)
    np.testing.assert_allclose(row[2, part["pursuers"]], [0.4, 0.0, 0.7, 0.4], atol=1e-7)
    np.testing.assert_allclose(row[2, part["obstacles"]], [-0.2, 0.0, 1.2, 0.6], atol=1e-7)


def test_the_extras_are_the_share_of_the_circle_the_stage_and_the_ratio() -> None:
    ring = [(0.3, 0.01), (-0.15, 0.26), (-0.15, -0.26)]
    for pursuers, stage in ((ring, 1.0), ([(0.3, 0.0), (0.3, 0.1), (0.3, -0.1)], 0.0)):
        sim = arranged(pursuers, speed_ratio=1.1, observe_extras=EXTRAS)
        row, part = seen(sim)[0], layout(sim.scenario)
        share = sim.measure.enclosure["all"].occupied_angle[0] / (2 * math.pi)
        assert row[:, part["occupied_angle"]] == pytest.approx(share)
        assert (row[:, part["stage"]] == stage).all()
        assert row[:, part["speed_ratio"]] == pytest.approx(1.1)


@pytest.mark.parametrize("n_directions", [100, 200, 300, 400])
def test_the_stage_begins_at_the_very_threshold(n_directions: int) -> None:
    # A lone pursuer at equal speeds owns the open half circle, K / 2 - 1 or K / 2 directions
    sim = arranged([(0.3, 0.0001)], speed_ratio=1.0, n_directions=n_directions, observe_extras=("stage",))
    owned = int((sim.measure.enclosure["all"].owner == 0).sum())
    for k in range(owned - 1, owned + 2):
        at = arranged(
            [(0.3, 0.0001)],
            speed_ratio=1.0,
            n_directions=n_directions,
            observe_extras=("stage",),
            stage_threshold=k / n_directions,
        )
        assert (seen(at)[..., -1] == (k <= owned)).all()


@pytest.mark.parametrize("unit", [True, False])
def test_a_composite_obstacle_is_seen_as_one_centre_or_disc_by_disc(unit: bool) -> None:
    sim = Simulator(Scenario(scene="concave", composite_unit=unit), 2, 0)
    sim.reset()
    part = layout(sim.scenario)["obstacles"]
    things = sim.state.obstacles if unit else sim.state.discs[..., :2]
    expected = things[:, None] - sim.state.pursuers[:, :, None]
    np.testing.assert_allclose(seen(sim)[..., part], expected.reshape(2, 3, -1), atol=1e-6)


def test_only_the_worlds_asked_for_are_written() -> None:
    sim = Simulator(Scenario(observe_extras=EXTRAS), 4, 0)
    sim.reset()
    out = np.full_like(seen(sim), 7.0)
    observe(sim, out, np.array([2, 0]))
    assert (out[[1, 3]] == 7.0).all()
    np.testing.assert_array_equal(out[[0, 2]], seen(sim)[[0, 2]])


@pytest.mark.compiled
@pytest.mark.parametrize("half_width", [1.0, 0.7, 3.0])
def test_all_values_stay_within_the_bounds(half_width: float) -> None:
    scenario = Scenario(obstacles=2, obstacle_radius=0.1, half_width=half_width, max_speed=1.7, observe_extras=EXTRAS)
    low, high = bounds(scenario)
    sim, rng = Simulator(scenario, 32, 3), np.random.default_rng(3)
    sim.reset()
    corners = np.sign(random_actions(sim, rng))
    for step in range(150):  # into corners, where the bounds are reached, then anywhere
        sim.step(corners if step < 60 else random_actions(sim, rng))
        row = seen(sim)
        assert (row >= low).all()
        assert (row <= high).all()
        if step == 59:
            assert np.abs(row[..., :2]).max() == pytest.approx(half_width)
