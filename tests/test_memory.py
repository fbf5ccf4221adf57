"""What this machine's memory does not hold is refused by every command, with figures, before anything is written."""

from pathlib import Path

import pytest
from tiny_runs import command, everything_in, finished, tiny_arguments

from marl_encircle.experiments import memory
from marl_encircle.experiments.search_space import load_space

COMMANDS = {
    "train": ["train", *tiny_arguments("--out", "{}/runs", "--quiet")],
    "sweep": ["sweep", "smoke", "--out", "{}/runs"],
    "reproduce-tables": ["reproduce-tables", "--grid", "smoke", "--out", "{}"],
    "calibrate": ["calibrate", "--out", "{}/calibration"],
    "tune": ["tune", "--out", "{}/search"],
    "play-with": [
        "play-with", "marl_encircle/encirclement-v0", "--set", "pursuers=2", "--world-steps", "1000", "--quiet",
        "--save", "{}/policy",
    ],
    "watch --save": ["watch", str(finished()), "--save", "{}/round.gif"],
    "watch --headless": ["watch", str(finished()), "--headless", "{}/pictures"],
}  # fmt: skip


def limit_to(n_bytes: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Be in a container with so much memory."""
    (folder / "memory.max").write_text(str(n_bytes))
    monkeypatch.setattr(memory, "CONTAINER_LIMIT", folder / "memory.max")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_asks_for_no_more_than_there_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    if name == "tune":
        pytest.importorskip("optuna")
    limit_to(10_000, tmp_path, monkeypatch)
    done = command(capsys, monkeypatch, *(word.replace("{}", str(tmp_path)) for word in COMMANDS[name]))
    assert done.code == 2, done.err
    assert "GB of memory" in done.err
    assert "this machine has 0.0 GB" in done.err
    assert everything_in(tmp_path) == ["memory.max"]


def test_the_pictures_of_a_film_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    limit_to(1_000_000, tmp_path, monkeypatch)  # in which the round fits, and a picture or none
    done = command(capsys, monkeypatch, "watch", finished(), "--save", tmp_path / "round.gif")
    assert done.code == 2
    assert f"error: --save {tmp_path / 'round.gif'}, " in done.err
    assert " pictures: needs 0.0 GB of memory" in done.err
    assert everything_in(tmp_path) == ["memory.max"]


def test_trainings_of_a_search_are_counted_side_by_side_and_at_their_largest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    largest = sum(memory.memory_needed(load_space("default").largest).values())
    limit_to(2 * largest + 1, tmp_path, monkeypatch)
    done = command(capsys, monkeypatch, "tune", "--jobs", "3", "--out", tmp_path / "search")
    assert (done.code, done.out) == (2, "")
    assert "error: 3 trainings at a time need" in done.err
    assert everything_in(tmp_path) == ["memory.max"]


def test_the_largest_training_of_a_search_is_that_of_all_large_ends_together() -> None:
    """The default search moves the layers and the batch, whose memory multiplies."""
    space = load_space("default")
    ends = {key: list(dimension.ends) for key, dimension in space.dimensions.items()}
    largest = space.largest.to_dict()["algorithm"]
    for key, values in ends.items():
        section, _, name = key.partition(".")
        if section == "algorithm" and name in ("batch_size", "net_arch"):
            assert largest[name] == max(values, key=lambda value: sum(value) if isinstance(value, list) else value)
