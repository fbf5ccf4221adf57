"""One SB3 VecEnv over SuperSuit's conversion of any PettingZoo ParallelEnv whose agents have equal spaces.

SuperSuit makes N slots of a world of N agents. Its own way on to SB3 (``concat_vec_envs_v1``) cannot be seeded, stores
time limits as true ends, lets the infos of a reset overwrite those of the last step, and more. Each such defect, seen
with SuperSuit 3.11.0, is named where it is worked around and has a test in ``tests/envs/test_supersuit_vec_env.py``.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any, TypeAlias

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from supersuit import pettingzoo_env_to_vec_env_v1
from supersuit.multiagent_wrappers.black_death import black_death_par

from marl_encircle.core.simulator import world_seeds

World: TypeAlias = ParallelEnv[str, Any, Any]


class WorldError(RuntimeError):
    """A world tells its agents what no learner can take: too little, numbers that are not finite, ends one by one."""


class SuperSuitVecEnv(VecEnv):
    """B worlds of N agents as B*N slots: slot = world * N + agent, agents in the order of ``possible_agents``.

    Worlds run one after another in this process: SuperSuit's ``num_cpus > 1`` gives several worlds one seed. A world is
    reset as soon as its episode ends; ``infos[slot]["terminal_observation"]`` keeps what its agents saw last. What
    belongs to a world (attributes, methods, options, seeds) is reached through any of its slots.

    :param env: makes one world, called ``n_worlds`` times; or an environment of which deep copies become the worlds
    :param n_worlds: number of worlds, B
    :raises TypeError: if a world is no ParallelEnv
    :raises ValueError: if agents or worlds differ in their spaces, or one world is made twice
    """

    def __init__(self, env: Callable[[], World] | World, n_worlds: int = 1) -> None:
        if n_worlds < 1:
            raise ValueError(f"n_worlds = {n_worlds}: at least one world is needed")
        # concat_vec_envs_v1 can only copy one environment, which must then be picklable.
        self._worlds = [env() if callable(env) else deepcopy(env) for _ in range(n_worlds)]
        _check_worlds(self._worlds)
        self.agents = tuple(self._worlds[0].possible_agents)
        self.n_agents = len(self.agents)
        self.n_worlds = n_worlds
        # SuperSuit's vector of the N slots of each world; it resets its world when an episode ends.
        self._converted = [pettingzoo_env_to_vec_env_v1(_Shield(world, b)) for b, world in enumerate(self._worlds)]
        slots = self._converted[0]
        super().__init__(n_worlds * self.n_agents, slots.observation_space, slots.action_space)
        self.metadata = slots.metadata
        dtype = slots.action_space.dtype
        self._largest_action = (np.finfo if np.issubdtype(dtype, np.floating) else np.iinfo)(dtype).max
        # Copies of one environment carry one random stream, and so SuperSuit's worlds play the same episodes.
        self.seed()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next ``reset()``; later episodes go on with each world's own stream.

        :param seed: world b gets ``world_seeds(seed, B)[b]``; None takes a fresh one from the system
        :return: the seed of each slot's world (B*N)
        """
        # ConcatVecEnv seeds world b with s + b: runs with seeds 7 and 8 would share all worlds but one.
        self._seeds = [world_seed for world_seed in world_seeds(seed, self.n_worlds) for _ in self.agents]
        return self._seeds

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of the next ``reset()``.

        :param options: one dict for all worlds, or one per slot (B*N), equal within a world
        :raises ValueError: if the list has another length, or the slots of one world differ
        """
        if isinstance(options, list):
            if len(options) != self.num_envs:
                raise ValueError(f"{len(options)} options for {self.num_envs} slots: give one per slot, or one dict")
            for slot in range(self.num_envs):
                if options[slot] != options[slot - slot % self.n_agents]:
                    raise ValueError(f"{self._name(slot)}: options differ from those of the world's first agent")
        super().set_options(options)

    def reset(self, seed: int | None = None) -> VecEnvObs:
        """Start new episodes in all worlds; what the worlds tell at their reset is in ``reset_infos``.

        :param seed: if given, as :meth:`seed`
        :return: first observations (B*N, O)
        :raises WorldError: if one is missing, does not fit its space or is not finite; names the world and the agent
        """
        # SB3VecEnvWrapper.reset does not hand its seed on.
        if seed is not None:
            self.seed(seed)
        first_slots = range(0, self.num_envs, self.n_agents)
        first_observations = [
            slots.reset(seed=self._seeds[first], options=self._options[first] or None)[0]
            for slots, first in zip(self._converted, first_slots, strict=True)
        ]
        self._reset_seeds()
        self._reset_options()
        self._collect_reset_infos()
        observations = np.concatenate(first_observations)
        self._check_finite("observation", observations)
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the coming step.

        :param actions: one per slot (B*N, U)
        :raises ValueError: if the shape is wrong or a number is not finite; names the world and the agent
        """
        # SuperSuit hands NaN on to the worlds, leaves surplus actions out, and names no agent where a shape is wrong.
        self._check_shape(actions)
        valid = np.abs(actions) <= self._largest_action  # False for NaN too
        if not valid.all():
            slot = int(np.argwhere(~valid)[0, 0])
            raise ValueError(f"{self._name(slot)}: action {actions[slot]} is not finite in {self.action_space.dtype}")
        self._actions = np.array(actions, dtype=self.action_space.dtype)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all worlds; those whose episode ends go on with the first observations of the next one.

        :return: observations (B*N, O), rewards (B*N), dones (B*N) and infos (B*N) of this step
        :raises WorldError: if agents of one world end at different steps, or what the world tells one is missing, has
            another shape or is not finite; names the world and the agents
        """
        actions = self._actions.reshape(self.n_worlds, self.n_agents, *self._actions.shape[1:])
        steps = [slots.step(joint_action) for slots, joint_action in zip(self._converted, actions, strict=True)]
        *arrays, world_infos = zip(*steps, strict=True)
        observations, rewards, terminations, truncations = map(np.concatenate, arrays)
        infos = [info for world in world_infos for info in world]
        # SuperSuit's flags are uint8, whose ~ is not a negation.
        dones = (terminations | truncations).astype(bool)
        self._check_finite("reward", rewards)
        self._check_finite("observation", observations)
        if dones.any():
            self._collect_reset_infos()
            last_observations = observations.copy()
            for slot in np.flatnonzero(dones):
                last_observations[slot] = infos[slot]["terminal_observation"]
            self._check_finite("last observation", last_observations)
        return observations, rewards, dones, infos

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Read an attribute of each slot's world."""
        return [getattr(_holder(world, attr_name), attr_name) for world in self._worlds_of(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute that each slot's world already has."""
        for world in self._worlds_of(indices):
            setattr(_holder(world, attr_name), attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once per world among the slots; each of its slots gets the answer."""
        worlds = self._worlds_of(indices)
        methods = {id(world): getattr(_holder(world, method_name), method_name) for world in worlds}
        answers = {world: method(*args, **kwargs) for world, method in methods.items()}
        return [answers[id(world)] for world in worlds]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Tell whether each slot's world has this wrapper among its layers."""
        return [any(isinstance(layer, wrapper_class) for layer in _layers(world)) for world in self._worlds_of(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Draw each world once, whatever its number of slots; None unless its render mode is ``rgb_array``."""
        return [world.render() if self.render_mode == "rgb_array" else None for world in self._worlds]  # type: ignore[misc]  # PettingZoo allows text too

    def close(self) -> None:
        """Close all worlds."""
        self.env_method("close")

    def _collect_reset_infos(self) -> None:
        self.reset_infos = [info for slots in self._converted for info in slots.par_env.reset_infos]

    def _worlds_of(self, indices: VecEnvIndices) -> list[World]:
        return [self._worlds[range(self.num_envs)[slot] // self.n_agents] for slot in self._get_indices(indices)]

    def _name(self, slot: int) -> str:
        return f"world {slot // self.n_agents}, agent {self.agents[slot % self.n_agents]!r}"

    def _check_finite(self, what: str, values: NDArray[Any]) -> None:
        """Refuse what makes a learner's weights NaN: many steps later its actions would get the blame."""
        finite = np.isfinite(values)
        if not finite.all():
            slot, *place = np.argwhere(~finite)[0].tolist()
            raise WorldError(f"{self._name(slot)}: {what}{place or ''} is {values[slot, *place]}; it must be finite")

    def _check_shape(self, actions: Any) -> None:
        shape = self.action_space.shape or ()
        if isinstance(actions, np.ndarray) and actions.shape == (self.num_envs, *shape):
            return
        for slot, action in enumerate(actions[: self.num_envs]):
            if np.shape(action) != shape:
                raise ValueError(f"{self._name(slot)}: action has shape {np.shape(action)}, expected {shape}")
        if len(actions) < self.num_envs:
            raise ValueError(f"{self._name(len(actions))}: no action; {len(actions)} given for {self.num_envs} slots")
        if len(actions) > self.num_envs:
            raise ValueError(
                f"{len(actions)} actions for {self.num_envs} slots; {self._name(self.num_envs - 1)} is the last"
            )


class _Shield(BaseParallelWrapper[str, Any, Any]):
    """One world as SuperSuit's MarkovVectorEnv gets it: nothing in there that it would lose, overwrite or misread."""

    def __init__(self, world: World, index: int) -> None:
        super().__init__(world)
        self.possible_agents = world.possible_agents
        self.shapes = {"observation": world.observation_space(world.possible_agents[0]).shape, "reward": ()}
        self.index = index
        self.reset_infos: list[dict[str, Any]] = []
        read_by_supersuit: dict[str, Any] = {"render_mode": None, "metadata": {}}
        for name, usual in read_by_supersuit.items():
            if not hasattr(world.unwrapped, name):
                setattr(world.unwrapped, name, usual)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        observations, infos = self.env.reset(seed=seed, options=options)
        self._check_told(observation=observations)
        self.reset_infos = self._copies(infos)
        # MarkovVectorEnv lays the infos of an automatic reset over those of the last step: leave it none.
        return observations, {}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        self._check_told(observation=observations, reward=rewards, termination=terminations, truncation=truncations)
        # MarkovVectorEnv plays on until all have ended, without a terminal_observation for those who ended before.
        ended = [agent for agent in self.possible_agents if terminations[agent] or truncations[agent]]
        if 0 < len(ended) < len(self.possible_agents):
            others = [agent for agent in self.possible_agents if agent not in ended]
            raise WorldError(f"world {self.index}: {ended} ended, {others} did not; all must end at the same step")
        if ended:  # MarkovVectorEnv keeps the last observations while the reset may write into the same arrays
            observations = deepcopy(observations)
        # MarkovVectorEnv writes into the world's own infos: give it copies. SB3VecEnvWrapper drops the truncations.
        told = dict(zip(self.possible_agents, self._copies(infos), strict=True))
        for agent, info in told.items():
            info["TimeLimit.truncated"] = bool(truncations[agent] and not terminations[agent])
        return observations, rewards, terminations, truncations, told

    def _copies(self, infos: dict[str, dict[str, Any]] | None) -> list[dict[str, Any]]:
        """Return a copy of each agent's info, which may be missing."""
        return [dict((infos or {}).get(agent) or {}) for agent in self.possible_agents]

    def _check_told(self, **told: dict[str, Any]) -> None:
        """Refuse what MarkovVectorEnv cannot stack, or makes something else of: a missing reward is 0 to it."""
        for what, values in told.items():
            if absent := [agent for agent in self.possible_agents if agent not in values]:
                raise WorldError(f"world {self.index}: no {what} of {absent}; all must take part in every step")
            if what in self.shapes:
                for agent in self.possible_agents:
                    shape, expected = np.shape(values[agent]), self.shapes[what]
                    if shape != expected:
                        expectation = f"its space has {expected}" if expected else "expected a single number"
                        raise WorldError(
                            f"world {self.index}, agent {agent!r}: {what} has shape {shape}, {expectation}"
                        )


def _check_worlds(worlds: Sequence[Any]) -> None:
    """Refuse worlds whose agents cannot stand in the slots of one VecEnv."""
    for world in worlds:
        if not isinstance(world, ParallelEnv):
            raise TypeError(
                f"{type(world).__name__} is no ParallelEnv; PettingZoo's aec_to_parallel converts an AECEnv"
            )
        if any(isinstance(layer, black_death_par) for layer in _layers(world)):
            raise ValueError("black_death_v3 shows an end one step late, with zeroed observations: leave it out")
    if len({id(world.unwrapped) for world in worlds}) < len(worlds):
        raise ValueError("env returned one world twice: it must make a new one at every call")
    agents = worlds[0].possible_agents
    seen, act = worlds[0].observation_space(agents[0]), worlds[0].action_space(agents[0])
    if not isinstance(seen, Box) or not isinstance(act, Box | Discrete):
        raise ValueError(f"observations {seen}, actions {act}: supported are Box, and Box or Discrete")
    for index, world in enumerate(worlds):
        if world.possible_agents != agents:
            raise ValueError(f"world {index} has the agents {world.possible_agents}, world 0 has {agents}")
        for agent in agents:
            for space, expected, padding in (
                (world.observation_space(agent), seen, "pad_observations_v0"),
                (world.action_space(agent), act, "pad_action_space_v0"),
            ):
                if space != expected:
                    raise ValueError(
                        f"world {index}, agent {agent!r} has the space {space}, but world 0, agent {agents[0]!r} has "
                        f"{expected}: supersuit.{padding} makes spaces equal"
                    )


def _layers(world: World) -> Iterator[Any]:
    """Yield the world and what it wraps, from the outside in."""
    layer: Any = world
    while isinstance(layer, ParallelEnv | AECEnv):
        yield layer
        layer = vars(layer).get("env", vars(layer).get("aec_env"))  # aec_to_parallel has its own name for it


def _holder(world: World, name: str) -> Any:
    """Return the outermost layer with an attribute of its own: PettingZoo's wrappers read through, but write on top."""
    for layer in _layers(world):
        if name in vars(layer) or hasattr(type(layer), name):
            return layer
    raise AttributeError(f"no layer of {world} has the attribute {name!r}")
