"""What is wrong with a configuration, one line a fault: file, key path, value, what is allowed, the nearest name."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import NoneType
from typing import Any, TypeVar, cast, get_args

from pydantic import BaseModel, ValidationError

from marl_encircle.experiments import library
from marl_encircle.experiments.yaml_files import ConfigError, holds
from marl_encircle.spelling import nearest

Model = TypeVar("Model", bound=BaseModel)


def section_of(model: type[Model], values: Mapping[str, Any], within: str = "") -> Model:
    """Return the section that plain values make.

    :param within: key path at which they stand
    :raises ConfigError: with one line for each thing that is wrong
    """
    try:
        return model(**values)
    except ValidationError as error:
        raise ConfigError("\n".join(_explain(error, model, within))) from error


def _explain(error: ValidationError, model: type[BaseModel], within: str) -> list[str]:
    """Return one line for each thing that is wrong, with its key path, value and what is allowed."""
    lines = []
    for item in error.errors():
        parts = [f"{part!s:.80}" for part in item["loc"] if part != "[key]"]
        path = ".".join([within, *parts] if within else parts)
        if item["type"] == "extra_forbidden":
            siblings = _known_keys(model, item["loc"][:-1])
            lines.append(f"{path:.200}: unknown key{nearest(str(item['loc'][-1]), siblings)}")
        elif item["type"] == "missing":
            lines.append(f"{path}: missing")
        else:
            reason = item["msg"].removeprefix("Value error, ")
            lines.append(f"{path:.200}: {reason[:1].lower()}{reason[1:]}; got {item['input']!r:.80}")
    return lines


@contextmanager
def naming_files(names: Mapping[str, str], changes: Mapping[str, Any]) -> Iterator[None]:
    """Put the file in front of every line of a ConfigError that is about a key which stands in one.

    :param names: of the sections' files
    :param changes: values by section that stand in none
    """
    try:
        yield
    except ConfigError as error:
        raise ConfigError("\n".join(_with_file(line, names, changes) for line in str(error).splitlines())) from error


def _with_file(line: str, names: Mapping[str, str], changes: Mapping[str, Any]) -> str:
    section, *keys = line.split(":")[0].split(" ")[0].split(".")
    if section not in names:
        return line
    for length in range(len(keys), -1, -1):  # a key that is missing stands where its mapping does
        changed = changes.get(section, {})
        if changed and holds(changed, keys[:length]):
            return line
        path = library.file_of(cast(library.Kind, section), names[section], keys[:length])
        if path is not None:
            return f"{path}: {line}"
    return line


def _known_keys(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the section at a path."""
    annotation: Any = model
    for part in path:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel) and isinstance(part, str):
            annotation = annotation.model_fields[part].annotation
        else:  # an entry of a list or dictionary of sections, or None
            inner = [each for each in get_args(annotation) if each not in (str, NoneType)]
            annotation = inner[-1]
    sections = [each for each in (annotation, *get_args(annotation)) if isinstance(each, type)]
    return [name for each in sections if issubclass(each, BaseModel) for name in each.model_fields]
