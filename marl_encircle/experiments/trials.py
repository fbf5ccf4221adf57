"""What a search leaves behind: the table of its trials, and the best one as files that ``train`` takes."""

import csv
import io
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML

from marl_encircle import files
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.library import is_path
from marl_encircle.experiments.overrides import parse_overrides
from marl_encircle.experiments.search_space import Space
from marl_encircle.experiments.yaml_files import merge

BEST = {"algorithm": "best.yaml", "reward": "best_reward.yaml"}
"""The best trial's files by section of the configuration."""


class Row(NamedTuple):
    """One trial.

    :param state: Optuna's word: ``complete``, ``pruned``, ``fail``, ``running`` or ``waiting``
    :param success: what it is worth, [0, 1]; of a pruned one its latest point; None where there is neither
    :param points: of the learning curve that were seen while it ran
    :param values: by the key of the dimension
    """

    number: int
    state: str
    success: float | None
    points: int
    values: dict[str, Any]


class Outcome(NamedTuple):
    """How a search stands.

    :param rows: all trials in their order
    :param best: the best one; None before one was trained to its end
    :param failed: how many trials failed in this call
    :param written: files with the best one's values, by section
    """

    rows: list[Row]
    best: Row | None
    failed: int
    written: dict[str, Path]


def write_outcome(space: Space, out: Path, rows: list[Row], failed: int) -> Outcome:
    """Write ``trials.csv``, and ``best.yaml`` and ``best_reward.yaml`` as far as their sections are searched.

    :param failed: how many trials failed in this call
    """
    files.write_text(out / "trials.csv", _table(space, rows))
    complete = [row for row in rows if row.state == "complete"]
    best = max(complete, key=lambda row: row.success or 0.0, default=None)
    written = {}
    if best is not None:
        for section, values in _best_values(space, best, out).items():
            written[section] = out / BEST[section]
            files.write_text(written[section], _as_yaml(space, best, values))
    return Outcome(rows, best, failed, written)


def _table(space: Space, rows: list[Row]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["trial", "state", "success", "points", *space.dimensions])
    for row in rows:
        values = [json.dumps(row.values[key]) if key in row.values else "" for key in space.dimensions]
        writer.writerow([row.number, row.state, "" if row.success is None else row.success, row.points, *values])
    return out.getvalue()


def _best_values(space: Space, best: Row, out: Path) -> dict[str, dict[str, Any]]:
    """Return what differs from the files that were searched from, on top of them, by section."""
    tried = [f"{key}={json.dumps(value)}" for key, value in best.values.items()]
    changes = parse_overrides([*space.file.overrides, *tried], Config.model_fields)
    bases = {"algorithm": space.file.algorithm, "reward": space.file.reward}
    found = {}
    for section, base in bases.items():
        if section in changes:
            head = {"base": os.path.relpath(base, out) if is_path(base) else base}
            if section == "reward":
                head["name"] = f"{space.jobs({})[0].config.reward.name[:58]}_tuned"
            found[section] = merge(head, changes[section])
    return found


def _as_yaml(space: Space, best: Row, values: dict[str, Any]) -> str:
    seeds = ", ".join(map(str, space.file.seeds))
    out = io.StringIO()
    yaml = YAML()
    yaml.representer.add_representer(
        list, lambda representer, items: representer.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=True)
    )
    yaml.dump(values, out)
    head = (
        f"Trial {best.number} of a search: success {best.success:.4f}, the mean of the last {space.file.last_points}",
        f"points of tuning seeds {seeds}; {space.file.setting.build().symbols}.",
    )
    return "".join(f"# {line}\n" for line in head) + out.getvalue()
