"""Verification: finds rounds that end otherwise and tables that the runs do not give, and writes nothing."""

import json
from pathlib import Path

import pytest
from made_up import compress
from tiny_runs import TINY, copy_of_finished, everything_in

from marl_encircle import files
from marl_encircle.experiments.episodes import episodes_from_csv, episodes_to_csv
from marl_encircle.experiments.grid import Grid, Job
from marl_encircle.experiments.records import Setting
from marl_encircle.experiments.train import run_folder, train
from marl_encircle.study import verify as verification
from marl_encircle.study.figures.write import write_figures
from marl_encircle.study.reproduce import write_tables
from marl_encircle.study.verify import Verification, is_off, verify

GRID = Grid((Job("ours", Setting(1.1, 3, 1), 0, "smoke", overrides=TINY),), {})


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """One finished run and its tables."""
    copy_of_finished(tmp_path / "runs")
    write_tables(GRID, tmp_path)
    return tmp_path


def change_a_round(results: Path, **values: float) -> None:
    """Change the first round of the run, as if another code had played it."""
    folder = run_folder(GRID.jobs[0].config, 0, results / "runs")
    first, *others = episodes_from_csv((folder / "episodes.csv").read_text())
    data = episodes_to_csv([first._replace(**values), *others]).encode()
    record = json.loads((folder / "run.json").read_text())
    record["sha256"]["episodes.csv"] = files.sha256_bytes(data)
    (folder / "episodes.csv").write_bytes(data)
    files.write_json(folder / "run.json", record)
    write_tables(GRID, results)


def test_what_was_recorded_here_is_played_again_to_the_last_bit(results: Path) -> None:
    before = everything_in(results)
    seen = []
    found = verify(GRID, results, lambda done, total: seen.append((done, total)))
    assert found == Verification(8, 8, rounds_here=8, equal_here=8, cells_off=0, changed=())
    assert found.passed
    assert seen == [(1, 1)]
    assert everything_in(results) == before


def test_a_run_that_was_stopped_before_its_record_was_written_is_passed_over(results: Path) -> None:
    run_folder(GRID.jobs[0].config, 0, results / "runs").joinpath("run.json").unlink()
    assert verify(GRID, results).rounds == 0


def test_compressed_rounds_are_played_again_too(results: Path) -> None:
    compress(run_folder(GRID.jobs[0].config, 0, results / "runs") / "episodes.csv")
    assert verify(GRID, results) == Verification(8, 8, rounds_here=8, equal_here=8, cells_off=0, changed=())


def test_another_figure_of_a_round_is_found(results: Path) -> None:
    change_a_round(results, return_mean=0.125)
    found = verify(GRID, results)
    assert (found.equal, found.equal_here, found.cells_off, found.changed) == (7, 7, 0, ())
    assert not found.passed


def test_another_processor_may_round_otherwise_but_not_end_otherwise(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verification, "cpu_model", lambda: "another")
    change_a_round(results, return_mean=0.125)
    assert verify(GRID, results) == Verification(8, 8, rounds_here=0, equal_here=0, cells_off=0, changed=())
    change_a_round(results, step_pursuers=17)
    found = verify(GRID, results)
    assert found.equal == 7
    assert not found.passed  # one of eight is more than 0.5 %


def test_every_number_can_be_asked_for_on_another_processor_too(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verification, "cpu_model", lambda: "another")
    change_a_round(results, return_mean=0.125)
    assert verify(GRID, results, exact=True) == Verification(8, 7, 8, 7, cells_off=0, changed=())


def test_a_run_of_another_processor_excuses_no_round_of_this_one(results: Path) -> None:
    job = Job("ours", Setting(1.1, 3, 1), 1, "smoke", overrides=TINY)
    grid = Grid((*GRID.jobs, job), {})
    train(job.config, job.seed, "native", results / "runs")
    record = run_folder(job.config, job.seed, results / "runs") / "run.json"
    files.write_json(record, {**json.loads(record.read_text()), "cpu": "another"})
    write_tables(grid, results)
    assert verify(grid, results) == Verification(16, 16, 8, 8, cells_off=0, changed=())
    change_a_round(results, return_mean=0.125)
    write_tables(grid, results)
    assert verify(grid, results) == Verification(16, 15, 8, 7, cells_off=0, changed=())


def test_a_table_that_the_runs_do_not_give_is_found(results: Path) -> None:
    table = results / "tables" / "table2.md"
    table.write_text(table.read_text().replace("not run", "99.99", 1))
    (results / "tables" / "table3.csv").unlink()
    found = verify(GRID, results)
    assert found.changed == ("tables/table2.md", "tables/table3.csv")
    assert found.equal == found.rounds
    assert not found.passed


def test_a_figure_that_the_runs_do_not_give_is_found(results: Path) -> None:
    write_figures(GRID, results)
    picture = results / "figures" / "figure4.svg"
    picture.write_bytes(picture.read_bytes().replace(b"success", b"failure", 1))
    (results / "figures" / "figure6.png").unlink()
    assert set(verify(GRID, results).changed) == {"figures/figure4.svg", "figures/figure6.png"}


def test_on_another_processor_only_figures_that_are_computed_anew_may_differ(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verification, "cpu_model", lambda: "another")
    write_figures(GRID, results)
    for name in ("figure1", "figure4", "figure6"):
        (results / "figures" / f"{name}.svg").write_text("another")
    assert verify(GRID, results).changed == ("figures/figure4.svg",)


def test_nothing_is_no_proof(tmp_path: Path) -> None:
    write_tables(GRID, tmp_path)
    found = verify(GRID, tmp_path)
    assert (found.rounds, found.changed) == (0, ())
    assert not found.passed


def test_a_cell_is_off_outside_the_99_percent_binomial_interval() -> None:
    """S = 90 % of 1,000 rounds: Wilson's interval is 87.29 to 92.18 %."""
    recorded = [True] * 900 + [False] * 100
    for successes, off in ((872, True), (873, False), (921, False), (922, True)):
        assert is_off(recorded, [True] * successes + [False] * (1000 - successes)) is off


@pytest.mark.parametrize("here", [0, 10_000])
def test_one_round_in_two_hundred_may_end_otherwise_elsewhere_and_none_here(here: int) -> None:
    def passed(equal: int, equal_here: int = here, cells_off: int = 0) -> bool:
        return Verification(here + 1000, equal_here + equal, here, equal_here, cells_off, ()).passed

    assert passed(995)
    assert not passed(994)
    assert not passed(1000, cells_off=1)
    assert not passed(1000, equal_here=here - 1)
