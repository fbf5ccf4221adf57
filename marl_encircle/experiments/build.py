"""Configuration -> objects: the environment that trains, the model, its policy."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import safetensors.torch
import torch as th
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from marl_encircle.core.scenario import Scenario
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.arena import spaces_of
from marl_encircle.envs.curriculum import CurriculumVecEnv, Ramp
from marl_encircle.envs.mixed_vec_env import MixedVecEnv
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.experiments.choices import Engine, Profile
from marl_encircle.experiments.config import Config, load_config
from marl_encircle.experiments.features import RelativeFeatures, SetFeatures
from marl_encircle.experiments.sections import AlgorithmConfig, ScheduleConfig
from marl_encircle.experiments.sizes import buffer_world_steps
from marl_encircle.experiments.trainable import check_curriculum
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.spelling import nearest


def make_vec_env(
    reward: str | Path = "ours",
    n_worlds: int = 16,
    *,
    scenario: str | Path | Scenario = "default",
    engine: Engine = "native",
    seed: int | None = None,
    curriculum: bool = True,
    profile: Profile = "full",
    overrides: Sequence[str] = (),
    **fields: Any,
) -> VecEnv:
    """Return worlds to train in: ``n_worlds * pursuers`` slots, monitored, with the setting's curriculum.

    :param reward: a method's name or the path of its YAML file
    :param n_worlds: worlds side by side: fewer learn more from each step, more take less time for it
    :param scenario: a name in ``configs/scenario/``, the path of a YAML file, or a ``Scenario``
    :param engine: ``native``, fast, or ``supersuit``, the PettingZoo environment through SuperSuit; equal seeds give
        equal trajectories
    :param seed: of the worlds; without one they start from fresh entropy. Those of ``evaluation.seed`` are the rounds
        that are reported, so train in others
    :param curriculum: start easy and become final over world steps, as the training section says; without it the
        worlds are final from the start, for evaluation
    :param profile: see :func:`marl_encircle.experiments.config.load_config`
    :param overrides: ``section.key=value`` each
    :param fields: fields of ``Scenario`` that differ from it, for example ``pursuers=3, obstacles=1, speed_ratio=1.1``
    :raises ConfigError: for an unknown name or a value that is not allowed
    """
    if "n_envs" in fields:
        raise ConfigError("n_envs counts slots, one for each pursuer of each world: give n_worlds")
    _check_integer("n_worlds", n_worlds, least=1)
    overrides = _with_worlds(overrides, n_worlds)
    config = load_config(reward, profile=profile, scenario=scenario, fields=fields, overrides=overrides)
    if seed is not None:
        _check_integer("seed", seed, least=0)
    env = build_vec_env(config, n_worlds, engine, curriculum=curriculum)
    if seed is not None:
        env.seed(seed)
    return env


def _with_worlds(overrides: Sequence[str], n_worlds: int) -> Sequence[str]:
    """Add the number of worlds to overrides that leave it alone; what is no list is told where they are read."""
    if isinstance(overrides, str) or not isinstance(overrides, Sequence):
        return overrides
    key = "training.n_worlds"
    if any(str(override).partition("=")[0].strip() == key for override in overrides):
        raise ConfigError(f"{key} is an argument here: give n_worlds")
    return [*overrides, f"{key}={n_worlds}"]


def build_vec_env(config: Config, n_worlds: int, engine: Engine = "native", *, curriculum: bool = True) -> VecEnv:
    """Return the environment that a configuration trains in.

    :param n_worlds: worlds side by side, a slot for each pursuer of each
    :param engine: ``native`` steps all worlds at once, ``supersuit`` the PettingZoo environment world by world
    :param curriculum: whether the scenario starts easier, as the training's curriculum says
    :raises ConfigError: for an unknown engine, or a curriculum that starts where the scene is not allowed
    """
    check_engine(engine, config)
    if curriculum:
        check_curriculum(config)
    scenario, reward = config.scenario, config.reward.build()
    worlds: VecEnv
    if config.training.settings:
        scenarios = [config.in_setting(setting).scenario for setting in config.settings]
        worlds = MixedVecEnv(scenario, scenarios, reward, n_worlds)
    elif engine == "native":
        worlds = EncirclementVecEnv(scenario, reward, n_worlds)
    else:
        worlds = SuperSuitVecEnv(lambda: encirclement_v0.parallel_env(scenario, reward), n_worlds)
    ramps: dict[str, Ramp] = {
        name: Ramp(ramp.start, getattr(scenario, name), ramp.world_steps)
        for name, ramp in config.training.curriculum.items()
        if ramp is not None and curriculum
    }
    return VecMonitor(CurriculumVecEnv(worlds, ramps))


def check_engine(engine: str, config: Config) -> None:
    """Raise a ConfigError unless there is such an engine, and it can train what the configuration asks for."""
    if engine not in get_args(Engine):
        raise ConfigError(f"engine {engine!r:.80}: unknown engine{nearest(str(engine), get_args(Engine))}")
    if config.training.settings and engine != "native":
        raise ConfigError(f"training.settings: only the native engine trains in several; got {engine}")


def _check_integer(name: str, value: object, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ConfigError(f"{name} must be an integer of at least {least}; got {value!r:.80}")


def build_model(config: Config, env: VecEnv, seed: int, **kwargs: Any) -> MADDPG:
    """Return the untrained model of a configuration; world steps become SB3's agent steps here.

    :param env: the environment to train in
    :param seed: of the networks, the exploration, the replay sampling and the environment
    :param kwargs: passed on to the algorithm
    """
    a, n = config.algorithm, config.scenario.pursuers
    end = a.learning_rate_end
    return ALGORITHMS[a.name](
        "MlpPolicy",
        env,
        learning_rate=a.learning_rate if end is None else LinearSchedule(a.learning_rate, end, 1.0),
        buffer_size=buffer_world_steps(a, config.training) * n,
        learning_starts=a.random_world_steps * n,
        batch_size=a.batch_size,
        tau=a.tau,
        gamma=a.gamma,
        train_freq=a.train_freq,
        gradient_steps=a.gradient_steps,
        critic=a.critic,
        exploration_noise=NoiseSchedule(a.exploration_noise, config.training.world_steps),
        exploration_random=a.exploration_random,
        policy_delay=a.policy_delay,
        max_grad_norm=a.max_grad_norm,
        n_steps=a.n_steps,
        actor_regularization=a.actor_regularization,
        policy_kwargs={"net_arch": list(a.net_arch), **features_kwargs(config)},
        seed=seed,
        device="cpu",
        **kwargs,
    )


def features_kwargs(config: Config) -> dict[str, Any]:
    """Return the policy's arguments that say what its networks read."""
    if config.algorithm.features == "observation":
        return {}
    kwargs: dict[str, Any] = {"features_extractor_kwargs": {"scenario": config.scenario}}
    if config.algorithm.features == "relative":
        return {"features_extractor_class": RelativeFeatures, **kwargs}
    return {"features_extractor_class": SetFeatures, "share_parameters": True, **kwargs}


class NoiseSchedule:
    """SB3 asks with the progress that remains, 1 to 0; the configuration counts world steps.

    :param schedule: from ``start`` to ``end`` over its world steps
    :param world_steps: of the whole training
    """

    def __init__(self, schedule: ScheduleConfig, world_steps: int) -> None:
        self.ramp = Ramp(schedule.start, schedule.end, schedule.world_steps)
        self.world_steps = world_steps

    def __call__(self, progress_remaining: float) -> float:
        """Return the standard deviation of the exploration noise."""
        return self.ramp.at(round((1.0 - progress_remaining) * self.world_steps))


def build_policy(config: Config) -> MADDPGPolicy:
    """Return an untrained policy for a configuration's scenario, to load actors into; its critics are of no use."""
    algorithm: AlgorithmConfig = config.algorithm
    policy = MADDPGPolicy(
        *spaces_of(config.scenario),
        lambda _: algorithm.learning_rate,
        n_agents=config.scenario.pursuers,
        critic="shared",
        net_arch={"pi": list(algorithm.net_arch), "qf": []},
        **features_kwargs(config),
    )
    policy.agents = config.scenario.agents
    return policy


def fit_policy(policy: MADDPGPolicy, config: Config) -> MADDPGPolicy:
    """Return a policy for the bodies of a setting: of sets, one with the same weights; itself where they are its own.

    Draws no random numbers, as a training may be under way.

    :param config: the policy's, in the setting to play in; see :meth:`Config.to_play_in`
    """
    there = config.scenario
    if (policy.n_agents, policy.observation_space) == (there.pursuers, spaces_of(there).observation):
        return policy
    with th.random.fork_rng(devices=[]):
        fitted = build_policy(config)
    fitted.actor.load_state_dict(policy.actor.state_dict())
    fitted.set_training_mode(False)
    return fitted


def policy_bytes(policy: MADDPGPolicy) -> bytes:
    """Return the actors' weights as safetensors; equal weights give equal bytes."""
    return safetensors.torch.save(policy.actor_state_dict())
