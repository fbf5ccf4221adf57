"""A search file says what is tried; what could not be trained is refused before anything is."""

from pathlib import Path
from typing import Any

import pytest
from search_files import search_file
from tiny_runs import TINY

from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.library import files_of
from marl_encircle.experiments.search_space import NO_REPORTED_ROUNDS, TUNING_SEEDS, Choices, Range, load_space
from marl_encircle.experiments.yaml_files import ConfigError


@pytest.mark.parametrize("name", files_of("tuning"))
def test_the_searches_of_the_package_judge_by_tuning_seeds_and_selection_rounds(name: str) -> None:
    space = load_space(name)
    assert set(space.file.seeds) <= set(TUNING_SEEDS)
    for job in space.jobs(space.base):
        evaluation = job.config.evaluation
        assert evaluation.seed != load_config().evaluation.seed
        assert evaluation.curve_seed == load_config().evaluation.curve_seed
    assert space.base.keys() == space.dimensions.keys(), "the values in use are tried first"


def test_dimensions_have_the_names_of_the_keys_that_they_move(tmp_path: Path) -> None:
    search = (
        "{algorithm: {tau: {low: 0.001, high: 0.1, log: true}, exploration_noise: {end: {low: 0.0, high: 0.2}}, "
        "net_arch: {choices: [[16], [8, 8]]}, policy_delay: {low: 1, high: 3}}, "
        "reward: {terms: {contraction: {low: 0.5, high: 2.0, step: 0.5}}, scale: {choices: [0.05, 0.1]}}}"
    )
    space = load_space(search_file(tmp_path, search=search))
    assert space.dimensions == {
        "algorithm.tau": Range(low=0.001, high=0.1, log=True),
        "algorithm.exploration_noise.end": Range(low=0.0, high=0.2),
        "algorithm.net_arch": Choices(choices=[[16], [8, 8]]),
        "algorithm.policy_delay": Range(low=1, high=3),
        "reward.terms.contraction": Range(low=0.5, high=2.0, step=0.5),
        "reward.scale": Choices(choices=[0.05, 0.1]),
    }
    assert space.base == {
        "algorithm.tau": 0.01,
        "algorithm.exploration_noise.end": 0.1,
        "algorithm.net_arch": [16],
        "algorithm.policy_delay": 2,
        "reward.terms.contraction": 1.0,
        "reward.scale": 0.05,
    }


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    path = search_file(tmp_path, algorithm="mine.yaml")
    for tau in (0.02, 0.03):
        (tmp_path / "mine.yaml").write_text(f"base: maddpg\ntau: {tau}\n")
        assert load_space(path).to_dict()["config"]["algorithm"]["tau"] == tau


def test_keys_that_a_record_leaves_out_are_tried_first_with_their_defaults(tmp_path: Path) -> None:
    search = "{algorithm: {n_steps: {low: 1, high: 5}, features: {choices: [relative, observation]}}}"
    base = load_space(search_file(tmp_path, search=search)).base
    assert base == {"algorithm.n_steps": 1, "algorithm.features": "observation"}


def test_values_in_use_that_are_not_tried_are_left_to_chance(tmp_path: Path) -> None:
    search = (
        "{algorithm: {gamma: {choices: [0.8, 0.95]}, tau: {low: 0.02, high: 0.1}, batch_size: {low: 16, high: 64, "
        "step: 12}, policy_delay: {low: 1, high: 3}}}"
    )
    assert load_space(search_file(tmp_path, search=search)).base == {"algorithm.policy_delay": 2}


def test_values_in_use_are_tried_wherever_floats_round_a_step(tmp_path: Path) -> None:
    search = "{algorithm: {gamma: {low: 0.8, high: 0.95, step: 0.05}, tau: {low: 0.005, high: 0.1, step: 0.002}}}"
    assert (0.9 - 0.8) / 0.05 != 2
    assert load_space(search_file(tmp_path, search=search)).base == {"algorithm.gamma": 0.9}


def test_a_trial_is_trained_with_its_values_and_each_seed(tmp_path: Path) -> None:
    space = load_space(search_file(tmp_path, seeds="[950, 999]"))
    jobs = space.jobs({"algorithm.learning_rate": 3e-5})
    assert [job.seed for job in jobs] == [950, 999]
    for job in jobs:
        assert job.config.algorithm.learning_rate == 3e-5
        expected = load_config(profile="smoke", overrides=[*TINY, *NO_REPORTED_ROUNDS, "algorithm.learning_rate=3e-5"])
        assert job.config == expected


def test_paths_in_a_file_are_relative_to_it(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("base: ours\nscale: 0.1\n")
    space = load_space(search_file(tmp_path, reward="mine.yaml"))
    assert space.jobs({})[0].config.reward.name == "mine"


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown key of the file": ({"serch": "{}"}, "serch: unknown key; did you mean search?"),
    "unknown section": ({"search": "{algorithms: {}}"}, "search.algorithms: unknown key; did you mean algorithm?"),
    "unknown key": (
        {"search": "{algorithm: {learning_rat: {low: 0.1, high: 0.2}}}"},
        "search.algorithm.learning_rat: algorithm.learning_rat: unknown key; did you mean learning_rate?",
    ),
    "unknown term": (
        {"search": "{reward: {terms: {contracton: {low: 0.1, high: 0.2}}}}"},
        "contracton",
    ),
    "unknown key of a range": (
        {"search": "{algorithm: {tau: {low: 0.1, hihg: 0.2}}}"},
        "search.algorithm.tau.hihg: unknown key; did you mean high?",
    ),
    "no range": (
        {"search": "{algorithm: {tau: 0.1}}"},
        "search.algorithm.tau: must be {low, high} or {choices}; got 0.1",
    ),
    "upside down": ({"search": "{algorithm: {tau: {low: 0.2, high: 0.1}}}"}, "low must be less than high, 0.1"),
    "log of nothing": ({"search": "{algorithm: {tau: {low: 0, high: 1.0, log: true}}}"}, "log needs a low above 0"),
    "log with step": (
        {"search": "{algorithm: {tau: {low: 0.1, high: 1.0, log: true, step: 0.1}}}"},
        "step must be above 0, and goes without log",
    ),
    "broken step": (
        {"search": "{algorithm: {batch_size: {low: 16, high: 64, step: 0.5}}}"},
        "step must be a whole number",
    ),
    "one choice": ({"search": "{algorithm: {gamma: {choices: [0.9]}}}"}, "search.algorithm.gamma.choices: "),
    "twice": ({"search": "{algorithm: {gamma: {choices: [0.9, 0.9]}}}"}, "0.9 stands there twice"),
    "too high": (
        {"search": "{algorithm: {gamma: {low: 0.9, high: 1.5}}}"},
        "search.algorithm.gamma: algorithm.gamma: input should be less than or equal to 1; got 1.5",
    ),
    "not whole": (
        {"search": "{algorithm: {batch_size: {low: 16.0, high: 64.0}}}"},
        "search.algorithm.batch_size: algorithm.batch_size: input should be a valid integer; got 16.0",
    ),
    "a choice of another kind": (
        {"search": "{algorithm: {net_arch: {choices: [[16], sixteen]}}}"},
        "search.algorithm.net_arch: algorithm.net_arch: input should be a valid list; got 'sixteen'",
    ),
    "nothing is learnt": (
        {"search": "{algorithm: {random_world_steps: {low: 10, high: 1000}}}"},
        "search.algorithm.random_world_steps: algorithm.random_world_steps: must be less than",
    ),
    "what success is": (
        {"search": "{reward: {closure: {choices: [all, pursuers]}}}"},
        "search.reward.closure: cannot be searched: it says what success is",
    ),
    "nothing": ({"search": "{}"}, "search: nothing to search"),
    "a reported seed": ({"seeds": "[0]"}, "seed 0 is no tuning seed: those are 900 to 999"),
    "the evaluation's": ({"seeds": "[1000]"}, "seed 1000 is no tuning seed"),
    "a long number": ({"seeds": f"[{'9' * 2000}]"}, f"seed {'9' * 80} is no tuning seed"),
    "a seed twice": ({"seeds": "[950, 950]"}, "seed 950 stands there twice"),
    "no seeds": ({"seeds": "[]"}, "seeds: "),
    "too many points": ({"last_points": "5"}, "last_points: a learning curve has 4 points; got 5"),
    "points that a training does not reach": (
        {"overrides": str([*TINY, "algorithm.train_freq=25", "training.curve_every=130"]), "last_points": "4"},
        "last_points: a learning curve has 3 points; got 4",  # at 200, 300 and, the end, 400
    ),
    "points that some trials do not reach": (
        {
            "overrides": str([*TINY, "training.curve_every=130"]),
            "search": "{algorithm: {train_freq: {low: 1, high: 25}}}",
            "last_points": "4",
        },
        "search.algorithm.train_freq: last_points: a learning curve has 3 points; got 4",
    ),
    "points between two trainings": (
        {"search": "{algorithm: {train_freq: {low: 1, high: 31}}}"},
        "search.algorithm.train_freq: training.curve_every: must be at least training.n_worlds * algorithm.train_freq",
    ),
    "unknown rule": ({"pruning": "{rule: medean}"}, "pruning.rule: "),
    "no such method": ({"reward": "our"}, "reward 'our'"),
    "a wrong override": ({"overrides": "[algorithm.gamm=0.9]"}, "gamm"),
    "too fast": ({"setting": "{speed_ratio: 0.5, pursuers: 3, obstacles: 1}"}, "speed_ratio"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_by_file_and_key(tmp_path: Path, what: str) -> None:
    changes, reason = BAD[what]
    path = search_file(tmp_path, **changes)
    with pytest.raises(ConfigError) as caught:
        load_space(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert reason in str(caught.value)


def test_an_unknown_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match=r"tuning 'defalt': neither a known name nor a .yaml path; did you mean default"
    ):
        load_space("defalt")
