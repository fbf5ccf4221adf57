"""Policies found by name: the first training seed, and what there is where there is none."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up import episode, write_run
from tiny_runs import IN_SEVERAL_SETTINGS, finished, tiny

from marl_encircle import MADDPG, files
from marl_encircle.experiments import loading, pretrained
from marl_encircle.experiments.build import make_vec_env, policy_bytes
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import load_policy, load_run
from marl_encircle.experiments.pretrained import USUAL_SETTING, find_run, first_run, pretrained_runs, setting_of
from marl_encircle.experiments.records import Cell, Setting, read_record, run_path
from marl_encircle.experiments.sizes import observation_size
from marl_encircle.experiments.train import train
from marl_encircle.experiments.yaml_files import ConfigError

OURS = Cell("ours", USUAL_SETTING)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installation, whose package brings three made-up runs and a real one."""
    monkeypatch.setattr(pretrained, "PACKAGE", tmp_path / "marl_encircle")
    runs = tmp_path / "marl_encircle" / "pretrained"
    for cell in (
        Cell("ours", Setting(1.1, 3, 0)),
        Cell("ours", Setting(1.4, 3, 1)),
        Cell("model_b", Setting(1.1, 5, 1)),
    ):
        write_run(runs, cell, 0, (episode(0, 10),))
    shutil.copytree(finished(), runs / run_path(OURS, 0))
    return runs


def test_a_name_means_the_packages_own_run_of_its_setting(installed: Path) -> None:
    assert pretrained_runs() == installed
    own = (finished() / "policy.safetensors").read_bytes()
    assert policy_bytes(load_policy("ours")) == own
    assert policy_bytes(load_policy("ours", pursuers=3, obstacles=1, speed_ratio=1.1, scene="random")) == own
    assert policy_bytes(load_policy("ours", speed_ratio=1.1)) == own


def test_a_checkout_has_the_runs_of_its_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pretrained_runs() == Path(__file__).parents[2] / "results" / "runs"
    monkeypatch.setattr(pretrained, "PACKAGE", tmp_path / "marl_encircle")
    assert pretrained_runs() == tmp_path / "results" / "runs"


def test_the_first_seed_is_chosen_whatever_it_is_worth(tmp_path: Path) -> None:
    for seed, step in ((10, 5), (9, 40), (12, 5)):
        write_run(tmp_path, OURS, seed, (episode(0, step),))
    (write_run(tmp_path, OURS, 2, None) / "run.json").unlink()  # unfinished
    assert find_run("ours", USUAL_SETTING, [tmp_path]) == tmp_path / run_path(OURS, 9)


def test_a_first_seed_that_diverged_is_told_and_no_other_is_taken_in_its_place(tmp_path: Path) -> None:
    diverged = write_run(tmp_path, OURS, 0, None, status="diverged")
    write_run(tmp_path, OURS, 1, (episode(0, 10),))
    with pytest.raises(ConfigError) as caught:
        find_run("ours", USUAL_SETTING, [tmp_path])
    assert str(caught.value) == (
        f"{diverged}: the first training seed of ours with 3 pursuers and 1 obstacle at speed ratio 1.1 diverged, so "
        "the name stands for no policy; give the folder of a run"
    )


def test_a_name_that_shares_the_runs_of_one_that_diverged_is_told_too(tmp_path: Path) -> None:
    setting = Setting(1.1, 3, 0)
    diverged = write_run(tmp_path, Cell("ours", setting), 0, None, status="diverged")
    with pytest.raises(ConfigError, match=f"{diverged}: the first training seed of model_a .* diverged"):
        find_run("model_a", setting, [tmp_path])


def test_an_earlier_folder_is_preferred(tmp_path: Path) -> None:
    near, far = tmp_path / "near", tmp_path / "far"
    write_run(near, OURS, 7, (episode(0, 10),))
    write_run(far, OURS, 0, (episode(0, 10),))
    assert find_run("ours", USUAL_SETTING, [near, far]).is_relative_to(near)
    assert find_run("ours", USUAL_SETTING, [tmp_path / "none", far]).is_relative_to(far)


def test_a_policy_of_sets_stands_for_any_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, _ = train(tiny(overrides=IN_SEVERAL_SETTINGS), 3, out=tmp_path)
    monkeypatch.setattr(loading, "pretrained_runs", lambda: tmp_path)
    for fields in ({}, {"pursuers": 2, "obstacles": 0}, {"pursuers": 6, "obstacles": 4, "speed_ratio": 1.25}):
        assert find_run("ours", setting_of(fields), [tmp_path]) == folder
        policy = load_policy("ours", **fields)
        scenario = replace(tiny().scenario, **fields)
        actions, _ = policy.predict(np.zeros((2 * scenario.pursuers, observation_size(scenario)), np.float32))
        assert actions.shape == (2 * scenario.pursuers, 2)
        assert policy.agents == scenario.agents
    with pytest.raises(ConfigError, match=r"scenario\.speed_ratio must be between"):
        load_policy("ours", speed_ratio=0.5)


def test_a_policy_of_sets_whose_first_seed_diverged_stands_for_none(tmp_path: Path) -> None:
    folder, _ = train(tiny(overrides=IN_SEVERAL_SETTINGS), 3, out=tmp_path)
    record = {**read_record(folder), "status": "diverged"}
    files.write_json(folder / "run.json", record)
    for fields in ({}, {"pursuers": 2}):
        with pytest.raises(ConfigError, match=f"{folder}: the first training seed of ours with 3 pursuers .* diverged"):
            find_run("ours", setting_of(fields), [tmp_path])


def test_without_obstacles_model_a_is_ours(installed: Path) -> None:
    setting = Setting(1.1, 3, 0)
    assert find_run("model_a", setting, [installed]) == installed / run_path(Cell("ours", setting), 0)
    own = write_run(installed, Cell("model_a", setting), 4, (episode(0, 10),))
    assert find_run("model_a", setting, [installed]) == own
    assert first_run(Cell("model_a", USUAL_SETTING), [installed]) is None


@pytest.mark.parametrize(
    ("name", "fields", "reasons"),
    [
        ("our", {}, ["'our': no method and no run folder; did you mean ours?"]),
        ("zzz", {}, ["'zzz': no method and no run folder; known: model_b, ours"]),
        ("", {}, ["'': no method and no run folder"]),
        ("..", {}, ["'..': no method and no run folder"]),
        ("ma2019", {}, ["no run of ma2019 with 3 pursuers and 1 obstacle at speed ratio 1.1; it has none at all"]),
        (
            "ours",
            {"speed_ratio": 1.3},
            [
                "the nearest is with 3 pursuers and 1 obstacle at speed ratio 1.4",
                "there are ratio1.1_n3_m0_random, ratio1.1_n3_m1_random, ratio1.4_n3_m1_random",
                "marl-encircle train --reward ours --speed-ratio 1.3 --pursuers 3 --obstacles 1",
            ],
        ),
        ("ours", {"obstacles": 0, "pursuers": 4}, ["ours with 4 pursuers and 0 obstacles", "is with 3 pursuers and 0"]),
        ("ours", {"scene": "tunnel"}, ["at speed ratio 1.1 in the scene tunnel;", "--obstacles 1 --scene tunnel"]),
        ("ours", {"scene": "tunel"}, ["scene 'tunel': unknown scene; did you mean tunnel?"]),
        ("ours", {"scene": "../../x"}, ["scene '../../x': unknown scene"]),
        ("ours", {"pursuer": 3}, ["pursuer: unknown key; did you mean pursuers?"]),
        ("ours", {"pursuers": "3"}, ["pursuers: input should be a valid integer; got '3'"]),
        ("ours", {"speed_ratio": float("nan")}, ["speed_ratio: input should be a finite number; got nan"]),
    ],
)  # fmt: skip
def test_what_is_not_there_is_told_with_what_is(
    installed: Path, name: str, fields: dict[str, Any], reasons: list[str]
) -> None:
    assert installed.is_dir()
    with pytest.raises(ConfigError) as caught:
        load_policy(name, **fields)
    for reason in reasons:
        assert reason in str(caught.value)


def test_a_run_folder_has_its_own_setting_unless_its_policy_serves_any(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"was trained with 3 pursuers and 1 obstacle.*; asked for with 4 pursuers"):
        load_policy(finished(), pursuers=4)
    with pytest.raises(ConfigError, match="pursuer: unknown key; did you mean pursuers"):
        load_policy(finished(), pursuer=4)
    folder, _ = train(tiny(overrides=IN_SEVERAL_SETTINGS), 3, out=tmp_path)
    assert load_policy(folder, pursuers=4).agents == replace(tiny().scenario, pursuers=4).agents


@pytest.mark.parametrize(
    "fields", [{"speed_ratio": 1.3}, {"scene": "tunnel"}, {"speed_ratio": 1.2, "scene": "concave", "obstacles": 1}]
)
def test_any_policy_of_a_folder_plays_at_other_speed_ratios_and_in_other_scenes(fields: dict[str, Any]) -> None:
    own = load_run(finished())
    setting = own.config.cell.setting._replace(**fields)
    policy, config, _ = load_run(finished(), fields)
    assert config.cell.setting == setting
    assert policy_bytes(policy) == policy_bytes(load_policy(finished(), **fields)) == policy_bytes(own.policy)
    assert play_rounds(policy, config, 10, 5) == play_rounds(own.policy, own.config, 10, 5, setting)


def test_a_setting_that_there_is_not_is_refused_for_a_folder_too() -> None:
    with pytest.raises(ConfigError, match=r"asked for .* at speed ratio 0\.5: scenario\.speed_ratio must be between"):
        load_policy(finished(), speed_ratio=0.5)


def test_a_zip_file_has_its_own_setting(tmp_path: Path) -> None:
    MADDPG("MlpPolicy", make_vec_env(n_worlds=2, seed=0)).save(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match=r"model\.zip: a zip-file has a setting of its own; got pursuers"):
        load_policy(tmp_path / "model.zip", trusted=True, pursuers=3)


def test_numpys_numbers_are_as_good_as_pythons(installed: Path) -> None:
    numbers = {"pursuers": np.int64(3), "obstacles": np.uint8(1), "speed_ratio": np.float64(1.1)}
    fields = {**numbers, "scene": np.str_("random")}
    assert installed.is_dir()
    assert policy_bytes(load_policy("ours", **fields)) == policy_bytes(load_policy("ours"))
    assert {type(value) for value in setting_of(fields)} == {int, float, str}
    with pytest.raises(ConfigError, match="pursuers: input should be a valid integer; got True"):
        setting_of({"pursuers": np.bool_(True)})


def test_a_setting_differs_from_the_usual_one_by_what_is_named() -> None:
    assert setting_of({}) == Setting(1.1, 3, 1, "random")
    assert setting_of({"pursuers": 4, "scene": "concave"}) == Setting(1.1, 4, 1, "concave")
