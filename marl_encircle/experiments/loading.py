"""A run folder, a name or a trusted model -> a trained policy, its configuration and its record, all of it checked."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch

from marl_encircle import files
from marl_encircle.experiments.build import build_policy, fit_policy
from marl_encircle.experiments.config import MAX_POLICY_BYTES, Config
from marl_encircle.experiments.pretrained import find_run, in_words, is_run_path, pretrained_runs, setting_of
from marl_encircle.experiments.records import POLICY, RECORD, read_record
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.maddpg.saving import load_actors

MAX_WEIGHTS_HEADER = 1 << 16
"""Largest header [bytes]: names and shapes of a few arrays per layer. Each name costs memory, whatever for."""


def load_policy(what: str | Path, *, trusted: bool = False, **fields: Any) -> MADDPGPolicy:
    """Return a trained policy: one that comes with the package, by name, or that of a run folder.

    Reads JSON and safetensors only, which cannot run code, and checks them against the recorded hashes.

    :param what: a method's name, for its first training seed in a setting; a run folder or the ``policy.safetensors``
        in one; or, if it is ``trusted``, a zip-file that ``MADDPG.save`` wrote, with its suffix or without, from which
        only the actors are taken
    :param trusted: read a zip-file, **which can run code when it is loaded**
    :param fields: ``speed_ratio``, ``pursuers``, ``obstacles`` and ``scene`` of a name's setting, 1.1, 3, 1 and random
        where they are not given; or those in which the policy of a run folder shall play: any speed ratio and scene,
        other numbers of bodies only if its features are sets
    :raises ConfigError: for a name or a setting without a policy, with those that there are and the nearest
    :raises DamagedFileError: if a file is missing, changed, does not fit the configuration, or is not trusted
    """
    if trusted and not Path(what).exists() and Path(f"{what}.zip").is_file():
        what = Path(f"{what}.zip")  # MADDPG.save adds the suffix
    setting = setting_of(fields)
    wanted = {name: value for name, value in setting._asdict().items() if name in fields}
    if isinstance(what, str) and not is_run_path(what):
        what, wanted = find_run(what, setting, [pretrained_runs()]), setting._asdict()
    path = Path(what)
    if trusted and path.is_file() and zipfile.is_zipfile(path):
        if fields:
            raise ConfigError(f"{what}: a zip-file has a setting of its own; got {', '.join(fields)}")
        try:
            return load_actors(path)
        except Exception as error:  # unpickling raises whatever it likes
            raise files.DamagedFileError(path, f"holds no actors: {_one_line(error)}") from error
    return load_run(path, wanted).policy


class LoadedRun(NamedTuple):
    """A run read back.

    :param policy: to act with
    :param config: of the run, in the setting that was asked for
    :param record: content of its ``run.json``
    """

    policy: MADDPGPolicy
    config: Config
    record: dict[str, Any]


def load_run(run: str | Path, fields: Mapping[str, Any] | None = None) -> LoadedRun:
    """Return a run's policy, configuration and record; see :func:`load_policy`.

    :param run: its folder, or the ``policy.safetensors`` in it
    :param fields: of a setting to play in, as far as they are not the run's; see :meth:`Config.to_play_in`
    :raises ConfigError: for a setting that the policy does not serve
    :raises DamagedFileError: if a file is missing, changed or does not fit the configuration
    """
    folder = folder_of(run)
    if folder.is_file():
        raise files.DamagedFileError(folder, _no_run(folder))
    record = read_record(folder)
    config = config_of(record, folder / RECORD)
    data = files.read_bytes(folder / POLICY, sha256=record["sha256"][POLICY], max_bytes=MAX_POLICY_BYTES)
    policy = build_policy(config)
    try:
        load_weights(policy, data)
    except (safetensors.SafetensorError, RuntimeError, ValueError) as error:
        reason = f"does not hold this policy's weights: {_one_line(error)}"
        raise files.DamagedFileError(folder / POLICY, reason) from error
    policy.set_training_mode(False)
    trained = config.cell.setting
    setting = trained._replace(**(fields or {}))
    if setting != trained:
        try:
            config = config.to_play_in(setting)
        except ConfigError as error:
            asked = f"{folder} was trained {in_words(trained)}; asked for {in_words(setting)}"
            raise ConfigError(f"{asked}: {error}") from error
        policy = fit_policy(policy, config)
    return LoadedRun(policy, config, record)


def folder_of(run: str | Path) -> Path:
    """Return the folder of a run that may be given by its ``policy.safetensors``."""
    path = Path(run)
    return path.parent if path.name == POLICY else path


def load_weights(policy: MADDPGPolicy, data: bytes) -> None:
    """Put the weights of a ``policy.safetensors`` into the actors; raise an error unless it holds just those."""
    if int.from_bytes(data[:8], "little") > MAX_WEIGHTS_HEADER:
        raise ValueError(f"its header is larger than the {MAX_WEIGHTS_HEADER} bytes allowed")
    tensors = safetensors.torch.load(data)
    for name, weights in policy.actor_state_dict().items():
        if name in tensors and tensors[name].dtype != weights.dtype:
            raise ValueError(f"{name} has dtype {tensors[name].dtype}")
    policy.actor.load_state_dict(tensors)
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise ValueError("some are not finite")


def _no_run(path: Path) -> str:
    """Say why a file is not a run folder."""
    if not zipfile.is_zipfile(path):
        return "a file, not the folder of a run"
    return (
        "a zip-file, which can run code when it is loaded, and only safetensors and JSON are read; if it is a model "
        "that you trust: load_policy(..., trusted=True) in Python"
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def config_of(record: dict[str, Any], path: Path) -> Config:
    """Return the configuration that a run was made with.

    :param record: of the run, or of its checkpoint
    :param path: of the file that holds it
    :raises DamagedFileError: if it is not a valid configuration
    """
    try:
        return Config.from_dict(record.get("config"))  # type: ignore[arg-type]  # it may be anything
    except (ValueError, RecursionError) as error:
        raise files.DamagedFileError(path, f"config: {str(error)[:500]}") from error
