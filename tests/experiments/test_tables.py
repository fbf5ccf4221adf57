import csv
import io
from pathlib import Path

import pytest
from made_up import SEEDS, episode, rounds, write_run

from marl_encircle import files
from marl_encircle.experiments import records, tables
from marl_encircle.experiments.records import Cell, Closure, Run, Setting
from marl_encircle.experiments.tables import MethodOptions

OPEN = Setting(1.1, 3, 0)
ONE = Setting(1.1, 3, 1)
MAIN = ["table2", "table3", "table4"]
OTHERS = ["table_common_rule", "table_differences"]


def finished(method: str, setting: Setting, seed: int, successes: int, step: int = 20, closure: Closure = "all") -> Run:
    return Run(Cell(method, setting), seed, "finished", closure, rounds(successes, 100, step))


def markdown_rows(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def markdown_row(text: str, *start: str) -> list[str]:
    [row] = [row for row in markdown_rows(text) if row[: len(start)] == list(start)]
    return row[len(start) :]


def csv_row(text: str, **where: str) -> dict[str, str]:
    rows = csv.DictReader(io.StringIO(text))
    [row] = [row for row in rows if all(row[key] == value for key, value in where.items())]
    return row


def test_the_papers_numbers_are_read_as_printed() -> None:
    paper = tables.paper_results()
    assert list(paper) == MAIN
    assert [len(table) for table in paper.values()] == [16, 16, 16]
    assert len({cell.setting for table in paper.values() for cell in table}) == 10
    assert paper["table2"][Cell("ours", Setting(1.4, 3, 1))] == (73.7, 32.59)
    assert paper["table3"][Cell("model_a", Setting(1.1, 2, 1))] == (None, None)
    # the cell that all three tables have is the same in all three
    for method in tables.TABLE_METHODS:
        assert len({paper[name][Cell(method, ONE)] for name in MAIN}) == 1


def test_without_runs_every_cell_is_not_run_and_the_papers_numbers_stand_beside() -> None:
    rendered = tables.render_tables([])
    assert sorted(rendered) == sorted(f"{name}.{kind}" for name in MAIN + OTHERS for kind in ("md", "csv"))
    for name in MAIN:
        rows = markdown_rows(rendered[f"{name}.md"])
        assert [row[0] for row in rows] == [name for name in ("Ma", "Model A", "Model B", "Ours") for _ in range(4)]
        assert {(row[4], row[5], row[7]) for row in rows} == {("not run", "not run", "")}
        assert {row["result"] for row in csv.DictReader(io.StringIO(rendered[f"{name}.csv"]))} == {"not run"}
    assert markdown_row(rendered["table2.md"], "Ours", "1.4", "3", "1")[2] == "73.70 / 32.59"
    assert markdown_row(rendered["table3.md"], "Ma", "1.1", "2", "1")[2] == "–"  # noqa: RUF001 - the paper's sign
    assert markdown_row(rendered["table4.md"], "Model A", "1.1", "3", "0")[2] == "95.40 / 25.35"
    assert len(markdown_rows(rendered["table_common_rule.md"])) == 40
    assert {row[5] for row in markdown_rows(rendered["table_differences.md"])} == {"not run"}


def test_a_cell_shows_mean_interval_and_seeds_in_every_table_it_belongs_to() -> None:
    runs = [finished("ours", ONE, seed, successes) for seed, successes in {900: 80, 901: 90, 902: 100}.items()]
    rendered = tables.render_tables(runs)
    # mean 90, s = 10, t(0.975, 2) = 4.302653: 90 +- 24.84, cut at 100
    expected = ["90.00 [65.16, 100.00]", "20.00 [20.00, 20.00]", "91.80 / 25.91", "3 (900 901 902)"]
    for name in [*MAIN, "table_common_rule"]:
        assert markdown_row(rendered[f"{name}.md"], "Ours", "1.1", "3", "1") == expected
        row = csv_row(rendered[f"{name}.csv"], method="ours", speed_ratio="1.1", pursuers="3", obstacles="1")
        assert (row["success_percent"], row["success_percent_low"], row["success_percent_high"]) == (
            "90.0000",
            "65.1586",
            "100.0000",
        )
        assert (row["result"], row["closure"], row["seeds"], row["training_seeds"]) == (
            "run",
            "all",
            "3",
            "900 901 902",
        )
        assert (row["paper_success_percent"], row["paper_mean_episode_length"]) == ("91.80", "25.91")
        assert row["scene"] == "random"


def test_one_seed_has_no_interval_and_no_success_has_no_length() -> None:
    rendered = tables.render_tables([finished("ours", ONE, 0, 75), finished("model_b", ONE, 0, 0)])
    assert markdown_row(rendered["table2.md"], "Ours", "1.1", "3", "1")[:2] == ["75.00", "20.00"]
    assert markdown_row(rendered["table2.md"], "Model B", "1.1", "3", "1")[:2] == ["0.00", "no success"]
    row = csv_row(rendered["table2.csv"], method="model_b", speed_ratio="1.1")
    assert (row["success_percent_low"], row["mean_episode_length"]) == ("", "")


def test_runs_without_a_result_are_counted_and_not_in_the_mean() -> None:
    cell = Cell("ours", ONE)
    others = [Run(cell, 1, "diverged", "all"), Run(cell, 2, "unfinished"), Run(cell, 3, "not evaluated", "all")]
    rendered = tables.render_tables([finished("ours", ONE, 0, 75), Run(cell, 4, "diverged", "all"), *others])
    row = markdown_row(rendered["table2.md"], "Ours", "1.1", "3", "1")
    assert row[0] == "75.00"
    assert row[3] == "1 (0), 2 diverged (1 4), 1 unfinished (2), 1 not evaluated (3)"
    record = csv_row(rendered["table2.csv"], method="ours", speed_ratio="1.1")
    assert [record[key] for key in ("seeds", "diverged", "unfinished", "not_evaluated")] == ["1", "2", "1", "1"]
    only_others = tables.render_tables(others)
    assert markdown_row(only_others["table2.md"], "Ours", "1.1", "3", "1") == [
        "diverged, unfinished, not evaluated",
        "diverged, unfinished, not evaluated",
        "91.80 / 25.91",
        "0, 1 diverged (1), 1 unfinished (2), 1 not evaluated (3)",
    ]


def test_main_tables_take_each_methods_own_rule_and_the_common_table_one_for_all() -> None:
    episodes = [episode(0, 10, 30), episode(1, 20, None)]
    runs = [
        Run(Cell("model_a", ONE), 0, "finished", "pursuers", episodes),
        Run(Cell("ours", ONE), 0, "finished", "all", episodes),
    ]
    rendered = tables.render_tables(runs)
    assert markdown_row(rendered["table2.md"], "Model A", "1.1", "3", "1")[:2] == ["50.00", "30.00"]
    assert markdown_row(rendered["table2.md"], "Ours", "1.1", "3", "1")[:2] == ["100.00", "15.00"]
    assert markdown_row(rendered["table_common_rule.md"], "Model A", "1.1", "3", "1")[:2] == ["100.00", "15.00"]
    closures = [
        csv_row(rendered[f"{name}.csv"], method="model_a", speed_ratio="1.1", pursuers="3", obstacles="1")["closure"]
        for name in ("table2", "table_common_rule")
    ]
    assert closures == ["pursuers", "all"]


def test_an_alias_shows_whose_runs_it_has_and_own_runs_come_first() -> None:
    runs = [finished("ours", OPEN, 0, 95), finished("ours", OPEN, 1, 97)]
    aliases = {Cell("model_a", OPEN): Cell("ours", OPEN), Cell("model_a", ONE): Cell("ours", ONE)}
    rendered = tables.render_tables(runs, aliases)
    shared = markdown_row(rendered["table4.md"], "Model A (runs of Ours)", "1.1", "3", "0")
    ours = markdown_row(rendered["table4.md"], "Ours", "1.1", "3", "0")
    assert (shared[:2], shared[3]) == (ours[:2], ours[3])
    assert shared[2] == "95.40 / 25.35"
    assert csv_row(rendered["table4.csv"], method="model_a", obstacles="0")["runs_of"] == "ours"
    assert markdown_row(rendered["table4.md"], "Model A", "1.1", "3", "1")[0] == "not run"
    assert markdown_row(rendered["table_differences.md"], "Model A", "1.1", "3", "0")[1] == "the same runs"
    own = tables.render_tables([*runs, finished("model_a", OPEN, 0, 50, closure="pursuers")], aliases)
    assert markdown_row(own["table4.md"], "Model A", "1.1", "3", "0")[0] == "50.00"


def test_a_method_that_the_paper_lacks_gets_its_rows_after_the_papers() -> None:
    runs = [finished("my_method", ONE, 0, 90), finished("model_c", ONE, 0, 80), finished("model_c", OPEN, 0, 70)]
    rendered = tables.render_tables(runs)
    assert [row[0] for row in markdown_rows(rendered["table2.md"])[16:]] == ["Model C", "my_method"]
    assert markdown_row(rendered["table2.md"], "my_method", "1.1", "3", "1")[2] == "not reported"
    assert len(markdown_rows(rendered["table4.md"])) == 16 + 3


def test_cells_outside_the_papers_settings_have_a_table_of_their_own() -> None:
    tunnel, five, many = Setting(1.1, 3, 1, "tunnel"), Setting(1.1, 5, 2), Setting(1.25, 3, 0)
    runs = [
        finished("my_method", tunnel, 0, 60),
        finished("ours", tunnel, 900, 80),
        finished("ours", tunnel, 901, 90),
        finished("ours", ONE, 0, 90),
        finished("my_method", ONE, 0, 90),
        finished("ours", many, 0, 70),
        Run(Cell("ma2019", five), 3, "diverged", "pursuers"),
    ]
    rendered = tables.render_tables(runs, {Cell("model_a", many): Cell("ours", many)})
    others = rendered.pop("table_other.md"), rendered.pop("table_other.csv")
    assert rendered == tables.render_tables([run for run in runs if run.cell.setting == ONE]), "they are nowhere else"
    assert next(line for line in others[0].splitlines() if line.startswith("|")) == (
        "| Method | λ | n | m | Scene | S % | MEL | Paper S % / MEL | Seeds |"
    )
    # mean 85, s = 7.07, t(0.975, 1) = 12.7: wider than 0 to 100
    assert markdown_rows(others[0]) == [
        ["Ma", "1.1", "5", "2", "random", "diverged", "diverged", "not reported", "0, 1 diverged (3)"],
        ["Model A (runs of Ours)", "1.25", "3", "0", "random", "70.00", "20.00", "not reported", "1 (0)"],
        ["Ours", "1.1", "3", "1", "tunnel", "85.00 [21.47, 100.00]", "20.00 [20.00, 20.00]", "not reported",
         "2 (900 901)"],
        ["Ours", "1.25", "3", "0", "random", "70.00", "20.00", "not reported", "1 (0)"],
        ["my_method", "1.1", "3", "1", "tunnel", "60.00", "20.00", "not reported", "1 (0)"],
    ]  # fmt: skip
    rows = list(csv.DictReader(io.StringIO(others[1])))
    assert list(rows[0]) == list(csv.DictReader(io.StringIO(rendered["table2.csv"])).fieldnames or ())
    assert [(row["method"], row["scene"], row["closure"], row["result"], row["runs_of"]) for row in rows] == [
        ("ma2019", "random", "pursuers", "diverged", ""),
        ("model_a", "random", "all", "run", "ours"),
        ("ours", "tunnel", "all", "run", ""),
        ("ours", "random", "all", "run", ""),
        ("my_method", "tunnel", "all", "run", ""),
    ]


def test_a_cell_of_mixed_rules_or_seeds_twice_is_an_error_that_names_it() -> None:
    with pytest.raises(
        ValueError, match=r"ours at ratio 1\.1, n=3, m=1, random: its runs have different closure rules"
    ):
        tables.render_tables([finished("ours", ONE, 0, 5), finished("ours", ONE, 1, 5, closure="pursuers")])
    with pytest.raises(ValueError, match="duplicate training seed 0"):
        tables.render_tables([finished("ours", ONE, 0, 5), finished("ours", ONE, 0, 5)])


def test_differences_are_ours_minus_the_other_and_say_when_none_is_shown() -> None:
    ours = [finished("ours", ONE, seed, 92, step=20) for seed in range(3)]
    clear = [finished("model_b", ONE, seed, 60, step=25) for seed in range(3)]
    # of the same 100 rounds in all seeds ours wins 32 more, 5 steps sooner; the floor is Student's over the rounds:
    # s = sqrt(.32 * .68 * 100/99) = .468826, t(0.975, 99) = 1.984217: half .093025
    row = markdown_row(tables.render_tables(ours + clear)["table_differences.md"], "Model B", "1.1", "3", "1")
    assert row == ["all / all", "+32.00 [+22.70, +41.30]: higher", "-5.00 [-5.00, -5.00]: lower", "3"]
    close = [finished("model_b", ONE, seed, successes) for seed, successes in {0: 91, 1: 93, 2: 90}.items()]
    row = markdown_row(tables.render_tables(ours + close)["table_differences.md"], "Model B", "1.1", "3", "1")
    assert row[1].endswith(": no difference shown")
    assert (
        csv_row(tables.render_tables(ours + close)["table_differences.csv"], method="model_b", result="compared")[
            "success_verdict"
        ]
        == "no difference shown"
    )


def test_differences_are_given_under_the_own_and_the_common_rule() -> None:
    ours = [Run(Cell("ours", ONE), 0, "finished", "all", [episode(0, 10, 12)])]
    model_a = [Run(Cell("model_a", ONE), 0, "finished", "pursuers", [episode(0, 10, None)])]
    rows = [
        row[4:]
        for row in markdown_rows(tables.render_tables(ours + model_a)["table_differences.md"])
        if row[:4] == ["Model A", "1.1", "3", "1"]
    ]
    assert rows == [
        ["all / pursuers", "+100.00: too few seeds to say", "no round both solve", "1"],
        ["all / all", "+0.00: too few seeds to say", "+0.00: too few seeds to say", "1"],
    ]


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (Run(Cell("model_b", ONE), 1, "finished", "all", rounds(5, 10)), "no common training seed"),
        (Run(Cell("model_b", ONE), 0, "finished", "all", rounds(5, 9)), "not evaluated on the same rounds"),
    ],
)
def test_what_cannot_be_compared_says_why(other: Run, reason: str) -> None:
    ours = Run(Cell("ours", ONE), 0, "finished", "all", rounds(5, 10))
    assert (
        markdown_row(tables.render_tables([ours, other])["table_differences.md"], "Model B", "1.1", "3", "1")[1]
        == reason
    )


def test_table_1_shows_the_options_of_each_model() -> None:
    text = tables.render_table1({"model_a": MethodOptions(True, False, True), "ours": MethodOptions(True, True, True)})[
        "table1.md"
    ]
    assert markdown_rows(text) == [["Model A", "✓", "", "✓"], ["Ours", "✓", "✓", "✓"]]


def write_study(folder: Path) -> None:
    for method, closure in (("ours", "all"), ("model_a", "pursuers")):
        for seed in (0, 1):
            write_run(folder, Cell(method, ONE), seed, rounds(90 - seed, 100), closure=closure)  # type: ignore[arg-type]


def test_rebuilt_tables_have_the_same_bytes(tmp_path: Path) -> None:
    write_study(tmp_path / "a")
    write_study(tmp_path / "b")
    first, again, copy = (tables.render_tables(records.read_runs(tmp_path / name)) for name in ("a", "a", "b"))
    assert first == again == copy
    assert tables.render_tables(reversed(records.read_runs(tmp_path / "a"))) == first


def test_an_edited_row_does_not_reach_the_tables(tmp_path: Path) -> None:
    write_study(tmp_path)
    path = tmp_path / records.run_path(Cell("ours", ONE), 1) / "episodes.csv"
    text = path.read_text()
    path.write_text(text.replace(f"99,{SEEDS[99]},,,60", f"99,{SEEDS[99]},20,20,60"))
    assert path.read_text() != text
    with pytest.raises(files.DamagedFileError) as caught:
        records.read_runs(tmp_path)
    assert caught.value.path == path
