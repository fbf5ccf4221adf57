"""Pictures: of the right kind, the same for the same world, another for another; and clear words where none can be."""

import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pygame
import pytest
from pettingzoo_tests import render_test

from marl_encircle.drawing import palette, pen, render
from marl_encircle.drawing.outlines import facing_arc, far_arc, polar
from marl_encircle.drawing.view import Layers
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.encirclement_v0 import parallel_env
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv

SHAPE = (render.SCENE, render.SCENE + render.PANEL, 3)


def drawn(**fields: Any) -> Any:
    env = parallel_env(render_mode="rgb_array", **fields)
    env.reset(seed=0)
    return env


def still(env: Any) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2, np.float32) for agent in env.agents}


@pytest.fixture
def no_window(monkeypatch: pytest.MonkeyPatch) -> Any:
    """SDL's driver for windows that nobody sees."""
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


# --- Pictures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"pursuers": 1, "obstacles": 0, "max_cycles": 5},
        {"pursuers": 64, "obstacles": 20, "obstacle_radius": 0.05, "pursuer_radius": 0.01, "half_width": 3.0},
        {"pursuers": 4, "scene": "tunnel", "obstacle_radius": 0.1, "composite_unit": False},
        {"pursuer_radius": 0.0, "target_radius": 0.0, "speed_ratio": 1.0, "n_directions": 8},
        {"pursuers": 20, "speed_ratio": 100.0, "half_width": 1000.0, "max_speed": 1e3},
    ],
    ids=str,
)
def test_every_world_can_be_drawn(fields: dict[str, Any]) -> None:
    env = drawn(**fields)
    for _ in range(3):
        picture = env.render()
        assert isinstance(picture, np.ndarray)
        assert (picture.shape, picture.dtype) == (SHAPE, np.uint8)
        assert picture.flags.c_contiguous
        assert picture.std() > 5
        env.step(still(env))


def test_degenerate_worlds_can_be_drawn() -> None:
    env = drawn()
    state = env.simulator.state
    state.pursuers[:] = state.target[:, None]
    env.step(still(env))
    assert env.render().shape == SHAPE


def test_the_same_world_gives_the_same_picture() -> None:
    one, other = drawn(), drawn()
    for env in (one, other):
        for _ in range(4):
            env.step(still(env))
    other.render()  # looking changes nothing
    assert np.array_equal(one.render(), other.render())


def fingerprint() -> int:
    env = drawn()
    env.step(still(env))
    return zlib.crc32(env.render().tobytes())


def test_the_picture_is_the_same_in_another_process() -> None:
    program = "import test_render; print(test_render.fingerprint())"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    assert int(done.stdout.split()[-1]) == fingerprint()


def test_another_state_gives_another_picture() -> None:
    env = drawn()
    pictures = [env.render()]
    env.step(still(env))
    pictures.append(env.render())
    env.reset(seed=1)
    pictures.append(env.render())
    assert len({picture.tobytes() for picture in pictures}) == 3


def test_bodies_are_drawn_where_they_are() -> None:
    env = drawn(pursuers=2, obstacles=1)
    state = env.simulator.state
    # The surface shows [-1.05, 1.05]: 720 / 2.1 = 342.86 pixels a unit; (0.5, 0.5) is at 360 + 171, 360 - 171.
    state.pursuers[0] = [[0.5, 0.5], [-0.5, 0.5]]
    state.velocities[:] = 0.0
    state.target[0] = [-0.5, -0.5]
    state.discs[0, 0] = [0.5, -0.5, 0.2]
    picture = render.picture(render.view(env.simulator, "all"))
    first, second = picture[189, 531 + 12], picture[189, 189 + 12]  # beside their numbers
    assert tuple(first) == palette.PURSUERS[0]
    assert tuple(second) == palette.PURSUERS[1]
    assert tuple(picture[531, 189]) == palette.INK
    assert tuple(picture[531, 531]) == palette.OBSTACLE


def test_a_closed_enclosure_is_shaded_and_an_open_one_is_not_outlined() -> None:
    env = drawn(pursuers=4, obstacles=0)
    state, sim = env.simulator.state, env.simulator
    state.target[0] = 0.0
    around = np.array([[0.4, 0.0], [0.0, 0.4], [-0.4, 0.0], [0.0, -0.4]])

    def inked(places: np.ndarray) -> int:
        state.pursuers[0] = places
        state.velocities[:] = 0.0
        sim.set_state(sim.get_state())  # measures what was moved by hand
        picture = render.picture(render.view(sim, "all"))[:, : render.SCENE]
        return int((picture == palette.INK).all(axis=2).sum())

    closed = inked(around)
    assert np.isfinite(sim.measure.enclosure["all"].movement_range[0])
    opened = inked(around * [[1, 1], [1, 1], [-1, 1], [1, 1]])  # two on one side
    assert not np.isfinite(sim.measure.enclosure["all"].movement_range[0])
    assert closed > opened + 100


def test_nothing_is_drawn_into_the_panel_by_the_scene() -> None:
    env = drawn(pursuers=3)
    env.simulator.state.pursuers[0] = [[1.0, 1.0], [1.0, 0.0], [1.0, -1.0]]
    with_bodies = render.picture(render.view(env.simulator, "all"))
    border = with_bodies[:, render.SCENE + 1]
    assert (border == palette.PAPER).all()


def seen(env: Any, **changes: Any) -> render.View:
    return render.view(env.simulator, "all")._replace(**changes)


def painted(view: render.View, layers: Layers = Layers()) -> np.ndarray:  # noqa: B008 - a named tuple
    return render.array_of(render.draw(view, layers)).astype(int)


def test_the_way_ahead_is_drawn_between_the_target_and_its_next_place() -> None:
    env = drawn(pursuers=1, obstacles=0)
    env.simulator.state.target[0] = [0.0, 0.0]
    env.simulator.state.pursuers[0] = [[-0.9, -0.9]]
    changed = (painted(seen(env)) != painted(seen(env, ahead=np.array([0.2, 0.0])))).any(axis=2)
    y, x = np.nonzero(changed)  # (0.2, 0) is at 360 + 0.2 * 342.86 = 429, 360; the mark's radius is 0.3 * 17 pixels
    assert x.min() > 360
    assert 429 < x.max() < 429 + 8
    assert abs(y - 360).max() < 8


def test_an_apollonius_circle_goes_through_the_places_that_both_reach_at_once() -> None:
    # Target at 0, pursuer at 0.3, twice as slow: 0.2 from the target is 0.1 from the pursuer, 0.6 is 0.3 from it.
    near, far = facing_arc(np.array([0.3, 0.0]), 2.0), far_arc(np.array([0.3, 0.0]), 2.0)
    assert near[1].min() == pytest.approx(0.2)
    assert far[1].max() == pytest.approx(0.6)
    assert near[1][[0, -1]] == pytest.approx(far[1][[0, -1]])  # the tangents' ends
    for angles, distances in (near, far):
        places = polar(np.zeros(2), angles, distances)
        assert np.hypot(*places.T) == pytest.approx(2 * np.hypot(*(places - [0.3, 0.0]).T))
    assert np.isinf(far_arc(np.array([0.3, 0.0]), 1.0)[1]).all()


def test_without_any_layer_only_bodies_are_drawn_and_the_panel_stays() -> None:
    env = drawn(pursuers=3, obstacles=1)
    trail = [np.zeros((4, 2)), np.full((4, 2), 0.5)]
    bare, full = (painted(seen(env, trail=trail), layers) for layers in (Layers(*[False] * 5), Layers()))
    assert np.array_equal(bare[:, render.SCENE :], full[:, render.SCENE :])
    colours = {tuple(colour) for colour in bare[:, : render.SCENE].reshape(-1, 3)[::7]}
    assert palette.PURSUERS[1] in colours
    assert (full != bare)[:, : render.SCENE].any(axis=2).sum() > 1000


def test_the_panel_tells_success_under_both_rules_and_the_reward() -> None:
    env = drawn()
    plain = painted(seen(env))
    for change in (
        {"success": {"all": None, "pursuers": None}},
        {"success": {"all": 3, "pursuers": None}},
        {"success": {"all": 3, "pursuers": 4}},
        {"rewards": (0.5, 1.5)},
        {"title": "ours", "caption": "round 1"},
    ):
        changed = (painted(seen(env, **change)) != plain).any(axis=2)
        assert changed[:, render.SCENE :].any(), change
        assert not changed[:, : render.SCENE].any()


def test_long_names_are_cut_and_symbols_are_not_mistaken_for_names() -> None:
    assert pen.cut("ours", 17, 130, bold=True) == "ours"
    assert pen.cut("a_very_long_name_of_a_method", 17, 130, bold=True).endswith("…")
    assert pen._pieces("model_b") == [(False, "model_b")]
    assert pen._pieces("range R_m") == [(False, "range R"), (True, "m")]


@pytest.mark.parametrize(
    "seen_as",
    [
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    ],
    ids=["no red cones", "no green cones", "no blue cones"],
)
def test_colours_differ_for_colour_blind_eyes(seen_as: list[list[float]]) -> None:
    # Machado, Oliveira and Fernandes (2009), in linear RGB; distances in CIELAB, of which 2.3 can just be seen.
    colours = np.array([*palette.PURSUERS, palette.OBSTACLE, palette.INK, palette.LINE]) / 255.0
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt((np.clip(linear @ np.transpose(seen_as), 0, 1) @ to_xyz.T / to_xyz.sum(axis=1)).T)
    lab = np.stack([116 * y, 500 * (x - y), 200 * (y - z)], axis=1)
    distance = np.linalg.norm(lab[:, None] - lab[None], axis=2) + 100 * np.eye(len(lab))
    assert distance.min() > 12


def test_without_a_render_mode_nothing_is_remembered_and_a_picture_is_refused_kindly() -> None:
    env = parallel_env()
    env.reset(seed=0)
    env.step(still(env))
    assert env._trail == []
    with pytest.warns(UserWarning, match="render_mode='human' or 'rgb_array'"):
        assert env.render() is None


def test_the_vec_env_tiles_its_worlds() -> None:
    venv = SuperSuitVecEnv(lambda: parallel_env(render_mode="rgb_array"), 4)
    venv.reset()
    assert venv.render().shape == (2 * SHAPE[0], 2 * SHAPE[1], 3)


def test_pettingzoo_accepts_the_pictures(no_window: None) -> None:
    render_test(encirclement_v0.env)


def test_drawing_is_not_loaded_before_it_is_asked_for() -> None:
    program = (
        "import sys; from marl_encircle.envs.encirclement_v0 import parallel_env; parallel_env().reset(); "
        "print(any(name.split('.')[0] in ('pygame', 'torch', 'matplotlib') for name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


# --- Windows ----------------------------------------------------------------------------------------------------------


def test_a_window_follows_the_round_and_closes(no_window: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(parallel_env().metadata, "render_fps", 0)  # do not wait
    env = parallel_env(render_mode="human")
    env.reset(seed=0)
    shown = pygame.surfarray.array3d(pygame.display.get_surface())
    env.step(still(env))
    assert not np.array_equal(shown, pygame.surfarray.array3d(pygame.display.get_surface()))
    assert env.render() is None
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    env.step(still(env))  # the user has closed the window: the round goes on unseen
    assert not pygame.display.get_init()
    env.step(still(env))
    env.close()
    env.close()


def test_a_window_without_a_display_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.quit()
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")  # also where a developer has a display
    env = parallel_env(render_mode="human")
    with pytest.raises(RuntimeError, match=r"found no display .*use render_mode='rgb_array'"):
        env.reset()
    assert not pygame.display.get_init()


@pytest.mark.parametrize("mode", ["human", "rgb_array"])
def test_without_pygame_the_extra_is_named(mode: str) -> None:
    program = f"""
import sys
sys.modules["pygame"] = None
from marl_encircle.envs.encirclement_v0 import parallel_env
parallel_env().reset()
try:
    parallel_env(render_mode={mode!r})
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "drawing needs pygame-ce: pip install 'marl-encircle[render]'"


def test_pygame_does_not_advertise() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import marl_encircle.drawing.render"], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("", "")


def test_it_draws_on_after_another_environment_ended_pygame() -> None:
    before = pen.font(24)
    pygame.quit()
    after = pen.font(24)
    assert after is not before
    assert after.render("text", True, "black").get_width() > 0
