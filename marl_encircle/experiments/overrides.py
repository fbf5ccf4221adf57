"""``section.key=value`` on the command line -> values that go on top of the files'."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.sections import AlgorithmConfig, EvaluationConfig, RewardConfig, TrainingConfig
from marl_encircle.experiments.yaml_files import ConfigError, merge, parse_yaml
from marl_encircle.spelling import nearest

SECTION_KEYS: Mapping[str, Collection[str]] = {
    "reward": RewardConfig.model_fields,
    "scenario": [field.name for field in dataclasses.fields(Scenario)],
    "algorithm": AlgorithmConfig.model_fields,
    "training": TrainingConfig.model_fields,
    "evaluation": EvaluationConfig.model_fields,
}
"""The keys of each section of a configuration."""


def parse_overrides(overrides: Sequence[str], sections: Iterable[str]) -> dict[str, Any]:
    """Return the values by section; of two for one key the last one wins.

    :param overrides: ``section.key=value`` each, the value in YAML
    :param sections: names that a section may have
    :raises ConfigError: naming the override
    """
    changes: dict[str, Any] = {}
    if isinstance(overrides, str) or not isinstance(overrides, Sequence):
        raise ConfigError(f"overrides must be a list of section.key=value; got {overrides!r:.80}")
    for override in overrides:
        if not isinstance(override, str):
            raise ConfigError(f"overrides must be a list of section.key=value; one is {override!r:.80}")
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            raise ConfigError(f"--set {override:.80}: must be section.key=value{_in_its_section(override)}")
        if keys[0] not in sections:
            raise ConfigError(f"--set {override:.80}: unknown section{nearest(keys[0], sections)}")
        try:
            value = parse_yaml(text)
        except ConfigError as error:
            raise ConfigError(f"--set {override:.80}: {error}") from error
        if value == {}:
            raise ConfigError(f"--set {override:.80}: mappings are merged, so an empty one changes nothing; use null")
        for key in reversed(keys):
            value = {key: value}
        changes = merge(changes, value)
    return changes


def _in_its_section(override: str) -> str:
    """Return '; did you mean ...?' for ``key=value`` where one section alone has such a key."""
    key, separator, _ = override.partition("=")
    sections = [section for section, keys in SECTION_KEYS.items() if key.strip() in keys]
    return f"; did you mean {sections[0]}.{override.strip():.80}?" if separator and len(sections) == 1 else ""
