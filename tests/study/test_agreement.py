"""How near the study comes to the paper, from made-up runs whose numbers can be worked out by hand."""

import csv
import io

import pytest
from made_up import finished, markdown_row

from marl_encircle.experiments.records import Cell, Run, Setting
from marl_encircle.study.agreement import gaps_of, pairs_of, render_agreement
from marl_encircle.study.cells import gather
from marl_encircle.study.paper import PaperResult

OPEN = Setting(1.1, 3, 0)
FAST = Setting(1.2, 3, 1)
OURS, MA, B = Cell("ours", OPEN), Cell("ma2019", OPEN), Cell("model_b", OPEN)
PAPER = {
    MA: PaperResult(85.0, 30.0),
    B: PaperResult(96.0, 25.0),
    OURS: PaperResult(97.0, 22.0),
    Cell("ma2019", FAST): PaperResult(None, None),
    Cell("ours", FAST): PaperResult(90.0, 28.0),
}


def seeds(cell: Cell, *successes: int, step: int = 20) -> list[Run]:
    return [finished(*cell, seed, n, step) for seed, n in enumerate(successes)]


def rendered(runs: list[Run], calibrated: tuple[Cell, ...] = ()) -> str:
    return render_agreement(gather(runs, {}), PAPER, calibrated)["table_agreement.md"]


def test_a_gap_is_this_studys_number_minus_the_papers() -> None:
    runs = seeds(MA, 90, 92, step=27) + seeds(Cell("ma2019", FAST), 50) + seeds(Cell("ours", FAST), 0, 0)
    assert gaps_of(gather(runs, {}), PAPER) == [
        (MA, pytest.approx(6.0), pytest.approx(-3.0)),
        (Cell("ours", FAST), pytest.approx(-90.0), None),
    ]


def test_cells_that_the_scenario_was_chosen_by_are_kept_apart() -> None:
    runs = seeds(MA, 90, 90, step=28) + seeds(B, 90, 90) + seeds(OURS, 99, 99, step=21)
    text = rendered(runs, calibrated=(OURS,))
    assert markdown_row(text, "calibrated on") == ["1", "2.00", "+2.00", "1.00", "-1.00"]
    assert markdown_row(text, "held out") == ["2", "5.50", "-0.50", "3.50", "-3.50"]
    assert markdown_row(text, "Ma") == ["1", "5.00", "+5.00", "2.00", "-2.00"]
    assert markdown_row(text, "Ours") == ["0", "–", "–", "–", "–"]  # noqa: RUF001 - the tables' own sign


def test_only_pairs_that_differ_by_more_than_the_papers_noise_have_an_order() -> None:
    runs = seeds(MA, 90, 90) + seeds(B, 90, 90) + seeds(OURS, 99, 99)
    pairs = list(pairs_of(gather(runs, {}), PAPER))
    # 97 and 96 % of 1,000 rounds each: 1 point is within 1.6
    assert [(pair.first, pair.second, pair.paper) for pair in pairs] == [(OURS, MA, 12.0), (B, MA, 11.0)]


@pytest.mark.parametrize(
    ("ours", "ma", "verdict"),
    [
        ((95, 95), (80, 80), "same"),
        ((80, 80), (95, 95), "opposite"),
        ((90, 99), (95, 80), "same, not shown"),
        ((90, 80), (89, 95), "opposite, not shown"),
        ((90, 90), (90, 90), "none, not shown"),
        ((98, 94, 93), (95, 95, 95), "none, not shown"),  # nor is what rounding leaves of it an order
    ],
)
def test_the_order_is_the_papers_or_not(ours: tuple[int, ...], ma: tuple[int, ...], verdict: str) -> None:
    text = rendered(seeds(OURS, *ours) + seeds(MA, *ma))
    row = markdown_row(text, "1.1", "3", "0", "Ours - Ma")
    assert row[0] == "*+12.0*"
    assert row[2] == verdict
    assert f"- Order of 1 pairs: 1 {verdict}. " in text


def test_it_is_said_whether_the_papers_difference_is_within_the_interval() -> None:
    for ma, place in (((85, 87), "within"), ((92, 92), "outside")):
        text = rendered(seeds(OURS, 98, 97) + seeds(MA, *ma))
        assert markdown_row(text, "1.1", "3", "0", "Ours - Ma")[0] == "*+12.0*"
        assert markdown_row(text, "1.1", "3", "0", "Ours - Ma")[3] == place
        assert text.count(f"lies outside this study's interval in {int(place == 'outside')}.") == 1
    assert markdown_row(rendered(seeds(OURS, 98) + seeds(MA, 92)), "1.1", "3", "0", "Ours - Ma")[3] == ""


def test_a_cell_that_shows_anothers_runs_is_what_the_other_is() -> None:
    paper = {**PAPER, Cell("model_a", OPEN): PaperResult(97.0, 22.0)}
    runs = gather(seeds(OURS, 99, 99, step=21) + seeds(MA, 90, 90, step=28), {Cell("model_a", OPEN): OURS})
    text = render_agreement(runs, paper, (OURS,))["table_agreement.md"]
    assert markdown_row(text, "calibrated on")[0] == "2"
    assert [pair.first.method for pair in pairs_of(runs, paper)] == ["ours"], "Model A minus Ma is the same pair"


def test_settings_are_told_apart_by_equation_6() -> None:
    text = rendered(seeds(MA, 90, 90) + seeds(Cell("ours", FAST), 60, 60))
    assert markdown_row(text, "Eq. 6 holds")[:2] == ["1", "5.00"]
    assert markdown_row(text, "Eq. 6 fails")[:2] == ["1", "30.00"]


def test_what_has_no_runs_is_left_out() -> None:
    assert render_agreement({}, PAPER, ()) == {}
    text = rendered(seeds(OURS, 90, 91))
    assert "No pair can be compared." in text


def test_the_csv_has_a_line_for_each_cell() -> None:
    runs = gather(seeds(MA, 90, 90) + seeds(OURS, 0), {})
    rows = list(csv.DictReader(io.StringIO(render_agreement(runs, PAPER, (OURS,))["table_agreement.csv"])))
    assert [(row["method"], row["cell"]) for row in rows] == [("ma2019", "held out"), ("ours", "calibrated on")]
    assert [row["success_percent_difference"] for row in rows] == ["5.0000", "-97.0000"]
    assert [row["mean_episode_length_difference"] for row in rows] == ["-10.0000", ""]
