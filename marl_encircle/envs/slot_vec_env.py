"""What the native VecEnvs have in common: slots that are parts of one object."""

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs.arena import ACTION_SIZE, spaces_of


class SlotVecEnv(VecEnv):
    """B worlds of N pursuers as B * N slots, which share all attributes and methods: slot = world * N + pursuer.

    :param scenario: the rules; of the largest world, where they differ
    :param reward: the reward, and the closure rule that ends a round
    :param n_worlds: B
    """

    def __init__(self, scenario: Scenario, reward: Reward, n_worlds: int) -> None:
        self._scenario, self._reward = scenario, reward
        self.n_worlds, self.n_agents = n_worlds, scenario.pursuers
        self.agents = list(scenario.agents)
        self.render_mode = None
        self._running = False
        super().__init__(n_worlds * self.n_agents, *spaces_of(scenario))

    @property
    def scenario(self) -> Scenario:
        """The rules; of the largest world, where they differ. They stay: other rules need other worlds."""
        return self._scenario

    @property
    def reward(self) -> Reward:
        """The reward, and the closure rule that ends a round. It stays: another reward needs other worlds."""
        return self._reward

    def reset(self) -> NDArray[np.float32]:
        """Start a new round in every world.

        :return: observations, (B * N, O)
        :raises PlacementError: if the bodies cannot be placed
        """
        observations = self._start()
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._running = True
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for ``step_wait``.

        :param actions: one row a slot, in [-1, 1], (B * N, 2)
        :raises ValueError: for a wrong shape
        :raises RuntimeError: if no round is running
        """
        with np.errstate(over="ignore"):  # too large for single precision is infinite, and told by name in step_wait
            actions = np.array(actions, np.float32)
        shape = (self.num_envs, ACTION_SIZE)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, one row a slot; got {actions.shape}")
        if not self._running:
            raise RuntimeError("no round is running: call reset() first")
        self._actions = actions.reshape(self.n_worlds, self.n_agents, ACTION_SIZE)

    def close(self) -> None:
        """Do nothing: there is nothing to give back."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this VecEnv once for each slot asked for.

        :raises AttributeError: if it has none of this name
        """
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this VecEnv; all slots share it.

        :raises AttributeError: for one that is only read, such as ``reward``
        """
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of this VecEnv, once, and return its result for each slot asked for.

        :raises AttributeError: if it has none of this name
        """
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each slot: worlds are no Gymnasium environments that could be wrapped."""
        return [False for _ in self._get_indices(indices)]

    @abstractmethod
    def _start(self) -> NDArray[np.float32]:
        """Start a new round in every world, with the seeds given since the last reset.

        :return: observations, (B * N, O)
        """
