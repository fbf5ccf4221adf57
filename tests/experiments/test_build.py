"""What users build from names: worlds to train in, a model, and a trained policy read back."""

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
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import VecMonitor
from tiny_runs import IN_SEVERAL_SETTINGS, copy_of_finished, finished, tiny

from marl_encircle import files
from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.experiments.build import (
    NoiseSchedule,
    build_model,
    build_policy,
    build_vec_env,
    load_policy,
    load_run,
    make_vec_env,
    policy_bytes,
)
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.records import config_hash
from marl_encircle.experiments.sections import Schedule
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG, MATD3

# worlds


def curriculum(venv: Any) -> CurriculumVecEnv:
    inner = venv.venv
    assert isinstance(inner, CurriculumVecEnv)
    return inner


@pytest.mark.parametrize(("engine", "kind"), [("native", EncirclementVecEnv), ("supersuit", SuperSuitVecEnv)])
def test_worlds_are_slots_under_a_monitor_with_the_settings_curriculum(engine: Any, kind: type[Any]) -> None:
    venv = make_vec_env("model_b", 5, engine=engine, pursuers=4, obstacles=2, speed_ratio=1.2)
    assert isinstance(venv, VecMonitor)
    assert isinstance(venv.venv, CurriculumVecEnv)
    assert isinstance(venv.venv.venv, kind)
    assert (venv.num_envs, venv.n_agents) == (20, 4)
    assert venv.venv.difficulty == pytest.approx({"safety_distance": 0.3})
    hard = make_vec_env(n_worlds=2, engine=engine, pursuers=2)
    assert curriculum(hard).difficulty == pytest.approx({"obstacle_radius": 0.45, "speed_ratio": 1.1})


def test_without_a_curriculum_worlds_are_final_from_the_start() -> None:
    venv = make_vec_env(n_worlds=2, curriculum=False, pursuers=2)
    venv.reset()
    assert curriculum(venv).difficulty == {}
    state = venv.get_attr("simulator")[0].state
    assert (state.safety_distance == 0.11).all()
    assert (state.obstacle_radius == 0.2).all()


def test_equal_seeds_make_equal_worlds_and_none_makes_others() -> None:
    def first(seed: int | None, engine: Any = "native") -> np.ndarray:
        observations = make_vec_env(n_worlds=3, seed=seed, engine=engine).reset()
        assert isinstance(observations, np.ndarray)
        return observations

    assert np.array_equal(first(3), first(3))
    assert np.array_equal(first(3), first(3, "supersuit"))
    assert not np.array_equal(first(3), first(4))
    assert not np.array_equal(first(None), first(None))


def test_a_scenario_is_taken_as_it_is() -> None:
    scenario = Scenario(pursuers=4, obstacles=2, observe_extras=("stage",))
    assert make_vec_env(n_worlds=1, scenario=scenario).get_attr("scenario") == [scenario] * 4
    assert make_vec_env(n_worlds=1, scenario=scenario, pursuers=2).num_envs == 2


@pytest.mark.parametrize("ramp", ["obstacle_radius={start: 0.9, world_steps: 9}", "speed_ratio.start=0.5"])
def test_only_who_wants_the_curriculum_needs_one_that_can_be_played(ramp: str) -> None:
    how: dict[str, Any] = {"n_worlds": 1, "pursuers": 2, "overrides": [f"training.curriculum.{ramp}"]}
    assert curriculum(make_vec_env(curriculum=False, **how)).difficulty == {}
    with pytest.raises(ConfigError, match=r"^training\.curriculum\.\w+\.start: scenario"):
        make_vec_env(**how)


def test_a_users_file_and_overrides_reach_the_worlds(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("base: ours\nterms: {time: 3.0, contraction: null}\n")
    for given in (path, str(path)):
        venv = make_vec_env(given, 2, overrides=["reward.scale=0.5"], max_cycles=7)
        reward = venv.get_attr("reward")[0]
        assert (reward.scale, reward.terms["time"], venv.get_attr("scenario")[0].max_cycles) == (0.5, 3.0, 7)
        assert "contraction" not in reward.active


def test_an_environment_needs_no_memory_for_a_replay_buffer() -> None:
    assert make_vec_env(n_worlds=1, pursuers=64, pursuer_radius=0.01, obstacles=0).num_envs == 64
    assert make_vec_env(n_worlds=1, overrides=["training.world_steps=10000000000",
                                               "algorithm.buffer_world_steps=10000000000"]).num_envs == 3  # fmt: skip


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"overrides": "scenario.damping=0.3"}, "overrides must be a list of section.key=value; got 'scenario."),
        ({"profile": None}, "profile None: unknown profile; known: full, smoke"),
        ({"scenario": 3}, "scenario must be a name or the path of a YAML file; got 3"),
        ({"pursuer": 3}, "scenario.pursuer: unknown key; did you mean pursuers?"),
        ({"pursuers": "3"}, "scenario.pursuers must be an integer"),
        ({"reward": "our"}, "did you mean ours?"),
        ({"overrides": ["training.n_world=3"]}, "did you mean n_worlds?"),
        ({"engine": "nativ"}, "engine 'nativ': unknown engine; did you mean native?"),
        ({"engine": None}, "engine None: unknown engine; known: native, supersuit"),
        ({"n_envs": 8}, "n_envs counts slots, one for each pursuer of each world: give n_worlds"),
        ({"n_worlds": "8"}, "n_worlds must be an integer of at least 1; got '8'"),
        ({"n_worlds": 0}, "n_worlds must be an integer of at least 1; got 0"),
        ({"n_worlds": 2.0}, "n_worlds must be an integer of at least 1; got 2.0"),
        (
            {"n_worlds": 5, "overrides": IN_SEVERAL_SETTINGS},
            "n_worlds must be a multiple of the 2 settings of training.settings; got 5",
        ),
        ({"seed": -1}, "seed must be an integer of at least 0; got -1"),
        ({"seed": "0"}, "seed must be an integer of at least 0; got '0'"),
    ],
)
def test_a_bad_argument_is_told_by_its_name(how: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_vec_env(**how)
    assert reason in str(caught.value)


def test_plain_maddpg_learns_in_these_worlds() -> None:
    venv = make_vec_env(n_worlds=4, seed=0)
    MADDPG("MlpPolicy", venv, learning_starts=60, batch_size=16, seed=0).learn(240)
    assert curriculum(venv).world_steps == 80


# models


def test_world_steps_become_the_pursuers_steps() -> None:
    config = load_config(fields={"pursuers": 4}, overrides=["algorithm.buffer_world_steps=1000"])
    model = build_model(config, build_vec_env(config, 8), 3)
    assert model.learning_starts == 4 * 5000
    assert model.buffer_size == 4000
    assert model.replay_buffer is not None
    assert model.replay_buffer.observations.shape[:2] == (125, 32)  # 125 steps of 8 worlds are 1,000 world steps
    assert (model.n_agents, model.gamma, model.tau, model.batch_size, model.seed) == (4, 0.9, 0.01, 1024, 3)
    assert (model.critic_kind, model.policy_delay, model.max_grad_norm) == ("shared", 2, None)
    assert str(model.device) == "cpu"


def test_training_frequency_and_gradient_steps_are_sb3s() -> None:
    config = tiny(overrides=["algorithm.train_freq=2", "algorithm.gradient_steps=3"])
    model = build_model(config, build_vec_env(config, 4), 0)
    assert isinstance(model.train_freq, TrainFreq)
    assert (model.train_freq.frequency, model.gradient_steps) == (2, 3)


def test_a_buffer_is_no_larger_than_its_training() -> None:
    config = tiny(overrides=["algorithm.buffer_world_steps=1000000"])
    assert build_model(config, build_vec_env(config, 4), 0).buffer_size == 3 * 404


def test_the_noise_follows_the_world_steps() -> None:
    noise = NoiseSchedule(Schedule(start=0.4, end=0.1, world_steps=500), world_steps=2000)
    assert noise(1.0) == pytest.approx(0.4)
    assert noise(1 - 250 / 2000) == pytest.approx(0.25)
    assert noise(1 - 500 / 2000) == noise(0.0) == noise(-0.1) == 0.1


def test_the_learning_rate_falls_over_the_whole_training() -> None:
    for end, halfway in ("null", 2e-3), ("1e-3", 1.5e-3):
        config = tiny(overrides=["algorithm.learning_rate=2e-3", f"algorithm.learning_rate_end={end}"])
        assert build_model(config, build_vec_env(config, 2), 0).lr_schedule(0.5) == pytest.approx(halfway)


def test_the_rewards_of_several_steps_are_summed_where_a_configuration_says_so() -> None:
    config = tiny(overrides=["algorithm.n_steps=3", "algorithm.gamma=0.8"])
    model = build_model(config, build_vec_env(config, 2), 0)
    assert model.replay_buffer is not None
    assert (model.n_steps, model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 3, 0.8)


def test_the_registry_has_what_a_configuration_may_name() -> None:
    assert ALGORITHMS == {"maddpg": MADDPG, "matd3": MATD3}
    for name, algorithm in ALGORITHMS.items():
        config = load_config(algorithm=name, profile="smoke")
        assert type(build_model(config, build_vec_env(config, 2), 0)) is algorithm


# policies


def test_a_trained_policy_comes_back_and_acts() -> None:
    policy = load_policy(finished())
    size = list(layout(tiny().scenario).values())[-1].stop
    observations = np.random.default_rng(0).uniform(-1, 1, (6, size)).astype(np.float32)
    actions, _ = policy.predict(observations, deterministic=True)
    assert np.asarray(actions).shape == (6, 2)
    assert np.abs(actions).max() <= 1
    assert policy_bytes(policy) == (finished() / "policy.safetensors").read_bytes()
    assert not policy.training


@pytest.mark.parametrize("algorithm", ["maddpg", "matd3"])
@pytest.mark.parametrize("critic", ["shared", "per_agent"])
def test_equal_weights_are_equal_bytes_whatever_the_algorithm(algorithm: str, critic: str) -> None:
    config = load_config(algorithm=algorithm, profile="smoke", overrides=[f"algorithm.critic={critic}"])
    one, other = (policy_bytes(build_model(config, build_vec_env(config, 2), 5).policy) for _ in range(2))
    assert one == other


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


def test_critics_that_are_not_read_cost_next_to_nothing() -> None:
    """Whatever a configuration says: 64 critics of this size would have 300 MB of weights."""
    large = tiny(pursuers=64, obstacles=0, pursuer_radius=0.01, overrides=["algorithm.net_arch=[100]"])
    policy = build_policy(large)
    critics = sum(weights.numel() for weights in policy.critic.parameters())
    assert critics < sum(weights.numel() for weights in policy.actor.parameters())


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
