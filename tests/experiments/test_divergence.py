"""The moment at which a training diverged can be looked at and lived again, from its file alone."""

import itertools
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from tiny_runs import IN_SEVERAL_SETTINGS, contents, everything_in, finished, tiny

from marl_encircle import files
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import checkpoint, divergence, train
from marl_encircle.experiments.divergence import DivergenceGuard, fault, load_moment
from marl_encircle.experiments.records import read_record
from marl_encircle.maddpg import MADDPG
from marl_encircle.maddpg.buffers import JointReplayBuffer

POISONED_AT = 40
OVERRIDES = {
    "maddpg": [],
    "matd3": ["algorithm.name=matd3"],
    "often": ["algorithm.gradient_steps=3"],
    "settings": IN_SEVERAL_SETTINGS,
}


def poison(monkeypatch: pytest.MonkeyPatch, value: float = np.nan) -> None:
    """Have one pursuer's reward be no number in that step of the worlds and from then on."""
    step_wait = CurriculumVecEnv.step_wait

    def poisoned(self: CurriculumVecEnv) -> Any:
        observations, rewards, dones, infos = step_wait(self)
        if self.world_steps >= POISONED_AT * 4:
            rewards = rewards.copy()
            rewards[1] = value
        return observations, rewards, dones, infos

    monkeypatch.setattr(CurriculumVecEnv, "step_wait", poisoned)


def diverged(monkeypatch: pytest.MonkeyPatch, out: Path, overrides: Any = (), **how: Any) -> Path:
    with monkeypatch.context() as patch:
        poison(patch)
        folder, _ = train.train(tiny(overrides=overrides), 0, "native", out, **how)
    assert read_record(folder)["status"] == "diverged"
    return folder


def weights(model: MADDPG) -> dict[str, bytes]:
    return {name: value.numpy().tobytes() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize("kind", OVERRIDES)
def test_a_poisoned_reward_ends_the_training_and_its_moment_can_be_repeated_bit_for_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    folder = diverged(monkeypatch, tmp_path, OVERRIDES[kind])
    moment = load_moment(folder)
    assert moment.reason == "train/critic_loss is nan"
    assert any(bool(batch.rewards.isnan().any()) for batch in moment.batches)
    assert len(moment.batches) == (3 if kind == "often" else 1)
    assert fault(moment.model) is None, "before the update all is well"
    before = weights(moment.model)
    assert moment.repeat() == moment.reason
    assert weights(moment.model) != before
    assert moment.model._n_updates == read_record(folder)["updates"]
    last = safetensors.torch.load((folder / "policy.safetensors").read_bytes())
    assert {name: tensor.numpy().tobytes() for name, tensor in last.items()} == {
        name: tensor.numpy().tobytes() for name, tensor in moment.model.policy.actor_state_dict().items()
    }


def test_the_batches_of_the_moment_are_those_that_were_learnt_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[ReplayBufferSamples] = []
    sample = JointReplayBuffer.sample

    def noting(self: JointReplayBuffer, *arguments: Any, **options: Any) -> ReplayBufferSamples:
        drawn.append(sample(self, *arguments, **options))
        return drawn[-1]

    with monkeypatch.context() as patch:
        patch.setattr(JointReplayBuffer, "sample", noting)
        folder = diverged(patch, tmp_path)
    (kept,) = load_moment(folder).batches
    learnt_from = drawn[-2]  # the last is the one drawn again
    for name, tensor in learnt_from._asdict().items():
        if tensor is not None:
            assert tensor.numpy().tobytes() == getattr(kept, name).numpy().tobytes(), name


def test_the_last_good_checkpoint_stays_and_the_warning_names_the_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        folder = diverged(monkeypatch, tmp_path, checkpoint_every=0.0)
    assert everything_in(folder) == sorted(
        [checkpoint.NAME, checkpoint.FORMER, divergence.NAME, "policy.safetensors", "progress.csv", "run.json"]
    )
    (line,) = caplog.messages
    assert line.startswith("train/critic_loss is nan at update ")
    assert str(folder / divergence.NAME) in line
    saved = checkpoint.load(folder)
    assert saved is not None
    assert saved["training"]["world_steps"] == read_record(folder)["world_steps"] - 4
    for name, value in saved["training"]["parameters"]["policy"].items():
        assert np.isfinite(value).all(), name


def test_the_guard_changes_no_bit_of_a_healthy_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_on_rollout_end", "check"):
        monkeypatch.setattr(DivergenceGuard, name, lambda _: None)
    folder, _ = train.train(tiny(), 0, "native", tmp_path)
    assert contents(folder) == contents(finished())


@pytest.mark.parametrize(
    ("network", "value", "reason"),
    [
        ("actor", th.nan, "the actor has weights that are not finite"),
        ("critic", th.inf, "the critic has weights that are not finite"),
        ("critic", 3e38, None),  # whose sum is infinite
    ],
)
def test_weights_that_are_not_finite_are_found_in_either_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, network: str, value: float, reason: str | None
) -> None:
    folder = diverged(monkeypatch, tmp_path)
    model = load_moment(folder).model
    with th.no_grad():
        list(getattr(model, network).parameters())[-1].fill_(value)
    assert fault(model) == reason


def test_a_moment_that_cannot_be_written_is_an_error_and_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "not saved: No space left on device", divergence.NAME)

    monkeypatch.setattr(checkpoint, "save_tree", full)
    with pytest.raises(OSError, match="No space left"):
        diverged(monkeypatch, tmp_path)
    assert not (train.run_folder(tiny(), 0, tmp_path) / "run.json").exists()


def test_a_damaged_or_missing_moment_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = diverged(monkeypatch, tmp_path)
    path = folder / divergence.NAME
    data = path.read_bytes()
    for position in itertools.islice(range(9, len(data), len(data) // 20), 20):
        path.write_bytes(data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :])
        with pytest.raises(files.DamagedFileError, match=divergence.NAME):
            load_moment(folder)
    path.unlink()
    with pytest.raises(files.DamagedFileError, match=divergence.NAME):
        load_moment(folder)
