"""Watching rounds: the right policy and rounds, what each moment shows, readable films, keys that work."""

import gc
import io
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pygame
import pytest
import torch as th
from PIL import Image
from tiny_runs import command, copy_of_finished, finished, tiny

from marl_encircle.core.simulator import world_seeds
from marl_encircle.drawing.pen import SUPERSAMPLING
from marl_encircle.drawing.render import PANEL, SCENE, TALL_PANEL, TALL_SCENE, TALL_TITLE, array_of, draw_tall, shrunk
from marl_encircle.drawing.view import Layers
from marl_encircle.experiments.build import build_policy
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.pretrained import find_run
from marl_encircle.experiments.records import run_path
from marl_encircle.experiments.train import train
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays import film, player
from marl_encircle.replays.player import BAR, SPEEDS, Player, timeline
from marl_encircle.replays.watch import Match, Side, end_of, find_match, find_side, fresh_seed

RUNS = Path(__file__).parents[2] / "results" / "runs"
OURS = Path(__file__).parents[2] / "ablations" / "ours.yaml"
REWARD = "name: my_idea\nclosure: pursuers\nterms:\n  contributing_angle: 1.0\n"


@cache
def side() -> Side:
    return find_side(str(finished()), Path("results"))


@cache
def match() -> Match:
    return Match(side(), eval_seed=5)


@cache
def short() -> Match:
    config = side().config
    scenario = replace(config.scenario, max_cycles=5)
    return Match(replace(side(), config=config.model_copy(update={"scenario": scenario})), eval_seed=5)


@cache
def duel() -> Match:
    """The same method, trained and untrained."""
    with th.random.fork_rng():
        th.manual_seed(0)
        return Match(side(), replace(side(), title="untrained", policy=build_policy(side().config)), eval_seed=5)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    copy_of_finished(tmp_path / "results" / "runs")
    return tmp_path / "results"


# --- Which policy, which rounds ---------------------------------------------------------------------------------------


def test_a_method_is_its_first_training_seed(results: Path) -> None:
    folder = results / "runs" / run_path(tiny().cell, 0)
    for seed in (11, 2):
        shutil.copytree(folder, folder.parent / f"seed{seed}")
    (folder.parent / "seed1").mkdir()  # unfinished
    assert find_side("ours", results).folder == folder
    folder.rename(folder.parent / "seed30")
    assert find_run("ours", tiny().cell.setting, [results / "runs"]).name == "seed2"


def test_a_method_that_has_the_runs_of_another_is_shown_with_them(results: Path) -> None:
    folder = results / "runs" / run_path(tiny().cell, 0)
    without = folder.parent.with_name("ratio1.1_n3_m0_random") / "seed0"
    without.parent.mkdir()
    folder.rename(without)
    assert find_run("model_a", tiny(obstacles=0).cell.setting, [results / "runs"]) == without


def test_other_scenes_are_played_by_the_policy_of_the_random_one(results: Path) -> None:
    found = find_side("ours", results, scene="tunnel")
    assert found.folder == results / "runs" / run_path(tiny().cell, 0)
    replay = Match(found, eval_seed=5).replays(0)[0]
    assert (replay.scenario.scene, len(replay.discs)) == ("tunnel", 10)
    with pytest.raises(ConfigError, match="did you mean tunnel"):
        find_side("ours", results, scene="tunel")


def test_a_policy_of_sets_is_watched_in_any_setting(tmp_path: Path) -> None:
    folder, _ = train(tiny(overrides=["algorithm.features=set"]), 0, out=tmp_path / "runs")
    assert find_side("ours", tmp_path).config == find_side(str(folder)).config
    many = {"pursuers": 5, "obstacles": 2}
    for what in ("ours", str(folder)):
        [replay] = Match(find_side(what, tmp_path, many), eval_seed=5).replays(0)
        assert (replay.scenario.pursuers, replay.scenario.obstacles) == (5, 2)
        assert replay.pursuers.shape[1] == 5
    copy_of_finished(tmp_path / "other" / "runs")
    with pytest.raises(ConfigError, match="no run of ours with 5 pursuers"):
        find_side("ours", tmp_path / "other", many)
    with pytest.raises(ConfigError, match="was trained with 3 pursuers and 1 obstacle"):
        find_side(str(finished()), None, many)
    with pytest.raises(ConfigError, match="pursuers must be"):
        find_side("ours", tmp_path, {"pursuers": 0})


def test_a_reward_is_watched_with_the_policy_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(REWARD)
    with pytest.raises(ConfigError, match="--policy RUN_DIR"):
        find_side(str(tmp_path / "mine.yaml"), tmp_path)
    found = find_side(str(tmp_path / "mine.yaml"), tmp_path, policy=finished())
    assert (found.title, found.trained_as, found.config.reward.closure) == ("my_idea", "ours", "pursuers")
    mine, own = (Match(each, eval_seed=5).replays(0)[0] for each in (found, side()))
    assert np.array_equal(mine.pursuers, own.pursuers)
    assert not np.allclose(mine.rewards, own.rewards)
    assert Match(found, eval_seed=5).views(0, 0)[0].caption == "policy of ours\nround 0 of seed 5"


@pytest.mark.parametrize(
    ("what", "options", "said"),
    [
        ("our", {}, "did you mean ours"),
        ("ours", {"fields": {"pursuers": 7}}, "there are ratio1.1_n3_m1_random. Train one: marl-encircle train"),
        ("model_b", {}, "it has none at all"),
        ("ours", {"policy": Path("x")}, "x/run.json: the file is missing"),
        ("nowhere/seed0", {}, "nowhere/seed0/run.json: the file is missing"),
        ("nowhere.yaml", {"policy": Path("x")}, "nowhere.yaml: no such file"),
        (str(OURS), {}, "is a reward without a policy: add --policy RUN_DIR"),
    ],
)
def test_what_is_not_there_is_named(results: Path, what: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError) as caught:
        find_side(what, results, **options)
    assert said in str(caught.value)


def test_a_run_folder_of_another_setting_or_with_a_policy_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"was trained with 3 pursuers and 1 obstacle .*; asked for with 4 pursuers"):
        find_side(str(finished()), Path("results"), {"pursuers": 4})
    with pytest.raises(ConfigError, match="its own"):
        find_side(str(finished()), Path("results"), policy=finished())


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"composite_unit": False}, "policies of ours cannot play with other numbers of bodies"),
        ({"obstacles": 2, "half_width": 0.4}, "scenario: too many bodies to place"),
    ],
)
def test_a_scene_that_a_policy_cannot_play_in_is_refused(tmp_path: Path, fields: dict[str, Any], said: str) -> None:
    folder, _ = train(tiny(**fields), 0, out=tmp_path)
    with pytest.raises(ConfigError, match=f"{folder} was trained .*; asked for .* in the scene tunnel: {said}"):
        find_side(str(folder), scene="tunnel")


def test_a_policy_of_sets_is_watched_where_an_obstacle_is_several(tmp_path: Path) -> None:
    folder, _ = train(tiny(overrides=["algorithm.features=set"], composite_unit=False), 0, out=tmp_path)
    [replay] = Match(find_side(str(folder), scene="tunnel"), eval_seed=5).replays(0)
    assert (replay.scenario.units, len(replay.discs)) == (10, 10)


def test_a_run_folder_is_watched_at_any_speed_ratio(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(REWARD)
    faster = {"speed_ratio": 1.3}
    for found in (
        find_side(str(finished()), None, faster),
        find_side(str(tmp_path / "mine.yaml"), None, faster, policy=finished()),
    ):
        [replay] = Match(found, eval_seed=5).replays(0)
        assert (replay.scenario.speed_ratio, found.policy.agents) == (1.3, side().policy.agents)


def test_rounds_are_fresh_unless_asked_for_and_it_is_said() -> None:
    config = side().config
    used = {0, config.evaluation.seed, config.evaluation.curve_seed}
    assert fresh_seed((side(),)) not in used
    crowded = config.model_copy(update={"evaluation": config.evaluation.model_copy(update={"seed": 7000})})
    assert fresh_seed((replace(side(), config=crowded, train_seed=7001),)) == 7002
    seeds = {None: "fresh ones; the reported ones are --seed 4000", 4000: "the reported ones", 0: "a training seed"}
    for seed, said in seeds.items():
        assert said in list(Match(side(), eval_seed=seed).notes())[-1]


def test_two_policies_start_alike_and_go_their_own_ways_by_one_clock() -> None:
    mine, other = duel().replays(0)
    assert np.array_equal(mine.pursuers[0], other.pursuers[0])
    assert not np.array_equal(mine.pursuers[2], other.pursuers[2])
    shorter, longer = sorted(end_of(each) for each in (mine, other))
    steps = [view.step for view in duel().views(0, longer)]
    assert sorted(steps) == [shorter, longer]


def test_policies_of_different_rounds_are_refused(results: Path) -> None:
    tunnel = find_side("ours", results, scene="tunnel")
    with pytest.raises(ConfigError, match="not the same rounds"):
        Match(side(), tunnel)
    wide = replace(side().config.scenario, half_width=2.0)
    with pytest.raises(ConfigError, match="place the bodies differently"):
        Match(side(), replace(side(), config=side().config.model_copy(update={"scenario": wide}))).replays(0)
    assert len(find_match("ours", "ours", results, {}, "tunnel", None, 5).replays(0)) == 2


# --- What a moment shows ----------------------------------------------------------------------------------------------


def test_the_way_ahead_is_the_targets_next_move_and_success_is_not_told_beforehand() -> None:
    rounds = play_rounds(side().policy, side().config, 40, 5)
    number = next(each.round for each in rounds if each.step_all)
    replay = match().replays(number)[0]
    assert match().length(number) == end_of(replay)
    for step in range(end_of(replay) + 1):
        view = match().views(number, step)[0]
        if step < replay.length:
            assert np.array_equal(view.ahead, replay.target[step + 1])
        else:
            assert view.ahead is None
        assert view.success == {
            "all": replay.step_all if replay.step_all and step >= replay.step_all else None,
            "pursuers": replay.step_pursuers if replay.step_pursuers and step >= replay.step_pursuers else None,
        }
        assert len(view.trail) == step + 1
        assert view.complete == bool(replay.enclosure["all"].complete[step])
    assert replay.seed == world_seeds(5, number + 1)[number]


@pytest.mark.parametrize(
    ("closure", "step_all", "step_pursuers", "end"),
    [
        ("all", 7, 12, 12),
        ("all", 7, None, 7),
        ("pursuers", 7, None, 20),
        ("all", None, None, 20),
    ],
)
def test_a_round_is_over_when_nothing_more_can_succeed(
    closure: Any, step_all: int | None, step_pursuers: int | None, end: int
) -> None:
    replay = replace(match().replays(0)[0], closure=closure, step_all=step_all, step_pursuers=step_pursuers)
    replay = replace(replay, target=np.zeros(((12 if step_pursuers else 20) + 1, 2)))
    assert end_of(replay) == end


def test_rewards_add_up_to_the_rounds_return() -> None:
    episode = next(each for each in play_rounds(side().policy, side().config, 40, 5) if each.step_all)
    view = match().views(episode.round, episode.step_all or 0)[0]
    assert view.rewards is not None
    assert view.rewards[1] == pytest.approx(episode.return_mean, abs=1e-5)
    before = match().views(episode.round, (episode.step_all or 0) - 1)[0].rewards
    assert before is not None
    assert view.rewards[0] == pytest.approx(view.rewards[1] - before[1])


# --- Films ------------------------------------------------------------------------------------------------------------


def test_a_gif_has_a_picture_of_every_step_and_the_same_bytes_again(tmp_path: Path) -> None:
    for name in ("one.gif", "two.gif"):
        film.save(tmp_path / name, short(), 1, fps=5)
    assert (tmp_path / "one.gif").read_bytes() == (tmp_path / "two.gif").read_bytes()
    with Image.open(tmp_path / "one.gif") as image:
        assert (image.n_frames, image.size) == (short().length(1) + 1, (SCENE + PANEL, SCENE))
        durations = []
        for frame in range(image.n_frames):
            image.seek(frame)
            durations.append(image.info["duration"])
            shown = np.asarray(image.convert("RGB")).astype(int)
            drawn = array_of(film.drawing(short(), 1, frame)).astype(int)
            assert np.abs(shown - drawn).mean() < 0.5  # the palette's rounding
            assert (shown == drawn).all(axis=2).mean() > 0.9
    assert durations == [200] * short().length(1) + [1500]


def test_headless_writes_png_of_every_step_that_hold_the_drawing(tmp_path: Path) -> None:
    paths = film.save_pictures(tmp_path / "a", short(), 0, Layers(trails=False))
    assert [path.name for path in paths] == [f"step{step:03}.png" for step in range(short().length(0) + 1)]
    again = film.save_pictures(tmp_path / "b", short(), 0, Layers(trails=False))
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in again]
    picture = np.asarray(Image.open(io.BytesIO(paths[3].read_bytes())))
    assert np.array_equal(picture, array_of(film.drawing(short(), 0, 3, Layers(trails=False))))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves pipes open
def test_an_mp4_can_be_read_back(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    import imageio.v2 as imageio

    film.save(tmp_path / "round.mp4", short(), 0, fps=10)
    with imageio.get_reader(tmp_path / "round.mp4") as reader:
        frames = [frame for frame in reader]  # noqa: C416 - its length is infinite
    assert len(frames) == short().length(0) + 1 + 15  # the last one stands 1.5 s longer
    assert frames[0].shape == (SCENE, SCENE + PANEL, 3)
    assert np.abs(frames[0].astype(int) - array_of(film.drawing(short(), 0, 0))).mean() < 6
    gc.collect()  # so that they are found here


def test_two_policies_are_drawn_side_by_side_at_one_size() -> None:
    both = array_of(film.drawing(duel(), 0, 4))
    for place, view in enumerate(duel().views(0, 4)):
        alone = array_of(shrunk(draw_tall(view)))
        part = both[:, place * TALL_SCENE : (place + 1) * TALL_SCENE]
        assert part.shape == alone.shape
        assert np.array_equal(part[:, 2:-2], alone[:, 2:-2])  # all but the line between them
    assert both.shape[1] == 2 * TALL_SCENE


# --- The window -------------------------------------------------------------------------------------------------------


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """SDL's driver for windows that nobody sees."""
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    yield
    pygame.display.quit()


def press(shown: Player, *keys: int) -> None:
    for key in keys:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
    for event in pygame.event.get():
        shown.handle(event)


def test_time_moves_a_round_on_and_then_the_next_one() -> None:
    shown = Player(match(), fps=10)
    assert not shown.advance(0.09)
    assert shown.advance(0.02)
    assert shown.step == 1
    for _ in range(shown.length - 1):
        assert shown.advance(0.11)
    assert (shown.number, shown.step) == (0, shown.length)
    assert not shown.advance(1.4)
    assert shown.advance(0.2)
    assert (shown.number, shown.step) == (1, 0)


def test_keys_pause_step_change_speed_and_round(unseen: None) -> None:
    shown = Player(match(), fps=10)
    press(shown, pygame.K_SPACE)
    assert not shown.advance(100)
    press(shown, pygame.K_RIGHT, pygame.K_RIGHT, pygame.K_RIGHT, pygame.K_LEFT)
    assert (shown.step, shown.playing) == (2, False)
    press(shown, pygame.K_SPACE, pygame.K_PLUS)
    assert shown.advance(0.06)
    press(shown, pygame.K_MINUS, pygame.K_MINUS)
    assert not shown.advance(0.19)
    assert shown.advance(0.02)
    press(shown, pygame.K_END)
    assert (shown.step, shown.playing) == (shown.length, False)
    press(shown, pygame.K_RIGHT)
    assert shown.step == shown.length
    press(shown, pygame.K_SPACE)  # from the end it starts over
    assert (shown.step, shown.playing) == (0, True)
    press(shown, pygame.K_HOME, pygame.K_LEFT)
    assert shown.step == 0
    press(shown, pygame.K_n)
    assert (shown.number, shown.step, shown.playing) == (1, 0, True)
    press(shown, pygame.K_p, pygame.K_p)
    assert shown.number == 0
    press(shown, *[pygame.K_MINUS] * 20)
    assert shown.speed == 0
    press(shown, *[pygame.K_EQUALS] * 20)
    assert shown.speed == len(SPEEDS) - 1


@pytest.mark.parametrize(
    ("key", "layer"),
    list(zip((pygame.K_a, pygame.K_c, pygame.K_r, pygame.K_t, pygame.K_z), Layers._fields, strict=True)),
)
def test_a_layers_key_changes_the_scene_alone_and_back(unseen: None, key: int, layer: str) -> None:
    number, step = lens_moment()
    shown = Player(good(), number)
    press(shown, pygame.K_SPACE)
    shown.step = step
    before = array_of(shrunk(shown.frame()))
    press(shown, key)
    assert shown.layers == Layers()._replace(**{layer: False})
    changed = (array_of(shrunk(shown.frame())) != before).any(axis=2)
    assert 50 < changed[:SCENE, :SCENE].sum() < 0.3 * SCENE * SCENE
    assert not changed[:, SCENE:].any()
    assert not changed[SCENE:].any()
    press(shown, key)
    assert np.array_equal(array_of(shrunk(shown.frame())), before)


@cache
def good() -> Match:
    """Of a policy that has learnt."""
    return Match(find_side(str(RUNS / "ours" / "ratio1.1_n3_m1_random" / "seed0"), RUNS.parent))


@cache
def lens_moment() -> tuple[int, int]:
    """A moment in which everything that can be drawn is."""
    for number in range(40):
        replay = good().replays(number)[0]
        for step in range(3, replay.length + 1):
            if replay.enclosure["all"].movement_range[step] < np.pi * 0.2**2:
                return number, step
    raise AssertionError("no such moment")


def test_help_covers_the_middle_and_names_every_key(unseen: None) -> None:
    shown = Player(match())
    before = array_of(shrunk(shown.frame()))
    press(shown, pygame.K_h)
    changed = (array_of(shrunk(shown.frame())) != before).any(axis=2)
    assert changed[:, 300:650].any()
    assert not changed[:100].any()
    labels = [key.label for key in player.KEYS]
    assert {"space", "+", "-", "n", "p", "a", "c", "r", "t", "h", "q"} <= set(labels)
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("key", [pygame.K_q, pygame.K_ESCAPE])
def test_a_window_plays_until_it_is_closed(unseen: None, monkeypatch: pytest.MonkeyPatch, key: int) -> None:
    left, right = timeline(SCENE + PANEL)
    frames, opened = [], player.open_window

    def window(*arguments: Any, **options: Any) -> Any:
        screen = opened(*arguments, **options)
        width, height = screen.get_size()  # smaller than the frame where the screen is small
        share = min(width / (SCENE + PANEL), height / (SCENE + BAR))
        middle = (width / 2 + share * ((left + right) / 2 - (SCENE + PANEL) / 2), height / 2 + share * (SCENE / 2))
        pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, button=1, pos=middle))
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
        return screen

    def show_frame(screen: Any, frame: Any) -> None:
        frames.append(frame)
        shown_frame(screen, frame)
        assert array_of(screen).std() > 5

    shown_frame = player._show_frame
    monkeypatch.setattr(player, "open_window", window)
    monkeypatch.setattr(player, "_show_frame", show_frame)
    shown = Player(match())
    player.show(shown)
    assert shown.over
    assert not pygame.display.get_init()
    assert frames
    assert shown.step == pytest.approx(shown.length / 2, abs=1)  # where the line of steps was touched
    assert not shown.playing


@pytest.mark.parametrize(
    ("desktop", "size"),
    [((3840, 2160), (1939, 1512)), ((1920, 1080), (980, 764)), ((1024, 768), (847, 660)), ((400, 800), (368, 287))],
)
def test_a_window_is_as_large_as_it_is_well_seen(
    unseen: None, monkeypatch: pytest.MonkeyPatch, desktop: tuple[int, int], size: tuple[int, int]
) -> None:
    monkeypatch.setattr(pygame.display, "get_desktop_sizes", lambda: [desktop])
    assert player.open_window("", (980, 764), "", resizable=True).get_size() == size


def test_a_window_that_is_higher_than_wide_has_the_panel_below(unseen: None, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, frames = Player(match()), []
    shown.playing = False

    def show_frame(screen: Any, frame: Any) -> None:
        frames.append(frame.get_size())
        pygame.display.set_mode((400, 800) if len(frames) == 1 else (800, 400))
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_h if len(frames) < 3 else pygame.K_q))

    monkeypatch.setattr(player, "_show_frame", show_frame)
    player.show(shown)
    wide, tall = (SCENE + PANEL, SCENE + BAR), (TALL_SCENE, TALL_TITLE + TALL_SCENE + TALL_PANEL + BAR)
    assert [(width // SUPERSAMPLING, height // SUPERSAMPLING) for width, height in frames] == [wide, tall, wide]


# --- The command ------------------------------------------------------------------------------------------------------


def test_the_command_writes_what_it_says(
    results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    gif, folder = results / "round.gif", results / "frames"
    arguments = ("watch", "ours", "--results", results, "--round", 2, "--hide", "trails", "--hide", "lens")
    done = command(capsys, monkeypatch, *arguments, "--save", gif, "--headless", folder)
    assert (done.code, done.out.split()) == (0, [str(gif), str(folder)])
    assert "rounds of seed 7000: fresh ones" in done.err
    shown = Match(find_side("ours", results))
    assert len(list(folder.iterdir())) == shown.length(2) + 1
    drawn = array_of(film.drawing(shown, 2, 4, Layers(trails=False, lens=False)))
    assert np.array_equal(np.asarray(Image.open(folder / "step004.png")), drawn)


def test_without_a_display_one_line_says_what_to_do(
    results: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pygame.display.quit()
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")  # also where a developer has a display
    done = command(capfd, monkeypatch, "watch", "ours", "--results", results)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert "--save FILE.gif" in done.err
    assert "--headless DIR" in done.err


def test_a_film_of_another_kind_is_refused_before_anything_is_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = command(capsys, monkeypatch, "watch", "--results", tmp_path, "--save", tmp_path / "a.avi")
    assert (done.code, done.err) == (2, f"error: --save {tmp_path / 'a.avi'}: must end in .gif or .mp4\n")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    done = command(capsys, monkeypatch, "watch", "--results", tmp_path, "--save", tmp_path / "a.mp4")
    assert done.code == 2
    assert done.err == "error: an MP4 needs imageio and its ffmpeg: pip install 'marl-encircle[video]'\n"
    assert list(tmp_path.iterdir()) == []


def test_without_what_draws_the_extra_is_named() -> None:
    program = (
        "import sys; sys.modules['pygame'] = None; sys.argv = ['marl-encircle', 'watch']; "
        "from marl_encircle.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "error: drawing needs pygame-ce: pip install 'marl-encircle[render]'\n"
