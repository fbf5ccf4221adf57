"""Every example runs as it stands, with a budget of a few steps."""

import runpy
import sys
from pathlib import Path

import pytest

from marl_encircle.core.rewards import TERMS
from marl_encircle.core.scenes import SCENES

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))
STEPS = "1500"

LEAVES = {"train_ours": {"ours.zip"}, "own_scene": {"cross.png"}}
PRINTS = {
    "train_ours": "nclosed after ",
    "own_environment": "return of one round: -",
    "swap_in_matd3": "MATD3: mean return -",
}


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")  # of SB3's progress bar
@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
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


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_to_run_it(example: Path) -> None:
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
    assert f"\npython examples/{example.name} " in text
