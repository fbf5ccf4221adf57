"""PettingZoo environments by name, and whether MADDPG can be trained on them."""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import numpy as np
import pettingzoo
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from pettingzoo.env_registry.exceptions import NameNotFound, NamespaceNotFound, PettingZooRegistryError
from pettingzoo.env_registry.registration import parallel_registry

from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv, World, WorldError
from marl_encircle.experiments.yaml_files import ConfigError, parse_yaml
from marl_encircle.spelling import nearest

MAX_ROUND = 10_000
"""Steps after which a round counts as one that never ends."""

NO_END = f"a round has not ended after {MAX_ROUND} steps; give it a time limit, for example --set max_cycles=100"


def parse_arguments(settings: Sequence[str]) -> dict[str, Any]:
    """Return the keyword arguments that ``key=value`` texts stand for, the values in YAML.

    :raises ConfigError: naming the text
    """
    arguments = {}
    for text in settings:
        key, separator, value = text.partition("=")
        if not separator or not key.isidentifier():
            raise ConfigError(f"--set {text:.80}: must be an argument of the environment, key=value")
        try:
            arguments[key] = parse_yaml(value)
        except ConfigError as error:
            raise ConfigError(f"--set {text:.80}: {error}") from error
    return arguments


def find_world(name: str, arguments: Mapping[str, Any], pad: bool = False) -> Callable[[], World]:
    """Return what makes a new world of an environment; one has been made and played for a round.

    :param name: an id of PettingZoo, ``sisl/multiwalker-v9``; or an import path, **whose code is run**: a module with a
        ``parallel_env``, such as ``mpe2.simple_spread_v3`` or one in the working folder; or ``module:function``
    :param arguments: keyword arguments of the environment
    :param pad: make unequal Box spaces equal, with zeros
    :raises ConfigError: if there is no such environment, or MADDPG cannot be trained on it, with what to do
    """
    make = _find_maker(name)

    def world() -> World:
        made: World = make(**arguments)
        if pad:
            from supersuit import pad_action_space_v0, pad_observations_v0

            made = pad_action_space_v0(pad_observations_v0(made))
        return made

    try:
        first = world()
    except (NameNotFound, NamespaceNotFound) as error:
        raise ConfigError(f"{name}: not among PettingZoo's environments{nearest(name, parallel_registry)}") from error
    except PettingZooRegistryError as error:
        raise ConfigError(f"{name}: {error}") from error
    except (TypeError, ValueError, AssertionError, ImportError) as error:
        given = ", ".join(f"{key}={value!r}" for key, value in arguments.items()) or "no arguments"
        raise ConfigError(f"{name}: no world could be made with {given}: {type(error).__name__}: {error}") from error
    check_spaces(name, first)
    _check_round(name, world)
    return world


def _find_maker(name: str) -> Callable[..., World]:
    if "/" in name or re.search(r"-v\d+$", name):
        return lambda **arguments: pettingzoo.make("parallel", name, **arguments)
    path, _, function = name.partition(":")
    if not all(part.isidentifier() for part in path.split(".")):
        raise ConfigError(f"{name:.80}: neither an id of PettingZoo, such as sisl/multiwalker-v9, nor an import path")
    sys.path.insert(0, os.getcwd())  # noqa: PTH109 - as python -m does
    try:
        module = import_module(path)
    except ImportError as error:
        raise ConfigError(f"{name}: cannot be imported: {error}{_nearest_module(path)}") from error
    finally:
        sys.path.pop(0)
    maker: Callable[..., World] | None = getattr(module, function or "parallel_env", None)
    if maker is None:
        raise ConfigError(f"{name}: the module has no {function or 'parallel_env'}; give module:function")
    return maker


def _nearest_module(path: str) -> str:
    """Return what :func:`nearest` says of a module that its package lacks; nothing where another one is missing."""
    package = path.rpartition(".")[0]
    names = [f"{package}.{each.name}" for each in iter_modules(getattr(sys.modules.get(package), "__path__", ()))]
    return nearest(path, names) if names and path not in names else ""


def check_spaces(name: str, world: Any) -> None:
    """Raise a ConfigError that says what to do, unless the agents have equal Box spaces that MADDPG can learn in."""
    if not isinstance(world, ParallelEnv):
        raise ConfigError(
            f"{name}: {type(world).__name__} is no ParallelEnv; pettingzoo.utils.aec_to_parallel converts an AECEnv"
        )
    agents = world.possible_agents
    first_seen, first_act = world.observation_space(agents[0]), world.action_space(agents[0])
    for agent in agents:
        seen, act = world.observation_space(agent), world.action_space(agent)
        if not isinstance(act, spaces.Box):
            raise ConfigError(
                f"{name}: the actions of {agent} are {act}; MADDPG needs continuous ones (Box). Many environments have "
                "them by an argument, for example --set continuous_actions=true"
            )
        if not act.is_bounded():
            raise ConfigError(
                f"{name}: the actions of {agent} are {act}; MADDPG needs bounds: supersuit.clip_actions_v0"
            )
        if not isinstance(seen, spaces.Box):
            raise ConfigError(f"{name}: the observations of {agent} are {seen}; MADDPG needs numbers (Box)")
        if len(seen.shape) > 1:
            raise ConfigError(
                f"{name}: the observations of {agent} have shape {seen.shape}; play-with trains on vectors. "
                'SuperSuit\'s resize_v1 and flatten_v0 make them such, or train MADDPG("CnnPolicy", ...) in Python'
            )
        for what, space, first in (("observations", seen, first_seen), ("actions", act, first_act)):
            if space != first:
                raise ConfigError(
                    f"{name}: the {what} of {agent} are {space}, those of {agents[0]} {first}; MADDPG needs equal "
                    "spaces: --pad makes them so"
                )


def _check_round(name: str, world: Callable[[], World]) -> None:
    """Play a round by chance: most of what would stop a training later is told now."""
    try:
        env = SuperSuitVecEnv(world)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from error
    act = random_actions(env.action_space)
    try:
        observations = np.asarray(env.reset(seed=0))
        for _ in range(MAX_ROUND):
            stepped, _, dones, _ = env.step(act(observations))
            observations = np.asarray(stepped)
            if dones.all():
                break
        else:
            raise ConfigError(f"{name}: {NO_END}")
    except WorldError as error:
        raise ConfigError(f"{name}: {error}") from error
    env.close()


def random_actions(space: spaces.Space[Any]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return what takes uniformly random actions for as many agents as there are observations; each time the same.

    :param space: of one agent's actions, a bounded Box
    """
    assert isinstance(space, spaces.Box)
    rng, low, high = np.random.default_rng(0), space.low, space.high
    return lambda observations: rng.uniform(low, high, (len(observations), *low.shape)).astype(low.dtype)
