"""Event files hold what was logged, once, and what the committed learning curves say."""

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import metadata
from tensorboard.summary.writer import event_file_writer
from tiny_runs import contents, copy_of_finished, everything_in, finished, tiny

from marl_encircle import files
from marl_encircle.core.rewards import TERMS
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments import train
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.descriptions import METRICS, TRAINING, hyperparameters, texts
from marl_encircle.experiments.learning_curve import count_points
from marl_encircle.experiments.loading import load_policy
from marl_encircle.experiments.signals import Stopped
from marl_encircle.experiments.tensorboard import EventFiles, Picture, is_drawn, lay_out
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.replays.thumbnails import thumbnails

RUNS = Path(__file__).parents[2] / "results" / "runs"


@pytest.fixture(autouse=True)
def _names_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Event files of one process and second are read in the order of their names, in which 10 comes before 9."""
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(1000))


def events_of(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0, "tensors": 0})
    events.Reload()
    return events


def curve_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((folder / "progress.csv").read_text())))


def assert_same_curve(events: EventAccumulator, run: Path, pursuers: int) -> None:
    """Every figure of the learning curve is there once, at its step, and no other."""
    rows = curve_of(run)
    columns = [name for name in rows[0] if name != "world_steps"]
    assert {tag for tag in events.Tags()["scalars"] if tag.startswith("eval/")} == {
        f"eval/{name}" for name in columns if any(row[name] for row in rows)
    }
    for name in columns:
        expected = [(int(row["world_steps"]) * pursuers, float(row[name])) for row in rows if row[name]]
        if expected:
            found = [(each.step, each.value) for each in events.Scalars(f"eval/{name}")]
            assert [step for step, _ in found] == [step for step, _ in expected]
            assert [value for _, value in found] == pytest.approx([value for _, value in expected], rel=1e-6)


# committed learning curves


def test_committed_curves_are_shown_under_the_tags_of_a_training(tmp_path: Path) -> None:
    shown = lay_out(RUNS, tmp_path)
    runs = sorted(path.parent for path in RUNS.glob("*/*/*/run.json"))
    assert sum(shown) == len(runs) >= 22
    for run in runs:
        pursuers = int(run.parent.name.split("_n")[1].split("_")[0])
        assert_same_curve(events_of(tmp_path / run.relative_to(RUNS)), run, pursuers)


def test_a_run_with_event_files_is_linked_to_and_goes_on_being_seen(tmp_path: Path) -> None:
    copy_of_finished(tmp_path / "runs")
    run, _ = train.train(tiny(), 1, "native", tmp_path / "runs", tensorboard=True)
    (run / "run.json").unlink()  # still in training, as far as one can see
    (tmp_path / "shown").mkdir()
    assert lay_out(tmp_path / "runs", tmp_path / "shown") == (1, 1)
    link = tmp_path / "shown" / run.relative_to(tmp_path / "runs")
    assert link.is_symlink()
    assert_same_curve(events_of(link), run, 3)


def test_a_changed_learning_curve_is_refused_by_name(tmp_path: Path) -> None:
    run = copy_of_finished(tmp_path / "runs")
    (run / "progress.csv").write_text((run / "progress.csv").read_text().replace("120", "121"))
    (tmp_path / "shown").mkdir()
    with pytest.raises(files.DamagedFileError, match=r"progress\.csv: changed since it was written"):
        lay_out(tmp_path / "runs", tmp_path / "shown")


# a training


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run with everything logged."""
    return train.train(tiny(), 0, "native", tmp_path_factory.mktemp("live"), tensorboard=True, draw=thumbnails)[0]


def test_logging_and_drawing_change_no_bit_of_a_training(live: Path) -> None:
    assert contents(live) == contents(finished())


def test_the_curve_is_logged_at_the_steps_of_its_points(live: Path) -> None:
    assert_same_curve(events_of(live / "tensorboard"), live, 3)


def test_each_chart_of_the_layout_has_scalars(live: Path) -> None:
    events = events_of(live / "tensorboard")
    (stored,) = events.Tensors("custom_scalars__config__")
    layout = layout_pb2.Layout.FromString(stored.tensor_proto.string_val[0])
    assert [category.title for category in layout.category] == list(TRAINING)
    tags = events.Tags()["scalars"]
    patterns = [pattern for category in layout.category for chart in category.chart for pattern in chart.multiline.tag]
    without = [pattern for pattern in patterns if not any(re.match(pattern, tag) for tag in tags)]
    assert without in ([], ["eval/mean_episode_length"]), "beginners may have no successful round"


def test_the_configuration_is_there_as_tables(live: Path) -> None:
    events = events_of(live / "tensorboard")
    expected = texts(tiny(), 0)
    assert "| contraction | 1 |" in expected["reward"]
    assert "| batch_size | 32 |" in expected["configuration"]
    for tag, text in expected.items():
        (stored,) = events.Tensors(f"{tag}/text_summary")
        assert stored.tensor_proto.string_val[0].decode() == text


def test_hyperparameters_are_one_row_for_all_seeds_judged_by_the_selection_rounds(tmp_path: Path) -> None:
    groups = set()
    for seed in (0, 1):
        folder, _ = train.train(
            tiny(overrides=["training.world_steps=100"]), seed, "native", tmp_path, tensorboard=True
        )
        plugin = events_of(folder / "tensorboard").PluginTagToContent(metadata.PLUGIN_NAME)
        experiment = metadata.parse_experiment_plugin_data(plugin[metadata.EXPERIMENT_TAG])
        start = metadata.parse_session_start_info_plugin_data(plugin[metadata.SESSION_START_INFO_TAG])
        assert [metric.name.tag for metric in experiment.metric_infos] == list(METRICS)
        values = hyperparameters(tiny(overrides=["training.world_steps=100"]))
        assert {info.name for info in experiment.hparam_infos} == values.keys()
        assert {
            name: value.string_value or value.number_value for name, value in start.hparams.items()
        } == pytest.approx(values)
        groups.add(start.group_name)
    assert len(groups) == 1


def test_every_method_has_the_same_hyperparameters() -> None:
    ours, ma = (hyperparameters(load_config(name)) for name in ("ours", "ma2019"))
    assert ours.keys() == ma.keys()
    assert {name for name in ours if name.startswith("weight.")} == {f"weight.{name}" for name in TERMS}
    assert (ours["weight.contraction"], ma["weight.contraction"]) == (1.0, 0.0)


# pictures


def test_the_last_policy_is_drawn_at_the_last_point(live: Path) -> None:
    events = events_of(live / "tensorboard")
    pictures = thumbnails(load_policy(live), tiny())
    assert {picture.tag for picture in pictures} == set(events.Tags()["images"])
    for picture in pictures:
        (stored,) = events.Images(picture.tag)
        assert (stored.step, stored.width, stored.height) == (3 * 400, picture.width, picture.height)
        assert stored.encoded_image_string == picture.data
        with Image.open(io.BytesIO(picture.data)) as image:
            assert image.size == (picture.width, picture.height)
            assert getattr(image, "n_frames", 1) == (1 if picture.data.startswith(b"\x89PNG") else 8)


@pytest.mark.parametrize(
    ("world_steps", "every", "drawn"),
    [
        (1_000_000, 50_000, [4, 8, 12, 16, 20]),
        (2_000_000, 50_000, [8, 16, 24, 32, 40]),
        (400_000, 50_000, [4, 8]),
        (100_000, 50_000, [2]),
        (12_000, 4_000, [3]),
        (1_000_000, 400_000, [1, 2, 3]),
    ],
)
def test_pictures_are_few_evenly_spaced_and_the_last_is_among_them(
    world_steps: int, every: int, drawn: Sequence[int]
) -> None:
    lengths = [f"training.world_steps={world_steps}", f"training.curve_every={every}"]
    config = load_config(overrides=[*lengths, "training.curriculum=null"])
    points = count_points(config)
    assert points == -(-world_steps // every)
    assert [point for point in range(1, points + 1) if is_drawn(config, point)] == drawn


def test_the_last_point_is_drawn_where_one_less_is_reached() -> None:
    lengths = ["training.world_steps=400", "algorithm.train_freq=25", "training.curve_every=130"]
    config = tiny(overrides=lengths)  # points at 200, 300 and 400
    assert [point for point in range(1, 4) if is_drawn(config, point)] == [3]


# resumed


def stop_at(monkeypatch: pytest.MonkeyPatch, world_steps: int, how: Callable[[], None]) -> None:
    step_wait = CurriculumVecEnv.step_wait

    def stopping(self: CurriculumVecEnv) -> Any:
        if self.world_steps == world_steps:
            how()
        return step_wait(self)

    monkeypatch.setattr(CurriculumVecEnv, "step_wait", stopping)


class Killed(Exception):  # noqa: N818
    """As by SIGKILL: no checkpoint is written any more."""


def killed() -> None:
    raise Killed


@pytest.mark.parametrize("checkpoint_at", [0, 200, 340])
def test_what_was_logged_after_the_checkpoint_is_not_seen_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checkpoint_at: int
) -> None:
    """Points at 120, 240, 360 and 400; killed at 380, after two or three of them."""
    save = train._Run.save_checkpoint
    with monkeypatch.context() as patch:
        patch.setattr(train, "ROUNDS_PER_LOG", 3)
        patch.setattr(
            train._Run,
            "save_checkpoint",
            lambda self: save(self) if 0 < self.curriculum.world_steps <= checkpoint_at else None,
        )
        stop_at(patch, 380, killed)
        with pytest.raises(Killed):
            train.train(tiny(), 0, "native", tmp_path, tensorboard=True, draw=one_dot, checkpoint_every=0.0)
    monkeypatch.setattr(train, "ROUNDS_PER_LOG", 3)
    folder, _ = train.train(tiny(), 0, "native", tmp_path, tensorboard=True, draw=one_dot)
    assert len(list((folder / "tensorboard").iterdir())) == (2 if checkpoint_at else 1)
    events = events_of(folder / "tensorboard")
    assert_same_curve(events, folder, 3)
    for tag in events.Tags()["scalars"]:
        steps = [each.step for each in events.Scalars(tag)]
        assert steps == sorted(set(steps)), tag
    assert [each.step for each in events.Images("dot")] == [1200]
    assert len(events.Tensors("reward/text_summary")) == 1


def test_a_last_point_that_comes_again_is_seen_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: Any) -> None:
        raise Stopped(15)

    with monkeypatch.context() as patch:
        patch.setattr(train._Run, "record", stopped)
        with pytest.raises(Stopped):
            train.train(tiny(), 0, "native", tmp_path, tensorboard=True)
    folder, _ = train.train(tiny(), 0, "native", tmp_path, tensorboard=True)
    assert_same_curve(events_of(folder / "tensorboard"), folder, 3)


def one_dot(_policy: MADDPGPolicy, _config: Config) -> list[Picture]:
    out = io.BytesIO()
    Image.new("RGB", (1, 1)).save(out, "PNG")
    return [Picture("dot", out.getvalue(), 1, 1)]


def test_event_files_that_lie_elsewhere_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "events.out.tfevents.1").write_bytes(b"somebody's")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(files.DamagedFileError, match="link: a link, where files"):
        EventFiles(tmp_path / "link", tiny(), 0, 0)
    assert everything_in(tmp_path / "elsewhere") == ["events.out.tfevents.1"]
