"""MADDPG and MATD3 learn in somebody else's environment; what they learnt is kept and can be loaded."""

import json
from pathlib import Path
from typing import Any, get_args

import imitation
import numpy as np
import pytest

from marl_encircle import files
from marl_encircle.experiments import play_with as module
from marl_encircle.experiments.choices import AlgorithmName
from marl_encircle.experiments.divergence import Diverged
from marl_encircle.experiments.play_with import FIRST_ROUND, Played, load_played, play_with, save_policy
from marl_encircle.experiments.worlds import find_world
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG


def played(algorithm: AlgorithmName = "maddpg", world_steps: int = 200, **more: Any) -> Played:
    return play_with("imitation", find_world("imitation", {}), algorithm, world_steps, **{"rounds": 20, **more})


@pytest.mark.parametrize("algorithm", ["maddpg", "matd3"])
def test_agents_learn_to_do_what_they_see(algorithm: AlgorithmName) -> None:
    result = played(algorithm, world_steps=2000)
    summary = result.summary()
    # Chance is 2/3 away on average: the mean distance of two uniform numbers in [-1, 1]
    assert summary["random"][0] == pytest.approx(-5 * 2 / 3, abs=0.4)
    assert summary["trained"][0] > -0.5  # a policy that does nothing is 1/2 away on average: -2.5
    mean, interval = summary["difference"]
    assert interval is not None
    assert 2 < interval.low < mean < interval.high
    assert mean == pytest.approx(summary["trained"][0] - summary["random"][0])
    assert (result.agents, result.world_steps) == (("left", "right"), 2000)


def test_a_training_is_repeated_by_its_seed() -> None:
    first, same, other = played(seed=1), played(seed=1), played(seed=2)
    assert first.returns.tolist() == same.returns.tolist()
    assert first.returns.tolist() != other.returns.tolist()
    assert first.random.tolist() == same.random.tolist() == other.random.tolist()


def test_policy_and_chance_play_the_same_rounds_which_nobody_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int | None] = []
    reset = imitation.Imitation.reset

    def spying(self: imitation.Imitation, seed: int | None = None, options: Any = None) -> Any:
        seeds.append(seed)
        return reset(self, seed, options)

    monkeypatch.setattr(imitation.Imitation, "reset", spying)
    played(rounds=5)
    rounds = list(range(FIRST_ROUND, FIRST_ROUND + 5))
    assert seeds[-10:] == rounds + rounds
    assert not set(rounds) & set(seeds[:-10])


def test_the_return_is_the_mean_of_the_agents() -> None:
    returns = module.play_returns("imitation", imitation.Imitation, lambda seen: seen + np.float32([[0.1], [0.3]]), 3)
    np.testing.assert_allclose(returns, -5 * 0.2, atol=1e-5)


def test_rounds_that_no_longer_end_together_or_at_all_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ROUND", 50)
    for unfit, reason in (("staggered", "only left went on; all agents must end together"), ("endless", "not ended")):
        with pytest.raises(ConfigError, match=f"^imitation: .*{reason}"):
            module.play_returns("imitation", lambda unfit=unfit: imitation.Imitation(unfit=unfit), lambda seen: seen, 1)
    with pytest.raises(ConfigError, match=r"^imitation: world 0: .* ended, .* did not"):
        play_with("imitation", lambda: imitation.Imitation(unfit="staggered"), world_steps=200)


def test_every_algorithm_can_be_chosen_by_its_name() -> None:
    assert get_args(AlgorithmName) == tuple(ALGORITHMS)


def test_a_training_that_diverges_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "fault", lambda _: "train/critic_loss is nan")
    with pytest.raises(Diverged, match="diverged: train/critic_loss is nan after 0 agent steps; try another --seed"):
        played()


def test_the_last_updates_of_a_training_are_looked_at_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def at_the_end(model: MADDPG) -> str | None:
        return "the actor has weights that are not finite" if model.num_timesteps >= model._total_timesteps else None

    monkeypatch.setattr(module, "fault", at_the_end)
    with pytest.raises(Diverged, match=r"not finite after \d+ agent steps"):
        played()


def test_progress_is_the_return_of_the_latest_rounds(capsys: pytest.CaptureFixture[str]) -> None:
    played(world_steps=400, progress_bar=True)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[-1].startswith("400 of 400 world steps, ")
    # Five steps a round, each at most 2 from what is seen
    assert -10 < float(lines[-1].rpartition("return ")[2]) < 0


# saved


@pytest.fixture(scope="module")
def result() -> Played:
    return played()


def test_a_saved_policy_acts_as_the_trained_one(result: Played, tmp_path: Path) -> None:
    save_policy(tmp_path, result, {"environment": "imitation"})
    policy = load_played(tmp_path)
    observations = np.random.default_rng(0).uniform(-1, 1, (20, 1)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(observations)[0], result.policy.predict(observations)[0])
    assert policy.agents == ("left", "right")
    about = json.loads((tmp_path / "policy.json").read_text())
    assert about["environment"] == "imitation"
    assert about["returns"] == {name: mean for name, (mean, _) in result.summary().items()}


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("policy.safetensors", b"x", "policy.safetensors: changed since it was written"),
        ("policy.safetensors", None, "policy.safetensors: the file is missing"),
        ("policy.json", None, "policy.json: the file is missing"),
        ("policy.json", b"{", "policy.json: does not describe a policy"),
        ("policy.json", b"[]", "policy.json: does not describe a policy"),
        ("policy.json", b"{}", "policy.json: does not describe a policy: 'action_low'"),
    ],
)
def test_a_damaged_policy_is_refused(
    result: Played, tmp_path: Path, name: str, content: bytes | None, reason: str
) -> None:
    save_policy(tmp_path, result, {})
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(files.DamagedFileError, match=reason):
        load_played(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("net_arch", [4000, 4000]),
        ("net_arch", [1] * 9),
        ("observation_shape", [10**13]),
        ("observation_shape", [10**5, 10**5]),
        ("agents", ["a"] * 20_000),
    ],
)
def test_networks_that_nobody_can_have_saved_are_refused_before_they_are_built(
    result: Played, tmp_path: Path, key: str, value: Any
) -> None:
    save_policy(tmp_path, result, {})
    about = json.loads((tmp_path / "policy.json").read_text())
    files.write_json(tmp_path / "policy.json", {**about, key: value})
    with pytest.raises(files.DamagedFileError, match=r"policy\.json: .* its networks would have \d+ weights"):
        load_played(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"), [("net_arch", [8]), ("observation_shape", [2]), ("agents", ["one"]), ("action_high", [2.0, 2.0])]
)
def test_a_description_of_another_policy_is_refused(result: Played, tmp_path: Path, key: str, value: Any) -> None:
    save_policy(tmp_path, result, {})
    about = json.loads((tmp_path / "policy.json").read_text())
    files.write_json(tmp_path / "policy.json", {**about, key: value})
    with pytest.raises(files.DamagedFileError):
        load_played(tmp_path)
