"""Model cards: figures and command are the run's, the program runs, and the committed cards are what is rendered."""

import json
import re
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch as th
from made_up import rounds
from safetensors.torch import load_file
from tiny_runs import TINY, command, copy_of_finished, finished, tiny

from marl_encircle.experiments.grid import Grid, Job, load_grid
from marl_encircle.experiments.grid_runs import read_grid_runs
from marl_encircle.experiments.pretrained import USUAL_SETTING, find_run
from marl_encircle.experiments.records import Setting, config_hash, read_record, run_path
from marl_encircle.experiments.train import train
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.cards import CARD, render_card, render_cards
from marl_encircle.study.reproduce import write_tables

RUNS = Path(__file__).parents[2] / "results" / "runs"
FIRST = Job("ours", Setting(1.1, 3, 1), 0, "smoke", overrides=TINY)


def card(successes: int = 150, total: int = 200, **record: Any) -> str:
    """The card of the tiny run, had it been played so."""
    return render_card({**read_record(finished()), **record}, rounds(successes, total), ["a", "b c"])


def code(text: str, language: str) -> str:
    [block] = re.findall(rf"```{language}\n(.*?)\n```", text, re.DOTALL)
    assert isinstance(block, str)
    return block


def test_a_card_has_the_figures_of_its_run() -> None:
    text = card()
    record = read_record(finished())
    for line in (
        "# Ours with 3 pursuers and 1 obstacle at speed ratio 1.1",
        "| method | `ours`; a round is won once pursuers and obstacles enclose the target together |",
        "| setting | 3 pursuers and 1 obstacle at speed ratio 1.1; scene: random |",
        '| scenario | `max_cycles=20`, `movement_range_limit=2.0`, `acceleration=5.0`, `turn_order="pursuers_first"` |',
        # Wilson with z = 1.96 for 150 of 200: (0.75 + 0.0096 -+ 0.0606) / 1.0192
        "| success S | 75.0 %; Wilson's 95 % interval: 68.6 to 80.5 % |",
        "| mean episode length MEL | 20.00 steps, of the rounds won |",
        "| evaluation | 200 rounds of evaluation seed 4000, without noise |",
        "| training seed | 0 |",
        "| training | 400 world steps in 4 worlds |",
        f"| configuration | sha256 `{record['config_hash']}` |",
        f"| policy.safetensors | sha256 `{record['sha256']['policy.safetensors']}` |",
    ):
        assert f"\n{line}\n" in f"\n{text}", line
    assert "| mean episode length MEL | no round was won |" in card(successes=0)
    assert code(text, "bash") == "a 'b c'"
    assert card() == text


def test_a_card_says_in_which_settings_one_policy_was_trained() -> None:
    settings = "training.settings=[" + "{speed_ratio: 1.05, pursuers: 2, obstacles: 1}, " * 2
    settings += "{speed_ratio: 1.1, pursuers: 3, obstacles: 0}]"
    values = tiny(overrides=("algorithm.features=set", "training.n_worlds=6", settings)).to_dict()
    text = card(config=values, config_hash=config_hash(values))
    shares = "2 pursuers and 1 obstacle at speed ratio 1.05 (2 shares); 3 pursuers and 0 obstacles at speed ratio 1.1"
    assert f"\n| trained in | {shares} |\n" in text
    assert "\nA policy for any number of pursuers that enclose one faster target" in text
    assert "It was trained in these settings" in text
    assert "trained in" not in card()


def test_the_program_on_a_card_plays_in_the_policys_own_world() -> None:
    for config in (tiny(), tiny("ma2019"), tiny("model_b", turn_order="simultaneous", observe_extras=("stage",))):
        values = config.to_dict()
        program = code(card(config=values, config_hash=config_hash(values)), "python")
        lines = [line for line in program.splitlines() if line.startswith(("from", "env"))]
        world: dict[str, Any] = {}
        exec("\n".join(lines), world)
        assert (world["env"].scenario, world["env"].reward.closure) == (config.scenario, config.reward.closure)


@pytest.mark.parametrize("method", ["ours", "ma2019"])
def test_the_program_on_a_card_plays_a_round(capsys: pytest.CaptureFixture[str], method: str) -> None:
    path = find_run(method, USUAL_SETTING, [RUNS]) / CARD
    exec(code(path.read_text(), "python"), {})
    assert capsys.readouterr().out in ("True\n", "False\n")


def test_the_program_on_the_card_of_another_folder_plays_that_policy(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(copy_of_finished(tmp_path))
    played: dict[str, Any] = {}
    exec(code(card(), "python"), played)
    assert capsys.readouterr().out in ("True\n", "False\n")
    weights = load_file("policy.safetensors")
    actor = played["policy"].actor.state_dict()
    assert all(th.equal(actor[name], weight) for name, weight in weights.items())


def test_only_the_first_seed_has_a_card_and_only_when_it_is_finished(tmp_path: Path) -> None:
    grid = Grid((FIRST._replace(seed=5), FIRST), {})
    train(FIRST.config, 5, "native", tmp_path)
    assert render_cards(grid, read_grid_runs(grid, tmp_path), tmp_path) == {}
    copy_of_finished(tmp_path)
    assert list(render_cards(grid, read_grid_runs(grid, tmp_path), tmp_path)) == [
        f"{run_path(FIRST.config.cell, 0)}/{CARD}"
    ]


def test_cards_are_written_with_the_tables(tmp_path: Path) -> None:
    folder = copy_of_finished(tmp_path / "runs")
    assert folder / CARD in write_tables(Grid((FIRST,), {}), tmp_path)
    assert (folder / CARD).read_text().startswith("# Ours with 3 pursuers")


def test_every_committed_policy_that_is_found_by_name_has_the_card_that_it_would_get_now() -> None:
    grid = load_grid("study")
    cards = render_cards(grid, read_grid_runs(grid, RUNS), RUNS)
    assert cards == {path.relative_to(RUNS).as_posix(): path.read_text() for path in RUNS.rglob(CARD)}
    found = set()
    for method, setting in grid.cells:
        with suppress(ConfigError):  # its first seed diverged, which has no card
            found.add(find_run(method, setting, [RUNS]) / CARD)
    assert found == {RUNS / name for name in cards}


def test_the_command_on_a_card_is_the_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for path in RUNS.rglob(CARD):
        program, name, *options = shlex.split(code(path.read_text(), "bash"))
        assert (program, name) == ("marl-encircle", "train")
        seed = options.index("--seed")
        assert options[seed + 1] == path.parent.name.removeprefix("seed")
        done = command(capsys, monkeypatch, "config", "show", "--json", *options[:seed], *options[seed + 2 :])
        assert config_hash(json.loads(done.out)) == read_record(path.parent)["config_hash"]
