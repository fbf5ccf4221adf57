"""The memory that a training takes is counted from its arrays, and held against what there is."""

from pathlib import Path

import pytest
from tiny_runs import tiny

from marl_encircle.experiments import memory
from marl_encircle.experiments.build import build_model, build_vec_env
from marl_encircle.experiments.checkpoint import REPLAY
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.memory import available_memory, check_memory, memory_needed
from marl_encircle.experiments.sizes import observation_size
from marl_encircle.experiments.yaml_files import ConfigError


def test_the_memory_that_is_needed_is_that_of_the_arrays() -> None:
    config = load_config(
        fields={"pursuers": 3, "obstacles": 1, "n_directions": 72},
        overrides=["algorithm.buffer_world_steps=1000", "algorithm.batch_size=10", "training.n_worlds=5"],
    )
    size = observation_size(config.scenario)
    assert memory_needed(config) == {
        "algorithm.buffer_world_steps": 2 * 1000 * 3 * (2 * size + 5) * 4,
        # a transition, what all critics read of it (3 x (size + 2)), two hidden layers of 64 of three pursuers
        "algorithm.batch_size": 10 * 4 * (3 * (2 * size + 5) + 3 * (size + 2) + 3 * 128),
        # actors size-64-64-2, a shared critic 3 (size + 2)-64-64-3; weight, target, gradient and two moments
        "algorithm.net_arch": 20
        * (
            3 * ((size + 1) * 64 + 65 * 64 + 65 * 2)
            + (3 * (size + 2) + 1) * 64 + 65 * 64 + 65 * 3
        ),
        # owner (1) and nearness (8) of 72 directions, before and after a step, under two rules; observations
        "training.n_worlds": 5 * (4 * 9 * 72 + 8 * 3 * size),
    }  # fmt: skip


def test_the_buffer_of_a_training_is_what_was_counted() -> None:
    config = tiny()
    with_buffer = build_model(config, build_vec_env(config, 4), 0).replay_buffer
    assert with_buffer is not None
    arrays = [getattr(with_buffer, name) for name in REPLAY]
    assert 2 * sum(array.nbytes for array in arrays) == memory_needed(config)["algorithm.buffer_world_steps"]


@pytest.mark.parametrize(
    ("key", "override"),
    [
        ("algorithm.buffer_world_steps", "training.world_steps=10000000000"),
        ("training.n_worlds", "training.n_worlds=65536"),
        ("algorithm.batch_size", "algorithm.batch_size=1048576"),
    ],
)
def test_the_key_that_asks_for_most_is_named_with_the_figures(key: str, override: str) -> None:
    overrides = ["algorithm.buffer_world_steps=10000000000", "training.world_steps=6000", override]
    config = load_config(overrides=overrides, fields={"n_directions": 4096})
    needed = memory_needed(config)
    total = sum(needed.values())
    check_memory(needed, available=total)
    with pytest.raises(ConfigError) as caught:
        check_memory(needed, available=total - 1)
    figures = [f"{size / 1e9:.1f} GB" for size in (needed[key], total, total - 1)]
    assert str(caught.value) == (
        f"{key}: needs {figures[0]} of memory, of {figures[1]} in all, but this machine has {figures[2]}"
    )


@pytest.mark.parametrize(("text", "limit"), [("5000000\n", 5_000_000), ("max\n", None), ("9" * 30, None), ("", None)])
def test_a_containers_memory_is_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, limit: int | None
) -> None:
    monkeypatch.setattr(memory, "CONTAINER_LIMIT", tmp_path / "memory.max")
    machine = available_memory()
    assert machine > 1e8
    (tmp_path / "memory.max").write_text(text)
    assert available_memory() == (machine if limit is None else limit)
