"""The whole road for a grid: what is missing is trained and evaluated, once, and the tables follow."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
import torch as th
from made_up import markdown_row
from safetensors.torch import load_file, save_file
from tiny_runs import IN_SEVERAL_SETTINGS, TINY, everything_in, train_in_this_process

from marl_encircle import files
from marl_encircle.experiments import grid as grids
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.grid import load_grid
from marl_encircle.experiments.records import Setting, config_hash, read_runs
from marl_encircle.experiments.train import run_folder, train
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study import reproduce as reproduction
from marl_encircle.study.reproduce import TABLE1_METHODS, Reproduction, options_of, reproduce, write_tables
from marl_encircle.study.tables import MethodOptions, render_table1
from marl_encircle.study.verify import verify

TABLES = sorted(
    [f"table{number}.{kind}" for number in (1, 2, 3, 4) for kind in ("csv", "md", "tex")]
    + [f"table_{name}.{kind}" for name in ("common_rule", "differences") for kind in ("csv", "md")]
)


ELSEWHERE = """\
profile: smoke
groups:
  - methods: [ours]
    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]
    seeds: [0]
shared: []
elsewhere: [{scene: tunnel, obstacles: 1}]
"""


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every run of a grid tiny, and train it in this process."""

    def tiny(*arguments: Any, **named: Any) -> Config:
        return load_config(*arguments, **{**named, "overrides": TINY})

    monkeypatch.setattr(grids, "load_config", tiny)
    train_in_this_process(monkeypatch)


def counts(result: Reproduction) -> tuple[int, int, int]:
    return result.trained, result.evaluated, result.reused


def tables(results: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((results / "tables").iterdir())}


def folders(results: Path) -> list[Path]:
    return [run_folder(job.config, job.seed, results / "runs") for job in load_grid("smoke").jobs]


def test_nothing_is_done_twice_and_what_is_lost_is_made_again(tmp_path: Path) -> None:
    assert counts(reproduce(load_grid("smoke"), tmp_path, 2)) == (2, 0, 0)
    before = tables(tmp_path)
    assert sorted(before) == TABLES
    assert counts(reproduce(load_grid("smoke"), tmp_path, 1)) == (0, 0, 2)
    assert tables(tmp_path) == before

    first, second = folders(tmp_path)
    rounds = (first / "episodes.csv").read_bytes()
    record = json.loads((first / "run.json").read_text())
    (first / "episodes.csv").unlink()
    del record["sha256"]["episodes.csv"]
    files.write_json(first / "run.json", record)
    (second / "episodes.csv").unlink()  # its hash stays
    assert counts(reproduce(load_grid("smoke"), tmp_path, 1)) == (0, 2, 0)
    assert (first / "episodes.csv").read_bytes() == rounds
    assert tables(tmp_path) == before

    (first / "run.json").unlink()  # the run is unfinished, and without a checkpoint starts anew
    for path in (tmp_path / "tables").iterdir():
        path.unlink()
    assert counts(reproduce(load_grid("smoke"), tmp_path, 1)) == (1, 0, 1)
    assert (first / "episodes.csv").read_bytes() == rounds
    assert tables(tmp_path) == before


def test_one_policy_fills_the_cells_of_several_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def tiny(*arguments: Any, **named: Any) -> Config:
        return load_config(*arguments, **{**named, "overrides": (*TINY, *IN_SEVERAL_SETTINGS)})

    monkeypatch.setattr(grids, "load_config", tiny)
    grid = tmp_path / "grid.yaml"
    others = "elsewhere: [{speed_ratio: 1.1, pursuers: 2, obstacles: 1}, {speed_ratio: 1.1, pursuers: 5, obstacles: 1}]"
    grid.write_text(ELSEWHERE.partition("elsewhere")[0].replace("seeds: [0]", f"seeds: [0]\n    {others}"))
    assert counts(reproduce(load_grid(str(grid)), tmp_path, 1)) == (1, 0, 0)
    [run] = read_runs(tmp_path / "runs")
    assert list(run.elsewhere) == [Setting(1.1, 2, 1), Setting(1.1, 5, 1)]
    with (tmp_path / "tables" / "table3.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == "ours" and row["result"] == "run"]
    assert [row["pursuers"] for row in rows] == ["2", "3", "5"]
    assert counts(reproduce(load_grid(str(grid)), tmp_path, 1)) == (0, 0, 1)
    verified = verify(load_grid(str(grid)), tmp_path)
    assert verified.equal == verified.rounds == 3 * len(run.episodes)

    grid.write_text(ELSEWHERE.partition("elsewhere")[0])  # what has been played elsewhere is not asked for any more
    reproduce(load_grid(str(grid)), tmp_path, 1)
    with (tmp_path / "tables" / "table3.csv").open() as file:
        assert [row["pursuers"] for row in csv.DictReader(file) if row["result"] == "run"] == ["3"]


def test_policies_are_played_elsewhere_once(tmp_path: Path) -> None:
    grid = tmp_path / "grid.yaml"
    grid.write_text(ELSEWHERE)
    assert counts(reproduce(load_grid(str(grid)), tmp_path, 1)) == (1, 0, 0)
    [run] = read_runs(tmp_path / "runs")
    [(setting, rounds)] = run.elsewhere.items()
    assert setting == Setting(1.1, 3, 1, "tunnel")
    assert [(then.round, then.seed) for then in rounds] == [(now.round, now.seed) for now in run.episodes]
    assert rounds != run.episodes
    before = everything_in(tmp_path)
    assert "tables/table_scenes.md" in before
    assert counts(reproduce(load_grid(str(grid)), tmp_path, 1)) == (0, 0, 1)
    assert verify(load_grid(str(grid)), tmp_path).rounds == 2 * len(run.episodes)

    [path] = tmp_path.rglob("episodes_*.csv")
    rows = path.read_bytes()
    path.unlink()
    reproduce(load_grid(str(grid)), tmp_path, 1)
    assert path.read_bytes() == rows
    assert everything_in(tmp_path) == before

    grid.write_text(ELSEWHERE.replace("tunnel", "random"))
    write_tables(load_grid(str(grid)), tmp_path)
    assert not (tmp_path / "tables" / "table_scenes.md").exists()


@pytest.mark.parametrize("left", ["all of them", "half of one"])
def test_rounds_whose_record_was_not_written_any_more_are_played_again(tmp_path: Path, left: str) -> None:
    (tmp_path / "grid.yaml").write_text(ELSEWHERE)
    grid = load_grid(str(tmp_path / "grid.yaml"))
    reproduce(load_grid(str(tmp_path / "grid.yaml")), tmp_path, 1)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    [rounds] = tmp_path.rglob("episodes_*.csv")
    record = json.loads((rounds.parent / "run.json").read_text())
    del record["sha256"][rounds.name]
    files.write_json(rounds.parent / "run.json", record)
    if left == "half of one":
        rounds.write_text("round,se")
    write_tables(grid, tmp_path)
    assert verify(grid, tmp_path).passed
    reproduce(load_grid(str(tmp_path / "grid.yaml")), tmp_path, 1)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_an_edited_row_is_found(tmp_path: Path) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    path = folders(tmp_path)[0] / "episodes.csv"
    path.write_text(path.read_text().replace(",20,", ",19,", 1))
    with pytest.raises(files.DamagedFileError, match=r"episodes\.csv: changed since it was written"):
        reproduce(load_grid("smoke"), tmp_path, 1)


def test_an_edited_policy_is_not_evaluated(tmp_path: Path) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    folder = folders(tmp_path)[0]
    (folder / "episodes.csv").unlink()
    (folder / "policy.safetensors").write_bytes(b"other")
    with pytest.raises(files.DamagedFileError, match=r"policy\.safetensors: changed"):
        reproduce(load_grid("smoke"), tmp_path, 1)


def test_a_users_method_by_path_has_its_row(tmp_path: Path) -> None:
    (tmp_path / "idea.yaml").write_text("base: ours\nscale: 0.1\n")
    (tmp_path / "grid.yaml").write_text(
        "profile: smoke\ngroups:\n  - methods: [idea.yaml]\n"
        "    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]\n    seeds: [1]\nshared: []\n"
    )
    results = tmp_path / "results"
    assert counts(reproduce(load_grid(str(tmp_path / "grid.yaml")), results, 1)) == (1, 0, 0)
    assert "\nidea,1.1,3,1,random,all,run," in (results / "tables" / "table4.csv").read_text()
    text = (results / "tables" / "table4.md").read_text()
    assert markdown_row(text, "idea")[0] == "", "the grid does not ask for it without obstacles"
    assert markdown_row(text, "idea")[1].endswith(("no success", "0"))


def test_a_grid_shows_the_methods_it_asks_for_before_they_are_run_and_the_commit_of_its_recipe(tmp_path: Path) -> None:
    (tmp_path / "idea.yaml").write_text("base: ours\nscale: 0.1\n")
    (tmp_path / "grid.yaml").write_text(
        f"profile: smoke\nfrozen: {'0123456789' * 3}abcdef0123\ngroups:\n  - methods: [idea.yaml]\n"
        "    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]\n    seeds: [1]\nshared: []\n"
    )
    write_tables(load_grid(str(tmp_path / "grid.yaml")), tmp_path)
    rendered = {name: data.decode() for name, data in tables(tmp_path).items()}
    assert "| idea | not run |  |  |  |" in rendered["table2.md"]
    for name, text in rendered.items():
        assert ("recipe frozen in commit 012345678901." in text) == (not name.endswith(".csv")), name


def test_runs_that_the_grid_does_not_ask_for_are_not_in_its_tables(tmp_path: Path) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    before = tables(tmp_path)
    train(load_grid("smoke").jobs[0].config, 5, "native", tmp_path / "runs")
    write_tables(load_grid("smoke"), tmp_path)
    assert tables(tmp_path) == before


def test_a_setting_that_the_paper_lacks_has_its_table_as_long_as_the_grid_asks_for_it(tmp_path: Path) -> None:
    (tmp_path / "grid.yaml").write_text(
        "profile: smoke\ngroups:\n  - methods: [ours]\n"
        "    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1, scene: tunnel}]\n    seeds: [1]\nshared: []\n"
    )
    results = tmp_path / "results"
    reproduce(load_grid(str(tmp_path / "grid.yaml")), results, 1)
    assert "tunnel" in (results / "tables" / "table_other.md").read_text()
    assert "tunnel" in (results / "tables" / "table_other.csv").read_text()
    write_tables(load_grid("smoke"), results)
    assert sorted(tables(results)) == TABLES


@pytest.mark.parametrize("status", ["finished", "diverged"])
def test_a_run_of_another_configuration_is_not_shown(tmp_path: Path, status: str) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    before = tables(tmp_path)
    path = folders(tmp_path)[1] / "run.json"
    record = json.loads(path.read_text())
    record["config"]["algorithm"]["gamma"] = 0.5
    files.write_json(path, {**record, "status": status, "config_hash": config_hash(record["config"])})
    with pytest.raises(ConfigError, match=r"config\.algorithm\.gamma: 0\.9 here, 0\.5 there") as caught:
        write_tables(load_grid("smoke"), tmp_path)
    assert str(path.parent) in str(caught.value)
    assert tables(tmp_path) == before


def test_a_run_of_either_engine_is_shown(tmp_path: Path) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    before = tables(tmp_path)
    path = folders(tmp_path)[0] / "run.json"
    files.write_json(path, {**json.loads(path.read_text()), "engine": "supersuit"})
    write_tables(load_grid("smoke"), tmp_path)
    assert tables(tmp_path) == before


def test_a_diverged_run_is_shown_and_not_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reproduce(load_grid("smoke"), tmp_path, 1)
    path = folders(tmp_path)[0] / "run.json"
    record = json.loads(path.read_text())
    del record["sha256"]["episodes.csv"]
    weights = path.with_name("policy.safetensors")
    save_file({name: th.full_like(weight, th.nan) for name, weight in load_file(weights).items()}, weights)
    record["sha256"][weights.name] = files.sha256_bytes(weights.read_bytes())
    files.write_json(path, {**record, "status": "diverged"})
    (path.parent / "episodes.csv").unlink()
    monkeypatch.setattr(reproduction, "play_rounds", lambda *_: pytest.fail("it was evaluated"))
    result = reproduce(load_grid("smoke"), tmp_path, 1)
    assert counts(result) == (0, 0, 2)
    assert result.sweep.diverged == 1
    assert "diverged" in (tmp_path / "tables" / "table4.md").read_text()


def test_table_1_is_the_papers() -> None:
    # Zheng et al. (2023), Table 1
    yes, no = True, False
    assert {method: options_of(method) for method in TABLE1_METHODS} == {
        "model_a": MethodOptions(two_stage=yes, obstacle_assisted=no, individual_contributing_angle=yes),
        "model_b": MethodOptions(two_stage=no, obstacle_assisted=yes, individual_contributing_angle=yes),
        "model_c": MethodOptions(two_stage=yes, obstacle_assisted=yes, individual_contributing_angle=no),
        "ours": MethodOptions(two_stage=yes, obstacle_assisted=yes, individual_contributing_angle=yes),
    }
    text = render_table1({method: options_of(method) for method in TABLE1_METHODS})["table1.md"]
    ticks = [line.count("✓") for line in text.splitlines() if line.startswith("|")][2:]
    assert ticks == [2, 2, 2, 3]


def test_an_unknown_grid_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="did you mean smoke"):
        reproduce(load_grid("smok"), tmp_path / "results", 1)
    assert not (tmp_path / "results").exists()
