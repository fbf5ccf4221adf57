"""A replay is the evaluation round itself, step by step."""

from pathlib import Path

import numpy as np
import pytest
from tiny_runs import finished, tiny

from marl_encircle import files
from marl_encircle.core.simulator import Simulator
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import Episode, episodes_from_csv
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import load_policy, load_run
from marl_encircle.replays.replay import Replay, record_round

RUNS = Path(__file__).parents[2] / "results" / "runs"


def recorded(config: Config, number: int, eval_seed: int = 5) -> Replay:
    return record_round(load_policy(finished()), config, number, eval_seed)


def easy(reward: str = "ours") -> Config:
    """In which some rounds are solved under both rules."""
    return tiny(reward, overrides=["scenario.movement_range_limit=2", "scenario.max_cycles=40"])


def steps(round_: Replay | Episode) -> tuple[int, int, int | None, int | None, int]:
    return round_.round, round_.seed, round_.step_all, round_.step_pursuers, round_.length


@pytest.mark.parametrize("method", ["ours", "model_a"])
def test_success_steps_are_those_of_the_evaluation(method: str) -> None:
    config = easy(method)
    rounds = play_rounds(load_policy(finished()), config, 130, 5)
    solved = [each.round for each in rounds if each.step_all]
    both = [each.round for each in rounds if each.step_pursuers]
    for number in {0, 1, 99, 100, 129, *solved[:4], *both[:2]}:
        assert steps(recorded(config, number)) == steps(rounds[number])
    assert solved, "else little was compared"
    assert both


@pytest.mark.parametrize(
    "run",
    [
        "ours/ratio1.1_n3_m1_random/seed0",
        "ma2019/ratio1.1_n3_m0_random/seed0",
        "ours/ratio1.1_n2_m1_random/seed0",
    ],
)
def test_a_committed_round_is_played_as_it_was_recorded(run: str) -> None:
    policy, config, _ = load_run(RUNS / run)
    rounds = episodes_from_csv(files.read_bytes(RUNS / run / "episodes.csv").decode())
    evaluation = config.evaluation
    numbers = [0, 1, 42, 99, 100, len(rounds) - 1]
    played = play_rounds(policy, config, len(rounds), evaluation.seed)
    for number in numbers:  # on another processor a round may end otherwise than it did when it was recorded
        assert steps(record_round(policy, config, number, evaluation.seed)) == steps(played[number])
    assert sum(steps(played[number]) == steps(rounds[number]) for number in range(len(rounds))) >= 0.98 * len(rounds)


def test_contributing_angles_of_all_steps_give_the_recorded_spread() -> None:
    rounds = play_rounds(load_policy(finished()), tiny(), 12, 5)
    for number, episode in enumerate(rounds):
        replay = recorded(tiny(), number)
        end = replay.success_step or replay.length
        angles = replay.enclosure["all"].contributing_angle[1 : end + 1, :3]
        assert angles.mean(axis=0).std() == pytest.approx(episode.sigma_c, rel=1e-12)


def test_it_starts_where_the_world_of_its_seed_does_and_success_is_in_its_last_step() -> None:
    rounds = play_rounds(load_policy(finished()), easy(), 130, 5)
    replay = recorded(easy(), next(each.round for each in rounds if each.step_pursuers))
    sim = Simulator(replay.scenario)
    sim.seed([replay.seed])
    sim.reset()
    for recorded_place, place in (
        (replay.pursuers[0], sim.state.pursuers[0]),
        (replay.target[0], sim.state.target[0]),
        (replay.discs, sim.state.discs[0]),
    ):
        assert np.array_equal(recorded_place, place)
    for rule, step in (("all", replay.step_all), ("pursuers", replay.step_pursuers)):
        assert np.flatnonzero(replay.enclosure[rule].complete)[0] == step
    assert replay.length == max(replay.step_all or 0, replay.step_pursuers or 0)


def test_each_enclosure_belongs_to_the_places_of_its_step() -> None:
    replay = recorded(tiny(scene="tunnel"), 3)
    sim = Simulator(replay.scenario, seed=0)
    for step in (0, 1, replay.length):
        saved = sim.get_state()
        places = {"pursuers": replay.pursuers, "target": replay.target}
        saved["state"] |= {name: array[step][None] for name, array in places.items()}
        saved["state"] |= {"discs": replay.discs[None], "speed_ratio": np.array([replay.scenario.speed_ratio])}
        sim.set_state(saved)
        for rule, enclosure in replay.enclosure.items():
            for now, then in zip(sim.measure.enclosure[rule], enclosure, strict=True):
                assert np.array_equal(now[0], then[step])


def test_shapes_and_read_only_arrays() -> None:
    replay = recorded(tiny(scene="concave"), 0)
    moments, directions = replay.length + 1, replay.scenario.n_directions
    assert replay.pursuers.shape == replay.velocities.shape == (moments, 3, 2)
    assert (replay.target.shape, replay.discs.shape) == ((moments, 2), (7, 3))
    enclosure = replay.enclosure["pursuers"]
    assert enclosure.owner.shape == enclosure.nearness.shape == (moments, directions)
    assert enclosure.contributing_angle.shape == (moments, 4)
    arrays = (replay.pursuers, replay.velocities, replay.target, replay.discs, *enclosure)
    assert not any(array.flags.writeable for array in arrays)


def test_a_snapshot_is_measured_under_the_methods_own_rule() -> None:
    for method, rule in (("ours", "all"), ("model_a", "pursuers")):
        replay = recorded(tiny(method), 0)
        moment, enclosure = replay.snapshot(2), replay.enclosure[rule]  # type: ignore[index]
        assert np.array_equal(moment.owner, enclosure.owner[2])
        assert moment.occupied_angle == enclosure.occupied_angle[2]
        assert moment.closed == enclosure.closed[2]
        assert moment.contributing_angle.sum() == pytest.approx(moment.occupied_angle)
