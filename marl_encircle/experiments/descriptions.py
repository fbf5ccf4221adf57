"""What TensorBoard is told of a training before it starts: which charts, the configuration, the hyper-parameters."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from marl_encircle.core.rewards import TERMS
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.records import config_hash, run_path

Layout = Mapping[str, Mapping[str, Sequence[str]]]
"""Tags, as regular expressions, by category and chart of the custom scalars."""

CURVES: Layout = {
    "Selection rounds": {
        "success, the method's own rule": ["eval/success$"],
        "mean episode length (MEL) of the successful rounds": ["eval/mean_episode_length"],
        "success under both rules": ["eval/success_all", "eval/success_pursuers"],
    },
}
TRAINING: Layout = {
    **CURVES,
    "Losses": {"critic": ["train/critic_loss"], "actor": ["train/actor_loss"]},
    "Curriculum": {"difficulty": ["curriculum/.+"], "success in training": ["rounds/success_.+"]},
    "Reward": {"terms, per round": ["reward/.+"], "return": ["rollout/ep_rew_mean"]},
}

METRICS = ("eval/success", "eval/mean_episode_length", "eval/sigma_c")
"""What hyper-parameters are judged by; not the reported rounds, since choosing by them would spoil the report."""


def describe(writer: Any, config: Config, seed: int, layout: Layout = TRAINING) -> None:
    """Write what is trained.

    :param writer: PyTorch's ``SummaryWriter``
    :param layout: the charts for which there will be scalars
    """
    writer.add_custom_scalars(
        {
            category: {title: ["Multiline", tags] for title, tags in charts.items()}
            for category, charts in layout.items()
        }
    )
    for tag, text in texts(config, seed).items():
        writer.add_text(tag, text, 0)
    for summary in _hyperparameter_summaries(config):
        writer.file_writer.add_summary(summary)
    writer.flush()


def texts(config: Config, seed: int) -> dict[str, str]:
    """Return Markdown by tag: the reward, and the other sections of the resolved configuration."""
    values, reward = config.to_dict(), config.reward
    head = f"**{reward.name}**: closure {reward.closure}, {'two stages' if reward.two_stage else 'one stage'}"
    active = reward.build().active.items()
    terms = [(name, f"{weight:g}", _in_words(parameters)) for name, (weight, parameters) in active]
    sections = [
        f"### {section}\n\n"
        + _table(("key", "value"), [(key, _in_words(value)) for key, value in values[section].items()])
        for section in ("scenario", "algorithm", "training", "evaluation")
    ]
    return {
        "reward": f"{head}, scale {reward.scale:g}\n\n{_table(('term', 'weight', 'parameters'), terms)}",
        "configuration": "\n\n".join([f"Training seed {seed}.", *sections]),
    }


def hyperparameters(config: Config) -> dict[str, str | float]:
    """Return what is learnt, and how: the setting, reward weights (0 where off), algorithm and length of training."""
    values, active = config.to_dict(), config.reward.build().active
    chosen = {
        "algorithm": values["algorithm"],
        "reward": {key: values["reward"][key] for key in ("closure", "two_stage", "scale")},
        "training": {key: values["training"][key] for key in ("n_worlds", "world_steps")},
        "weight": {name: active[name][0] if name in active else 0.0 for name in TERMS},
    }
    return {**_cell(config), **dict(_flat(chosen))}


def _cell(config: Config) -> dict[str, str | float]:
    return {"method": config.reward.name, **config.cell.setting._asdict()}


def _hyperparameter_summaries(config: Config) -> Iterator[Any]:
    """Yield what the hyper-parameter dashboard needs; the runs of a configuration are one row, the mean of its seeds.

    PyTorch's ``add_hparams`` opens a run of its own, and knows no rows of several runs.
    """
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import metadata
    from tensorboard.plugins.hparams.api_pb2 import DataType, Experiment, HParamInfo, MetricInfo, MetricName
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData, SessionStartInfo

    values = hyperparameters(config)
    first = _cell(config)  # the columns that are seen at first: TensorBoard prefers those that differ between runs
    kinds = {
        name: "DATA_TYPE_STRING" if isinstance(value, str) else "DATA_TYPE_FLOAT64" for name, value in values.items()
    }
    experiment = Experiment(
        hparam_infos=[
            HParamInfo(name=name, type=DataType.Value(kind), differs=name in first) for name, kind in kinds.items()
        ],
        metric_infos=[MetricInfo(name=MetricName(tag=tag)) for tag in METRICS],
    )
    row = f"{run_path(config.cell, 0).parent} {config_hash(config.to_dict())[:8]}"
    start = SessionStartInfo(group_name=row)
    for name, value in values.items():
        setattr(start.hparams[name], "string_value" if isinstance(value, str) else "number_value", value)
    for tag, data in (
        (metadata.EXPERIMENT_TAG, HParamsPluginData(experiment=experiment)),
        (metadata.SESSION_START_INFO_TAG, HParamsPluginData(session_start_info=start)),
    ):
        yield Summary(value=[Summary.Value(tag=tag, metadata=metadata.create_summary_metadata(data))])


def _flat(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str | float]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{path}{key}.")
        else:
            is_number = isinstance(value, (float, int)) and not isinstance(value, bool)
            yield f"{path}{key}", value if is_number else _in_words(value)


def _in_words(value: Any) -> str:
    """Return a value in one line."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_in_words(inner)}" for key, inner in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_in_words, value))
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
