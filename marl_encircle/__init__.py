"""Encircling a faster target with multi-agent reinforcement learning.

Importing the package registers ``pettingzoo.make("parallel", "marl_encircle/encirclement-v0")``. The names below are
imported when they are first used, so that an environment alone does not load torch; ``__version__`` is read then, too.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import pettingzoo

if TYPE_CHECKING:
    from marl_encircle.core.rewards import Reward
    from marl_encircle.core.scenario import Scenario
    from marl_encircle.envs import encirclement_v0
    from marl_encircle.envs.encirclement_v0 import parallel_env
    from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
    from marl_encircle.experiments.build import make_vec_env
    from marl_encircle.experiments.loading import load_policy
    from marl_encircle.experiments.yaml_files import ConfigError
    from marl_encircle.maddpg import MADDPG, MATD3

__version__: str

__all__ = [
    "MADDPG",
    "MATD3",
    "ConfigError",
    "Reward",
    "Scenario",
    "SuperSuitVecEnv",
    "encirclement_v0",
    "load_policy",
    "make_vec_env",
    "parallel_env",
]

_HOMES = {
    "MADDPG": "maddpg",
    "MATD3": "maddpg",
    "ConfigError": "experiments.yaml_files",
    "Reward": "core.rewards",
    "Scenario": "core.scenario",
    "SuperSuitVecEnv": "envs.supersuit_vec_env",
    "encirclement_v0": "envs.encirclement_v0",
    "load_policy": "experiments.loading",
    "make_vec_env": "experiments.build",
    "parallel_env": "envs.encirclement_v0",
}

_ENVIRONMENT = "marl_encircle.envs.encirclement_v0"
pettingzoo.register("parallel", "marl_encircle/encirclement-v0", f"{_ENVIRONMENT}:parallel_env")
pettingzoo.register("aec", "marl_encircle/encirclement-v0", f"{_ENVIRONMENT}:env")


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("marl-encircle")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = f"{__name__}.{_HOMES[name]}"
    return import_module(home) if home.endswith(f".{name}") else getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
