"""``play-with``: what it prints and keeps."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_runs import Done

from marl_encircle.experiments.play_with import load_played

Run = Callable[..., Done]
SHORT = ("--world-steps", "200", "--episodes", "10")
SPREAD = ("mpe2.simple_spread_v3", "--set", "continuous_actions=true")


def test_both_means_are_printed_with_their_intervals(run: Run) -> None:
    done = run("play-with", *SPREAD, *SHORT)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].startswith("mpe2.simple_spread_v3: 3 agents, 200 world steps, ")
    assert [line.split()[0] for line in lines[2:]] == ["maddpg", "random", "difference"]
    for line in lines[2:]:
        _, mean, low, high = line.replace("[", "").replace("]", "").replace(",", "").split()
        assert float(low) < float(mean) < float(high)
    assert "200 of 200 world steps" in done.err
    assert "return -" in done.err


def test_a_script_gets_one_object_and_the_policy(run: Run, tmp_path: Path) -> None:
    arguments = ("--algorithm", "matd3", "--seed", "3", "--save", tmp_path / "kept", "--quiet", "--json")
    done = run("play-with", *SPREAD, *SHORT, "--rounds", "12", *arguments)
    assert (done.code, done.err) == (0, "")
    found = json.loads(done.out)
    about = {"environment": SPREAD[0], "arguments": {"continuous_actions": True}, "pad": False, "algorithm": "matd3"}
    assert {key: found[key] for key in about} == about
    assert (found["seed"], found["world_steps"], found["rounds"]) == (3, 200, 12)
    assert found["difference"]["mean"] == pytest.approx(found["trained"]["mean"] - found["random"]["mean"])
    kept = json.loads((tmp_path / "kept" / "policy.json").read_text())
    assert kept["returns"]["trained"] == found["trained"]["mean"]
    assert load_played(tmp_path / "kept").agents == ("agent_0", "agent_1", "agent_2")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([SPREAD[0]], "the actions of agent_0 are Discrete(5); MADDPG needs continuous ones (Box)"),
        (["mpe2.simple_tag_v3", *SPREAD[1:]], "--pad makes them so"),
        (["mpe2.simple_spred_v3"], "cannot be imported"),
        ([*SPREAD, "--set", "N"], "--set N: must be an argument of the environment, key=value"),
        ([*SPREAD, "--algorithm", "ppo"], "ppo"),
        ([*SPREAD, "--world-steps", "1"], "100"),
    ],
)
def test_what_cannot_be_trained_ends_with_2_and_leaves_nothing(
    run: Run, tmp_path: Path, arguments: list[str], reason: str
) -> None:
    done = run("play-with", *arguments, "--save", tmp_path / "kept")
    assert (done.code, done.out) == (2, "")
    assert reason in done.err
    assert "Traceback" not in done.err
    assert not (tmp_path / "kept").exists()
