"""A grid file becomes runs: every one once, each checked before the first is started."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from marl_encircle import cli
from marl_encircle.experiments import train as training
from marl_encircle.experiments.config import load_config
from marl_encircle.experiments.grid import Grid, Job, arguments, load_grid
from marl_encircle.experiments.pretrained import pretrained_runs
from marl_encircle.experiments.records import RECORD, Cell, Setting, run_folders
from marl_encircle.experiments.train import run_folder
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.paper import paper_results

ONE = Setting(1.1, 3, 1)
OURS = Cell("ours", ONE)


def grid_of(folder: Path, text: str) -> Grid:
    (folder / "grid.yaml").write_text(text)
    return load_grid(str(folder / "grid.yaml"))


def test_the_smoke_grid_is_two_tiny_cells() -> None:
    assert load_grid("smoke") == Grid((Job("ours", ONE, 900, "smoke"), Job("ma2019", ONE, 900, "smoke")), {})


def test_the_study_covers_every_cell_of_the_papers_tables() -> None:
    grid = load_grid("study")
    cells = {job.config.cell for job in grid.jobs} | grid.aliases.keys()
    asked = {cell for table in paper_results().values() for cell in table}
    assert len({cell.setting for cell in asked}) == 10
    assert asked <= cells
    assert len(set(grid.jobs)) == len(grid.jobs)
    assert {job.seed for job in grid.jobs}.isdisjoint({900, 901, 902})


def test_every_run_of_the_study_comes_with_the_repository() -> None:
    grid = load_grid("study")
    asked = {run_folder(job.config, job.seed, pretrained_runs()) for job in grid.jobs}
    assert asked == {run for run in run_folders(pretrained_runs()) if (run / RECORD).exists()}


def test_what_goes_beyond_the_paper_has_the_settings_seeds_and_rounds_of_the_study() -> None:
    jobs = load_grid("study").jobs
    ours, beyond = ([job for job in jobs if job.reward == reward] for reward in ("ours", "ours_plus"))
    assert {(job.setting, job.seed) for job in beyond} == {(job.setting, job.seed) for job in ours}
    for job in beyond:
        mine, ours = job.config, Job("ours", job.setting, 0, "full", "paper").config
        assert (mine.scenario, mine.evaluation, mine.training.curriculum) == (
            ours.scenario,
            ours.evaluation,
            ours.training.curriculum,
        )


def test_one_policy_is_trained_and_played_in_the_settings_of_the_study() -> None:
    grid = load_grid("study")
    (job,) = (job for job in grid.jobs if job.reward == "generalist")
    settings = {job.setting for job in grid.jobs if job.reward == "ours"}
    assert set(job.config.settings) == settings
    unseen = {Setting(1.1, 3, 5), Setting(1.1, 7, 1)}
    assert set(grid.elsewhere[job.config.cell]) == settings | unseen
    plus, ours = load_config("ours_plus").reward, job.config.reward
    assert ours.model_copy(update={"name": plus.name}) == plus


def test_without_obstacles_model_a_has_the_runs_of_ours() -> None:
    setting = Setting(1.1, 3, 0)
    grid = load_grid("study")
    assert grid.aliases[Cell("model_a", setting)] == Cell("ours", setting)
    assert Cell("model_a", setting) not in {job.config.cell for job in grid.jobs}


GRID = """profile: smoke
groups:
  - methods: [ours, {method}]
    settings: [{{speed_ratio: 1.1, pursuers: 3, obstacles: 1}}]
    seeds: [2, 3, 2]
shared: []
"""


def test_a_run_that_is_asked_for_twice_is_one_run(tmp_path: Path) -> None:
    grid = grid_of(tmp_path, GRID.format(method="ours"))
    assert [(job.reward, job.seed) for job in grid.jobs] == [("ours", 2), ("ours", 3)]


COMMIT = "0123456789abcdef0123456789abcdef01234567"


def test_a_grid_may_name_the_commit_in_which_its_recipe_was_frozen(tmp_path: Path) -> None:
    assert grid_of(tmp_path, GRID.format(method="ours")).frozen is None
    assert grid_of(tmp_path, f"frozen: {COMMIT}\n" + GRID.format(method="ours")).frozen == COMMIT


def test_a_grid_may_say_what_was_amended_since(tmp_path: Path) -> None:
    assert grid_of(tmp_path, GRID.format(method="ours")).amended is None
    amended = grid_of(tmp_path, "amended: twice the budget\n" + GRID.format(method="ours"))
    assert amended.amended == "twice the budget"
    with pytest.raises(ConfigError, match="amended: string should have at least 1 character"):
        grid_of(tmp_path, "amended: ''\n" + GRID.format(method="ours"))


def test_policies_are_played_in_the_scenes_that_a_grid_names(tmp_path: Path) -> None:
    text = GRID.format(method="ours") + "elsewhere: [{scene: concave, obstacles: %d}]\n"
    assert grid_of(tmp_path, text % 1).elsewhere == {OURS: (ONE._replace(scene="concave"),)}
    with pytest.raises(ConfigError, match=r"grid\.yaml: elsewhere\.0\.obstacles: no setting has 2"):
        grid_of(tmp_path, text % 2)
    study = {cell: others for cell, others in load_grid("study").elsewhere.items() if cell.method != "generalist"}
    assert {cell.setting.obstacles for cell in study} == {1}
    assert {len(others) for others in study.values()} == {2}


def test_a_scene_in_which_a_policy_was_trained_is_not_elsewhere(tmp_path: Path) -> None:
    text = GRID.format(method="ours") + "elsewhere: [{scene: random, obstacles: 1}]\n"
    assert grid_of(tmp_path, text).elsewhere == {}


def test_a_method_is_played_in_a_scene_in_which_only_another_was_trained(tmp_path: Path) -> None:
    tunnel = "{speed_ratio: 1.1, pursuers: 3, obstacles: 1, scene: tunnel}"
    other = f"  - methods: [model_b]\n    settings: [{tunnel}]\n    seeds: [0]\n"
    text = groups(group("ours", 3), other) + "elsewhere: [{scene: tunnel, obstacles: 1}]\n"
    assert grid_of(tmp_path, text).elsewhere == {OURS: (ONE._replace(scene="tunnel"),)}


def test_a_scene_in_which_no_policy_can_play_is_refused(tmp_path: Path) -> None:
    text = GRID.format(method="ours")
    with pytest.raises(ConfigError, match=r"elsewhere\.0\.scene: unknown scene 'tunel'; did you mean tunnel"):
        grid_of(tmp_path, text + "elsewhere: [{scene: tunel, obstacles: 1}]\n")
    (tmp_path / "split.yaml").write_text("composite_unit: false\n")
    split = "scenario: split.yaml\n" + text + "elsewhere: [{scene: tunnel, obstacles: 1}]\n"
    with pytest.raises(ConfigError, match=r"elsewhere\.0\.scene: policies of ours cannot play with other numbers"):
        grid_of(tmp_path, split)
    assert len(grid_of(tmp_path, split.replace("[ours, ours]", "[ours]\n    algorithm: matd3_set")).elsewhere) == 1


SETS = """\
profile: smoke
groups:
  - methods: [ours]
    overrides: [algorithm.features=%s]
    settings: [{speed_ratio: 1.1, pursuers: 3, obstacles: 1}]
    seeds: [0]
    elsewhere: [{speed_ratio: 1.2, pursuers: 7, obstacles: %s}]
shared: []
"""


def test_policies_of_sets_are_played_with_other_bodies(tmp_path: Path) -> None:
    assert grid_of(tmp_path, SETS % ("set", 5)).elsewhere == {OURS: (Setting(1.2, 7, 5),)}
    for features in ("observation", "relative"):
        with pytest.raises(ConfigError, match="elsewhere: policies of ours cannot play with other numbers of bodies"):
            grid_of(tmp_path, SETS % (features, 5))
    with pytest.raises(ConfigError, match=r"grid\.yaml: elsewhere: scenario\.obstacles must be"):
        grid_of(tmp_path, SETS % ("set", -1))


def setting_of(pursuers: int) -> str:
    return f"{{speed_ratio: 1.1, pursuers: {pursuers}, obstacles: 1}}"


def group(method: str, pursuers: int, *elsewhere: int, features: str = "set") -> str:
    return f"""\
  - methods: [{method}]
    overrides: [algorithm.features={features}]
    settings: [{setting_of(pursuers)}]
    seeds: [0]
    elsewhere: [{", ".join(map(setting_of, elsewhere))}]
"""


def groups(*some: str) -> str:
    return f"profile: smoke\ngroups:\n{''.join(some)}shared: []\n"


def test_where_one_group_is_played_too_is_not_asked_of_another(tmp_path: Path) -> None:
    text = groups(group("ours", 3, 5, 7, 5), group("model_b", 3, 4), group("ma2019", 3, features="observation"))
    assert grid_of(tmp_path, text).elsewhere == {
        OURS: (Setting(1.1, 5, 1), Setting(1.1, 7, 1)),
        Cell("model_b", ONE): (Setting(1.1, 4, 1),),
    }


@pytest.mark.parametrize(
    ("text", "pursuers", "of"),
    [
        (groups(group("ours", 3, 3)), 3, 3),
        (groups(group("ours", 3, 4), group("ours", 4)), 4, 4),
        (groups(group("ours", 3, 5), group("ours", 4, 5)), 5, 3),
    ],
    ids=["its own setting", "that of another training", "that another training is played in"],
)
def test_no_cell_has_rounds_of_two_trainings(tmp_path: Path, text: str, pursuers: int, of: int) -> None:
    where = f"ratio 1.1, n={pursuers}, m=1, random"
    fault = f"elsewhere: ours at {where} has the runs of its training at ratio 1.1, n={of},"
    with pytest.raises(ConfigError, match=fault):
        grid_of(tmp_path, text)


def test_the_cells_of_a_grid_are_those_that_have_or_share_runs() -> None:
    grid = load_grid("study")
    assert len(grid.cells) == 55
    assert Cell("model_a", Setting(1.1, 3, 0)) in grid.cells


def test_a_users_method_is_given_by_path_from_the_grids_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "idea.yaml").write_text("base: ours\nscale: 0.1\n")
    for path in ("mine/idea.yaml", str(tmp_path / "mine" / "idea.yaml")):
        monkeypatch.chdir("/")
        grid = grid_of(tmp_path, GRID.format(method=path))
        assert grid.jobs[1].config.reward.scale == 0.1
        assert grid.jobs[1].config.cell == Cell("idea", ONE)


def test_a_group_may_change_the_configurations_of_its_runs(tmp_path: Path) -> None:
    text = GRID.format(method="model_b").replace("seeds:", "overrides: [algorithm.gamma=0.5]\n    seeds:")
    jobs = grid_of(tmp_path, text).jobs
    assert {job.config.algorithm.gamma for job in jobs} == {0.5}
    assert all(arguments(job)[-2:] == ["--set", "algorithm.gamma=0.5"] for job in jobs)


def test_a_group_may_not_change_the_setting_of_its_runs(tmp_path: Path) -> None:
    text = GRID.format(method="model_b").replace("seeds:", "overrides: [scenario.pursuers=4]\n    seeds:")
    with pytest.raises(ConfigError, match=r"grid\.yaml: overrides: the setting belongs to settings; got .*pursuers=4"):
        grid_of(tmp_path, text)


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    for scale in (0.1, 0.2):
        (tmp_path / "idea.yaml").write_text(f"base: ours\nscale: {scale}\n")
        assert grid_of(tmp_path, GRID.format(method="idea.yaml")).jobs[1].config.reward.scale == scale


def test_two_methods_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "ours.yaml").write_text("base: ours\nscale: 0.1\n")
    with pytest.raises(ConfigError, match=r": ours and .*ours\.yaml have the same method name, ours"):
        grid_of(tmp_path, GRID.format(method="ours.yaml"))


TWO_ALGORITHMS = """profile: smoke
groups:
  - {{methods: [ours], algorithm: {first}, settings: [{setting}], seeds: [0, 1]}}
  - {{methods: [ours], algorithm: {second}, settings: [{setting}], seeds: [1, 2]}}
shared: []
"""


@pytest.mark.parametrize("seeds", ["[1, 2]", "[2]"])
def test_one_cell_with_two_configurations_is_refused(tmp_path: Path, seeds: str) -> None:
    text = TWO_ALGORITHMS.format(first="maddpg", second="matd3", setting=SETTING).replace("[1, 2]", seeds)
    with pytest.raises(ConfigError) as caught:
        grid_of(tmp_path, text)
    assert str(caught.value) == (
        f"{tmp_path}/grid.yaml: ours at ratio 1.1, n=3, m=1, random is asked for with two configurations: "
        "algorithm.name: maddpg first, matd3 then; the method of one of them needs another name"
    )


def test_one_training_under_two_names_is_one_run(tmp_path: Path) -> None:
    (tmp_path / "same.yaml").write_text("base: maddpg\n")
    grid = grid_of(tmp_path, TWO_ALGORITHMS.format(first="maddpg", second="same.yaml", setting=SETTING))
    assert [(job.algorithm, job.seed) for job in grid.jobs] == [("maddpg", 0), ("maddpg", 1), ("maddpg", 2)]


def test_what_is_wrong_with_a_method_is_told_with_the_grid_that_asks_for_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        grid_of(tmp_path, GRID.format(method="our"))
    assert str(caught.value).startswith(f"{tmp_path}/grid.yaml: reward 'our': neither a known name")
    (tmp_path / "mine.yaml").write_text("base: ours\nscales: 1.0\n")
    with pytest.raises(ConfigError) as caught:
        grid_of(tmp_path, GRID.format(method="mine.yaml"))
    assert str(caught.value).startswith(f"{tmp_path}/grid.yaml: {tmp_path}/mine.yaml: reward.scales: unknown key")


SETTING = "{speed_ratio: 1.1, pursuers: 3, obstacles: 1}"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("profile: smoke\n", "", "profile: missing"),
        ("profile: smoke", "profile: quick", "profile: input should be 'full' or 'smoke'; got 'quick'"),
        ("shared: []", "shares: []", "shares: unknown key; did you mean shared?"),
        ("methods:", "method:", "groups.0.method: unknown key; did you mean methods?"),
        ("pursuers:", "pursuer:", "groups.0.settings.0.pursuer: unknown key; did you mean pursuers?"),
        ("pursuers: 3", "pursuers: true", "groups.0.settings.0.pursuers: input should be a valid integer; got True"),
        ("pursuers: 3", "pursuers: 0", "scenario.pursuers must be between 1 and 64; got 0"),
        ("obstacles: 1", "obstacles: 30", "too many bodies to place"),
        ("speed_ratio: 1.1", "speed_ratio: 0.5", "scenario.speed_ratio must be between"),
        ("obstacles: 1", "obstacles: 1, scene: tunel", "scenario.scene must be one of"),
        ("[2, 3, 2]", "[-1]", "groups.0.seeds.0: input should be greater than or equal to 0; got -1"),
        ("[2, 3, 2]", "[4294967296]", "groups.0.seeds.0: input should be less than 4294967296"),
        ("[2, 3, 2]", "[true]", "groups.0.seeds.0: input should be a valid integer; got True"),
        ("[2, 3, 2]", "3", "groups.0.seeds: input should be a valid list; got 3"),
        ("[ours, ours]", "[]", "groups.0.methods: list should have at least 1 item"),
        ("[2, 3, 2]", "[]", "groups.0.seeds: list should have at least 1 item"),
        (f"[{SETTING}]", "[]", "groups.0.settings: list should have at least 1 item"),
        ("[ours, ours]", "[ours, our]", "reward 'our': neither a known name nor a .yaml path; did you mean ours?"),
        ("shared: []", f"shared: []\nfrozen: {COMMIT[1:]}", "frozen: string should match pattern"),
        ("shared: []", f"shared: []\nfrozen: {COMMIT.upper()}", "frozen: string should match pattern"),
        ("shared: []", f"shared: []\nfrozen: {COMMIT}0", "frozen: string should match pattern"),
        ("shared: []", f"shared: []\nfrozen: {'1' * 40}", "frozen: input should be a valid string; got 111"),
        ("shared: []", "shared: [{method: a, run_of: ours, obstacles: 0}]", "unknown key; did you mean runs_of?"),
        ("shared: []", "shared: [{method: ours, runs_of: model_a, obstacles: 1}]", "which is not in the grid"),
        ("shared: []", "shared: [{method: our, runs_of: ours, obstacles: 1}]", "shared.0.method: 'our' is not here;"),
        ("shared: []", "shared: [{method: ours, runs_of: ours, obstacles: 7}]", "shared.0.obstacles: no setting of"),
    ],
)  # fmt: skip
def test_a_bad_grid_is_refused_by_key_and_reason(tmp_path: Path, old: str, new: str, reason: str) -> None:
    text = GRID.format(method="ours")
    assert old in text
    with pytest.raises(ConfigError) as caught:
        grid_of(tmp_path, text.replace(old, new, 1))
    assert reason in str(caught.value)


def test_runs_are_shared_once(tmp_path: Path) -> None:
    entry = "{method: model_b, runs_of: ours, obstacles: 1}"
    text = GRID.format(method="model_b").replace("shared: []", f"shared: [{entry}]")
    assert grid_of(tmp_path, text).aliases == {Cell("model_b", ONE): OURS}
    with pytest.raises(ConfigError, match=r"grid\.yaml: shared\.1: model_b is there for obstacles 1 already"):
        grid_of(tmp_path, text.replace(entry, f"{entry}, {entry}"))


def test_a_seed_of_the_evaluation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"grid\.yaml: seed must differ from evaluation\.seed: .*; got 4000"):
        grid_of(tmp_path, GRID.format(method="ours").replace("[2, 3, 2]", "[2, 4000]"))


def test_a_grid_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"grid\.yaml: groups: list should have at least 1 item"):
        grid_of(tmp_path, "profile: smoke\ngroups: []\nshared: []\n")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("stud", "did you mean study?"),
        ("nope", "known: smoke, study"),
        ("calibration", "known: smoke, study"),
        ("absent.yaml", "No such file"),
    ],
)
def test_a_grid_that_is_not_there_is_refused(name: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_grid(name)
    assert reason in str(caught.value)


def test_a_job_on_the_command_line_is_the_same_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    trained: list[Any] = []

    def note(config: Any, seed: int, *_: Any, **__: Any) -> Any:
        trained.append((config, seed))
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "train", note)
    job = Job("model_c", Setting(1.25, 4, 2, "concave"), 17, "smoke")
    CliRunner().invoke(cli.app, ["train", *arguments(job), "--out", str(tmp_path)])
    assert trained == [(job.config, 17)]
    expected = load_config(
        "model_c", profile="smoke", fields={"speed_ratio": 1.25, "pursuers": 4, "obstacles": 2, "scene": "concave"}
    )
    assert job.config == expected


def test_the_first_seeds_of_all_cells_come_first() -> None:
    jobs = load_grid("study").jobs
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    first = [job.config.cell for job in jobs if job.seed == 0]
    assert set(first) == {job.config.cell for job in jobs}
    assert first[0] == Cell("ma2019", Setting(1.1, 3, 0, "random"))
