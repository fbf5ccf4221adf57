"""What the tables say: the paper's layout, our numbers above the paper's, and nothing that the runs do not show."""

import csv
import io
from pathlib import Path

import pytest
from made_up import SEEDS, episode, finished, markdown_row, markdown_rows, rounds, write_run

from marl_encircle import files
from marl_encircle.experiments import records
from marl_encircle.experiments.records import Cell, Run, Setting
from marl_encircle.study import paper, tables
from marl_encircle.study.tables import MethodOptions

OPEN = Setting(1.1, 3, 0)
ONE = Setting(1.1, 3, 1)
FAST = Setting(1.2, 3, 1)
MAIN = ["table2", "table3", "table4"]
FILES = sorted(
    [f"{name}.{kind}" for name in MAIN for kind in ("md", "tex", "csv")]
    + [f"table_{name}.{kind}" for name in ("common_rule", "differences") for kind in ("md", "csv")]
)


def our_row(text: str, method: str) -> list[str]:
    """Our row of a method: the first one of its name."""
    return next(row[1:] for row in markdown_rows(text) if row[0] == method)


def papers_row(text: str, method: str) -> list[str]:
    """The paper's row, below ours."""
    rows = markdown_rows(text)
    name, *cells = rows[[row[0] for row in rows].index(method) + 1]
    assert name == "*paper*"
    return cells


def behind(text: str) -> str:
    """The note on the training seeds."""
    [note] = [line for line in text.splitlines() if line.startswith("- Behind each number")]
    return note.removeprefix("- Behind each number: ")


def csv_row(text: str, **where: str) -> dict[str, str]:
    rows = csv.DictReader(io.StringIO(text))
    [row] = [row for row in rows if all(row[key] == value for key, value in where.items())]
    return row


def test_the_papers_numbers_are_read_as_printed() -> None:
    reported = paper.paper_results()
    assert list(reported) == MAIN
    assert [len(table) for table in reported.values()] == [16, 16, 16]
    assert len({cell.setting for table in reported.values() for cell in table}) == 10
    assert reported["table2"][Cell("ours", Setting(1.4, 3, 1))] == (73.7, 32.59)
    assert reported["table3"][Cell("model_a", Setting(1.1, 2, 1))] == (None, None)
    # the cell that all three tables have is the same in all three
    for method in paper.TABLE_METHODS:
        assert len({reported[name][Cell(method, ONE)] for name in MAIN}) == 1


def test_the_layout_is_the_papers_and_without_runs_every_cell_is_not_run() -> None:
    rendered = tables.render_tables([])
    assert sorted(rendered) == FILES
    heads = {"table2": ["λ = 1.1", "λ = 1.2", "λ = 1.3", "λ = 1.4"], "table3": ["n = 2", "n = 3", "n = 4", "n = 5"]}
    heads["table4"] = ["m = 0", "m = 1", "m = 2", "m = 3"]
    for name in MAIN:
        text = rendered[f"{name}.md"]
        assert next(line for line in text.splitlines() if "|" in line) == f"| Method | {' | '.join(heads[name])} |"
        rows = markdown_rows(text)
        assert [row[0] for row in rows] == [
            "Ma",
            "*paper*",
            "Model A",
            "*paper*",
            "Model B",
            "*paper*",
            "Ours",
            "*paper*",
        ]
        assert {cell for row in rows[::2] for cell in row[1:]} == {"not run"}
        assert "Behind each number" not in text
        assert {row["result"] for row in csv.DictReader(io.StringIO(rendered[f"{name}.csv"]))} == {"not run"}
    # Zheng et al. (2023), Tables 2 to 4
    assert papers_row(rendered["table2.md"], "Ours") == [
        "*91.80 / 25.91*", "*89.84 / 27.82*", "*88.70 / 28.52*", "*73.70 / 32.59*",
    ]  # fmt: skip
    assert papers_row(rendered["table3.md"], "Ma") == ["*–*", "*85.80 / 29.68*", "*97.40 / 19.90*", "*98.00 / 19.60*"]  # noqa: RUF001 - the paper's sign
    assert papers_row(rendered["table4.md"], "Model A")[0] == "*95.40 / 25.35*"
    assert "*paper*" not in rendered["table_common_rule.md"].split("##", 1)[1]
    assert len(markdown_rows(rendered["table_common_rule.md"])) == 3 * 4 + 2 * 2  # and the heads of two more tables


def test_a_cell_shows_mean_and_interval_in_every_table_it_belongs_to() -> None:
    runs = [finished("ours", ONE, seed, successes) for seed, successes in {900: 80, 901: 90, 902: 100}.items()]
    rendered = tables.render_tables(runs)
    # mean 90, s = 10, t(0.975, 2) = 4.302653: 90 +- 24.84, cut at 100
    expected = "90.0 [65.2, 100.0] / 20.0"
    places = {"table2": 0, "table3": 1, "table4": 1, "table_common_rule": 0}
    for name, place in places.items():
        text = rendered[f"{name}.md"]
        assert our_row(text, "Ours") == [expected if column == place else "not run" for column in range(4)]
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
    assert behind(rendered["table2.md"]) == "3 seeds (900 901 902) of 100 rounds."
    assert f"Ours & {expected} & not run & not run & not run" in rendered["table2.tex"]


def test_one_seed_has_no_interval_and_no_success_has_no_length() -> None:
    rendered = tables.render_tables([finished("ours", ONE, 0, 75), finished("model_b", ONE, 0, 0)])
    assert our_row(rendered["table2.md"], "Ours")[0] == "75.0 / 20.0"
    assert our_row(rendered["table2.md"], "Model B")[0] == "0.0 / no success"
    row = csv_row(rendered["table2.csv"], method="model_b", speed_ratio="1.1")
    assert (row["success_percent_low"], row["mean_episode_length"]) == ("", "")


def test_where_the_pursuers_alone_cannot_close_the_circle_zero_is_a_dash() -> None:
    two = Setting(1.1, 2, 1)
    runs = [
        finished("ma2019", FAST, 0, 0, closure="pursuers"),
        finished("model_a", FAST, 0, 3, closure="pursuers"),  # it did all the same: the number stands
        finished("model_b", FAST, 0, 0),  # may use the obstacle: it just failed
        finished("ma2019", ONE, 0, 0, closure="pursuers"),  # Eq. 6 holds: it just failed
        finished("ma2019", two, 0, 0, closure="pursuers"),
        Run(Cell("model_a", two), 0, "diverged", "pursuers"),
    ]
    rendered = tables.render_tables(runs)
    text = rendered["table2.md"]
    assert our_row(text, "Ma")[:2] == ["0.0 / no success", "– (0.0)"]  # noqa: RUF001 - the paper's sign
    assert our_row(text, "Model A")[1] == "3.0 / 20.0"
    assert our_row(text, "Model B")[1] == "0.0 / no success"
    assert our_row(rendered["table3.md"], "Ma")[0] == "– (0.0)"  # noqa: RUF001 - the paper's sign
    assert our_row(rendered["table3.md"], "Model A")[0] == "diverged"
    assert "-- (0.0)" in rendered["table2.tex"]
    assert "Eq. 6" in text
    assert "Eq. 6" not in rendered["table4.md"]
    # under the common rule the obstacle counts for all
    assert our_row(rendered["table_common_rule.md"], "Ma")[1] == "0.0 / no success"
    assert csv_row(rendered["table2.csv"], method="ma2019", speed_ratio="1.2")["success_percent"] == "0.0000"


def test_only_an_s_that_is_shown_to_be_higher_than_each_of_the_papers_is_bold() -> None:
    ours = [finished("ours", ONE, seed, 92) for seed in range(3)]
    low = [finished("model_b", ONE, seed, 60) for seed in range(3)]
    near = [
        finished("model_a", ONE, seed, successes, closure="pursuers") for seed, successes in enumerate((91, 93, 90))
    ]

    def first_column(runs: list[Run]) -> list[str]:
        return [row[1] for row in markdown_rows(tables.render_tables(runs)["table2.md"])[::2]]

    shown = first_column(ours + low)
    assert shown == ["not run", "not run", "60.0 [50.2, 69.1] / 20.0", "**92.0** [85.0, 95.9] / 20.0"]
    assert r"\textbf{92.0} [85.0, 95.9]" in tables.render_tables(ours + low)["table2.tex"]
    assert "**" not in "".join(first_column(ours + low + near)), "higher than Model B, but not than Model A"
    assert "**" not in "".join(first_column(ours)), "nothing to be higher than"
    assert "**" not in "".join(first_column(ours[:1] + low)), "one common seed has no interval"
    assert "**" not in "".join(first_column([*ours, finished("model_b", ONE, 7, 1)])), "no common seed"
    better = [finished("my_method", ONE, seed, 100) for seed in range(3)]
    assert [cell.split()[0] for cell in first_column(ours + low + better) if "**" in cell] == ["**92.0**", "**100.0**"]
    worse = [finished("my_method", ONE, seed, 80) for seed in range(3)]
    assert [cell.split()[0] for cell in first_column(ours + low + worse) if "**" in cell] == ["**92.0**"]


def test_bold_follows_the_closure_rule_of_the_table_and_passes_over_dashes() -> None:
    # Model A's rounds end enclosed under the common rule, not under its own
    model_a = [
        Run(Cell("model_a", ONE), seed, "finished", "pursuers", [episode(i, 20, None) for i in range(100)])
        for seed in range(3)
    ]
    ours = [finished("ours", ONE, seed, 92) for seed in range(3)]
    rendered = tables.render_tables(model_a + ours)
    assert our_row(rendered["table2.md"], "Ours")[0].startswith("**92.0**")
    assert our_row(rendered["table_common_rule.md"], "Model A")[0].startswith("**100.0**")
    fast = [finished("ours", FAST, seed, 92) for seed in range(3)]
    fast += [finished("model_b", FAST, seed, 60) for seed in range(3)]
    dashed = [*fast, finished("ma2019", FAST, 0, 0, closure="pursuers")]
    assert our_row(tables.render_tables(dashed)["table2.md"], "Ours")[1].startswith("**92.0**")
    numbered = [*fast, finished("ma2019", FAST, 0, 1, closure="pursuers")]  # one seed: no interval
    assert our_row(tables.render_tables(numbered)["table2.md"], "Ours")[1].startswith("92.0")


def test_every_column_has_its_own_best() -> None:
    shares = {("ours", ONE): 90, ("model_b", ONE): 40, ("ours", FAST): 20, ("model_b", FAST): 60}
    runs = [finished(*cell, seed, successes) for cell, successes in shares.items() for seed in range(3)]
    text = tables.render_tables(runs)["table2.md"]
    assert [cell.startswith("**") for cell in our_row(text, "Ours")] == [True, False, False, False]
    assert [cell.startswith("**") for cell in our_row(text, "Model B")] == [False, True, False, False]


def test_runs_without_a_result_are_counted_and_not_in_the_mean() -> None:
    cell = Cell("ours", ONE)
    others = [Run(cell, 1, "diverged", "all"), Run(cell, 2, "unfinished"), Run(cell, 3, "not evaluated", "all")]
    rendered = tables.render_tables([finished("ours", ONE, 0, 75), Run(cell, 4, "diverged", "all"), *others])
    assert our_row(rendered["table2.md"], "Ours")[0] == "75.0 / 20.0"
    assert behind(rendered["table2.md"]) == (
        "1 seed (0) of 100 rounds, 2 diverged (1 4), 1 unfinished (2), 1 not evaluated (3)."
    )
    record = csv_row(rendered["table2.csv"], method="ours", speed_ratio="1.1")
    assert [record[key] for key in ("seeds", "diverged", "unfinished", "not_evaluated")] == ["1", "2", "1", "1"]
    only_others = tables.render_tables(others)["table2.md"]
    assert our_row(only_others, "Ours")[0] == "diverged, unfinished, not evaluated"
    assert behind(only_others) == "no finished run, 1 diverged (1), 1 unfinished (2), 1 not evaluated (3)."
    assert "are counted, and are not in the means" in only_others


def test_the_seeds_behind_each_number_are_told_once_and_then_the_exceptions() -> None:
    runs = [
        finished(method, setting, seed, 90)
        for method in ("model_b", "ours")
        for setting in (ONE, FAST)
        for seed in (0, 1)
    ]
    runs += [finished("ma2019", Setting(ratio, 3, 1), 0, 0, closure="pursuers") for ratio in (1.2, 1.3)]
    runs += [finished("model_a", FAST, 0, 0, closure="pursuers")]
    runs += [finished("model_a", ONE, 0, 90), finished("model_a", ONE, 1, 0), Run(Cell("model_a", ONE), 2, "diverged")]
    assert behind(tables.render_tables(runs)["table2.md"]) == (
        "2 seeds (0 1) of 100 rounds; 1 seed (0) of 100 rounds for Ma at λ = 1.2, 1.3 and Model A at λ = 1.2; 2 seeds"
        " (0 1) of 100 rounds, 1 diverged (2), MEL from the 1 with a success for Model A at λ = 1.1."
    )


def test_main_tables_take_each_methods_own_rule_and_the_common_table_one_for_all() -> None:
    episodes = [episode(0, 10, 30), episode(1, 20, None)]
    runs = [
        Run(Cell("model_a", ONE), 0, "finished", "pursuers", episodes),
        Run(Cell("ours", ONE), 0, "finished", "all", episodes),
    ]
    rendered = tables.render_tables(runs)
    assert our_row(rendered["table2.md"], "Model A")[0] == "50.0 / 30.0"
    assert our_row(rendered["table2.md"], "Ours")[0] == "100.0 / 15.0"
    assert our_row(rendered["table_common_rule.md"], "Model A")[0] == "100.0 / 15.0"
    closures = [
        csv_row(rendered[f"{name}.csv"], method="model_a", speed_ratio="1.1", pursuers="3", obstacles="1")["closure"]
        for name in ("table2", "table_common_rule")
    ]
    assert closures == ["pursuers", "all"]


def test_an_alias_shows_whose_runs_it_has_and_own_runs_come_first() -> None:
    runs = [finished("ours", OPEN, 0, 95), finished("ours", OPEN, 1, 97)]
    aliases = {Cell("model_a", OPEN): Cell("ours", OPEN), Cell("model_a", ONE): Cell("ours", ONE)}
    rendered = tables.render_tables(runs, aliases)
    text = rendered["table4.md"]
    assert our_row(text, "Model A") == our_row(text, "Ours") == ["96.0 [83.3, 100.0] / 20.0", *["not run"] * 3]
    assert behind(text) == "2 seeds (0 1) of 100 rounds."
    assert "- The runs of Ours are shown for Model A at m = 0 too.\n" in text
    assert "under its own closure rule (pursuers and obstacles: Ours)." in text
    assert csv_row(rendered["table4.csv"], method="model_a", obstacles="0")["runs_of"] == "ours"
    assert markdown_row(rendered["table_differences.md"], "Model A", "1.1", "3", "0")[1] == "the same runs"
    own = tables.render_tables([*runs, finished("model_a", OPEN, 0, 50, closure="pursuers")], aliases)
    assert our_row(own["table4.md"], "Model A")[0] == "50.0 / 20.0"


def test_a_method_that_the_paper_lacks_gets_its_row_after_the_papers() -> None:
    runs = [finished("my_method", ONE, 0, 90), finished("model_c", ONE, 0, 80), finished("model_c", OPEN, 0, 70)]
    rendered = tables.render_tables(runs, asked=[Cell("idea", ONE), Cell("idea", Setting(1.1, 3, 7))])
    rows = markdown_rows(rendered["table4.md"])[8:]
    assert rows == [
        ["Model C", "70.0 / 20.0", "80.0 / 20.0", "", ""],
        ["idea", "", "not run", "", ""],
        ["my_method", "", "90.0 / 20.0", "", ""],
    ]
    assert "- Empty: the grid does not ask for it.\n" in rendered["table4.md"]
    assert "- Not run: there is no such run here.\n" in rendered["table4.md"]
    assert csv_row(rendered["table2.csv"], method="my_method")["paper_success_percent"] == ""
    assert csv_row(rendered["table2.csv"], method="idea")["result"] == "not run"
    assert markdown_row(rendered["table_differences.md"], "idea", "1.1", "3", "1")[1] == "not run"
    assert r"my\_method &" in rendered["table4.tex"]


def test_a_policy_is_shown_in_every_setting_that_it_has_played() -> None:
    home, many = Setting(1.4, 5, 3), Setting(1.1, 7, 1)
    played = {ONE: rounds(80, 100, step=30), OPEN: rounds(70, 100, step=20), many: rounds(60, 100, step=20)}
    run = finished("one_for_all", home, 0, 90)
    run = Run(run.cell, 0, "finished", run.closure, run.episodes, played)
    rendered = tables.render_tables([run])
    assert markdown_row(rendered["table4.md"], "one_for_all") == ["70.0 / 20.0", "80.0 / 30.0", "", ""]
    settings = [row[:5] for row in markdown_rows(rendered["table_other.md"])]
    assert settings == [["one_for_all", "1.1", "7", "1", "random"], ["one_for_all", "1.4", "5", "3", "random"]]
    tunnel = Run(run.cell, 0, "finished", run.closure, run.episodes, {ONE._replace(scene="tunnel"): run.episodes})
    assert "tunnel" not in "".join(tables.render_tables([tunnel]).values())


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
        finished("ma2019", many, 0, 0, closure="pursuers"),
    ]
    rendered = tables.render_tables(runs, {Cell("model_a", many): Cell("ours", many)})
    others = rendered.pop("table_other.md"), rendered.pop("table_other.csv")
    assert rendered == tables.render_tables([run for run in runs if run.cell.setting == ONE]), "they are nowhere else"
    assert next(line for line in others[0].splitlines() if line.startswith("|")) == (
        "| Method | λ | n | m | Scene | S [95 % interval] / MEL | Training seeds |"
    )
    # mean 85, s = 7.07, t(0.975, 1) = 12.7: wider than 0 to 100
    assert markdown_rows(others[0]) == [
        ["Ma", "1.1", "5", "2", "random", "diverged", "no finished run, 1 diverged (3)"],
        ["Ma", "1.25", "3", "0", "random", "– (0.0)", "1 seed (0) of 100 rounds"],  # noqa: RUF001 - the paper's sign
        ["Model A (runs of Ours)", "1.25", "3", "0", "random", "70.0 / 20.0", "1 seed (0) of 100 rounds"],
        ["Ours", "1.1", "3", "1", "tunnel", "85.0 [21.5, 100.0] / 20.0", "2 seeds (900 901) of 100 rounds"],
        ["Ours", "1.25", "3", "0", "random", "70.0 / 20.0", "1 seed (0) of 100 rounds"],
        ["my_method", "1.1", "3", "1", "tunnel", "60.0 / 20.0", "1 seed (0) of 100 rounds"],
    ]
    rows = list(csv.DictReader(io.StringIO(others[1])))
    assert list(rows[0]) == list(csv.DictReader(io.StringIO(rendered["table2.csv"])).fieldnames or ())
    assert [(row["method"], row["scene"], row["closure"], row["result"], row["runs_of"]) for row in rows] == [
        ("ma2019", "random", "pursuers", "diverged", ""),
        ("ma2019", "random", "pursuers", "run", ""),
        ("model_a", "random", "all", "run", "ours"),
        ("ours", "tunnel", "all", "run", ""),
        ("ours", "random", "all", "run", ""),
        ("my_method", "tunnel", "all", "run", ""),
    ]


def test_every_table_for_readers_names_the_commit_in_which_the_recipe_was_frozen() -> None:
    commit = "0123456789abcdef0123456789abcdef01234567"
    runs = [finished("ours", Setting(1.1, 3, 1, "tunnel"), 0, 90)]
    options = {"ours": MethodOptions(True, True, True)}

    def rendered(*freeze: str | None) -> dict[str, str]:
        notes = tables.freeze_notes(*freeze)
        return tables.render_tables(runs, notes=notes) | tables.render_table1(options, notes)

    note = "Scenario and recipe frozen in commit 0123456789ab."
    for name, text in rendered(commit).items():
        assert text.count(note) == (0 if name.endswith(".csv") else 1), name
    assert "frozen" not in "".join(rendered(None).values())
    amended = "Amended since: the budget is twice as long."
    for name, text in rendered(commit, "the budget is twice as long.").items():
        assert text.replace("\\_", "_").count(amended) == text.count(note) == (0 if name.endswith(".csv") else 1), name


def test_a_cell_of_mixed_rules_or_seeds_twice_is_an_error_that_names_it() -> None:
    with pytest.raises(
        ValueError, match=r"ours at ratio 1\.1, n=3, m=1, random: its runs have different closure rules"
    ):
        tables.render_tables([finished("ours", ONE, 0, 5), finished("ours", ONE, 1, 5, closure="pursuers")])
    with pytest.raises(ValueError, match="duplicate training seed 0"):
        tables.render_tables([finished("ours", ONE, 0, 5), finished("ours", ONE, 0, 5)])


def test_table_1_shows_the_options_of_each_model() -> None:
    rendered = tables.render_table1(
        {"model_a": MethodOptions(True, False, True), "ours": MethodOptions(True, True, True)}
    )
    assert markdown_rows(rendered["table1.md"]) == [["Model A", "✓", "", "✓"], ["Ours", "✓", "✓", "✓"]]
    assert r"Model A & \checkmark &  & \checkmark \\" in rendered["table1.tex"]
    assert rendered["table1.tex"].startswith("% \\usepackage{booktabs,amssymb}\n")
    assert csv_row(rendered["table1.csv"], method="model_a") == {
        "method": "model_a",
        "two_stage": "yes",
        "obstacle_assisted": "no",
        "individual_contributing_angle": "yes",
    }


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
