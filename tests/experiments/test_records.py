"""Run folders come back as they were written; what does not belong there is refused by name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_up import compress, episode, write_run

from marl_encircle import files
from marl_encircle.core.simulator import world_seeds
from marl_encircle.experiments import records
from marl_encircle.experiments.episodes import Episode, episodes_to_csv
from marl_encircle.experiments.records import Cell, Run, Setting, config_hash
from marl_encircle.experiments.train import write_episodes

CELL = Cell("ours", Setting(1.1, 3, 1))
KEYS = ("status", "method", "seed", "config", "config_hash", "sha256")


def test_a_run_comes_back_from_its_folder(tmp_path: Path) -> None:
    episodes = (episode(0, 10, 12), episode(1, None))
    model_a = Cell("model_a", Setting(1.25, 2, 0, "tunnel"))
    write_run(tmp_path, CELL, 10, episodes)
    write_run(tmp_path, CELL, 9, episodes[:1])
    write_run(tmp_path, model_a, 0, episodes, closure="pursuers")
    assert records.read_runs(tmp_path) == [
        Run(model_a, 0, "finished", "pursuers", episodes),
        Run(CELL, 9, "finished", "all", episodes[:1]),
        Run(CELL, 10, "finished", "all", episodes),
    ]
    assert (tmp_path / "model_a" / "ratio1.25_n2_m0_tunnel" / "seed0" / "run.json").exists()


def test_rounds_elsewhere_belong_to_the_run_and_are_checked_like_its_own(tmp_path: Path) -> None:
    folder = write_run(tmp_path, CELL, 0, (episode(0, 10), episode(1, None)))
    tunnel = CELL.setting._replace(scene="tunnel")
    write_episodes(folder, [episode(0, 30), episode(1, 40)], tunnel)
    [run] = records.read_runs(tmp_path)
    assert run.elsewhere == {tunnel: (episode(0, 30), episode(1, 40))}
    assert run.episodes == (episode(0, 10), episode(1, None))
    write_episodes(folder, [episode(0, 30)], tunnel)
    with pytest.raises(files.DamagedFileError, match=r"tunnel\.csv.*its 1 rounds are not rounds 0 to 1"):
        records.read_runs(tmp_path)


def test_compressed_rounds_are_the_same_rounds_until_others_take_their_place(tmp_path: Path) -> None:
    folder = write_run(tmp_path, CELL, 0, (episode(0, 10), episode(1, None)))
    plain, names = records.read_runs(tmp_path), sorted(path.name for path in folder.iterdir())
    compress(folder / "episodes.csv")
    assert records.read_runs(tmp_path) == plain
    write_episodes(folder, [episode(0, 20), episode(1, 20)])
    assert sorted(path.name for path in folder.iterdir()) == names
    assert records.read_runs(tmp_path)[0].episodes == (episode(0, 20), episode(1, 20))


def test_rounds_stand_without_their_policy_for_who_asks_for_no_policies(tmp_path: Path) -> None:
    folder = write_run(tmp_path, CELL, 0, (episode(0, 10),))
    whole = records.read_runs(tmp_path)
    (folder / "policy.safetensors").unlink()
    assert records.read_runs(tmp_path, policies=False) == whole
    with pytest.raises(files.DamagedFileError, match=r"policy\.safetensors: the file is missing"):
        records.read_runs(tmp_path)


def test_no_folder_has_no_runs(tmp_path: Path) -> None:
    assert records.read_runs(tmp_path / "none") == []


def test_what_is_no_result_is_told_apart(tmp_path: Path) -> None:
    write_run(tmp_path, CELL, 0, (), status="diverged")
    write_run(tmp_path, CELL, 1, None)
    (write_run(tmp_path, CELL, 2, (episode(0, 10),)) / "run.json").unlink()
    assert [(run.seed, run.status, run.episodes) for run in records.read_runs(tmp_path)] == [
        (0, "diverged", ()),
        (1, "not evaluated", ()),
        (2, "unfinished", ()),
    ]


def test_files_beside_the_folders_and_hidden_folders_are_not_runs(tmp_path: Path) -> None:
    write_run(tmp_path, CELL, 0, (episode(0, 10),))
    (tmp_path / ".cache").mkdir()
    (tmp_path / "README.md").touch()
    (tmp_path / "ours" / "notes.txt").touch()
    assert len(records.read_runs(tmp_path)) == 1


@pytest.mark.parametrize("name", ["ours/ratio1.1_n3/seed0", "ours/ratio1.1_n3_m1_random/0", "ours/x/seed0"])
def test_a_folder_of_another_name_is_an_error_that_names_it(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(files.DamagedFileError, match="folder must be named"):
        records.read_runs(tmp_path)


@pytest.mark.parametrize(
    ("name", "right"),
    [
        ("ours/ratio1.10_n3_m1_random/seed0", "ratio1.1_n3_m1_random"),
        ("ours/ratio1_n3_m1_random/seed0", "ratio1.0_n3_m1_random"),
        ("ours/ratio1.1_n03_m1_random/seed0", "ratio1.1_n3_m1_random"),
        ("ours/ratio1.1_n3_m1_random/seed00", "seed0"),
    ],
)
def test_a_folder_that_spells_its_numbers_otherwise_is_an_error_that_says_how(
    tmp_path: Path, name: str, right: str
) -> None:
    write_run(tmp_path, CELL, 0, (episode(0, 10),))
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(files.DamagedFileError, match=f"the folder must be named {right}$"):
        records.read_runs(tmp_path)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.mark.parametrize("name", ["episodes.csv", "policy.safetensors", "progress.csv"])
def test_an_edited_file_is_found_by_its_hash(tmp_path: Path, name: str) -> None:
    path = write_run(tmp_path, CELL, 0, (episode(0, None),)) / name
    edit(path, path.read_text()[-2], "1")
    with pytest.raises(files.DamagedFileError, match=f"{name}: changed since it was written") as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path


def test_a_missing_file_is_found(tmp_path: Path) -> None:
    path = write_run(tmp_path, CELL, 0, (episode(0, None),)) / "episodes.csv"
    path.unlink()
    with pytest.raises(files.DamagedFileError, match="missing") as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path


@pytest.mark.parametrize(
    "rounds",
    [
        [episode(0, 10), episode(2, 10)],
        [episode(1, 10), episode(2, 10)],
        [episode(1, 10), episode(0, 10)],
        [episode(0, 10), episode(1, 10, seed=1001)],
        [episode(number, 10, seed=seed) for number, seed in enumerate(world_seeds(7, 2))],
        [episode(0, 10)],
        [episode(0, 10), episode(1, 10), episode(2, 10)],
    ],
)
def test_other_rounds_than_those_of_the_configuration_are_refused(tmp_path: Path, rounds: list[Episode]) -> None:
    path = write_run(tmp_path, CELL, 0, rounds, n_rounds=2) / "episodes.csv"
    with pytest.raises(files.DamagedFileError, match="not rounds 0 to 1 of evaluation seed 1000") as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path


def test_an_absurd_number_of_rounds_is_refused_at_once(tmp_path: Path) -> None:
    write_run(tmp_path, CELL, 0, [episode(0, 10)], n_rounds=10**15)
    with pytest.raises(files.DamagedFileError, match="not rounds 0 to"):
        records.read_runs(tmp_path)


def test_rounds_that_nobody_vouches_for_are_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path, CELL, 0, None)
    (folder / "episodes.csv").write_text(episodes_to_csv([episode(0, 10)]))
    with pytest.raises(files.DamagedFileError, match=r"episodes.csv: its hash is not in run\.json"):
        records.read_runs(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda record: record.update(schema=2), "schema is 2, not 1: no record that this version can read"),
        (lambda record: record.pop("schema"), "schema is None, not 1"),
        *((lambda record, key=key: record.pop(key), f"missing {key}") for key in KEYS),
        (lambda record: [record.pop(key) for key in KEYS], f"missing {', '.join(KEYS)}"),
        (lambda record: record.update(status="done"), "status is 'done', not finished or diverged"),
        (lambda record: record.update(status=[]), r"status is \[\], not finished or diverged"),
        (lambda record: record.update(seed=None), "seed is None, not an integer of at least 0"),
        (lambda record: record.update(seed=True), "seed is True, not an integer of at least 0"),
        (lambda record: record.update(seed=-1), "seed is -1, not an integer of at least 0"),
        (lambda record: record.update(seed=0.0), "seed is 0.0, not an integer of at least 0"),
        (lambda record: record.update(method="model_b"), "method is 'model_b', but its folder says 'ours'"),
        (lambda record: record.update(seed=1), "seed is 1, but its folder says 0"),
        (lambda record: record.update(config=[]), r"config is \[\], not an object"),
        *(
            (lambda record, key=key: record["config"].pop(key), f"config.{key} is None, not an object")
            for key in ("reward", "scenario", "evaluation")
        ),
        (lambda record: record["config"]["reward"].pop("closure"), "config.reward.closure is None"),
        (lambda record: record["config"]["reward"].update(closure="any"), "config.reward.closure is 'any'"),
        (
            lambda record: record["config"]["evaluation"].update(episodes=0),
            "config.evaluation.episodes is 0, not an integer of at least 1",
        ),
        (
            lambda record: record["config"]["evaluation"].update(seed="1000"),
            "config.evaluation.seed is '1000', not an integer of at least 0",
        ),
        (
            lambda record: record["config"]["scenario"].update(obstacles=0),
            "config.scenario.obstacles is 0, but its folder says 1",
        ),
        (lambda record: record["config"]["scenario"].pop("scene"), "config.scenario.scene is None, but its"),
        (lambda record: record.update(sha256=[]), r"sha256 is \[\], not an object of file names and hashes"),
        (lambda record: record["sha256"].pop("policy.safetensors"), r"sha256 has no policy\.safetensors"),
        (lambda record: record["sha256"].update({"../../secret": "0"}), "not a plain file name"),
        (lambda record: record["sha256"].update({"episodes.csv": 0}), "not an object of file names and hashes"),
    ],
)
def test_a_run_json_that_does_not_belong_there_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], reason: str
) -> None:
    path = write_run(tmp_path, CELL, 0, (episode(0, 10),)) / "run.json"
    record = json.loads(path.read_text())
    change(record)
    if "config_hash" in record and "config" in record:
        record["config_hash"] = config_hash(record["config"])
    files.write_json(path, record)
    with pytest.raises(files.DamagedFileError, match=reason) as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path


@pytest.mark.parametrize("value", ["0" * 64, None, 3])
def test_a_configuration_that_nobody_vouches_for_is_refused(tmp_path: Path, value: object) -> None:
    path = write_run(tmp_path, CELL, 0, None) / "run.json"
    record = json.loads(path.read_text())
    files.write_json(path, {**record, "config_hash": value})
    with pytest.raises(files.DamagedFileError, match="config has changed since it was written") as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path
    record["config"]["reward"]["scale"] = 0.5
    files.write_json(path, record)
    with pytest.raises(files.DamagedFileError, match="config has changed since it was written"):
        records.read_runs(tmp_path)


RESULTS = Path(__file__).parents[2] / "results"


def test_the_committed_runs_are_what_they_were() -> None:
    assert len(records.read_runs(RESULTS / "runs")) >= 43


def test_what_supersuits_worlds_taught_is_what_ours_taught() -> None:
    reference = RESULTS / "reference" / "supersuit"
    (run,) = records.read_runs(reference)
    folder = records.run_path(run.cell, run.seed)
    assert json.loads((reference / folder / "run.json").read_text())["engine"] == "supersuit"
    ours = RESULTS / "former" / folder  # before its budget was amended; of its policy only the hash is there
    for name in ("progress.csv", "episodes.csv"):
        assert files.read_bytes(reference / folder / name) == files.read_bytes(ours / name)
    theirs, own = (records.read_record(each / folder)["sha256"] for each in (reference, RESULTS / "former"))
    assert theirs["policy.safetensors"] == own["policy.safetensors"]


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[]", b"[" * 100_000, b"9" * 5000, b" " * (1 << 21)])
def test_a_run_json_that_is_none_is_refused(tmp_path: Path, data: bytes) -> None:
    path = write_run(tmp_path, CELL, 0, (episode(0, 10),)) / "run.json"
    path.write_bytes(data)
    with pytest.raises(files.DamagedFileError) as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path
