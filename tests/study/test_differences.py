"""Differences between methods: paired, and only called one where the interval leaves out zero."""

import csv
import io

import pytest
from made_up import episode, finished, markdown_row, rounds

from marl_encircle.experiments.records import Cell, Run, Setting
from marl_encircle.study.cells import gather
from marl_encircle.study.differences import difference_table
from marl_encircle.study.tables import render_tables

ONE = Setting(1.1, 3, 1)
THREE = ("1.1", "3", "1")


def differences(runs: list[Run]) -> str:
    return render_tables(runs)["table_differences.md"]


def test_differences_are_ours_minus_the_other_and_say_when_none_is_shown() -> None:
    ours = [finished("ours", ONE, seed, 92, step=20) for seed in range(3)]
    clear = [finished("model_b", ONE, seed, 60, step=25) for seed in range(3)]
    # of the same 100 rounds in all seeds ours wins 32 more, 5 steps sooner; the floor is Student's over the rounds:
    # s = sqrt(.32 * .68 * 100/99) = .468826, t(0.975, 99) = 1.984217: half .093025
    assert markdown_row(differences(ours + clear), "Model B", *THREE) == [
        "all / all", "+32.00 [+22.70, +41.30]: higher", "-5.00 [-5.00, -5.00]: lower",
        "+0.000 [+0.000, +0.000]: no difference shown", "3",
    ]  # fmt: skip
    close = [finished("model_b", ONE, seed, successes) for seed, successes in {0: 91, 1: 93, 2: 90}.items()]
    assert markdown_row(differences(ours + close), "Model B", *THREE)[1].endswith(": no difference shown")
    [compared] = [
        row
        for row in csv.DictReader(io.StringIO(render_tables(ours + close)["table_differences.csv"]))
        if row["result"] == "compared"
    ]
    assert (compared["method"], compared["success_verdict"]) == ("model_b", "no difference shown")


def test_differences_are_given_under_the_own_and_the_common_rule() -> None:
    ours = [Run(Cell("ours", ONE), 0, "finished", "all", [episode(0, 10, 12)])]
    model_a = [Run(Cell("model_a", ONE), 0, "finished", "pursuers", [episode(0, 10, None)])]
    lines = [line for line in differences(ours + model_a).splitlines() if line.startswith("| Model A | 1.1 | 3 | 1 |")]
    few = "too few seeds to say"
    assert lines == [
        f"| Model A | 1.1 | 3 | 1 | all / pursuers | +100.00: {few} | no round both solve | +0.000: {few} | 1 |",
        f"| Model A | 1.1 | 3 | 1 | all / all | +0.00: {few} | +0.00: {few} |  | 1 |",
    ]


def test_comparisons_that_nobody_ran_may_be_left_out_and_are_counted() -> None:
    runs = gather([finished(method, ONE, 0, 90) for method in ("ours", "model_b")], {})
    others = [Cell("model_b", ONE), Cell("model_a", ONE), Cell("ma2019", ONE)]
    table = difference_table(others, runs, ["Note."])
    assert [row[0] for row in table.rows] == ["Model B"]
    assert table.notes[-2:] == ["Note.", "Rows left out in which one of the two is not run: 2."]
    assert difference_table(others[:1], runs, ["Note."]).notes[-1] == "Note."


def test_the_spread_of_the_contributing_angles_is_compared_under_the_own_rules() -> None:
    runs = {
        method: [Run(Cell(method, ONE), seed, "finished", "all", [episode(i, 9, sigma_c=sigma) for i in range(50)])
                 for seed, sigma in enumerate(sigmas)]
        for method, sigmas in {"ours": (0.50, 0.52, 0.51), "model_c": (0.40, 0.40, 0.40)}.items()
    }  # fmt: skip
    # .10, .12, .11: t(0.975, 2) = 4.302653, half 4.302653 * .01 / sqrt(3) = .024842
    row = markdown_row(differences(runs["ours"] + runs["model_c"]), "Model C", *THREE)
    assert row[3] == "+0.110 [+0.085, +0.135]: higher"


def test_what_stays_shown_when_all_comparisons_are_taken_together_is_named() -> None:
    ours = [finished("ours", ONE, seed, 92) for seed in range(3)]

    def near(method: str) -> list[Run]:  # 7, 10, 13 points: t = 10 / (3 / sqrt(3)) = 5.77, p = .029, above .05 / 2
        return [finished(method, ONE, seed, successes) for seed, successes in enumerate((85, 82, 79))]

    end = "by Holm's procedure, a difference stays shown from"
    assert f"{end} Model A (ratio 1.1, n=3, m=1).\n" in differences(ours + near("model_a"))
    both = differences(ours + near("model_a") + near("model_b"))
    assert ": higher" in markdown_row(both, "Model A", *THREE)[1]
    assert "Corrected for all 2 comparisons" in both
    assert f"{end} none.\n" in both
    assert f"{end} none.\n" in differences(ours[:1] + near("model_a"))


def test_a_method_that_the_paper_lacks_is_compared_too() -> None:
    runs = [finished(method, ONE, seed, 90) for method in ("ours", "my_method") for seed in (0, 1)]
    assert markdown_row(differences(runs), "my_method", *THREE)[-1] == "2"
    assert "| Ours |" not in differences(runs)


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (Run(Cell("model_b", ONE), 1, "finished", "all", rounds(5, 10)), "no common training seed"),
        (Run(Cell("model_b", ONE), 0, "finished", "all", rounds(5, 9)), "not evaluated on the same rounds"),
        (Run(Cell("model_b", ONE), 0, "diverged", "all"), "no finished run"),
        (Run(Cell("model_c", ONE), 0, "diverged", "all"), "not run"),
    ],
)
def test_what_cannot_be_compared_says_why(other: Run, reason: str) -> None:
    ours = Run(Cell("ours", ONE), 0, "finished", "all", rounds(5, 10))
    assert markdown_row(differences([ours, other]), "Model B", *THREE)[1] == reason
