"""What a configuration must hold to be trained on this machine; one that does not may still be shown and compared."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from marl_encircle.experiments.config import Config, build_scenario, fields_of
from marl_encircle.experiments.sizes import count_weights, observation_size
from marl_encircle.experiments.yaml_files import ConfigError

CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Where a container says how much memory it may have."""


def check_seed(config: Config, seed: int) -> None:
    """Refuse a training seed whose worlds are those of the evaluation.

    :raises ConfigError: also if it is no integer from 0 to 2**32 - 1
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 1 << 32:
        raise ConfigError(f"seed must be an integer from 0 to {(1 << 32) - 1}; got {seed!r:.80}")
    for name in ("seed", "curve_seed"):
        if seed == getattr(config.evaluation, name):
            raise ConfigError(
                f"seed must differ from evaluation.{name}: the training would see the evaluation's rounds; got {seed}"
            )


def check_training(config: Config) -> None:
    """Refuse a training that would learn nothing or not fit into this machine's memory; an environment may do both.

    :raises ConfigError: naming the keys
    """
    check_curriculum(config)
    random, total = config.algorithm.random_world_steps, config.training.world_steps
    if random >= total:
        raise ConfigError(
            f"algorithm.random_world_steps: must be less than training.world_steps, {total}, or nothing is "
            f"learnt; got {random}"
        )
    check_memory(memory_needed(config), available_memory())


def check_trainings(configs: Sequence[Config], at_a_time: int) -> None:
    """Refuse trainings one of which cannot be carried out, or that do not fit into this machine's memory together.

    :param at_a_time: how many are trained side by side
    :raises ConfigError: naming keys and figures
    """
    for config in configs:
        check_training(config)
    largest = sorted((sum(memory_needed(config).values()) for config in configs), reverse=True)[:at_a_time]
    available = available_memory()
    if sum(largest) > available:
        raise ConfigError(
            f"{len(largest)} trainings at a time need {sum(largest) / 1e9:.1f} GB of memory, but this machine has "
            f"{available / 1e9:.1f} GB; use fewer jobs"
        )


def check_curriculum(config: Config) -> None:
    """Refuse a curriculum that starts where the scene is not allowed; only who trains by it needs one.

    :raises ConfigError: naming the key and how to change it
    """
    for name, ramp in config.training.curriculum.items():
        if ramp is not None:
            key = f"training.curriculum.{name}"
            try:
                build_scenario({**fields_of(config.scenario), name: ramp.start})
            except ConfigError as error:
                remedy = f"--set {key}.start=... to another value, or --set {key}=null for none"
                raise ConfigError(f"{key}.start: {error}; {remedy}") from error


def check_memory(needed: Mapping[str, int], available: int) -> None:
    """Refuse what cannot fit into this machine's memory.

    :param needed: bytes by the key that asks for them
    :param available: bytes
    :raises ConfigError: naming the key that asks for most, with the figures
    """
    total = sum(needed.values())
    if total > available:
        key = max(needed, key=needed.__getitem__)
        raise ConfigError(
            f"{key}: needs {needed[key] / 1e9:.1f} GB of memory, of {total / 1e9:.1f} GB in all, but this machine has "
            f"{available / 1e9:.1f} GB"
        )


def memory_needed(config: Config) -> dict[str, int]:
    """Return the least memory [bytes] that a training takes, by the key that asks for it."""
    a, scenario = config.algorithm, config.scenario
    n, size = scenario.pursuers, observation_size(scenario)
    steps = min(a.buffer_world_steps, config.training.world_steps + config.training.n_worlds)
    transition = 4 * n * (2 * size + 5)  # two observations, two actions, reward, done, time limit in single precision
    joint = 4 * n * n * (size + 2)  # each critic's input
    hidden = 4 * n * sum(a.net_arch)
    return {
        "algorithm.buffer_world_steps": 2 * steps * transition,  # beside that of the checkpoint it resumes from
        "algorithm.batch_size": a.batch_size * (transition + joint + hidden),
        "algorithm.net_arch": 20 * sum(count_weights(scenario, a).values()),  # with targets, gradients, two moments
        "training.n_worlds": _worlds_memory(config),
    }


def _worlds_memory(config: Config) -> int:
    """Return the least memory [bytes] that worlds take: what each direction meets, twice, under both closure rules."""
    scenario = config.scenario
    return config.training.n_worlds * (36 * scenario.n_directions + 8 * scenario.pursuers * observation_size(scenario))


def available_memory() -> int:
    """Return the memory [bytes] of this machine, or of the container if that is less."""
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CONTAINER_LIMIT.read_text().strip()
    except OSError:
        return installed
    return min(installed, int(limit)) if limit.isdigit() else installed  # "max": no limit
