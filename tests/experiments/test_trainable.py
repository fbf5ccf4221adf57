"""A training that could not be carried out on this machine, or would learn nothing, is refused before it begins."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import tiny

from marl_encircle.experiments import memory
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.memory import memory_needed
from marl_encircle.experiments.records import Setting
from marl_encircle.experiments.sweep import sweep
from marl_encircle.experiments.trainable import check_seed, check_training, check_trainings
from marl_encircle.experiments.yaml_files import ConfigError


@pytest.mark.parametrize(
    ("ramp", "reason"),
    [
        ("speed_ratio={start: 0.5, world_steps: 9}", "speed_ratio.start: scenario.speed_ratio must be between"),
        ("obstacle_radius={start: 0.9, world_steps: 9}", "obstacle_radius.start: scenario: too many bodies"),
        (
            "obstacle_radius={start: 1e200, world_steps: 9}",
            "obstacle_radius.start: scenario.obstacle_radius must be between 1e-06 and 1e+06; got 1e+200",
        ),
    ],
)
def test_a_first_value_that_cannot_be_played_is_refused_for_a_training_with_the_remedy(ramp: str, reason: str) -> None:
    config = load_config(overrides=[f"training.curriculum.{ramp}"])  # which may be shown
    with pytest.raises(ConfigError) as caught:
        check_training(config)
    key = "training.curriculum." + ramp.partition("=")[0]
    assert str(caught.value).startswith(f"training.curriculum.{reason}")
    assert str(caught.value).endswith(f"; --set {key}.start=... to another value, or --set {key}=null for none")


@pytest.mark.parametrize(
    "overrides",
    [
        ["algorithm.buffer_world_steps=10000000000", "training.world_steps=10000000000"],
        ["training.n_worlds=65536", "scenario.n_directions=4096", "scenario.pursuers=64", "scenario.obstacles=0",
         "scenario.pursuer_radius=0.01", "algorithm.buffer_world_steps=1000000000", "training.world_steps=1000000000"],
    ],
)  # fmt: skip
def test_what_would_not_fit_into_memory_is_refused(overrides: Sequence[str]) -> None:
    config = load_config(overrides=overrides)  # which may be shown, and its environment built
    with pytest.raises(ConfigError, match="GB in all, but this machine has"):
        check_training(config)


def test_a_buffer_is_no_larger_than_its_training() -> None:
    check_training(load_config(profile="smoke", overrides=["algorithm.buffer_world_steps=10000000000"]))


@pytest.mark.parametrize("profile", ["full", "smoke"])
@pytest.mark.parametrize("pursuers", [2, 3])
def test_a_training_without_learning_is_refused(profile: Any, pursuers: int) -> None:
    def check(random: int) -> None:
        how = [f"algorithm.random_world_steps={random}", "training.world_steps=12000"]
        check_training(load_config(profile=profile, fields={"pursuers": pursuers}, overrides=how))

    check_training(load_config(profile=profile, fields={"pursuers": pursuers}))
    check(11999)
    for random in (12000, 20000):
        with pytest.raises(ConfigError, match=f"random_world_steps: must be less than .* 12000.*; got {random}"):
            check(random)


def test_points_of_a_learning_curve_are_no_nearer_than_rollouts() -> None:
    def check(every: int) -> None:
        how = ["training.n_worlds=8", "algorithm.train_freq=10", f"training.curve_every={every}"]
        check_training(tiny(overrides=how))

    check(80)
    with pytest.raises(ConfigError) as caught:
        check(79)
    assert str(caught.value) == (
        "training.curve_every: must be at least training.n_worlds * algorithm.train_freq, 8 * 10: a point of the "
        "learning curve comes between two rollouts; got 79"
    )


@pytest.mark.parametrize(
    ("seed", "reason"),
    [
        (4000, r"seed must differ from evaluation\.seed: the training would see the evaluation's rounds; got 4000"),
        (2000, r"seed must differ from evaluation\.curve_seed: .*; got 2000"),
        (-1, "seed must be an integer from 0 to 4294967295; got -1"),
        (1 << 32, "seed must be an integer from 0 to 4294967295; got 4294967296"),
        (True, "got True"),
        (1.0, r"got 1\.0"),
        ("1", "got '1'"),
    ],
)
def test_a_training_seed_is_none_of_the_evaluations(seed: Any, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        check_seed(load_config(), seed)
    check_seed(load_config(), 999)
    check_seed(load_config(overrides=["evaluation.seed=3"]), 4000)


def test_trainings_must_fit_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small, large = tiny(), tiny(overrides=["algorithm.batch_size=3200"])
    needs = {config.algorithm.batch_size: sum(memory_needed(config).values()) for config in (small, large)}
    monkeypatch.setattr(memory, "CONTAINER_LIMIT", tmp_path / "memory.max")
    (tmp_path / "memory.max").write_text(str(needs[3200] + needs[32]))
    configs = [small, large, small]
    check_trainings(configs, 1)
    check_trainings(configs, 2)
    with pytest.raises(
        ConfigError, match=r"3 trainings at a time need 0\.0 GB of memory, .* has 0\.0 GB; use fewer jobs"
    ):
        check_trainings(configs, 3)
    (tmp_path / "memory.max").write_text(str(needs[3200] - 1))
    with pytest.raises(ConfigError, match=r"algorithm\.batch_size: needs"):
        check_trainings(configs, 1)
    check_trainings([small], 1)
    with pytest.raises(ConfigError, match="random_world_steps: must be less"):
        check_trainings([small, tiny(overrides=["algorithm.random_world_steps=400"])], 1)


def test_a_sweep_is_refused_before_it_touches_its_folder(tmp_path: Path) -> None:
    (tmp_path / "random.yaml").write_text("base: maddpg\nrandom_world_steps: 999999999\n")
    job = Job("ours", Setting(1.1, 3, 1, "random"), 0, "smoke", algorithm=str(tmp_path / "random.yaml"))
    with pytest.raises(ConfigError, match="random_world_steps: must be less"):
        sweep([job], tmp_path / "runs", 1)
    assert not (tmp_path / "runs").exists()
