"""Every example runs as it stands, those that train with a budget of a few steps."""

import csv
import runpy
import sys
from pathlib import Path

import pytest
from tiny_runs import finished

from marl_encircle.core.rewards import TERMS
from marl_encircle.core.scenes import SCENES

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
TRAININGS = [path for path in EXAMPLES if path.stem != "lost_rounds"]
STEPS = "1500"

LEAVES = {"train_ours": {"ours.zip"}, "own_scene": {"cross.png"}}
PRINTS = {
    "train_ours": "nclosed after ",
    "own_environment": "return of one round: -",
    "own_reward_term": "mean return of 200 rounds: -",
    "own_scene": "mean return of 200 rounds: -",
    "swap_in_matd3": "MATD3: mean return -",
}


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")  # of SB3's progress bar
@pytest.mark.slow
@pytest.mark.parametrize("example", TRAININGS, ids=lambda path: path.stem)
def test_an_example_runs(
    example: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), STEPS])
    terms, scenes = dict(TERMS), dict(SCENES)
    names = runpy.run_path(str(example), run_name="__main__")
    assert names["total_timesteps"] == int(STEPS)
    assert names["model"].num_timesteps >= int(STEPS)
    assert names["model"]._n_updates > 0
    assert {path.name for path in tmp_path.iterdir()} == LEAVES.get(example.stem, set())
    assert PRINTS.get(example.stem, "") in capsys.readouterr().out
    for registry, before in ((TERMS, terms), (SCENES, scenes)):
        for name in registry.keys() - before.keys():
            del registry[name]


def test_lost_rounds_are_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = set(EXAMPLES) - set(TRAININGS)
    monkeypatch.setattr(sys, "argv", [str(example), str(finished())])
    measured = runpy.run_path(str(example), run_name="__main__")["measured"]
    (row,) = csv.DictReader(capsys.readouterr().out.splitlines())
    assert (row["run"], row["lost"]) == (str(finished()), f"{len(measured)}/100")
    assert 50 < len(measured) <= 100, "the policy has hardly been trained"
    occupied, closed, wall = (float(row[name]) for name in ("occupied", "closed", "wall"))
    assert 0 < occupied <= 1
    assert 0 <= closed <= 1
    assert 0 < wall <= 1.0


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_to_run_it(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    assert f"\npython examples/{example.name} " in text
