"""The report shows what the records and replays say, in the same bytes, and nothing in it reaches out or breaks out."""

import base64
import hashlib
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from made_up import finished as made_up_run
from packed_rounds import unpacked, whole_numbers
from tiny_runs import TINY, command, everything_in, finished, tiny

from marl_encircle.core.geometry import NOBODY
from marl_encircle.experiments import grid as grids
from marl_encircle.experiments.build import build_policy
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.learning_curve import curve_from_csv
from marl_encircle.experiments.loading import load_policy
from marl_encircle.experiments.records import Cell, Run, Setting, read_runs
from marl_encircle.experiments.train import train
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.replays.replay import Replay, record_round
from marl_encircle.study.figures.curves import Band, band_of
from marl_encircle.study.paper import label
from marl_encircle.study.report import replays
from marl_encircle.study.report.charts import charts, ticks
from marl_encircle.study.report.page import Page, html_table, render_page
from marl_encircle.study.report.replays import ROUNDS, Played, ShownCell, pack, player_data, shown_cells
from marl_encircle.study.report.write import report, write_report
from marl_encircle.study.tables import main_tables
from marl_encircle.study.typeset import Styled, Table

HERE = Setting(1.1, 3, 1)
PAPER = "https://proceedings.mlr.press/v222/"


def made_up_band(*seeds: list[float]) -> Band:
    text = ["world_steps,success\n" + "".join(f"{100 * i},{s}\n" for i, s in enumerate(seed)) for seed in seeds]
    return band_of([curve_from_csv(each) for each in text], 200)


def played(number: int = 0, **scenario: Any) -> Replay:
    """A round of a tiny policy, some of which are solved; an untrained one where the trained one does not fit."""
    overrides = ["scenario.movement_range_limit=4", "scenario.max_cycles=40", "evaluation.n_directions=90"]
    config = tiny(overrides=overrides, **scenario)
    th.manual_seed(0)
    policy = load_policy(finished()) if config.scenario.units == 1 else build_policy(config)
    return record_round(policy, config, number, 5)


def player_of(*found: Replay, method: str = "ours") -> dict[str, Any]:
    rounds = [Played(replay, replay.success_step) for replay in found]
    setting = Setting(1.1, 3, found[0].scenario.obstacles, found[0].scenario.scene)
    return player_data([ShownCell(Cell(method, setting), "run", 0, rounds=rounds)])


def page_of(method: str) -> str:
    """A page whose only method has this name; one setting is run, one is not."""
    run, missing = Cell(method, HERE), Cell(method, Setting(1.1, 3, 2))
    shown = [ShownCell(run, "run", 0, rounds=[Played(played(), 3)]), ShownCell(missing, "not run")]
    tables = main_tables([made_up_run(method, HERE, seed, 90) for seed in (0, 1)], {}, [run, missing])
    drawn = charts({run: made_up_band([0.0, 0.5], [0.1, 0.9])}, [run, missing], {})
    return render_page(Page([("runs", "1 of 2")], tables, drawn, player_data(shown)))


class Parsed(HTMLParser):
    """What a browser would find in a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.content: dict[str, list[str]] = {"script": [], "style": []}
        self.words = ""
        self.open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open = tag

    def handle_endtag(self, tag: str) -> None:
        self.open = ""

    def handle_data(self, data: str) -> None:
        if self.open in self.content:
            self.content[self.open].append(data)
        else:
            self.words += data


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with one tiny run of the two that the smoke grid asks for."""
    results = tmp_path_factory.mktemp("results")
    train(tiny(), 900, "native", results / "runs")
    return results


@pytest.fixture
def _tiny_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    def tiny(*arguments: Any, **named: Any) -> Config:
        return load_config(*arguments, **{**named, "overrides": TINY})

    monkeypatch.setattr(grids, "load_config", tiny)


def data_in(page: str) -> dict[str, Any]:
    [text] = re.findall(r'<script type="application/json" id="rounds">(.*?)</script>', page, flags=re.DOTALL)
    data: dict[str, Any] = json.loads(text)
    return data


@pytest.mark.usefixtures("_tiny_grid")
def test_the_same_runs_give_the_same_bytes_in_one_whole_file(runs: Path) -> None:
    assert write_report(load_grid("smoke"), runs) == runs / "report.html"
    before = (runs / "report.html").read_bytes()
    write_report(load_grid("smoke"), runs)
    assert (runs / "report.html").read_bytes() == before
    assert [name for name in everything_in(runs) if not name.startswith("runs")] == ["report.html"]


def test_the_order_in_which_runs_are_found_does_not_matter(runs: Path) -> None:
    [run] = read_runs(runs / "runs")
    asked = [Cell(method, HERE) for method in ("ours", "ma2019", "zeta", "alpha")]
    others = [made_up_run("model_b", HERE, seed, 50) for seed in (3, 1, 2)]
    unfinished = [Run(each.cell, each.seed, "unfinished") for each in others]
    one = shown_cells([run, *unfinished], runs / "runs", {}, asked)
    two = shown_cells([*unfinished[::-1], run], runs / "runs", {}, set(asked))
    assert json.dumps(player_data(one)) == json.dumps(player_data(two))
    assert [each.cell.method for each in one] == ["ma2019", "model_b", "ours", "alpha", "zeta"]


@pytest.mark.usefixtures("_tiny_grid")
def test_nothing_but_the_paper_is_referred_to_and_nothing_can_be_fetched(runs: Path) -> None:
    page = report(load_grid("smoke"), runs / "runs")
    assert re.findall(r"[a-z]+://[^\s\"'<)]*", page) == [PAPER]
    found = Parsed(page)
    sources = {"src", "srcset", "data", "action", "poster", "style"} & {key for _, given in found.tags for key in given}
    assert not sources
    assert not {tag for tag, _ in found.tags} & {"link", "img", "iframe", "object", "embed", "base", "audio", "video"}
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|WebSocket|sendBeacon|import\(", page)
    [policy] = [given["content"] for tag, given in found.tags if given.get("http-equiv") == "Content-Security-Policy"]
    [style], [_, script] = found.content["style"], found.content["script"]
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)]
    assert policy is not None
    assert policy.split("; ") == [
        "default-src 'none'",
        f"style-src 'sha256-{hashes[0]}'",
        f"script-src 'sha256-{hashes[1]}'",
        "base-uri 'none'",
        "form-action 'none'",
    ]


@pytest.mark.usefixtures("_tiny_grid")
def test_the_number_of_the_only_training_seed_is_not_taken_for_how_many_there_are(runs: Path) -> None:
    assert "<dt>training seeds</dt><dd>one, number 900</dd>" in report(load_grid("smoke"), runs / "runs")


@pytest.mark.usefixtures("_tiny_grid")
def test_the_rounds_are_the_first_of_the_first_seed_and_end_as_recorded(runs: Path, tmp_path: Path) -> None:
    data = data_in(report(load_grid("smoke"), runs / "runs"))
    [run] = read_runs(runs / "runs")
    [cell] = [cell for cell in data["cells"] if cell["rounds"]]
    assert (data["methods"][cell["method"]], cell["seed"], cell["closure"]) == ("Ours", 900, "all")
    assert [each["number"] for each in cell["rounds"]] == list(range(ROUNDS))
    for shown, episode in zip(cell["rounds"], run.episodes, strict=False):
        assert shown["success"] == shown["recorded"] == episode.step_all
        assert shown["moments"] == (episode.step_all or 20) + 1


@pytest.mark.parametrize(
    ("scenario", "seen"),
    [
        ({}, {0, 2}),
        ({"obstacles": 0}, {0}),
        ({"scene": "tunnel"}, {0, 2}),
        ({"scene": "tunnel", "composite_unit": False}, {0}),
    ],
    ids=["one obstacle", "none", "one of several discs", "several discs"],
)
def test_what_is_embedded_is_the_replay_within_its_steps(scenario: dict[str, Any], seen: set[int]) -> None:
    states = set()
    for number in range(16):
        replay = played(number, **scenario)
        data = json.loads(json.dumps(player_of(replay)))
        [cell] = data["cells"]
        [shown] = cell["rounds"]
        found, t = unpacked(shown, cell["world"], data["units"]), shown["moments"]
        enclosure = replay.enclosure["all"]
        for key, unit in (("pursuers", 1e-4), ("target", 1e-4), ("velocities", 1e-2)):
            np.testing.assert_allclose(found[key], getattr(replay, key)[:t], rtol=0, atol=0.5001 * unit)
        np.testing.assert_allclose(found["discs"], replay.discs, rtol=0, atol=0.5001e-4)
        np.testing.assert_array_equal(found["owner"], enclosure.owner[:t])
        np.testing.assert_allclose(found["angles"], enclosure.contributing_angle[:t], rtol=0, atol=0.5001e-4)
        met = enclosure.owner[:t] != NOBODY
        reach = np.minimum(enclosure.distance[:t], 4 * replay.scenario.half_width)
        np.testing.assert_allclose(found["reach"][met], reach[met], rtol=0, atol=0.5001e-3)
        closed = np.isfinite(enclosure.movement_range[:t])
        np.testing.assert_allclose(found["area"][closed], enclosure.movement_range[:t][closed], rtol=0, atol=0.5001e-5)
        np.testing.assert_array_equal(found["state"], closed.astype(int) + enclosure.complete[:t])
        states |= set(found["state"].tolist())
    assert seen <= states, "else little was compared"


def test_every_cell_has_the_world_of_its_own_policy() -> None:
    tunnel = Setting(1.1, 3, 1, "tunnel")
    rounds = {"ours": played(scene="tunnel"), "model_b": played(scene="tunnel", composite_unit=False)}
    cells = [
        ShownCell(Cell(method, tunnel), "run", 0, rounds=[Played(replay, replay.success_step)])
        for method, replay in rounds.items()
    ]
    assert [cell["world"]["entities"] for cell in player_data(cells)["cells"]] == [3 + 1, 3 + 10]


def test_a_round_ends_with_its_own_success_or_with_its_time() -> None:
    replay = next(each for each in map(played, range(20)) if each.success_step and each.success_step < each.length)
    success = replay.success_step or 0
    assert replays.moments_shown(replay) == success + 1
    assert replays.moments_shown(replace(replay, step_all=None)) == replay.length + 1


def test_numbers_of_any_size_survive_packing() -> None:
    numbers = [0, -1, 1, 63, -64, 64, -65, 127, 128, 8191, -8192, 8192, 2**31, -(2**31), 2**40]
    assert whole_numbers(base64.b64encode(replays._digits(numbers)).decode()) == numbers


def test_53_cells_fit_into_15_megabytes_even_if_nothing_is_ever_solved() -> None:
    """60 steps of 360 directions, all of them owned: more than any round needs."""
    config = load_config("ours", profile="smoke")
    overrides = ["scenario.max_cycles=60", "evaluation.n_directions=360", "scenario.movement_range_limit=0.000001"]
    replay = record_round(load_policy(finished()), tiny(overrides=overrides), 0, 5)
    assert (replay.length, config.scenario.max_cycles) == (60, 60)
    assert 53 * ROUNDS * len(pack(replay)) < 12e6, "the rest is tables and curves"


def test_a_cell_that_shares_runs_points_to_its_owner() -> None:
    owner, sharing = Cell("ours", HERE), Cell("model_a", HERE)
    data = player_data(
        [ShownCell(sharing, "run", runs_of="ours"), ShownCell(owner, "run", 7, rounds=[Played(played(), 4)])]
    )
    shared, own = data["cells"]
    assert (data["methods"][shared["runsOf"]], shared["rounds"]) == ("Ours", [])
    assert (own["runsOf"], len(own["rounds"]), own["rounds"][0]["recorded"]) == (None, 1, 4)


def test_what_is_shown_first_is_ours_where_one_obstacle_has_to_help_few_pursuers() -> None:
    rounds = [Played(played(), 3)]
    settings = [Setting(1.1, 5, 1), Setting(1.1, 2, 1), Setting(1.1, 2, 0), Setting(1.1, 3, 1)]
    shown = [
        ShownCell(Cell(method, each), "run", 0, rounds=rounds) for method in ("ma2019", "ours") for each in settings
    ]
    data = player_data([*shown, ShownCell(Cell("ours", Setting(1.1, 1, 1)), "not run")])
    first = data["start"]
    assert data["methods"][first["method"]] == "Ours"
    assert data["settings"][first["setting"]] == "2 pursuers, 1 obstacle, λ = 1.1"


@pytest.mark.usefixtures("_tiny_grid")
def test_missing_runs_are_shown_as_not_run(runs: Path, tmp_path: Path) -> None:
    page = report(load_grid("smoke"), runs / "runs")
    data = data_in(page)
    cells = {data["methods"][cell["method"]]: cell for cell in data["cells"]}
    assert (cells["Ma"]["status"], cells["Ma"]["rounds"], cells["Ours"]["status"]) == ("not run", [], "run")
    words = Parsed(page).words
    assert "1 of 2 finished" in words
    assert "Ma: not run" in words
    assert '<td colspan="2" class="none">not run</td>' in page

    nothing = report(load_grid("smoke"), tmp_path / "runs")
    assert "0 of 2 finished" in Parsed(nothing).words
    assert "Not run: 3 pursuers, 1 obstacle, λ = 1.1." in Parsed(nothing).words
    assert {cell["status"] for cell in data_in(nothing)["cells"]} == {"not run"}
    assert data_in(nothing)["cells"][0]["world"] is None


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "a&amp;b", "{{data}}"])
def test_a_methods_name_is_text_whatever_is_in_it(name: str) -> None:
    page, plain = Parsed(page_of(name)), Parsed(page_of("plain"))
    assert [tag for tag, _ in page.tags] == [tag for tag, _ in plain.tags]
    assert page.words.replace(name, "plain") == plain.words
    assert page.words.count(name) >= 3, "in a table, in a legend and below a chart"
    assert data_in(page_of(name))["methods"] == [name]


def test_a_cell_of_tables_2_to_4_becomes_two_columns() -> None:
    rows = [
        ["Ours", "99.3 [97.0, 100.0] / 16.5", (Styled("98.0", "bold"), " [-1.0, 99.0] / no success"), "not run"],
        [Styled("paper", "italic"), Styled("91.80 / 25.91", "italic"), "", Styled("–", "italic")],  # noqa: RUF001
    ]
    page = html_table(Table("table3", "Title", ["Method", "n = 2", "n = 3", "n = 4"], rows, []))
    assert '<td>99.3 <span class="ci">[97.0, 100.0]</span></td><td class="mel">16.5</td>' in page
    assert '<td><strong>98.0</strong> <span class="ci">[−1.0, 99.0]</span></td>' in page  # noqa: RUF001
    assert '<td class="mel">no success</td>' in page
    assert '<tr class="paper"><th scope="row">paper</th><td>91.80</td><td class="mel">25.91</td>' in page
    columns = [
        sum(int(span or 1) for span in re.findall(r'<t[dh](?: scope="row")?(?: colspan="(\d)")?', row))
        for row in re.findall(r"<tr.*?</tr>", page)[2:]
    ]
    assert columns == [7, 7]


def test_every_number_of_the_tables_is_in_the_report() -> None:
    made_up = [made_up_run(method, HERE, seed, 60 + 10 * seed) for method in ("ours", "model_b") for seed in range(3)]
    tables = main_tables(made_up, {}, [])
    page = "".join(map(html_table, tables)).replace("\N{MINUS SIGN}", "-")
    for table in tables:
        for row in table.rows:
            for part in (part for cell in row for part in (cell if isinstance(cell, tuple) else (cell,))):
                text = part if isinstance(part, str) else part.text
                assert all(number in page for number in re.findall(r"[-+]?\d+\.\d+", text))
    assert label("model_b") in page


@pytest.mark.parametrize(
    ("last", "places"),
    [(1.0, [0, 0.2, 0.4, 0.6, 0.8, 1]), (2.0, [0, 0.5, 1, 1.5, 2]), (0.0004, [0, 0.0001, 0.0002, 0.0003, 0.0004])],
)
def test_ticks_are_round_and_few(last: float, places: list[float]) -> None:
    assert ticks(last) == pytest.approx(places)


def test_curves_are_drawn_where_the_numbers_are() -> None:
    cell = Cell("ours", HERE)
    drawn = charts({cell: made_up_band([0.0, 0.5, 1.0])}, [cell], {})
    [path] = re.findall(r'<path class="mean series-0" d="([^"]*)"/></g>', drawn)
    # The frame is 316 wide from 36 on, and 176 high from 186 upwards.
    assert path == "M36.0 186.0L194.0 98.0L352.0 10.0"


@pytest.mark.usefixtures("_tiny_grid")
def test_the_command_says_what_takes_its_time_and_prints_the_file(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = command(capsys, monkeypatch, "report", "--grid", "smoke", "--out", runs)
    assert (done.code, done.out) == (0, f"{runs / 'report.html'}\n")
    assert done.err == "playing the first rounds of every cell again, about a second each\n"


def test_a_report_of_no_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"{tmp_path}/runs: no runs"):
        write_report(None, tmp_path)
    assert not list(tmp_path.iterdir())


def test_without_a_grid_and_runs_of_the_usual_one_all_runs_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tiny(), 7, "native", tmp_path / "runs")
    train(tiny(obstacles=2), 8, "native", tmp_path / "runs")
    done = command(capsys, monkeypatch, "report", "--results", tmp_path)
    assert (done.code, done.out) == (0, f"{tmp_path / 'report.html'}\n")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "2 of 2 finished" in Parsed(page).words
    assert [(cell["seed"], len(cell["rounds"])) for cell in data_in(page)["cells"]] == [(7, ROUNDS), (8, ROUNDS)]

    other = train(tiny(overrides=["algorithm.gamma=0.8"]), 9, "native", tmp_path / "runs")[0]
    done = command(capsys, monkeypatch, "report", "--results", tmp_path)
    assert (done.code, done.out) == (2, "")
    assert done.err.splitlines()[-1] == (
        f"error: {other} and {other.with_name('seed7')} are of one cell and were not trained alike "
        "(algorithm.gamma: 0.8 here, 0.9 there): write a grid of those that are meant and give it by --grid"
    )


def test_runs_that_are_not_as_the_usual_grid_asks_are_all_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tiny(), 0, "native", tmp_path / "runs")
    done = command(capsys, monkeypatch, "report", "--results", tmp_path)
    assert done.code == 0
    assert "the runs are not those of the grid study: all are shown\n" in done.err
    assert "1 of 1 finished" in Parsed((tmp_path / "report.html").read_text(encoding="utf-8")).words
    done = command(capsys, monkeypatch, "report", "--results", tmp_path, "--grid", "study")
    assert (done.code, "already holds a different run" in done.err) == (2, True)


@pytest.mark.usefixtures("_tiny_grid")
def test_runs_that_the_usual_grid_leaves_out_are_told(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = load_grid("smoke")
    monkeypatch.setattr(grids, "load_grid", lambda _: usual)
    shutil.copytree(runs / "runs", tmp_path / "runs")
    assert "left out" not in command(capsys, monkeypatch, "report", "--results", tmp_path).err
    train(tiny(), 7, "native", tmp_path / "runs")
    for arguments, told in (((), True), (("--grid", "study"), False)):
        done = command(capsys, monkeypatch, "report", "--results", tmp_path, *arguments)
        said = "left out: 1 run that the grid study does not ask for, such as ours/ratio1.1_n3_m1_random/seed7\n"
        assert (done.code, said in done.err) == (0, told)
    assert "1 of 2 finished" in Parsed((tmp_path / "report.html").read_text(encoding="utf-8")).words
