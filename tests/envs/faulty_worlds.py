"""Environments with a planted fault each, and sound ones beside them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pettingzoo.utils.wrappers import BaseParallelWrapper

from marl_encircle.envs.encirclement_v0 import parallel_env

CYCLES = 8
"""Short rounds: the faults show at once."""


class Faulty(BaseParallelWrapper[str, Any, Any]):
    """Counts steps and leaves a place for a fault in what a step tells."""

    def __init__(self) -> None:
        super().__init__(parallel_env(max_cycles=CYCLES))
        self.possible_agents = self.env.possible_agents
        self.steps = 0

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.steps = 0
        return super().reset(seed=seed, options=options)

    def step(self, actions: dict[str, Any]) -> Any:
        self.steps += 1
        return self.spoil(*super().step(actions))

    def spoil(self, observations: Any, rewards: Any, terminations: Any, truncations: Any, infos: Any) -> Any:
        return observations, rewards, terminations, truncations, infos


class NanObservation(Faulty):
    def spoil(self, observations: Any, *told: Any) -> Any:
        if self.steps == 5:
            observations["pursuer_1"][3] = np.nan
        return observations, *told


class OutsideItsSpace(Faulty):
    def spoil(self, observations: Any, *told: Any) -> Any:
        observations["pursuer_2"][0] = 1.5  # the scene ends at 1
        return observations, *told


class DoublePrecision(Faulty):
    def spoil(self, observations: Any, *told: Any) -> Any:
        return {agent: o.astype(np.float64) for agent, o in observations.items()}, *told


class RecycledObservations(Faulty):
    def spoil(self, observations: Any, *told: Any) -> Any:
        if not hasattr(self, "buffers"):
            self.buffers = observations
        for agent, observation in observations.items():
            self.buffers[agent][:] = observation
        return self.buffers, *told


class NanReward(Faulty):
    def spoil(self, observations: Any, rewards: Any, *told: Any) -> Any:
        return observations, rewards | ({"pursuer_0": np.nan} if self.steps == 5 else {}), *told


class ArrayReward(Faulty):
    def spoil(self, observations: Any, rewards: Any, *told: Any) -> Any:
        return observations, {agent: np.float32(reward) for agent, reward in rewards.items()}, *told


class EndsApart(Faulty):
    def spoil(self, observations: Any, rewards: Any, terminations: Any, truncations: Any, infos: Any) -> Any:
        return observations, rewards, terminations | {"pursuer_1": self.steps == 4}, truncations, infos


class LimitAsTrueEnd(Faulty):
    def spoil(self, observations: Any, rewards: Any, terminations: Any, truncations: Any, infos: Any) -> Any:
        return observations, rewards, truncations, terminations, infos


class NoSuccessTold(Faulty):
    def spoil(self, observations: Any, rewards: Any, terminations: Any, truncations: Any, infos: Any) -> Any:
        return observations, rewards, terminations, truncations, {agent: {} for agent in infos}


class RandomFromTheSecondStep(Faulty):
    def spoil(self, observations: Any, *told: Any) -> Any:
        if self.steps > 1:
            observations["pursuer_0"][0] *= np.random.default_rng().uniform(0.9, 1.0)
        return observations, *told


class RandomRewardFromTheSecondStep(Faulty):
    def spoil(self, observations: Any, rewards: Any, *told: Any) -> Any:
        if self.steps > 1:
            rewards["pursuer_0"] += np.random.default_rng().random()
        return observations, rewards, *told


class ForgetsItsSeedAfterOneEpisode(Faulty):
    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        seed = int(np.random.default_rng().integers(1 << 31)) if seed is None else seed
        return super().reset(seed=seed, options=options)


class FirstWorldIsAlwaysTheSame(Faulty):
    """Replays itself perfectly: the seed is not used at all."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=0, options=options)


SEEN_IN_ONE_RUN = (
    NanObservation,
    OutsideItsSpace,
    DoublePrecision,
    RecycledObservations,
    NanReward,
    ArrayReward,
    EndsApart,
    LimitAsTrueEnd,
    NoSuccessTold,
)
SEEN_IN_A_REPLAY = (RandomFromTheSecondStep, RandomRewardFromTheSecondStep, ForgetsItsSeedAfterOneEpisode)
MISSED_BY_PETTINGZOO = (
    NanObservation,
    OutsideItsSpace,
    RecycledObservations,
    NanReward,
    LimitAsTrueEnd,
    NoSuccessTold,
    RandomFromTheSecondStep,
    RandomRewardFromTheSecondStep,
    ForgetsItsSeedAfterOneEpisode,
    FirstWorldIsAlwaysTheSame,
)

SOUND: dict[str, Callable[[], Any]] = {
    "default": parallel_env,
    "four in a tunnel": lambda: parallel_env(pursuers=4, obstacles=1, scene="tunnel", obstacle_radius=0.12),
    "first order": lambda: parallel_env(dynamics="first_order", obstacles=2, observe_extras=("stage", "speed_ratio")),
    "quick success": lambda: parallel_env(movement_range_limit=10.0, pursuers=5, speed_ratio=1.01),
}
"""Environments that must replay, by name."""

REPLAYED: dict[str, Callable[[], Any]] = {**SOUND, **{fault.__name__: fault for fault in SEEN_IN_A_REPLAY}}
"""Environments whose episodes are played again in another process."""
