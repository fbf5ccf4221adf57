"""YAML as this project reads it: plain data in one small file, everything else refused before it is parsed further.

YAML 1.2 by ruamel.yaml: ``1e-3`` is a number, ``no`` is a word, a duplicate key is an error.
"""

import copy
import datetime
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)

from marl_encircle import files

MAX_BYTES = 128_000
MAX_DEPTH = 20
MAX_VALUES = 2000
MAX_BITS = 10_000
"""Of an integer; beyond, Python does not write it out in a message. A float holds 1024."""


class ConfigError(ValueError):
    """A configuration that cannot be used; the message says where, what, and what is allowed."""


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a mapping from a YAML file.

    :raises ConfigError: if there is no such file, it is larger than 128 kB, no YAML, no mapping, or has more in it than
        mappings, lists, strings, finite numbers, booleans and null
    """
    try:
        with files.open_regular(path) as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except files.DamagedFileError as error:
        raise ConfigError(str(error)) from error
    try:
        _check_length(data)  # before it is decoded: its last character may be cut
        value = parse_yaml(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path}: must be a mapping of keys to values; got {value!r:.80}")
    return value


def parse_yaml(text: str) -> Any:
    """Return the plain data that a YAML text holds, the caller's to change.

    :raises ConfigError: see :func:`read_yaml`
    """
    _check_length(text)
    return copy.deepcopy(_parse(text))


@lru_cache(maxsize=128)
def _parse(text: str) -> Any:
    """Parse a text once: the many jobs of a grid share few files."""
    yaml = YAML(typ="safe", pure=True)
    try:
        _refuse_tricks(yaml, text)
        value = yaml.load(text)  # safe: plain data, and the tags have been refused
    except MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(line + _in_short(error.problem or error.context or "")) from error
    except (YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"not valid YAML: {_in_short(str(error) or type(error).__name__)}") from error
    _check_plain(value, "")
    return value


def _check_length(text: str | bytes) -> None:
    if len(text) > MAX_BYTES:
        raise ConfigError(f"larger than {MAX_BYTES // 1000} kB")


def _in_short(reason: str) -> str:
    """First line of what ruamel says, without the values that it quotes in full."""
    return reason.removeprefix("found ").partition(" with value")[0].splitlines()[0][:120]


def _refuse_tricks(yaml: YAML, text: str) -> None:
    """Walk over the events, which costs little, before anything is built."""
    depth = documents = 0
    for count, event in enumerate(yaml.parse(text)):
        where = f"line {event.start_mark.line + 1}"
        if isinstance(event, AliasEvent) or getattr(event, "anchor", None):
            raise ConfigError(f"{where}: anchors and aliases are not allowed; write the value out")
        if isinstance(event, DocumentStartEvent) and (event.version or event.tags):
            raise ConfigError(f"{where}: YAML directives are not allowed")
        documents += isinstance(event, DocumentStartEvent)
        if documents > 1:
            raise ConfigError(f"{where}: more than one document")
        if isinstance(event, (ScalarEvent, MappingStartEvent, SequenceStartEvent)) and event.tag:
            raise ConfigError(f"{where}: the tag {event.tag!s:.80} is not allowed; only plain values")
        if isinstance(event, ScalarEvent) and event.value == "<<" and event.style is None:
            raise ConfigError(f"{where}: merge keys are not allowed; use 'base:'")
        depth += isinstance(event, (MappingStartEvent, SequenceStartEvent))
        depth -= isinstance(event, (MappingEndEvent, SequenceEndEvent))
        if count > MAX_VALUES:
            raise ConfigError(f"{where}: more than {MAX_VALUES} values")
        if depth > MAX_DEPTH:
            raise ConfigError(f"{where}: nested more than {MAX_DEPTH} deep")


def _check_plain(value: Any, path: str) -> None:
    where = f"{path:.200}: " if path else ""
    if isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str):
                _check_size(key, where)
                raise ConfigError(f"{where}keys must be strings; got {key!r:.80}")
            _check_plain(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            _check_plain(inner, f"{path}[{i}]")
    elif isinstance(value, (datetime.date, datetime.datetime)):
        raise ConfigError(f"{where}{value} is read as a date; put it in quotes")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}must be finite; got {value}")
    elif not isinstance(value, (str, int, float, bool, type(None))):
        raise ConfigError(f"{where}{value!r:.80} is not a plain value")
    _check_size(value, where)


def _check_size(value: Any, where: str) -> None:
    if isinstance(value, int) and value.bit_length() > MAX_BITS:
        raise ConfigError(f"{where}an integer of {value.bit_length()} bits; at most {MAX_BITS}")


def merge(base: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the values of ``override``, mapping by mapping; null overrides too."""
    merged = dict(base)
    for key, value in override.items():
        below = merged.get(key)
        merged[key] = merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def holds(values: Any, keys: Sequence[str]) -> bool:
    """Whether there is a value at a path of keys."""
    for key in keys:
        if not isinstance(values, Mapping) or key not in values:
            return False
        values = values[key]
    return True
