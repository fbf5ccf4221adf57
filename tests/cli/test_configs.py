"""``config show``, ``diff`` and ``validate``: what they print, and that they know every kind of file."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_runs import Done

from marl_encircle.cli import kinds
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.library import files_of

Run = Callable[..., Done]


def test_config_show_prints_terms_and_weights_and_every_section(run: Run) -> None:
    out = run("config", "show", "--reward", "ma2019", "--pursuers", "4").out
    for text in ("reward ma2019: closed by the pursuers alone", "encirclement_radius", "radius=0.15", "times 0.05"):
        assert text in out
    assert "(Ma et al. 2019)" in " ".join(out.split())
    for section in ("scenario", "algorithm", "training", "evaluation", "learning_rate", "safety_distance"):
        assert section in out
    assert "overall_angle" not in out
    assert "methods: generalist, ma2019, model_a, model_b, model_c, ours, ours_plus" in out


def test_config_show_prints_keys_that_a_record_leaves_out(run: Run) -> None:
    rows = [line.split() for line in run("config", "show").out.splitlines()]
    assert ["n_steps", "1"] in rows
    assert ["features", "observation"] in rows


def test_config_show_as_json_is_the_resolved_configuration(run: Run) -> None:
    done = run("config", "show", "--profile", "smoke", "--obstacles", "2", "--set", "training.n_worlds=3", "--json")
    expected = load_config(profile="smoke", fields={"obstacles": 2}, overrides=["training.n_worlds=3"])
    assert json.loads(done.out) == expected.to_dict()


def test_config_diff_says_what_differs_and_where(run: Run) -> None:
    rows = [line.split() for line in run("config", "diff", "ours", "model_b").out.splitlines() if "." in line]
    assert rows == [["reward.name", "ours", "model_b"], ["reward.two_stage", "true", "false"]]
    found = json.loads(run("config", "diff", "ours", "model_b", "--json").out)
    assert found == {"reward.name": ["ours", "model_b"], "reward.two_stage": [True, False]}
    assert run("config", "diff", "ours", "ours").out == "no difference\n"
    assert run("config", "diff", "ours", "ours", "--json").out == "{}\n"


def test_config_diff_compares_any_two_of_one_kind(run: Run, tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("acceleration: 3\nturn_order: simultaneous\n")
    found = {"scenario.acceleration": [5.0, 3.0], "scenario.turn_order": ["pursuers_first", "simultaneous"]}
    assert json.loads(run("config", "diff", "centre", mine, "--json").out) == found
    assert run("config", "diff", "paper", mine).out == "no difference\n"
    found = json.loads(run("config", "diff", "maddpg", "matd3_relative", "--json").out)
    assert found["algorithm.n_steps"] == [1, 3]
    assert found["algorithm.features"] == ["observation", "relative"]
    found = json.loads(run("config", "diff", "study", "smoke", "--json").out)
    assert found["profile"] == ["full", "smoke"]
    assert found["seeds.ours/ratio1.1_n3_m1_random"] == [[0, 1, 2, 3, 4], [900]]
    found = json.loads(run("config", "diff", "full", "smoke", "--json").out)
    assert {key.split(".")[0] for key in found} == {"training", "evaluation"}
    done = run("config", "diff", "ours", mine)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"error: ours (reward) and {mine} (scenario) cannot be compared: two of one kind can\n"


SETTINGS = "settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]"
GRID = "profile: smoke\nshared: []\ngroups: "
SEARCH = "profile: smoke\nsetting: {speed_ratio: 1.1, pursuers: 3, obstacles: 1}\nseeds: [950]\nlast_points: 1\n"
PROTOCOL = "reward: ours\nprofile: smoke\nscenario: centre\nseeds: [1]\nevaluation_seed: 1000\ncombinations: 0\n"
KINDS = {
    "reward": ("base: ours\nterms: {contraction: 2.0}", "base: ours\nterm: {}", "term: unknown key"),
    "scenario": ("acceleration: 3", "base: paper\nacceleration: -3", "acceleration must be"),
    "algorithm": ("base: maddpg\ngamma: 0.8", "base: matd3\ngamma: 8", "gamma: input should be less"),
    "training": ("base: full\nn_worlds: 8", "base: full\nn_worlds: 0", "training.n_worlds: input should be greater"),
    "evaluation": ("base: full\nepisodes: 8", "base: full\nepisodes: eight", "evaluation.episodes: input should"),
    "grid": (GRID + f"[{{methods: [ours], {SETTINGS}, seeds: [1]}}]", GRID + "[]", "groups: "),
    "protocol": (
        PROTOCOL + f"{SETTINGS}\nneighbours: [{{acceleration: 3}}]",
        PROTOCOL + "settings: []\nneighbours: []",
        "settings: ",
    ),
    "tuning": (
        SEARCH + "search: {algorithm: {gamma: {low: 0.8, high: 0.9}}}",
        SEARCH + "search: {algorithm: {gama: {low: 0.8, high: 0.9}}}",
        "gama: unknown key; did you mean gamma?",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_config_validate_finds_out_what_a_file_is(run: Run, tmp_path: Path, kind: str) -> None:
    good, bad, reason = KINDS[kind]
    path = tmp_path / "mine.yaml"
    path.write_text(good)
    assert run("config", "validate", path) == (0, f"valid {kind}\n", "")
    path.write_text(bad)
    done = run("config", "validate", path)
    assert (done.code, done.out) == (2, "")
    assert f"{path}: " in done.err
    assert reason in done.err
    assert set(KINDS) == set(kinds.KINDS)


def test_every_file_of_the_package_is_known_by_its_path(run: Run) -> None:
    for kind in kinds.KINDS:
        for path in files_of(kind).values():
            assert kinds.find_kinds(str(path)) == [kind]
            assert kinds.find_kinds(os.path.relpath(path)) == [kind]
    assert run("config", "validate", "full") == (0, "valid training\nvalid evaluation\n", "")


def test_config_validate_asks_where_a_file_could_be_anything(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("base: full\n")
    done = run("config", "validate", path)
    assert (done.code, done.out) == (2, "")
    assert done.err == f"error: {path}: cannot tell which it is, training or evaluation; say so by --kind\n"
    assert run("config", "validate", path, "--kind", "evaluation") == (0, "valid evaluation\n", "")
    path.write_text("wrong: 1\n")
    assert "cannot tell which it is" in run("config", "validate", path).err
    done = run("config", "validate", "our")
    assert done.err == "error: 'our': neither a known name nor a .yaml path; did you mean ours?\n"


def test_config_validate_says_valid_or_what_is_wrong(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("base: ours\nterms: {contraction: 2.0}\n")
    assert run("config", "validate", path) == (0, "valid reward\n", "")
    path.write_text("base: ours\nterms: {contration: 2.0}\n")
    done = run("config", "validate", path)
    assert (done.code, done.out) == (2, "")
    assert "reward.terms.contration: unknown reward term; did you mean contraction?" in done.err
