"""``section.key=value`` on the command line -> values that go on top of the files'."""

from collections.abc import Iterable, Sequence
from typing import Any

from marl_encircle.experiments.yaml_files import ConfigError, merge, parse_yaml
from marl_encircle.spelling import nearest


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
            raise ConfigError(f"--set {override:.80}: must be section.key=value")
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
