"""A curriculum around a VecEnv of encirclement worlds: its difficulty follows the world steps that were played."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs, VecEnvStepReturn, VecEnvWrapper


class Ramp(NamedTuple):
    """A straight line from ``start`` to ``end`` over ``world_steps``, then ``end``."""

    start: float
    end: float
    world_steps: int

    def at(self, world_steps: int) -> float:
        """Return the value after so many world steps."""
        return self.end + (self.start - self.end) * max(0.0, 1.0 - world_steps / self.world_steps)


class CurriculumVecEnv(VecEnvWrapper):
    """Set the difficulty of ``venv``'s worlds before every step; it acts at each world's next round.

    :param venv: slots of worlds whose environments have ``set_difficulty``
    :param ramps: by the name of a scenario field: ``safety_distance``, ``obstacle_radius`` or ``speed_ratio``
    """

    def __init__(self, venv: VecEnv, ramps: Mapping[str, Ramp]) -> None:
        super().__init__(venv)
        self.ramps = dict(ramps)
        self.world_steps = 0
        self._last: dict[str, float] = {}

    @property
    def difficulty(self) -> dict[str, float]:
        """The present value of every field of the curriculum."""
        return {name: ramp.at(self.world_steps) for name, ramp in self.ramps.items()}

    def reset(self) -> VecEnvObs:
        """Start new rounds at the present difficulty."""
        self._set_difficulty()
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Set the difficulty for the rounds that will start in this step."""
        self._set_difficulty()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Count the step of every world."""
        self.world_steps += self.venv.n_worlds  # type: ignore[attr-defined]  # both engines have it
        return self.venv.step_wait()

    def _set_difficulty(self) -> None:
        difficulty = self.difficulty
        if difficulty != self._last:  # the worlds check it anew every time
            self.venv.env_method("set_difficulty", difficulty)
            self._last = difficulty
