"""A learning curve is read as it was written, or refused."""

from pathlib import Path

import pytest
from tiny_runs import tiny

from marl_encircle import files
from marl_encircle.experiments.learning_curve import count_points, curve_from_csv, read_curve
from marl_encircle.experiments.train import train


def test_a_curve_has_the_steps_and_shares_of_its_lines() -> None:
    curve = curve_from_csv("world_steps,success,sigma_c\n100,0.25,0.1\n200,1,\n")
    assert curve.world_steps.tolist() == [100, 200]
    assert curve.success.tolist() == [0.25, 1.0]


def test_the_curve_of_a_training_under_way_may_have_no_points_yet() -> None:
    curve = curve_from_csv("world_steps,success\n")
    assert curve.world_steps.shape == curve.success.shape == (0,)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "must be among the columns"),
        ("world_steps\n3\n", "must be among the columns"),
        ("world_steps,success\n3\n", "must be in every line"),
        ("world_steps,success\n3,many\n", "could not convert"),
        ("world_steps,success\n3,nan\n", "success must be between 0 and 1"),
        ("world_steps,success\n3,1.1\n", "success must be between 0 and 1"),
        ("world_steps,success\n3,0.1\n3,0.1\n", "world_steps must rise"),
        ("world_steps,success\n-3,0.1\n", "world_steps must rise"),
        (f"world_steps,success\n{'9' * 30},0.1\n", "world_steps: too large"),
        (f"world_steps,success\n3,{'1' * 200_000}\n", "line 2: longer than 10000 characters"),
        ("world_steps,success\n3,0\r1\n", "not CSV"),
    ],
)
def test_a_learning_curve_that_cannot_be_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        curve_from_csv(text)
    (tmp_path / "progress.csv").write_bytes(text.encode())
    with pytest.raises(files.DamagedFileError, match=rf"progress\.csv: no learning curve: .*{reason}"):
        read_curve(tmp_path)


@pytest.mark.parametrize(
    ("world_steps", "train_freq", "every", "points"),
    [
        (40, 1, 20, [20, 40]),
        (44, 2, 12, [16, 24, 40, 48]),  # a rollout begins at 0, 8, ..., 40
        (40, 5, 30, [40]),  # it begins at 0 and 20, the next one would at 40, where the training ends
        (50, 5, 20, [20, 40, 60]),
    ],
)
def test_the_points_of_a_training_are_as_many_as_were_counted(
    tmp_path: Path, world_steps: int, train_freq: int, every: int, points: list[int]
) -> None:
    lengths = [f"training.world_steps={world_steps}", f"training.curve_every={every}"]
    config = tiny(overrides=[*lengths, f"algorithm.train_freq={train_freq}", "algorithm.random_world_steps=8"])
    folder, _ = train(config, 0, out=tmp_path)
    assert read_curve(folder).world_steps.tolist() == points
    assert count_points(config) == len(points)


def test_a_curve_is_the_one_that_was_hashed(tmp_path: Path) -> None:
    text = "world_steps,success\n3,0.5\n"
    with pytest.raises(files.DamagedFileError, match=r"progress\.csv: the file is missing"):
        read_curve(tmp_path)
    (tmp_path / "progress.csv").write_text(text)
    assert read_curve(tmp_path, files.sha256_bytes(text.encode())).success.tolist() == [0.5]
    with pytest.raises(files.DamagedFileError, match=r"progress\.csv: changed since it was written"):
        read_curve(tmp_path, files.sha256_bytes(b"another"))
