"""Evaluation rounds come back exactly, or are refused by line and column."""

import numpy as np
import pytest
from made_up import episode

from marl_encircle.experiments import episodes
from marl_encircle.experiments.episodes import episodes_from_csv, episodes_to_csv


def test_episodes_come_back_exactly() -> None:
    rounds = [
        episode(0, 10, None, seed=1000, return_mean=0.1 + 0.2, sigma_c=1e-17),
        episode(1, None, 60, seed=1001, return_mean=-123456.789, sigma_c=0.0),
    ]
    text = episodes_to_csv(rounds)
    assert episodes_from_csv(text) == rounds
    assert text.splitlines() == [
        "round,seed,step_all,step_pursuers,length,return_mean,sigma_c,contacts_pursuers,contacts_obstacles",
        "0,1000,10,,60,0.30000000000000004,1e-17,2,0",
        "1,1001,,60,60,-123456.789,0.0,2,0",
    ]


def test_numpy_scalars_are_written_like_pythons() -> None:
    plain = episode(1, 10)
    typed = plain._replace(round=np.int64(1), step_all=np.int32(10), sigma_c=np.float64(0.25))  # type: ignore[arg-type]
    assert episodes_to_csv([typed]) == episodes_to_csv([plain])


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("round,", "rounds,", "line 1"),
        ("0,1000,10,,", "0,1000,10,", "line 2: 8 values for 9 columns"),
        ("0,1000,10,", "0,1000,0,", "line 2, step_all: 0 is not within 1 to the length 60"),
        ("0,1000,10,", "0,1000,61,", "line 2, step_all: 61 is not within"),
        ("0,1000,10,", "0,1000,ten,", "line 2, step_all: 'ten' is not an integer"),
        ("0,1000,10,", "0,1000,10.5,", "line 2, step_all: '10.5' is not an integer"),
        ("0,1000,10,", "0,,10,", "line 2, seed: '' is not an integer"),
        ("0,1000,10,", "-1,1000,10,", "line 2, round: '-1' is out of range"),
        ("-1.5,", "nan,", "line 2, return_mean: 'nan' is out of range"),
        ("1,1001,", "0,1000,", "duplicate round number"),
        ("1000", "9" * 400, "line 2, seed: .* is out of range"),
        ("1000", "1" * 200_000, "line 2: longer than 10000 characters"),
        ("1000", "10\r00", "not CSV"),
        ("\n0,1000,10,,60,-1.5,0.25,2,0\n1,1001,,,60,-1.5,0.25,2,0", "", "no rounds"),
    ],
)
def test_a_row_that_cannot_be_is_refused_by_line_and_column(old: str, new: str, where: str) -> None:
    text = episodes_to_csv([episode(0, 10, seed=1000), episode(1, None, seed=1001)])
    assert old in text
    with pytest.raises(ValueError, match=where):
        episodes_from_csv(text.replace(old, new, 1))


def test_there_are_as_many_rounds_as_an_evaluation_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "MAX_ROUNDS", 2)
    texts = [episodes_to_csv([episode(number, 10) for number in range(total)]) for total in (2, 3)]
    assert len(episodes_from_csv(texts[0])) == 2
    with pytest.raises(ValueError, match="more than 2 rounds"):
        episodes_from_csv(texts[1])
