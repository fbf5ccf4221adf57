"""Each fault is one line: the file, the key, the value, what is allowed."""

from pathlib import Path
from typing import Any

import pytest

from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.yaml_files import ConfigError


def refused(reward: str = "ours", **how: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(reward, **how)
    return str(caught.value)


def write(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_what_is_wrong_is_told_with_the_file_that_says_it(tmp_path: Path) -> None:
    base = write(tmp_path, "base.yaml", "base: ours\nscale: true\nterms: {time: [3]}\n")
    top = write(tmp_path, "top.yaml", "base: base.yaml\nclosure: both\n")
    assert refused(top).splitlines() == [
        f"{top}: reward.closure: input should be 'all' or 'pursuers'; got 'both'",
        f"{base}: reward.scale: input should be a valid number; got True",
    ]
    assert refused(top, overrides=["reward.closure=all", "reward.scale=1"]).startswith(
        f"{base}: reward.terms.time.weight must be a finite number"
    )
    assert refused(top, overrides=["reward.closure=any", "reward.scale=1"]).startswith("reward.closure: ")
    algorithm = write(tmp_path, "mine.yaml", "base: maddpg\nupdates: 3\n")
    assert refused(algorithm=algorithm).startswith(f"{algorithm}: algorithm.updates: unknown key; known: actor_")


def test_a_scenarios_file_is_told_also_where_a_change_would_hide_its_fault(tmp_path: Path) -> None:
    path = write(tmp_path, "mine.yaml", "accelerat: 3\n")
    assert refused(scenario=path) == f"{path}: scenario.accelerat: unknown key; did you mean acceleration?"
    path = write(tmp_path, "mine.yaml", "speed_ratio: 0.3\n")
    for changes in ({}, {"speed_ratio": 1.2}):
        assert refused(scenario=path, fields=changes).startswith(f"{path}: scenario.speed_ratio must be between")
    path = write(tmp_path, "mine.yaml", "obstacles: 30\n")
    assert refused(scenario=path).startswith(f"{path}: scenario: too many bodies")
    assert load_config(scenario=path, fields={"obstacles": 2}).scenario.obstacles == 2
    assert refused(scenario=path, fields={"pursuers": 4}).startswith("scenario: too many bodies")


def test_a_change_of_a_scenario_that_stands_in_no_file_is_told_by_its_key() -> None:
    fault = "scenario.accelerat: unknown key; did you mean acceleration?"
    assert refused(scenario=Scenario(), overrides=["scenario.accelerat=3"]) == fault
    assert refused(scenario=Scenario(), fields={"accelerat": 3}) == fault


def test_every_fault_of_a_file_is_told_at_once() -> None:
    overrides = ["reward.scale=true", "training.n_worlds=0", "algorithm.gama=1"]
    lines = refused(overrides=overrides).splitlines()
    assert [line.partition(":")[0] for line in lines] == ["reward.scale", "algorithm.gama", "training.n_worlds"]
