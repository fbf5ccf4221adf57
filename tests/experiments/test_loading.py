"""What was trained comes back from its folder or a trusted model, whole or not at all."""

import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch as th
from tiny_runs import copy_of_finished, finished, tiny

from marl_encircle import files
from marl_encircle.core.observations import layout
from marl_encircle.envs import encirclement_v0
from marl_encircle.experiments.build import build_model, build_vec_env, policy_bytes
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.loading import load_policy, load_run
from marl_encircle.experiments.records import config_hash


def test_a_trained_policy_comes_back_and_acts() -> None:
    policy = load_policy(finished())
    size = list(layout(tiny().scenario).values())[-1].stop
    observations = np.random.default_rng(0).uniform(-1, 1, (6, size)).astype(np.float32)
    actions, _ = policy.predict(observations, deterministic=True)
    assert np.asarray(actions).shape == (6, 2)
    assert np.abs(actions).max() <= 1
    assert policy_bytes(policy) == (finished() / "policy.safetensors").read_bytes()
    assert not policy.training


def edit_record(folder: Path, change: Callable[[dict[str, Any]], object], vouch: bool = True) -> None:
    record = json.loads((folder / "run.json").read_text())
    change(record)
    if vouch and "config" in record:
        record["config_hash"] = config_hash(record["config"])
    (folder / "run.json").write_text(json.dumps(record))


def rewrite_policy(folder: Path, change: Callable[[dict[str, th.Tensor]], object]) -> None:
    """Change the weights and vouch for them, as someone who means ill would."""
    path = folder / "policy.safetensors"
    tensors = safetensors.torch.load(path.read_bytes())
    change(tensors)
    path.write_bytes(safetensors.torch.save(tensors))
    edit_record(folder, lambda record: record["sha256"].update({path.name: files.sha256_bytes(path.read_bytes())}))


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def nested(depth: int) -> dict[str, Any]:
    return {"weight": nested(depth - 1) if depth else 1.0}


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (lambda f: f.rename(f.with_name("gone")), "run.json: the file is missing"),
    "no record": (lambda f: (f / "run.json").unlink(), "run.json: the file is missing"),
    "empty record": (write("run.json", b""), "run.json: not valid JSON"),
    "half a record": (
        lambda f: write("run.json", (f / "run.json").read_bytes()[:900])(f), "run.json: not valid JSON"),
    "bytes": (write("run.json", b"\xff\xfe"), "run.json: not valid JSON"),
    "a list": (write("run.json", b"[1]"), "run.json: not a JSON object"),
    "nested": (write("run.json", b"[" * 100_000), "run.json: not valid JSON"),
    "large": (write("run.json", b" " * (1 << 20) + b"{}"), "run.json: larger than"),
    "no config": (lambda f: edit_record(f, lambda r: r.pop("config")), "run.json: missing config"),
    "config a list": (lambda f: edit_record(f, lambda r: r.update(config=[1])), "run.json: config is [1], not"),
    "config null": (lambda f: edit_record(f, lambda r: r.update(config=None)), "run.json: config is None"),
    "scenario a list": (lambda f: edit_record(f, lambda r: r["config"].update(scenario=[1])), "config.scenario is"),
    "no scenario": (lambda f: edit_record(f, lambda r: r["config"].pop("scenario")), "config.scenario is None"),
    "an edit": (lambda f: edit_record(f, lambda r: r["config"]["reward"].update(scale=0.5), vouch=False),
        "run.json: config has changed since it was written"),
    "no seed": (lambda f: edit_record(f, lambda r: r.pop("seed")), "run.json: missing seed"),
    "seed null": (lambda f: edit_record(f, lambda r: r.update(seed=None)), "run.json: seed is None, not"),
    "a status": (lambda f: edit_record(f, lambda r: r.update(status="x")), "run.json: status is 'x', not"),
    "unknown key": (lambda f: edit_record(f, lambda r: r["config"]["reward"].update(x=1)), "reward.x: unknown key"),
    "terms deep down": (
        lambda f: edit_record(f, lambda r: r["config"]["reward"]["terms"].update(time=nested(600))),
        "run.json: config: "),
    "nan": (lambda f: edit_record(f, lambda r: r["config"]["reward"].update(scale=math.nan)), "reward.scale: "),
    "huge": (lambda f: edit_record(f, lambda r: r["config"]["algorithm"].update(net_arch=[4096] * 8)), "net_arch: the"),
    "no hashes": (lambda f: edit_record(f, lambda r: r.pop("sha256")), "run.json: missing sha256"),
    "hashes a list": (lambda f: edit_record(f, lambda r: r.update(sha256=[])), "run.json: sha256 is [], not"),
    "no hash": (
        lambda f: edit_record(f, lambda r: r["sha256"].pop("policy.safetensors")),
        "run.json: sha256 has no policy.safetensors"),
    "hash a number": (
        lambda f: edit_record(f, lambda r: r["sha256"].update({"policy.safetensors": 3})), "run.json: sha256 is"),
    "another hash": (
        lambda f: edit_record(f, lambda r: r["sha256"].update({"policy.safetensors": "0" * 64})),
        "policy.safetensors: changed since it was written"),
    "many keys": (
        lambda f: edit_record(f, lambda r: r["config"]["reward"].update({str(i): 0 for i in range(9999)})),
        "reward.0: unknown key"),
    "no policy": (lambda f: (f / "policy.safetensors").unlink(), "policy.safetensors: the file is missing"),
    "other bytes": (write("policy.safetensors", b"x"), "policy.safetensors: changed since it was written"),
    "pickle": (lambda f: (write("policy.safetensors", b"\x80\x04N.")(f), edit_record(
        f, lambda r: r["sha256"].update({"policy.safetensors": files.sha256_bytes(b"\x80\x04N.")}))),
        "policy.safetensors: does not hold this policy's weights"),
    "large header": (lambda f: rewrite_policy(f, lambda t: t.update({str(i): th.ones(0) for i in range(2000)})),
        "its header is larger than"),
    "not finite": (lambda f: rewrite_policy(f, lambda t: next(iter(t.values())).fill_(math.nan)), "not finite"),
    "a name": (lambda f: rewrite_policy(f, lambda t: t.update(other=t.pop(next(iter(t))))), "does not hold"),
    "one more": (lambda f: rewrite_policy(f, lambda t: t.update(other=th.ones(1))), "does not hold"),
    "a shape": (lambda f: rewrite_policy(f, lambda t: t.update({k: v[..., :1].clone() for k, v in t.items()})),
        "does not hold"),
    "a type": (lambda f: rewrite_policy(f, lambda t: t.update({k: v.to(th.float64) for k, v in t.items()})),
        "policy.safetensors"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_run_is_refused_by_file_and_reason(tmp_path: Path, damage: str) -> None:
    folder = copy_of_finished(tmp_path)
    change, reason = DAMAGE[damage]
    change(folder)
    with pytest.raises(files.DamagedFileError) as caught:
        load_run(folder)
    assert reason in str(caught.value)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value)) < 700


@pytest.mark.parametrize("trusted", [False, True])
def test_a_folder_and_the_policy_in_it_are_one(trusted: bool) -> None:
    own = (finished() / "policy.safetensors").read_bytes()
    for what in (finished(), str(finished()), finished() / "policy.safetensors"):
        assert policy_bytes(load_policy(what, trusted=trusted)) == own


def test_a_policy_knows_whose_observation_is_whose() -> None:
    policy = load_policy(finished())
    env = encirclement_v0.parallel_env(tiny().scenario)
    observations, _ = env.reset(seed=3)
    steps = 0
    while env.agents:
        actions, _ = policy.predict(observations)
        slots, _ = policy.predict(np.stack(list(observations.values())))
        shuffled, _ = policy.predict({agent: observations[agent] for agent in reversed(env.agents)})
        assert isinstance(actions, dict)
        assert isinstance(shuffled, dict)
        for slot, agent in enumerate(env.agents):
            assert np.array_equal(actions[agent], slots[slot])
            assert np.array_equal(shuffled[agent], slots[slot])
        observations, *_ = env.step(actions)
        steps += 1
    assert 1 <= steps <= 20
    for others in ({}, {"pursuer_0": observations["pursuer_0"]}, dict(zip("abc", observations.values(), strict=True))):
        with pytest.raises(ValueError, match="observations of pursuer_0, pursuer_1, pursuer_2, but got"):
            policy.predict(others)


# models of Stable-Baselines3


@pytest.mark.parametrize("algorithm", ["maddpg", "matd3"])
def test_the_actors_of_a_trusted_zip_act_as_the_model_does(tmp_path: Path, algorithm: str) -> None:
    config = load_config(algorithm=algorithm, profile="smoke")
    model = build_model(config, build_vec_env(config, 2), 5)
    model.save(tmp_path / "model")
    policy = load_policy(tmp_path / "model.zip", trusted=True)
    observations = np.random.default_rng(0).uniform(-1, 1, (6, *model.observation_space.shape))  # type: ignore[misc]
    assert np.array_equal(policy.predict(observations)[0], model.predict(observations)[0])
    assert policy_bytes(policy) == policy_bytes(model.policy)
    assert not policy.training


def test_a_zip_is_not_read_unless_it_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(profile="smoke")
    build_model(config, build_vec_env(config, 2), 5).save(tmp_path / "model.zip")
    monkeypatch.chdir(tmp_path)
    for what in ("model.zip", "./model.zip", tmp_path / "model.zip"):
        with pytest.raises(files.DamagedFileError, match=r"model\.zip: a zip-file, which can run code .* trusted=True"):
            load_policy(what)


def test_a_trusted_zip_without_actors_is_refused(tmp_path: Path) -> None:
    config = load_config(profile="smoke")
    build_model(config, build_vec_env(config, 2), 5).save(tmp_path / "model.zip")
    whole = (tmp_path / "model.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", json.dumps({"n_agents": 3}))
    (tmp_path / "flipped.zip").write_bytes(bytes([*whole[:2000], whole[2000] ^ 1, *whole[2001:]]))
    (tmp_path / "cut.zip").write_bytes(whole[:-1000])
    for name, reason in (("other", "not a model of MADDPG"), ("flipped", "Error"), ("cut", "")):
        with pytest.raises(files.DamagedFileError, match=rf"{name}\.zip: holds no actors: .*{reason}"):
            load_policy(tmp_path / f"{name}.zip", trusted=True)
