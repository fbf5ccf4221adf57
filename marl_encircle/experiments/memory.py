"""How much memory there is on this machine, and how much a training takes at least."""

import os
from collections.abc import Mapping
from pathlib import Path

from marl_encircle.experiments.config import Config
from marl_encircle.experiments.sizes import buffer_world_steps, count_weights, observation_size
from marl_encircle.experiments.yaml_files import ConfigError

CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Where a container says how much memory it may have."""


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
    """Return the least memory [bytes] that a training takes that can be resumed, by the key that asks for it."""
    a, scenario = config.algorithm, config.scenario
    n, size = scenario.pursuers, observation_size(scenario)
    steps = buffer_world_steps(a, config.training)
    transition = 4 * n * (2 * size + 5)  # two observations, two actions, reward, done, time limit in single precision
    joint = 4 * n * (size + 2)  # what all critics read
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
