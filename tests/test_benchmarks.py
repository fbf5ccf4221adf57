"""The benchmarks run and write what they promise; nothing here looks at a time."""

import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_encircle.experiments.metrics import student_interval

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"

RATES = {
    "core_b256",
    "core_b1",
    "vec_env_b256",
    "parallel_env",
    "mpe2_parallel",
    "mpe2_supersuit",
    "training_loop",
}
UPDATES = {"maddpg_update_ms", "maddpg_update_shared_ms", "gemm_gflops"}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    return load("run", monkeypatch)


@pytest.fixture
def spread(monkeypatch: pytest.MonkeyPatch) -> Any:
    module = load("simple_spread", monkeypatch)
    monkeypatch.setattr(module, "COMMON", module.COMMON | {"learning_starts": 0, "buffer_size": 3_000})
    return module


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.delitem(sys.modules, name, raising=False)
    return import_module(name)


def test_every_row_is_a_finite_positive_number(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "CHUNK", 30)  # two make a round of ours, each more than one of MPE2's
    rates = bench.measure_rates(seconds=0.0, repeats=1, n_worlds=4, buffer_world_steps=100)
    updates = bench.measure_updates(repeats=2, buffer_world_steps=1_000)
    assert set(rates) == RATES
    assert set(updates) == UPDATES
    assert {len(samples) for samples in rates.values()} == {1}
    assert {len(samples) for samples in updates.values()} == {2}

    monkeypatch.setattr(bench, "measure_rates", lambda *_: rates)
    monkeypatch.setattr(bench, "measure_updates", lambda *_: updates)
    monkeypatch.setattr(sys, "argv", ["run.py", "--out", str(tmp_path / "results.json")])
    bench.main()

    results = json.loads((tmp_path / "results.json").read_text())
    numbers = RATES | UPDATES | {"maddpg_update_gemm_fraction"}
    assert set(results) == numbers | {"machine", "versions", "git_commit"}
    assert all(0 < results[name] < np.inf for name in numbers)
    assert {"numpy", "torch", "mpe2", "supersuit"} <= set(results["versions"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in [*numbers, *bench.AIMS])


def test_the_training_loop_makes_one_update_per_100_world_steps(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    models = []
    build = bench._model_with_memory

    def build_and_tell(*args: Any, **kwargs: Any) -> Any:
        models.append(build(*args, **kwargs))
        return models[0]

    monkeypatch.setattr(bench, "_model_with_memory", build_and_tell)
    play = bench.training_loop(n_worlds=8, buffer_world_steps=200)
    (model,) = models
    play()
    before = model._n_updates, model.num_timesteps
    assert play() == 25 * 8
    assert model.num_timesteps - before[1] == 25 * 8 * 3
    assert model._n_updates - before[0] == 2


def test_an_update_has_the_operations_of_its_matrix_products(bench: Any) -> None:
    assert bench.update_flop() / 1e6 == pytest.approx(338.17, abs=0.005)
    # By hand for n = o = u = h = b = 1. The actor's three products have 2 operations each, 6 together; the critic reads
    # two numbers, 4 + 2 + 2 = 8. The targets take 6 + 8; learning takes the critic 3 * 8 - 4, the actor 3 * 6 - 2 and,
    # through the critic, 2 * 8 - 4 + 2.
    assert bench.update_flop(n=1, o=1, u=1, h=1, b=1) == 14 + 20 + 16 + 14


def test_medians_and_the_share_of_the_gemm_rate(bench: Any) -> None:
    samples = {"maddpg_update_ms": [1.0, 2.0, 90.0], "gemm_gflops": [300.0, 338.16576, 1.0]}
    summary = bench.summarise(samples)
    assert summary["maddpg_update_ms"] == 2.0
    # 338.16576e6 operations in 2 ms are 169 of 300 GFLOP/s
    assert summary["maddpg_update_gemm_fraction"] == pytest.approx(169.08288 / 300.0)


def test_simple_spread_trains_both_with_the_same_steps_and_updates(spread: Any, tmp_path: Path) -> None:
    out = tmp_path / "spread.json"
    result = spread.run(world_steps=8, seeds=[0, 1], rounds=3, out=out)
    spread.print_results(result)
    assert [(r["algorithm"], r["seed"]) for r in result["runs"]] == [
        ("maddpg", 0),
        ("td3", 0),
        ("maddpg", 1),
        ("td3", 1),
    ]
    assert {(r["world_steps"], r["updates"]) for r in result["runs"]} == {(8, 2)}
    assert all(len(r["returns"]) == 3 and np.isfinite(r["returns"]).all() for r in result["runs"])
    assert json.loads(out.read_text()) == result
    assert {"maddpg - random", "td3 - random", "maddpg - td3"} < set(result["comparisons"])


def test_simple_spread_keeps_what_is_finished(spread: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "spread.json"
    trained: list[tuple[str, int]] = []

    def train(algorithm: str, seed: int, world_steps: int, rounds: int) -> dict[str, Any]:
        if len(trained) == 3:
            raise KeyboardInterrupt
        trained.append((algorithm, seed))
        return {"algorithm": algorithm, "seed": seed, "returns": [float(seed)] * rounds}

    monkeypatch.setattr(spread, "train", train)
    with pytest.raises(KeyboardInterrupt):
        spread.run(24, [0, 1], 2, out)
    trained.clear()
    result = spread.run(24, [0, 1], 2, out)
    assert trained == [("td3", 1)]
    assert len(result["runs"]) == 4

    with pytest.raises(SystemExit, match="other settings"):
        spread.run(32, [0, 1], 2, out)


def test_the_same_actions_bring_the_same_returns(spread: Any) -> None:
    assert np.array_equal(spread.play_randomly(3), spread.play_randomly(3))
    assert len(set(spread.play_randomly(3))) == 3


def test_a_difference_has_the_wider_of_both_intervals(spread: Any) -> None:
    # Three seeds that agree in the mean, rounds that do not: the interval is that of the rounds
    agreeing = spread.difference([[1.0, 3.0], [1.0, 3.0], [1.0, 3.0]], [[0.0, 0.0]])
    assert agreeing["difference"] == 2.0
    assert agreeing["interval"] == pytest.approx(student_interval([1.0, 3.0]), abs=1e-3)
    # Rounds that agree, seeds that do not: that of the seeds
    spreading = spread.difference([[1.0, 1.0], [2.0, 2.0], [6.0, 6.0]], [[0.0, 0.0]])
    assert spreading["interval"] == pytest.approx(student_interval([1.0, 2.0, 6.0]), abs=1e-3)


def test_the_cost_of_event_files_is_that_of_pairs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = load("event_files", monkeypatch)
    assert min(bench.seconds(5_100, logged) for logged in (False, True)) > 0.0
    taken = {False: iter([10.0, 10.0, 20.0]), True: iter([10.1, 10.5, 20.4])}  # + 1 %, 5 %, 2 %
    monkeypatch.setattr(bench, "take_turns", lambda tasks: [next(taken[logged]) for _, logged in tasks])
    monkeypatch.setattr(sys, "argv", ["event_files.py", "--world-steps", "640", "--pairs", "3"])
    bench.main()
    assert capsys.readouterr().out == "2.0 % (1.0, 2.0, 5.0)\n"
