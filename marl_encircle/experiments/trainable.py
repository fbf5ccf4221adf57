"""What a configuration must hold to be trained on this machine; one that does not may still be shown and compared."""

from collections.abc import Sequence

from marl_encircle.experiments.config import Config, build_scenario, fields_of
from marl_encircle.experiments.memory import available_memory, check_memory, memory_needed
from marl_encircle.experiments.yaml_files import ConfigError


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
    """Refuse a training that would learn nothing, not fit into this machine's memory or lack points of its curve.

    An environment may do all of it.

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
    _check_curve(config)


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


def _check_curve(config: Config) -> None:
    """Refuse a learning curve whose points would be further apart than asked for."""
    n_worlds, train_freq, every = config.training.n_worlds, config.algorithm.train_freq, config.training.curve_every
    if n_worlds * train_freq > every:
        raise ConfigError(
            f"training.curve_every: must be at least training.n_worlds * algorithm.train_freq, {n_worlds} * "
            f"{train_freq}: a point of the learning curve comes between two rollouts; got {every}"
        )
