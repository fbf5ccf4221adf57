"""``save`` and ``save_replay_buffer`` keep SB3's format, and a former file until the new one is whole."""

import io
import warnings
from pathlib import Path

import numpy as np
import pytest
from faults import ERRNOS, fail_everywhere, largest_file, temporary_files
from stable_baselines3 import DDPG
from test_maddpg import load, make_model, weights_hash

from marl_encircle.experiments.build import policy_bytes
from marl_encircle.experiments.loading import load_policy
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import MADDPG, MATD3
from marl_encircle.maddpg.saving import load_actors


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_suffixes_and_missing_folders_are_added_as_sb3_does(tmp_path: Path) -> None:
    model = make_model()
    model.save(tmp_path / "new" / "model")
    model.save(str(tmp_path / "new" / "v1.2"))
    model.save_replay_buffer(tmp_path / "new" / "buffer")
    assert names(tmp_path / "new") == ["buffer.pkl", "model.zip", "v1.2"]
    assert weights_hash(load(MADDPG, tmp_path / "new" / "model")) == weights_hash(model)
    with warnings.catch_warnings():
        model.load_replay_buffer(tmp_path / "new" / "buffer")


def test_what_a_link_points_to_is_written(tmp_path: Path) -> None:
    (tmp_path / "latest.zip").symlink_to("model.zip")
    model = make_model()
    model.save(tmp_path / "latest")
    assert (tmp_path / "latest.zip").is_symlink()
    assert weights_hash(load(MADDPG, tmp_path / "model.zip")) == weights_hash(model)


def test_an_open_file_is_written_to_as_it_is() -> None:
    model, data, buffer = make_model(), io.BytesIO(), io.BytesIO()
    model.save(data)
    model.save_replay_buffer(buffer)
    data.seek(0)
    assert weights_hash(load(MADDPG, data)) == weights_hash(model)  # type: ignore[arg-type]  # SB3 takes both
    assert len(buffer.getvalue()) > 1000


def test_the_actors_of_a_saved_model_act_alone(tmp_path: Path) -> None:
    model = make_model(MATD3, critic="shared", policy_kwargs={"net_arch": [5, 4], "share_parameters": True})
    model.save(tmp_path / "model.zip")
    policy = load_actors(tmp_path / "model.zip")
    obs = np.random.default_rng(0).standard_normal((6, 3)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(obs)[0], model.predict(obs)[0])
    assert (policy.n_agents, policy.critic_kind, policy.training) == (3, "shared", False)
    DDPG("MlpPolicy", "Pendulum-v1", device="cpu").save(tmp_path / "ddpg.zip")
    with pytest.raises(ValueError, match="not a model of MADDPG"):
        load_actors(tmp_path / "ddpg.zip")


def test_a_trusted_model_is_loaded_by_the_name_it_was_saved_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    model = make_model()
    for name in "md", "ours", "folder/md":  # there is a method "ours", too
        model.save(name)
        for saved in name, f"{name}.zip", Path(name):
            assert policy_bytes(load_policy(saved, trusted=True)) == policy_bytes(model.policy)
    assert policy_bytes(load_policy("ours")) != policy_bytes(model.policy)
    with pytest.raises(ConfigError, match="'md': no method and no run folder"):
        load_policy("md")


def test_every_call_may_fail(tmp_path: Path) -> None:
    former, new = make_model(seed=0), make_model(seed=1)
    assert weights_hash(former) != weights_hash(new)
    for number in ERRNOS:

        def check(folder: Path, error: OSError | None) -> None:
            saved = load(MADDPG, folder / "model.zip")
            assert weights_hash(saved) == weights_hash(new if error is None else former)
            assert temporary_files(folder) == []

        above = tmp_path / str(number)
        above.mkdir()
        calls = fail_everywhere(
            above,
            lambda folder: former.save(folder / "model"),
            lambda folder: new.save(folder / "model"),
            check,
            number,
        )
        assert calls.count("fsync") == 2


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_full_disk_keeps_the_former_model(tmp_path: Path, share: float) -> None:
    path = tmp_path / "model.zip"
    former, new = make_model(seed=0), make_model(seed=1)
    former.save(path)
    former.save_replay_buffer(tmp_path / "buffer.pkl")
    for save, saved in ((new.save, path), (new.save_replay_buffer, tmp_path / "buffer.pkl")):
        data = saved.read_bytes()
        with largest_file(int(share * len(data))), pytest.raises(OSError, match="not saved"):
            save(saved)
        assert saved.read_bytes() == data
    assert names(tmp_path) == ["buffer.pkl", "model.zip"]
    new.learn(12)
    assert np.isfinite(new.replay_buffer.rewards).all()  # type: ignore[union-attr]  # there is one
