"""Figures show what the records say, in the same bytes wherever and whenever they are drawn."""

import hashlib
import io
import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from made_up import episode, rounds
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Arc
from PIL import Image
from tiny_runs import TINY, finished

from marl_encircle import files
from marl_encircle.drawing.palette import PURSUERS, SERIES
from marl_encircle.experiments import grid as grids
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.learning_curve import curve_from_csv
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.metrics import share_interval, summarise_cell
from marl_encircle.experiments.records import Cell, Run, Setting, read_runs
from marl_encircle.experiments.train import OtherRunError, run_folder, train, write_episodes
from marl_encircle.replays.replay import Replay, record_round
from marl_encircle.study.cells import absences, gather
from marl_encircle.study.figures import canvas, curves, situations, write
from marl_encircle.study.figures.canvas import encode, rgb
from marl_encircle.study.figures.contributions import draw_figure5
from marl_encircle.study.figures.curves import Band, band_of, draw_figure4
from marl_encircle.study.figures.rounds import PLACES, Choice, Column, choose_round, draw_figure6
from marl_encircle.study.figures.situations import SITUATIONS, draw_figure1, draw_figure3, moment_of
from marl_encircle.study.figures.write import encode_figures, write_figures

OPEN, OBSTACLE = curves.SETTINGS
NAMES = ("figure1", "figure3", "figure4", "figure4_all", "figure5", "figure6")


def band(*seeds: list[float], n_rounds: int = 200) -> Band:
    text = ["world_steps,success\n" + "".join(f"{100 * i},{s}\n" for i, s in enumerate(seed)) for seed in seeds]
    return band_of([curve_from_csv(each) for each in text], n_rounds)


def figure4() -> Figure:
    bands = {
        Cell("ours", OPEN): band([0.0, 0.5, 0.9], [0.1, 0.52, 1.0]),
        Cell("model_b", OPEN): band([0.0, 0.3, 0.4], [0.1, 0.2, 0.3]),
        Cell("ma2019", OBSTACLE): band([0.2, 0.3, 0.7]),
    }
    return draw_figure4(bands, absent={Cell("model_b", OBSTACLE): "runs of Ma"})


def figure5() -> Figure:
    settings = [Setting(1.1, n, 1) for n in (2, 3, 5)]
    runs = {0: rounds(10, 20), 1: [episode(n, 5, sigma_c=0.5) for n in range(20)]}
    return draw_figure5({Cell("ours", setting): summarise_cell(runs, "all") for setting in settings})


def solved_round(run: Path) -> Replay:
    """A round of a tiny run whose success, for the drawing's sake, is its fourth step."""
    policy, config, _ = load_run(run)
    replay = record_round(policy, config, 0, 5)
    return Replay(**{**vars(replay), "step_all": 4})


def figure6(run: Path) -> Figure:
    return draw_figure6([Column("here", solved_round(run), Choice(0, 3, 7, 9)), Column("there", None, note="not run")])


def fingerprints(run: Path) -> str:
    """Hashes of the files of one figure of each kind, as JSON."""
    figures = {"3": draw_figure3(), "4": figure4(), "6": figure6(run)}
    hashes = {f"{n}.{s}": hashlib.sha256(data).hexdigest() for n, f in figures.items() for s, data in encode(f).items()}
    return json.dumps(hashes)


def lines(figure: Figure, panel: int = 0, **properties: Any) -> list[Line2D]:
    """The lines of a panel with these properties."""
    found = figure.axes[panel].get_lines()
    return [line for line in found if all(getattr(line, f"get_{key}")() == value for key, value in properties.items())]


def words(figure: Figure) -> list[str]:
    """What can be read in the SVG; Matplotlib notes it beside the outlines of the letters."""
    return re.findall(r"<!-- (.*?) -->", encode(figure)["svg"].decode(), flags=re.DOTALL)


def test_bytes_are_the_same_in_another_process_at_another_time(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text(
        "font.size: 20\nlines.linewidth: 9\nsvg.fonttype: none\nfigure.facecolor: red\n"
    )
    program = "import sys, test_figures; from pathlib import Path; print(test_figures.fingerprints(Path(sys.argv[1])))"
    here = Path(__file__).parent
    there = os.pathsep.join([str(here), str(here.parent), os.environ.get("PYTHONPATH", "")])
    mine = json.loads(fingerprints(finished()))
    time.sleep(1.1)  # files that hold a date hold its second
    other = {"PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "MATPLOTLIBRC": str(tmp_path), "USER": "else"}
    done = subprocess.run(
        [sys.executable, "-c", program, str(finished())],
        cwd=here,
        env={**os.environ, "PYTHONPATH": there, "OMP_NUM_THREADS": "1", **other},
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout.splitlines()[-1]) == mine
    assert len(set(mine.values())) == 9


def test_files_name_neither_the_day_nor_the_program() -> None:
    encoded = encode(draw_figure3())
    assert set(encoded) == {"svg", "pdf", "png"}
    for suffix, start in (("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")):
        assert encoded[suffix].startswith(start)
    for name in (b"dc:date", b"dc:creator", b"CreationDate", b"/Creator", b"/Producer", b"Software", b"matplotlib.org"):
        assert not any(name in data for data in encoded.values()), name


def test_a_picture_with_a_palette_looks_as_drawn() -> None:
    """It is held against Matplotlib's own picture, which has all colours."""
    figure, whole = figure4(), io.BytesIO()
    with canvas.style():
        figure.savefig(whole, format="png", dpi=300)
    small = Image.open(io.BytesIO(encode(figure, ["png"])["png"]))
    assert small.mode == "P"
    difference = np.abs(np.asarray(small.convert("RGB"), float) - np.asarray(Image.open(whole).convert("RGB"), float))
    assert difference.mean() < 0.5
    assert (difference.max(axis=2) > 12).mean() < 0.005


def test_the_users_settings_are_neither_used_nor_changed() -> None:
    before = encode(draw_figure3())["svg"]
    with matplotlib.rc_context({"font.size": 30.0, "figure.facecolor": "red"}):
        assert encode(draw_figure3())["svg"] == before
        assert matplotlib.rcParams["font.size"] == 30.0


def test_figure_1_is_what_its_titles_say() -> None:
    field, in_the_way, shared, lazy, used = (moment_of(situation) for situation in SITUATIONS)
    assert [moment.closed for moment in (field, in_the_way, shared, lazy, used)] == [True, False, False, False, True]
    # The polygon: four equal shares. Near the obstacle one corner lies within it.
    assert np.allclose(np.degrees(field.contributing_angle), 90, atol=0.5)
    bearing, distance = SITUATIONS[1].missed or (0, 0)
    corner = distance * np.array([math.cos(math.radians(bearing)), math.sin(math.radians(bearing))])
    x, y, radius = in_the_way.discs[0]
    assert math.hypot(corner[0] - x, corner[1] - y) < radius
    # Directions that a pursuer and the obstacle both occupy are shared out between them.
    alone = 2 * math.asin(1 / situations.SPEED_RATIO)
    assert 0 < shared.contributing_angle[2] < alone - 0.1
    assert shared.contributing_angle[3] > 0
    assert lazy.contributing_angle[3] == 0
    # Three pursuers cannot close the circle at this ratio; the obstacle does its part.
    assert len(used.pursuers) < math.pi / math.asin(1 / situations.SPEED_RATIO)
    assert used.contributing_angle[3] > 0
    for moment in (in_the_way, shared, lazy, used):
        for x, y, radius in moment.discs:
            assert (np.hypot(*(moment.pursuers - [x, y]).T) > radius).all()


def test_figure_1_writes_the_measured_angles() -> None:
    written = words(draw_figure1())
    for situation in SITUATIONS:
        moment = moment_of(situation)
        shown = moment.contributing_angle if situation.closure == "all" else moment.contributing_angle[:-1]
        for angle in shown:
            assert f"{math.degrees(angle):.0f}°" in written
    assert "partial engagement" in " ".join(written)


def test_figure_3_draws_tangents_that_touch_the_circle() -> None:
    figure = draw_figure3()
    circle = next(patch for patch in figure.axes[0].patches if getattr(patch, "radius", 0) > 1)
    centre, radius = np.array(circle.get_center()), circle.get_radius()  # type: ignore[attr-defined]
    # Every point of the circle is lambda times as far from the target, at the origin, as from the pursuer.
    bearing, distance = math.radians(8), 1.0
    pursuer = distance * np.array([math.cos(bearing), math.sin(bearing)])
    for angle in (0.0, 1.0, 4.0):
        point = centre + radius * np.array([math.cos(angle), math.sin(angle)])
        assert np.hypot(*point) == pytest.approx(situations.SPEED_RATIO * np.hypot(*(point - pursuer)))
    dashed = [line for line in figure.axes[0].get_lines() if line.is_dashed()]
    assert len(dashed) == 2
    for line in dashed:
        (x, y), (cx, cy) = np.array(line.get_xydata())[1], centre
        assert abs(x * cy - y * cx) / math.hypot(x, y) == pytest.approx(radius)
    widths = [patch.theta2 - patch.theta1 for patch in figure.axes[0].patches if isinstance(patch, Arc)]
    # 2 arcsin(1 / 1.3) = 100.57 degrees occupied, of which the neighbours take some.
    assert max(widths) == pytest.approx(100.57, abs=0.01)
    assert 45 < min(widths) < 90
    assert r"$\alpha_1$" in words(figure)


def test_figure_4_draws_the_means_the_seeds_and_the_intervals() -> None:
    figure = figure4()
    (mean,) = lines(figure, label="Ours")
    assert np.allclose(mean.get_xydata(), [[0.0, 5.0], [1e-4, 51.0], [2e-4, 95.0]])
    thin = [list(np.round(line.get_ydata(), 9)) for line in lines(figure, linewidth=0.4)]
    assert sorted(thin) == [[0, 30, 40], [0, 50, 90], [10, 20, 30], [10, 52, 100]]
    interval = share_interval([0.5, 0.52], 200)
    assert interval is not None
    vertices = np.vstack([path.vertices for shade in figure.axes[0].collections for path in shade.get_paths()])
    for end in interval:
        assert np.isclose(vertices, [1e-4, 100 * end]).all(axis=1).any()
    assert not figure.axes[1].collections, "one seed has no interval"


def test_figure_4_says_what_is_not_there() -> None:
    written = words(figure4())
    assert {"Ours", "Model B", "Ma", "success S [%]", "training [million world steps]"} <= set(written)
    assert "Ma: not run" in written
    assert "Model B: runs of Ma" in written
    assert words(draw_figure4({})).count("not run") == 2


def test_figures_tell_what_diverged_from_what_is_not_run() -> None:
    diverged = Run(Cell("ours", OBSTACLE), 0, "diverged", "all")
    absent = absences(gather([diverged], {Cell("model_b", OBSTACLE): Cell("ours", OBSTACLE)}))
    assert absent == {Cell(method, OBSTACLE): "diverged" for method in ("ours", "model_b")}
    written = words(draw_figure4({}, absent=absent))
    assert {"Ours: diverged", "Model B: diverged", "Ma: not run"} <= set(written)
    assert written.count("not run") == 1, "without an obstacle"
    written = words(draw_figure5({}, absent))
    assert {"Ours, n = 3: diverged", "Ours, n = 2, 4, 5: not run"} <= set(written)
    column = write._column(PLACES[1], [diverged], absent, Path())
    assert column == Column("one obstacle", None, note="diverged")


def test_points_that_a_seed_lacks_are_left_out() -> None:
    texts = ("world_steps,success\n100,0.5\n200,0.6\n300,0.7\n", "world_steps,success\n200,0.8\n300,0.9\n400,1.0\n")
    joint = band_of([curve_from_csv(text) for text in texts], 200)
    assert joint.world_steps.tolist() == [200, 300]
    assert joint.mean.tolist() == pytest.approx([0.7, 0.8])


@pytest.mark.parametrize(("points", "reason"), [("200,0.8\n", "no step in common"), ("", "without points")])
def test_curves_of_seeds_without_a_common_step_are_refused(points: str, reason: str) -> None:
    texts = ("world_steps,success\n100,0.5\n", f"world_steps,success\n{points}")
    with pytest.raises(ValueError, match=reason):
        band_of([curve_from_csv(text) for text in texts], 200)


def test_figure_5_draws_the_summaries() -> None:
    figure = figure5()
    # 20 rounds of 0.25 rad and 20 of 0.5 rad; 50 % and 100 % solved.
    for panel, value in ((0, 0.375), (1, 75.0)):
        (line,) = lines(figure, panel, label="Ours")
        assert np.allclose(line.get_ydata(), value)
        assert np.round(line.get_xdata()).tolist() == [2, 3, 5]
        assert len(lines(figure, panel, marker="_")) == 3
    written = words(figure)
    assert "Model C, n = 2, 3, 4, 5: not run" in written[-1] or any("Model C" in text for text in written)
    assert any("Ours, n = 4: not run" in text for text in written)


def test_figure_5_does_not_join_what_is_lost() -> None:
    """The angles of rounds that are lost are those of another situation."""
    shares = {2: 20, 3: 9, 4: 20}
    runs = {n: {seed: rounds(won, 20) for seed in (0, 1)} for n, won in shares.items()}
    cells = {n: Cell("model_c", Setting(1.1, n, 1)) for n in shares}
    figure = draw_figure5({cell: summarise_cell(runs[n], "all") for n, cell in cells.items()})
    for panel in (0, 1):
        (line,) = lines(figure, panel, label="Model C")
        assert np.isnan(line.get_ydata()).tolist() == [False, True, False]
        (hollow,) = lines(figure, panel, markerfacecolor="white")
        assert round(float(np.squeeze(hollow.get_xdata()))) == 3
    assert np.squeeze(hollow.get_ydata()) == 45.0


def test_figure_6_draws_the_round_until_its_success() -> None:
    replay, figure = solved_round(finished()), figure6(finished())
    paths = [np.array(line.get_xydata()) for line in lines(figure, linestyle="-", linewidth=0.8)]
    bodies = [*np.moveaxis(replay.pursuers, 1, 0), replay.target]
    assert len(paths) == len(bodies) == 4
    for path, body in zip(paths, bodies, strict=True):
        assert np.array_equal(path, body[:5])
    colours = [line.get_color() for line in lines(figure, linestyle="-", linewidth=0.8)]
    assert colours[:3] == [rgb(colour) for colour in PURSUERS[:3]]
    written = words(figure)
    moment = replay.snapshot(4)
    for angle in moment.contributing_angle:
        assert f"{math.degrees(angle):.0f}°" in written
    assert written.count("not run") == 2
    assert any("3 of 7 solved rounds" in text for text in written)


def test_the_round_drawn_is_the_median_of_those_that_an_obstacle_helped_to_solve() -> None:
    unsolved, alone = episode(0, None, 7), [episode(n, n, n) for n in (1, 2)]
    helped = [episode(3, 40, None), episode(4, 10, 11), episode(5, 20, None), episode(6, 20, 30)]
    # Of 10, 20, 20, 40 the second: round 5 comes before round 6.
    assert choose_round([unsolved, *alone, *helped], "all") == Choice(5, 4, 6, 7)
    assert choose_round([unsolved, *alone], "all") == Choice(1, 0, 2, 3)
    assert choose_round([unsolved, *helped], "pursuers") == Choice(4, 0, 3, 5)
    assert choose_round([unsolved], "all") is None


def test_methods_and_pursuers_are_told_apart() -> None:
    methods = (*curves.BY_IMPORTANCE, "ours_plus", "generalist", "idea")
    looks = [curves.series_of(method, methods) for method in methods]
    assert len({look.dashes for look in looks}) == len({look.marker for look in looks}) == len(SERIES)
    many = [*methods, *(f"idea_{i}" for i in range(9))]
    papers = [curves.series_of(method, many) for method in curves.BY_IMPORTANCE]
    assert papers == looks[:5]
    assert not {curves.series_of(method, many) for method in many[5:]} & set(papers)


@pytest.fixture
def tiny_grid(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> grids.Grid:
    """Two cells of one seed each, which train in a second."""

    def tiny(*arguments: Any, **named: Any) -> Config:
        more = ["scenario.movement_range_limit=2", "scenario.max_cycles=40", "evaluation.episodes=60"]
        return load_config(*arguments, **{**named, "overrides": [*TINY, *more]})

    monkeypatch.setattr(grids, "load_config", tiny)
    return load_grid("smoke")


def test_a_policy_of_one_obstacle_is_not_shown_in_a_scene_of_several(tmp_path: Path) -> None:
    config = load_config(profile="smoke", overrides=[*TINY, "scenario.composite_unit=false"])
    train(config, 0, "native", tmp_path)
    concave = next(place for place in PLACES if place.setting.scene == "concave")
    column = write._column(concave, read_runs(tmp_path), {}, tmp_path)
    assert column == Column("concave", None, note="several obstacles")


def test_all_figures_are_written_and_the_same_runs_give_the_same_bytes(
    tiny_grid: grids.Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = {path.name: path.read_bytes() for path in write_figures(tiny_grid, tmp_path)}
    assert sorted(empty) == sorted(f"{name}.{suffix}" for name in NAMES for suffix in ("svg", "pdf", "png"))
    assert empty["figure6.svg"].count(b"<!-- not run -->") == 10
    monkeypatch.setattr(canvas, "_METADATA", {"svg": {"Date": None, "Creator": None}})  # the others take long
    job = tiny_grid.jobs[0]
    folder, _ = train(job.config, job.seed, "native", tmp_path / "runs")
    full = {path.name: path.read_bytes() for path in write_figures(tiny_grid, tmp_path)}
    assert {name for name in full if full[name] != empty[name]} == {
        "figure4.svg",
        "figure4_all.svg",
        "figure5.svg",
        "figure6.svg",
    }
    assert full["figure6.svg"].count(b"<!-- not run -->") == 4  # neither without obstacles nor with two pursuers
    assert b"(trained with discs)" in full["figure6.svg"]
    # A run that the grid does not ask for is not shown, and nothing else changes.
    train(job.config, job.seed + 1, "native", tmp_path / "runs")
    assert {path.name: path.read_bytes() for path in write_figures(tiny_grid, tmp_path)} == full

    (folder / "progress.csv").write_text("world_steps,success\n1,1.0\n")
    with pytest.raises(files.DamagedFileError, match=r"progress\.csv: changed since it was written"):
        write_figures(tiny_grid, tmp_path)


def test_rounds_that_a_run_has_elsewhere_are_not_played_again(
    tiny_grid: grids.Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(canvas, "_METADATA", {"svg": {"Date": None, "Creator": None}})
    job = tiny_grid.jobs[0]
    folder, _ = train(job.config, job.seed, "native", tmp_path / "runs")
    before = encode_figures(tiny_grid, tmp_path)
    policy, config, _ = load_run(folder)
    scenes = tuple(job.setting._replace(scene=scene) for scene in ("concave", "tunnel"))
    for scene in scenes:
        rounds = play_rounds(policy, config, config.evaluation.episodes, config.evaluation.seed, scene)
        write_episodes(folder, rounds, scene)
    monkeypatch.delattr(write, "play_rounds")
    assert encode_figures(tiny_grid._replace(elsewhere={config.cell: scenes}), tmp_path) == before


def test_a_run_of_another_configuration_is_not_drawn(tiny_grid: grids.Grid, tmp_path: Path) -> None:
    job = tiny_grid.jobs[0]
    config = Config.from_dict(
        {**job.config.to_dict(), "algorithm": {**job.config.to_dict()["algorithm"], "gamma": 0.5}}
    )
    train(config, job.seed, "native", tmp_path / "runs")
    with pytest.raises(OtherRunError, match="gamma"):
        write_figures(tiny_grid, tmp_path)
    assert not (tmp_path / "figures").exists()
    assert run_folder(config, job.seed, tmp_path / "runs").exists()


def test_matplotlib_is_loaded_for_figures_alone() -> None:
    program = (
        "import sys; import marl_encircle.cli, marl_encircle.replays.replay, marl_encircle.study.reproduce; "
        "print('matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_palette_needs_neither_pygame_nor_matplotlib() -> None:
    program = (
        "import sys; import marl_encircle.drawing.palette, marl_encircle.drawing.outlines; "
        "print([name for name in ('pygame', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
