"""A scenario takes what makes sense and says in one line what does not."""

import math
from dataclasses import fields
from typing import Any, Literal, get_origin, get_type_hints

import numpy as np
import pytest
from core_worlds import arranged, push

from marl_encircle.core import dynamics
from marl_encircle.core.dynamics import TARGETS
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.scenes import SCENES
from marl_encircle.core.simulator import Simulator

HINTS = get_type_hints(Scenario)
NUMBERS = [f for f in fields(Scenario) if HINTS[f.name] in (int, float)]


def refused(**values: Any) -> str:
    with pytest.raises(ValueError) as caught:
        Scenario(**values)
    return str(caught.value)


def test_the_defaults_are_those_of_the_notes() -> None:
    s = Scenario()
    assert (s.max_cycles, s.half_width, s.n_directions) == (60, 1.0, 72)
    assert (s.movement_range_limit, s.stage_threshold) == (0.05, 0.93)
    assert (s.pursuer_radius, s.target_radius, s.obstacle_radius) == (0.05, 0.05, 0.2)
    assert (s.time_step, s.damping, s.contact_force, s.contact_margin, s.pursuer_mass) == (0.1, 0.25, 1e2, 1e-3, 1.0)
    assert s.max_speed * s.time_step == pytest.approx(0.1)
    assert (s.path_samples, s.path_rule, s.repulsion_power, s.acceleration) == (10, "literal", 2, 3.0)
    assert s.safety_distance == pytest.approx(s.pursuer_radius + s.target_radius + 0.01)
    assert s.agents == ("pursuer_0", "pursuer_1", "pursuer_2")


def test_the_limits_are_those_of_the_notes() -> None:
    positive = ("obstacle_radius", "time_step", "max_speed", "acceleration", "pursuer_mass")
    at_least_0 = ("pursuer_radius", "target_radius", "contact_force", "repulsion_softening", "wall_weight")
    assert {f.name: (f.metadata["low"], f.metadata["high"]) for f in NUMBERS} == {
        **dict.fromkeys(positive, (1e-6, 1e6)),
        **dict.fromkeys((*at_least_0, "safety_distance", "obstacle_margin"), (0, 1e6)),
        **dict.fromkeys(("movement_range_limit", "contact_margin", "direction_softening"), (1e-9, 1e6)),
        **dict.fromkeys(("stage_threshold", "damping", "obstacle_limit"), (0, 1)),
        "pursuers": (1, 64),
        "obstacles": (0, 64),
        "speed_ratio": (1, 100),
        "max_cycles": (1, 100_000),
        "half_width": (1e-3, 1e3),
        "n_directions": (8, 4096),
        "repulsion_power": (1, 2),
        "path_samples": (1, 1000),
    }


@pytest.mark.parametrize("name", [f.name for f in NUMBERS])
def test_a_number_out_of_range_or_of_another_type_names_the_field(name: str) -> None:
    meta = next(f.metadata for f in NUMBERS if f.name == name)
    kind = HINTS[name]
    below = meta["low"] - 1
    bad = [below, meta["high"] + 1, True, "3", None, [1], math.nan, math.inf, -math.inf]
    if kind is int:
        bad.append(3.0)
    for value in bad:
        message = refused(**{name: value})
        assert message.startswith(f"{name} must be ")
        assert "\n" not in message
        assert f"{value!r:.80}" in message


@pytest.mark.parametrize("name", [f.name for f in NUMBERS])
@pytest.mark.parametrize("value", [10**400, -(10**400)])
def test_a_whole_number_that_no_float_can_hold_is_out_of_range(name: str, value: int) -> None:
    assert refused(**{name: value}).startswith(f"{name} must be ")


def test_numpys_numbers_are_pythons() -> None:
    given: dict[str, Any] = {
        "pursuers": np.int64(4),
        "n_directions": np.uint16(36),
        "obstacle_radius": np.float32(0.25),
    }
    scenario = Scenario(**given, speed_ratio=np.float64(1.5), half_width=np.int8(2))
    assert scenario == Scenario(pursuers=4, n_directions=36, obstacle_radius=0.25, speed_ratio=1.5, half_width=2.0)
    for f in NUMBERS:
        assert type(getattr(scenario, f.name)) is HINTS[f.name]
    for value in (np.float64(3.0), np.True_, np.array(3)):
        assert refused(pursuers=value).startswith("pursuers must be an integer; got ")
    assert refused(pursuers=np.int64(0)).startswith("pursuers must be between 1 and 64; got ")


@pytest.mark.parametrize("value", [True, False])
def test_numpys_truth_values_are_pythons(value: bool) -> None:
    scenario = Scenario(composite_unit=np.bool_(value))  # type: ignore[arg-type]
    assert scenario.composite_unit is value
    assert refused(composite_unit=np.int64(1)) == "composite_unit must be a bool; got 1"


@pytest.mark.parametrize("name", [n for n, hint in HINTS.items() if get_origin(hint) is Literal])
def test_a_choice_outside_the_list_shows_the_list(name: str) -> None:
    for value in ("nonsense", None, 1, ""):
        message = refused(**{name: value})
        assert message.startswith(f"{name} must be one of ")
        assert getattr(Scenario(), name) in message


@pytest.mark.parametrize("value", [["unhashable"], {}, "x" * 10_000])
def test_any_kind_of_value_is_refused_in_few_words(value: Any) -> None:
    for f in fields(Scenario):
        message = refused(**{f.name: value})
        assert message.startswith(f"{f.name} must be ")
        assert len(message) < 300


def test_names_of_scenes_and_targets_are_checked() -> None:
    assert refused(scene="tunel") == "scene must be one of random, concave, tunnel; got 'tunel'"
    assert refused(target="repulsive") == "target must be one of repulsion, still; got 'repulsive'"
    assert refused(scene=3) == "scene must be a str; got 3"
    assert refused(composite_unit=1) == "composite_unit must be a bool; got 1"


def test_extras_are_a_tuple_of_known_names() -> None:
    assert Scenario(observe_extras=("stage",)).observe_extras == ("stage",)
    for bad in (["stage"], ("stages",), "stage", None):
        assert refused(observe_extras=bad).startswith(
            "observe_extras must be a tuple of occupied_angle, stage, speed_ratio"
        )


def test_an_odd_number_of_directions_has_no_opposites() -> None:
    assert refused(n_directions=73).startswith("n_directions must be even")


def test_too_many_bodies_to_place_are_refused_by_their_cover() -> None:
    # (16 x 0.04 + 4 x 0.0025) pi / 4 = 51 %
    assert Scenario(obstacles=15).cover == pytest.approx(0.479, abs=1e-3)
    assert "cover 51% of the scene; at most 50%" in refused(obstacles=16)
    # Tunnel: ten discs of 0.4 R: 1.6 R^2
    assert Scenario(scene="tunnel").cover == pytest.approx(math.pi * (1.6 * 0.04 + 4 * 0.0025) / 4)


def test_more_bodies_than_a_byte_can_number_are_refused() -> None:
    many = {"scene": "tunnel", "obstacle_radius": 0.02, "composite_unit": False}
    assert "too many obstacles: 9 pursuers and 120 obstacles" in refused(pursuers=9, obstacles=12, **many)
    sim = Simulator(Scenario(pursuers=8, obstacles=12, **many), 20, 0)
    angles = sim.reset().enclosure["all"].contributing_angle
    assert angles.shape == (20, 128)
    assert angles[:, -10:].sum() > 0
    Scenario(pursuers=64, obstacles=64, pursuer_radius=0.01, obstacle_radius=0.01)


def test_a_misspelt_field_is_an_error() -> None:
    with pytest.raises(TypeError, match="pursuer_count"):
        Scenario(pursuer_count=3)  # type: ignore[call-arg]


def test_the_radius_at_a_cover_is_covers_inverse() -> None:
    for scene in SCENES:
        s = Scenario(scene=scene, obstacles=2, pursuers=4, half_width=1.5)
        assert s.obstacle_radius_at(s.cover) == pytest.approx(s.obstacle_radius)
    # Two discs and four bodies of 0.05 in a scene of area 4: pi (2 R^2 + 4 x 0.0025) / 4 = pi / 4 x 0.19 at R = 0.3
    assert Scenario(obstacles=2).obstacle_radius_at(0.19 * math.pi / 4) == pytest.approx(0.3)
    assert Scenario().obstacle_radius_at(0.001) == 0.0


@pytest.mark.parametrize("value", [np.array(["soft", "hard"]), np.array("soft"), ["soft"], None, 1])
def test_a_choice_that_is_no_text_names_the_field(value: Any) -> None:
    assert refused(contacts=value).startswith("contacts must be one of soft, hard, off; got ")
    assert refused(observe_extras=(value,)).startswith("observe_extras must be a tuple of ")
    assert refused(scene=value).startswith("scene must be a str; got ")


@pytest.mark.parametrize("name", ["my-cross", "my/cross", "", "a cross"])
def test_a_scene_that_no_folder_could_be_named_after_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(SCENES, name, SCENES["random"])
    assert refused(scene=name) == f"scene {name!r} must be named by letters, digits and _: folders are named after it"


def test_units_and_discs_count_composite_obstacles_as_told() -> None:
    whole, apart = (
        Scenario(scene="concave", obstacles=2, obstacle_radius=0.1, composite_unit=u) for u in (True, False)
    )
    assert (whole.units, whole.discs) == (2, 14)
    assert (apart.units, apart.discs) == (14, 14)
    assert (Scenario(obstacles=0, scene="tunnel").units, Scenario(obstacles=0).discs) == (0, 0)


def test_equation_6_says_how_many_pursuers_suffice() -> None:
    for ratio, least in ((1.0, 2), (1.1, 3), (1.2, 4), (1.3, 4), (1.4, 4)):
        assert Scenario(pursuers=least, speed_ratio=ratio).solvable_without_obstacles
        assert not Scenario(pursuers=least - 1, speed_ratio=ratio).solvable_without_obstacles


# Targets


def test_the_registry_of_targets_is_what_the_file_can_do() -> None:
    assert all(getattr(dynamics, name) is target for name, target in TARGETS.items())
    for name in TARGETS:
        Simulator(Scenario(target=name), 1, 0)


def test_each_target_moves_in_its_own_way() -> None:
    moved = {name: push(arranged([(-0.3, 0.0)], target=name)).state.target[0, 0] for name in TARGETS}
    assert moved == {"repulsion": pytest.approx(0.11), "still": 0.0}


def test_whole_numbers_do_for_any_number() -> None:
    whole = {
        "half_width": 2,
        "max_speed": 1,
        "acceleration": 5,
        "damping": 0,
        "pursuer_radius": 0,
        "safety_distance": 0,
    }
    plain = {name: float(value) for name, value in whole.items()}
    ends = []
    for values in (whole, plain):
        sim = Simulator(Scenario(**values), 2, 3)
        sim.reset()
        for _ in range(5):
            push(sim, (1.0, 0.5))
        ends.append(sim.state.pursuers.copy())
    np.testing.assert_array_equal(*ends)
    assert Scenario(**whole) == Scenario(**plain)
    assert repr(Scenario(**whole)) == repr(Scenario(**plain))
    assert dynamics.physics_of(Scenario(**whole)).dtype == dynamics.physics_of(Scenario()).dtype, "one compilation"
