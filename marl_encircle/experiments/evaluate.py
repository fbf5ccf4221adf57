"""Policy and scenario -> evaluation rounds."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from marl_encircle.core.rounds import NEVER
from marl_encircle.core.simulator import world_seeds
from marl_encircle.envs.arena import Arena
from marl_encircle.experiments.build import fit_policy
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.records import Setting
from marl_encircle.maddpg.policies import MADDPGPolicy

WORLDS_AT_ONCE = 100
"""Always so many, the last ones for nothing if need be: the rounding of matrix products depends on the batch size."""


def play_rounds(
    policy: MADDPGPolicy, config: Config, episodes: int, seed: int, setting: Setting | None = None
) -> list[Episode]:
    """Play each round once, in a world of its own, with noise off and the scenario at its final difficulty.

    Round r of evaluation seed s starts from the same placement for every method. It counts until both closure rules
    have held or time is up, so that it does not matter which of them ends the method's training rounds.

    :param episodes: number of rounds
    :param seed: evaluation seed; world r is seeded with ``world_seeds(seed, episodes)[r]``
    :param setting: where to play; by default where the policy was trained
    :raises ConfigError: for a setting in which it cannot play: other numbers of bodies need the features ``set``
    """
    if setting is not None:
        config = config.to_play_in(setting)
        policy = fit_policy(policy, config)
    rounds: list[Episode] = []
    seeds = world_seeds(seed, -(-episodes // WORLDS_AT_ONCE) * WORLDS_AT_ONCE)
    for start in range(0, len(seeds), WORLDS_AT_ONCE):
        rounds += _play(policy, config, seeds[start : start + WORLDS_AT_ONCE], start)
    return rounds[:episodes]


def evaluation_worlds(config: Config, seeds: Sequence[int]) -> Arena:
    """Return worlds of these seeds that see in as many directions as evaluation asks for; they are not reset yet."""
    scenario = replace(config.scenario, n_directions=config.evaluation.n_directions)
    arena = Arena(scenario, config.reward.build(), len(seeds))
    arena.simulator.seed(seeds)
    return arena


def _play(policy: MADDPGPolicy, config: Config, seeds: Sequence[int], first_round: int) -> list[Episode]:
    arena, max_cycles = evaluation_worlds(config, seeds), config.scenario.max_cycles
    observations = arena.reset()
    for _ in range(max_cycles):
        actions, _ = policy.predict(observations, deterministic=True)
        observations = arena.step(np.asarray(actions)).observations
    rounds = arena.rounds
    steps = np.stack(list(rounds.success_step.values()))
    length = np.where((steps != NEVER).all(axis=0), steps.max(axis=0), max_cycles)
    sigma_c = rounds.contribution_spread
    return [
        Episode(
            round=first_round + b,
            seed=seeds[b],
            step_all=rounds.success_steps(b)["all"],
            step_pursuers=rounds.success_steps(b)["pursuers"],
            length=int(length[b]),
            return_mean=float(rounds.returns[b].mean()),
            sigma_c=float(sigma_c[b]),
            contacts_pursuers=int(rounds.contacts_pursuers[b]),
            contacts_obstacles=int(rounds.contacts_obstacles[b]),
        )
        for b in range(len(seeds))
    ]
