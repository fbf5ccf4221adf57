"""Thumbnails are the selection rounds that the learning curve counts."""

import io

from PIL import Image
from tiny_runs import finished, tiny

from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.loading import load_policy
from marl_encircle.replays.replay import record_first_rounds, record_round
from marl_encircle.replays.thumbnails import FRAMES, _steps, thumbnails

EASY = tiny(overrides=["scenario.movement_range_limit=2", "scenario.max_cycles=40"])


def test_the_first_rounds_are_those_that_are_recorded_one_by_one() -> None:
    policy = load_policy(finished())
    together = record_first_rounds(policy, EASY, 60, 5)
    played = play_rounds(policy, EASY, 60, 5)
    early = [replay.round for replay in together if replay.length < 40]
    assert early, "each round ends by itself"
    for number in {0, 1, 59, *early[:3]}:
        replay = together[number]
        alone = record_round(policy, EASY, number, 5)
        assert (replay.round, replay.seed, replay.length) == (number, alone.seed, alone.length)
        assert (replay.step_all, replay.step_pursuers) == (played[number].step_all, played[number].step_pursuers)
        for name in ("pursuers", "velocities", "target", "discs", "rewards"):
            assert (getattr(replay, name) == getattr(alone, name)).all()
        for rule, enclosure in replay.enclosure.items():
            assert (enclosure.movement_range == alone.enclosure[rule].movement_range).all()


def test_a_film_is_short_and_has_the_start_and_the_end() -> None:
    for end in range(1, 61):
        steps = _steps(end)
        assert (steps[0], steps[-1]) == (0, end)
        assert steps == sorted(set(steps))
        assert len(steps) <= FRAMES


def test_the_film_moves_and_the_ends_are_four() -> None:
    film, ends = thumbnails(load_policy(finished()), EASY)
    with Image.open(io.BytesIO(film.data)) as image:
        assert image.format == "GIF"
        first = image.convert("RGB").tobytes()
        image.seek(image.n_frames - 1)  # type: ignore[attr-defined]
        assert image.convert("RGB").tobytes() != first
    assert (ends.width, ends.height) == (2 * film.width, 2 * film.height)


def test_equal_policies_give_equal_pictures() -> None:
    policy = load_policy(finished())
    assert thumbnails(policy, EASY) == thumbnails(policy, EASY)
