"""Model cards: what a trained policy is, what it was measured at, and how it came about; written beside the policy.

A card has no clock and no opinion in it: the same run gives the same bytes.
"""

import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.grid import Grid, Job, arguments
from marl_encircle.experiments.metrics import RunSummary, summarise_run
from marl_encircle.experiments.pretrained import first_run, in_words, pretrained_runs
from marl_encircle.experiments.records import POLICY, Cell, Run, Setting, read_record, run_path
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.study.paper import label

CARD = "README.md"
"""Name of a card in its run's folder, where a browser of the repository shows it."""

_CLOSURES = {"all": "pursuers and obstacles enclose the target together", "pursuers": "the pursuers enclose it alone"}

_LIMITS = """\
- This is one training seed, the first, chosen by nothing else: another gives another policy. The interval of S holds
  the noise of the evaluation rounds only; the tables have the intervals over the training seeds.
- {limit}
- The target follows one fixed rule. Nothing is known about targets that learn, nor about anything but a simulation.

## Safe to load

The weights are safetensors and the record is JSON: nothing in these files can run code. `load_policy` reads no more of
them than a policy needs, and refuses them unless hashes, names, shapes and types are right and every number is finite.
"""


_ONE_SETTING = (
    "It was trained and measured for these numbers of pursuers and obstacles, this speed ratio and these rules only."
)
_SEVERAL_SETTINGS = """\
It was trained in these settings and under these rules only. The figures above are of one setting, the tables have
  those of the others that it was measured in, some of which it never saw."""


def render_cards(grid: Grid, runs: Iterable[Run], folder: Path) -> dict[str, str]:
    """Return the card of each cell's first training seed where that is finished: path below ``folder`` -> text.

    :param runs: of the grid
    :param folder: of all runs
    :raises DamagedFileError: if a record is not what a run writes
    """
    first: dict[Cell, Job] = {}
    for job in sorted(grid.jobs, key=lambda job: job.seed):
        first.setdefault(job.config.cell, job)
    cards = {}
    for run in runs:
        if run.status == "finished" and run.seed == first[run.cell].seed:
            path = run_path(run.cell, run.seed)
            command = ["marl-encircle", "train", *arguments(first[run.cell])]
            cards[f"{path.as_posix()}/{CARD}"] = render_card(read_record(folder / path), run.episodes, command)
    return cards


def render_card(record: Mapping[str, Any], episodes: Sequence[Episode], command: Sequence[str]) -> str:
    """Return the card of a finished run.

    :param record: content of its ``run.json``
    :param episodes: its evaluation rounds
    :param command: that trained it, word by word
    """
    config = Config.from_dict(record["config"])
    method, setting = config.cell
    several = config.training.settings
    whose = "any number of" if several else setting.pursuers
    limits = _LIMITS.format(limit=_SEVERAL_SETTINGS if several else _ONE_SETTING)
    return f"""\
# {label(method)} {in_words(setting)}

A policy for {whose} pursuers that enclose one faster target; each acts on what it observes itself. It was
trained by marl-encircle with {config.algorithm.name.upper()}.

{_facts(record, config, summarise_run(episodes, config.reward.closure))}

## Play a round

```python
{_program(config, _comes_with_the_package(record))}
```

## The command that made it

```bash
{shlex.join(command)}
```

## Limits

{limits}"""


def _facts(record: Mapping[str, Any], config: Config, summary: RunSummary) -> str:
    """Return a Markdown table of what is known of a run."""
    low, high = summary.success_interval
    length = summary.mean_episode_length
    rows = {
        "method": f"`{config.reward.name}`; a round is won once {_CLOSURES[config.reward.closure]}",
        "setting": f"{in_words(config.cell.setting).removeprefix('with ')}; scene: {config.scenario.scene}",
        **_trained_in(config),
        "scenario": ", ".join(f"`{rule}`" for rule in _rules(config.scenario)) or "the default rules",
        "success S": f"{100 * summary.success:.1f} %; Wilson's 95 % interval: {100 * low:.1f} to {100 * high:.1f} %",
        "mean episode length MEL": "no round was won" if length is None else f"{length:.2f} steps, of the rounds won",
        "evaluation": f"{summary.rounds} rounds of evaluation seed {config.evaluation.seed}, without noise",
        "training seed": record["seed"],
        "training": f"{config.training.world_steps:,} world steps in {config.training.n_worlds} worlds",
        "configuration": f"sha256 `{record['config_hash']}`",
        POLICY: f"sha256 `{record['sha256'][POLICY]}`",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {text} |" for name, text in rows.items())])


def _trained_in(config: Config) -> dict[str, str]:
    """Return the settings of a training in several, each with its share of the worlds where that is not one."""
    if not config.training.settings:
        return {}
    shares = Counter(config.settings).items()
    texts = [in_words(setting).removeprefix("with ") + (f" ({n} shares)" if n > 1 else "") for setting, n in shares]
    return {"trained in": "; ".join(texts)}


def _comes_with_the_package(record: Mapping[str, Any]) -> bool:
    """Whether the name of the method stands for this policy."""
    try:
        run = first_run(Config.from_dict(record["config"]).cell, [pretrained_runs()])
    except ConfigError:  # it diverged there
        return False
    return run is not None and read_record(run)["sha256"].get(POLICY) == record["sha256"][POLICY]


def _program(config: Config, has_name: bool) -> str:
    """Return the Python that plays a round of the policy in its own world.

    :param has_name: whether the policy is loaded by its name, else by its file in the card's folder
    """
    setting = [f"{name}={_literal(value)}" for name, value in config.cell.setting._asdict().items()]
    rules = ", ".join([*setting, *_rules(config.scenario)])
    closure = config.reward.closure
    policy = ", ".join([_literal(config.reward.name), *setting]) if has_name else _literal(POLICY)
    reward = "" if closure == Reward().closure else f", Reward(closure={_literal(closure)})"
    return f"""\
from marl_encircle import {"Reward, " if reward else ""}Scenario, load_policy, parallel_env

policy = load_policy({policy}){"" if has_name else "  # in this folder"}
env = parallel_env(Scenario({rules}){reward})
observations, _ = env.reset(seed=7000)
while env.agents:
    actions, _ = policy.predict(observations)
    observations, rewards, terminations, truncations, infos = env.step(actions)
print(infos["pursuer_0"]["is_success"])"""


def _rules(scenario: Scenario) -> list[str]:
    """Return what differs from the default scenario, apart from the setting."""
    usual = asdict(Scenario())
    return [
        f"{name}={_literal(value)}"
        for name, value in asdict(scenario).items()
        if name not in Setting._fields and value != usual[name]
    ]


def _literal(value: object) -> str:
    """Write a name, a number or a tuple of them, with the quotes that the rest of the code has."""
    return repr(value).replace("'", '"')
