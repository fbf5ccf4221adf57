"""Calibration: the protocol as it is written, on trainings that are given or tiny."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from made_up import rounds, write_run
from tiny_runs import TINY, everything_in, train_in_this_process

from marl_encircle.experiments import grid as grids
from marl_encircle.experiments import memory
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.memory import memory_needed
from marl_encircle.experiments.records import Cell, Setting
from marl_encircle.experiments.sweep import Progress
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study import calibrate as calibration
from marl_encircle.study.calibrate import Trial, calibrate, render
from marl_encircle.study.protocol import (
    MAX_SCENARIOS,
    Protocol,
    SuccessAndLength,
    cells_with_numbers,
    jobs_of,
    load_protocol,
    name_of,
)

ROOT = Path(__file__).parents[2]
PROTOCOL = """\
reward: ours
profile: smoke
scenario: centre
settings:
  - {speed_ratio: 1.1, pursuers: 3, obstacles: 0}
seeds: [910]
evaluation_seed: 1000
neighbours:
  - {acceleration: 3}
  - {contacts: hard}
  - {wall_weight: 0.5}
combinations: 2
"""


@pytest.fixture
def protocol(tmp_path: Path) -> Protocol:
    path = tmp_path / "protocol.yaml"
    path.write_text(PROTOCOL)
    return load_protocol(str(path))


def with_distances(monkeypatch: pytest.MonkeyPatch, distances: Mapping[str, float]) -> list[str]:
    """Give every scenario its distance in place of trainings; return the names in the order they are asked for."""
    asked: list[str] = []

    def measure(protocol: Protocol, changes: Mapping[str, Any], folder: Path) -> Trial:
        asked.append(name_of(changes))
        results = tuple(SuccessAndLength(90.0, 20.0) for _ in protocol.cells)
        return Trial(changes, results, distances[name_of(changes)], tuple((90.0,) for _ in results))

    monkeypatch.setattr(calibration, "sweep", lambda jobs, *_: Progress(total=len(jobs), done=len(jobs)))
    monkeypatch.setattr(calibration, "_measure", measure)
    return asked


def test_a_scenario_whose_file_changed_is_read_again(tmp_path: Path) -> None:
    scenario = tmp_path / "mine.yaml"
    (tmp_path / "protocol.yaml").write_text(PROTOCOL.replace("centre", str(scenario)))
    for acceleration in (4.0, 5.0):
        scenario.write_text(f"base: centre\nacceleration: {acceleration}\n")
        protocol = load_protocol(str(tmp_path / "protocol.yaml"))
        assert jobs_of(protocol, {})[0].config.scenario.acceleration == acceleration


@pytest.mark.parametrize(
    ("distances", "trials", "chosen"),
    [
        # The nearest neighbour is the best so far; the next is joined and stays; the third is farther than the centre
        ([9, 5, 7, 12, {"acceleration=3,contacts=hard": 4}], 5, "acceleration=3,contacts=hard"),
        # What does not come nearer is left out of what is tried next
        (
            [9, 5, 7, 8, {"acceleration=3,contacts=hard": 6, "acceleration=3,wall_weight=0.5": 3}],
            6,
            "acceleration=3,wall_weight=0.5",
        ),
        ([9, 9, 10, 11, {}], 4, "centre"),
        ([9, 5, 10, 9, {}], 4, "acceleration=3"),
    ],
)
def test_the_best_neighbours_are_joined(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    protocol: Protocol,
    distances: Sequence[Any],
    trials: int,
    chosen: str,
) -> None:
    *single, joined = distances
    names = ["centre", "acceleration=3", "contacts=hard", "wall_weight=0.5"]
    asked = with_distances(monkeypatch, dict(zip(names, single, strict=True)) | joined)
    result = calibrate(protocol, tmp_path / "out", 1)
    assert asked == [*names, *joined]
    assert len(result.trials) == trials
    assert name_of(result.chosen.changes) == chosen
    assert f"Chosen: {chosen}." in (tmp_path / "out" / "sensitivity.md").read_text()
    config = load_config(scenario=tmp_path / "out" / "scenario.yaml").scenario
    assert {field: getattr(config, field) for field in result.chosen.changes} == result.chosen.changes


def test_no_more_combinations_are_tried_than_the_protocol_allows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, protocol: Protocol
) -> None:
    distances = {"centre": 9.0, "acceleration=3": 5.0, "contacts=hard": 7.0, "wall_weight=0.5": 8.0}
    distances |= {"acceleration=3,contacts=hard": 6.0}
    asked = with_distances(monkeypatch, distances)
    calibrate(protocol.model_copy(update={"combinations": 1}), tmp_path, 1)
    assert asked == list(distances)


def test_a_neighbour_that_does_not_fit_into_memory_is_refused_before_the_centre_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = with_distances(monkeypatch, {})
    (tmp_path / "protocol.yaml").write_text(PROTOCOL.replace("acceleration: 3", "n_directions: 4096"))
    protocol = load_protocol(str(tmp_path / "protocol.yaml"))
    centre = sum(memory_needed(load_config("ours", profile="smoke", fields={"obstacles": 0})).values())
    (tmp_path / "memory.max").write_text(str(centre))
    monkeypatch.setattr(memory, "CONTAINER_LIMIT", tmp_path / "memory.max")
    with pytest.raises(ConfigError, match="GB of memory"):
        calibrate(protocol, tmp_path / "out", 1)
    assert asked == []


def test_the_distance_is_to_the_papers_cells(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, protocol: Protocol
) -> None:
    """Paper, Ours at ratio 1.1, n=3, m=0: 97.88 / 23.51."""
    monkeypatch.setattr(grids, "load_config", _tiny)
    train_in_this_process(monkeypatch)
    one = protocol.model_copy(update={"neighbours": [], "combinations": 0})
    result = calibrate(one, tmp_path, 1)
    (ours,) = result.chosen.results
    assert result.chosen.distance == pytest.approx(abs(ours.success - 97.88) + abs(ours.length - 23.51))
    table = (tmp_path / "sensitivity.csv").read_text().splitlines()
    ((each,),) = result.chosen.seeds
    assert each == pytest.approx(ours.success), "one seed"
    assert table[1] == f"centre,{ours.success:.4f},{ours.length:.4f},{each:.4f},{result.chosen.distance:.2f}"
    assert table[2] == "the paper,97.8800,23.5100,,"
    text = (tmp_path / "sensitivity.md").read_text()
    assert f"| centre | {ours.success:.2f} ({each:.1f}) / {ours.length:.2f} |" in text
    write_run(tmp_path / "runs" / "centre", Cell("other", Setting(1.1, 3, 0)), protocol.seeds[0], rounds(0, 8))
    before = everything_in(tmp_path)
    assert calibrate(one, tmp_path, 1) == result, "whatever another method has there"
    assert everything_in(tmp_path) == before
    assert render(one, result)["sensitivity.md"] == (tmp_path / "sensitivity.md").read_text()


def _tiny(*arguments: Any, **named: Any) -> Config:
    return load_config(*arguments, **{**named, "overrides": TINY})


def test_the_projects_protocol_is_allowed_and_holds_the_other_cells_out() -> None:
    protocol = load_protocol("calibration")
    assert 1 + len(protocol.neighbours) + protocol.combinations <= MAX_SCENARIOS == 16
    assert protocol.cells == [Cell("ours", Setting(1.1, 3, 0)), Cell("ours", Setting(1.1, 2, 1))]
    assert len(protocol.seeds) == 2


def test_the_studys_scenario_is_the_calibrations_outcome() -> None:
    chosen = load_config("ours", scenario=str(ROOT / "results" / "calibration" / "scenario.yaml"))
    assert load_config("ours", scenario="paper") == chosen
    assert load_config("ours") == chosen, "what learns without naming a scenario does so in the study's"
    assert load_config("ours", scenario="centre") != chosen
    assert {job.scenario for job in grids.load_grid("study").jobs} == {"paper"}


def test_the_table_of_the_calibration_follows_from_its_trainings(tmp_path: Path) -> None:
    committed = ROOT / "results" / "calibration"
    shutil.copytree(committed / "runs", tmp_path / "runs")
    before = everything_in(tmp_path / "runs")
    calibrate(load_protocol("calibration"), tmp_path, 1)
    assert everything_in(tmp_path / "runs") == before
    for name in ("sensitivity.md", "sensitivity.csv", "scenario.yaml"):
        assert (tmp_path / name).read_bytes() == (committed / name).read_bytes()


def test_a_grid_is_no_protocol() -> None:
    for name in ("study", "calibratio"):
        with pytest.raises(ConfigError, match=r"neither a known name.*(known: calibration$|mean calibration\?)"):
            load_protocol(name)


def test_the_papers_cells_are_those_with_numbers() -> None:
    cells = cells_with_numbers()
    assert cells[Cell("ours", Setting(1.1, 2, 1))] == SuccessAndLength(77.75, 29.48)
    assert Cell("model_a", Setting(1.1, 2, 1)) not in cells


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("combinations: 2", "combinations: 13", "17 scenarios; at most 16 may be tried"),
        ("combinations: 2", f"combinations: {'9' * 2000}", f"less than or equal to 16; got {'9' * 80}$"),
        ("pursuers: 3", "pursuers: 7", "the paper has no numbers of ours in"),
        ("reward: ours", "reward: model_c", "the paper has no numbers of model_c in"),
        ("{contacts: hard}", "{contacts: no}", "scenario.contacts must be one of soft, hard, off; got 'no'"),
        ("{contacts: hard}", "{contact: hard}", "contact"),
        ("{contacts: hard}", "{contacts: hard, acceleration: 3}", "neighbours"),
        ("seeds: [910]", "seeds: []", "seeds"),
        ("seeds: [910]", "seeds: [1000]", "seed must differ from evaluation.seed"),
        ("seeds: [910]", "seed: [910]", "did you mean seeds"),
        ("seeds: [910]", "seeds: [910, 911, 910]", "seeds.2: stands there twice; got 910"),
        ("{contacts: hard}", "{pursuers: 4}", "neighbours.1.pursuers: belongs to the settings"),
        ("{contacts: hard}", "{obstacles: 1}", "neighbours.1.obstacles: belongs to the settings"),
        ("{contacts: hard}", "{speed_ratio: 1.2}", "neighbours.1.speed_ratio: belongs to the settings"),
        ("{contacts: hard}", "{scene: tunnel}", "neighbours.1.scene: belongs to the settings"),
        ("{contacts: hard}", "{contacts: soft}", "neighbours.1: contacts=soft is the same scenario as the centre"),
        ("{contacts: hard}", "{acceleration: 3.0}", "neighbours.1: acceleration=3.0 is the same .* as neighbours.0"),
        (
            "obstacles: 0}",
            "obstacles: 0}\n  - {speed_ratio: 1.1, pursuers: 3, obstacles: 0}",
            "settings.1: stands there twice",
        ),
    ],
)
def test_a_protocol_that_cannot_be_carried_out_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "protocol.yaml"
    assert old in PROTOCOL
    path.write_text(PROTOCOL.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        load_protocol(str(path))
