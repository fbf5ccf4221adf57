"""Exported actors act as the policy does, say whose they are, and are not written where they do otherwise."""

import importlib
import json
import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch as th
from tiny_runs import copy_of_finished, everything_in, finished

from marl_encircle.core.observations import bounds
from marl_encircle.experiments import export
from marl_encircle.experiments.choices import ExportFormat
from marl_encircle.experiments.export import Array, ParityError, export_run
from marl_encircle.experiments.loading import load_run
from marl_encircle.experiments.records import read_record
from marl_encircle.experiments.yaml_files import ConfigError

FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[ExportFormat, export.Export]:
    pytest.importorskip("onnxruntime")
    folder = tmp_path_factory.mktemp("exported")
    return {to: export_run(finished(), to, folder / f"actors.{to}") for to in FORMATS}


def act(to: ExportFormat, path: Path, observations: Array) -> Array:
    """Use a file as somebody does who has nothing of this package."""
    if to == "onnx":
        session = importlib.import_module("onnxruntime").InferenceSession(path)
        actions: Array = session.run(["actions"], {"observations": observations})[0]
        return actions
    if to == "torchscript":
        with pytest.warns(DeprecationWarning, match="torch.jit.load"):
            module: Any = th.jit.load(path)  # type: ignore[no-untyped-call]
    else:
        module = th.export.load(path).module()
    return np.asarray(module(th.from_numpy(observations)).detach())


@pytest.mark.parametrize("to", FORMATS)
def test_the_file_acts_as_predict_in_any_number_of_worlds(
    exported: dict[ExportFormat, export.Export], to: ExportFormat
) -> None:
    policy, config, _ = load_run(finished())
    low, high = bounds(config.scenario)
    rng = np.random.default_rng(3)
    for worlds in (1, 2, 77):
        observations = rng.uniform(low, high, (worlds, 3, len(low))).astype(np.float32)
        expected, _ = policy.predict(observations.reshape(-1, len(low)))
        actions = act(to, exported[to].path, observations)
        assert actions.shape == (worlds, 3, 2)
        np.testing.assert_allclose(actions.reshape(-1, 2), np.asarray(expected), atol=1e-5)
        assert np.abs(actions).max() <= 1.0
    assert max(exported[to].random, exported[to].played) <= 1e-5


@pytest.mark.parametrize("to", FORMATS)
def test_the_file_says_whose_the_actors_are(exported: dict[ExportFormat, export.Export], to: ExportFormat) -> None:
    path = exported[to].path
    if to == "onnx":
        texts = {entry.key: entry.value for entry in importlib.import_module("onnx").load(path).metadata_props}
        as_json = ("setting", "agents", "observation_layout", "train_seed")
        found = texts | {key: json.loads(texts[key]) for key in as_json}
    else:
        inside = {"metadata.json": ""}
        if to == "torchscript":
            with pytest.warns(DeprecationWarning, match="torch.jit.load"):
                th.jit.load(path, _extra_files=inside)  # type: ignore[no-untyped-call]
        else:
            th.export.load(path, extra_files=inside)
        found = json.loads(inside["metadata.json"])
    record = read_record(finished())
    assert found == exported[to].description
    assert found["setting"] == {"speed_ratio": 1.1, "pursuers": 3, "obstacles": 1, "scene": "random"}
    assert found["agents"] == ["pursuer_0", "pursuer_1", "pursuer_2"]
    assert found["observation_layout"]["target"] == [4, 6]
    assert (found["method"], found["train_seed"], found["status"]) == ("ours", 0, "finished")
    assert found["config_hash"] == record["config_hash"]
    assert found["policy_sha256"] == record["sha256"]["policy.safetensors"]


@pytest.mark.parametrize("to", FORMATS)
def test_the_file_tells_nothing_of_the_machine(exported: dict[ExportFormat, export.Export], to: ExportFormat) -> None:
    content = exported[to].path.read_bytes()
    assert str(Path(export.__file__).parents[1]).encode() not in content
    assert str(finished()).encode() not in content


@pytest.mark.parametrize("to", ["torch-export", "onnx"])
def test_equal_runs_give_equal_files(
    exported: dict[ExportFormat, export.Export], tmp_path: Path, to: ExportFormat
) -> None:
    again = export_run(copy_of_finished(tmp_path), to, tmp_path / "again")
    assert again.path.read_bytes() == exported[to].path.read_bytes()


@pytest.mark.parametrize("to", FORMATS)
def test_actors_that_act_otherwise_are_not_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, to: ExportFormat
) -> None:
    pytest.importorskip("onnxruntime")
    forward = export.Actors.forward
    monkeypatch.setattr(export.Actors, "forward", lambda self, x: forward(self, x) * 0.9999)
    out = tmp_path / "actors"
    out.write_text("the former one")
    with pytest.raises(
        ParityError, match=r"not written: an action differs from predict by \d.\de-05; allowed is 1e-05"
    ):
        export_run(finished(), to, out)
    assert (everything_in(tmp_path), out.read_text()) == (["actors"], "the former one")


def test_actions_that_are_no_numbers_are_not_the_policys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(export, "difference", lambda *_: float("nan"))
    with pytest.raises(ParityError):
        export_run(finished(), "torchscript", tmp_path / "actors.pt")
    assert everything_in(tmp_path) == []


def test_the_observations_compared_are_random_ones_and_those_of_rounds() -> None:
    policy, config, _ = load_run(finished())
    low, high = bounds(config.scenario)
    random, played = export.random_observations(policy), export.played_observations(policy, config)
    assert random.shape == (1000, 3, len(low))
    assert played.shape == (16 * config.scenario.max_cycles, 3, len(low))
    for observations in (random, played):
        assert (low <= observations).all()
        assert (observations <= high).all()
        assert len(np.unique(observations.reshape(-1, len(low)), axis=0)) == 3 * len(observations)


def test_a_file_has_a_name_of_its_own_in_the_working_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert export_run(finished(), "torchscript").path == Path("ours_ratio1.1_n3_m1_random_seed0.pt")
    assert everything_in(tmp_path) == ["ours_ratio1.1_n3_m1_random_seed0.pt"]


def test_onnx_without_its_libraries_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    pattern = r"ONNX needs onnx: pip install 'marl-encircle\[export\]'"
    with pytest.raises(ConfigError, match=pattern):
        export_run(finished(), "onnx", tmp_path / "actors.onnx")
    assert everything_in(tmp_path) == []
