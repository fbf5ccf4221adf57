"""Configuration -> objects: the environment that trains, the model, and a trained policy read back."""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import safetensors.torch
import torch as th
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from marl_encircle import files
from marl_encircle.core.scenario import Scenario
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.arena import spaces_of
from marl_encircle.envs.curriculum import CurriculumVecEnv, Level
from marl_encircle.envs.mixed_vec_env import MixedVecEnv
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.experiments.choices import Engine, Profile
from marl_encircle.experiments.config import MAX_POLICY_BYTES, Config, load_config
from marl_encircle.experiments.features import RelativeFeatures, SetFeatures
from marl_encircle.experiments.pretrained import find_run, in_words, is_run_path, pretrained_runs, setting_of
from marl_encircle.experiments.records import POLICY, RECORD, read_record
from marl_encircle.experiments.sections import AlgorithmConfig, Schedule
from marl_encircle.experiments.trainable import check_curriculum
from marl_encircle.experiments.yaml_files import ConfigError
from marl_encircle.maddpg import ALGORITHMS, MADDPG
from marl_encircle.maddpg.policies import MADDPGPolicy
from marl_encircle.maddpg.saving import load_actors
from marl_encircle.spelling import nearest

MAX_HEADER_BYTES = 1 << 16
"""Largest header of one: names and shapes of a few arrays per layer. Each name costs memory, whatever it stands for."""


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
    config = load_config(reward, profile=profile, scenario=scenario, fields=fields, overrides=overrides)
    _check_integer("n_worlds", n_worlds, least=1)
    n = len(config.settings)
    if n_worlds % n:
        raise ConfigError(f"n_worlds must be a multiple of the {n} settings of training.settings; got {n_worlds}")
    if seed is not None:
        _check_integer("seed", seed, least=0)
    env = build_vec_env(config, n_worlds, engine, curriculum=curriculum)
    if seed is not None:
        env.seed(seed)
    return env


def build_vec_env(config: Config, n_worlds: int, engine: Engine = "native", *, curriculum: bool = True) -> VecEnv:
    """Return the environment that a configuration trains in.

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
    levels: dict[str, Level] = {
        name: Level(ramp.start, getattr(scenario, name), ramp.world_steps)
        for name, ramp in config.training.curriculum.items()
        if ramp is not None and curriculum
    }
    return VecMonitor(CurriculumVecEnv(worlds, levels))


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
    # A buffer larger than the training would only cost memory.
    buffer_world_steps = min(a.buffer_world_steps, config.training.world_steps + config.training.n_worlds)
    return ALGORITHMS[a.name](
        "MlpPolicy",
        env,
        learning_rate=a.learning_rate if end is None else LinearSchedule(a.learning_rate, end, 1.0),
        buffer_size=buffer_world_steps * n,
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

    def __init__(self, schedule: Schedule, world_steps: int) -> None:
        self.level = Level(schedule.start, schedule.end, schedule.world_steps)
        self.world_steps = world_steps

    def __call__(self, progress_remaining: float) -> float:
        """Return the standard deviation of the exploration noise."""
        return self.level.at(round((1.0 - progress_remaining) * self.world_steps))


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
    """Return a policy whose features are sets, with the same weights, for other numbers of bodies.

    Draws no random numbers, as a training may be under way.

    :param config: the policy's, in the setting to play in
    """
    with th.random.fork_rng(devices=[]):
        fitted = build_policy(config)
    fitted.actor.load_state_dict(policy.actor.state_dict())
    fitted.set_training_mode(False)
    return fitted


def policy_bytes(policy: MADDPGPolicy) -> bytes:
    """Return the actors' weights as safetensors; equal weights give equal bytes."""
    return safetensors.torch.save(policy.actor_state_dict())


def load_policy(what: str | Path, *, trusted: bool = False, **fields: Any) -> MADDPGPolicy:
    """Return a trained policy: one that comes with the package, by name, or that of a run folder.

    Reads JSON and safetensors only, which cannot run code, and checks them against the recorded hashes.

    :param what: a method's name, for its first training seed in a setting; a run folder or the ``policy.safetensors``
        in one; or, if it is ``trusted``, a zip-file that ``MADDPG.save`` wrote, from which only the actors are taken
    :param trusted: read a zip-file, **which can run code when it is loaded**
    :param fields: ``speed_ratio``, ``pursuers``, ``obstacles`` and ``scene`` of a name's setting, 1.1, 3, 1 and random
        where they are not given; or those in which the policy of a run folder shall play, if it serves any setting
    :raises ConfigError: for a name or a setting without a policy, with those that there are and the nearest
    :raises DamagedFileError: if a file is missing, changed, does not fit the configuration, or is not trusted
    """
    setting = setting_of(fields)
    wanted = {name: value for name, value in setting._asdict().items() if name in fields}
    if isinstance(what, str) and not is_run_path(what):
        what, wanted = find_run(what, setting, [pretrained_runs()]), setting._asdict()
    path = Path(what)
    if trusted and path.is_file() and zipfile.is_zipfile(path):
        if fields:
            raise ConfigError(f"{what}: a zip-file has a setting of its own; got {', '.join(fields)}")
        try:
            return load_actors(path)
        except Exception as error:  # unpickling raises whatever it likes
            raise files.DamagedFileError(path, f"holds no actors: {_one_line(error)}") from error
    return load_run(path, wanted).policy


class LoadedRun(NamedTuple):
    """A run read back.

    :param policy: to act with
    :param config: of the run, in the setting that was asked for
    :param record: content of its ``run.json``
    """

    policy: MADDPGPolicy
    config: Config
    record: dict[str, Any]


def load_run(run: str | Path, fields: Mapping[str, Any] | None = None) -> LoadedRun:
    """Return a run's policy, configuration and record; see :func:`load_policy`.

    :param run: its folder, or the ``policy.safetensors`` in it
    :param fields: of a setting to play in, as far as they are not the run's; only policies of sets have others
    :raises ConfigError: for a setting that the policy does not serve
    :raises DamagedFileError: if a file is missing, changed or does not fit the configuration
    """
    folder = Path(run)
    if folder.name == POLICY:
        folder = folder.parent
    if folder.is_file():
        raise files.DamagedFileError(folder, _no_run(folder))
    record = read_record(folder)
    config = config_of(record, folder)
    data = files.read_bytes(folder / POLICY, sha256=record["sha256"][POLICY], max_bytes=MAX_POLICY_BYTES)
    policy = build_policy(config)
    try:
        load_weights(policy, data)
    except (safetensors.SafetensorError, RuntimeError, ValueError) as error:
        reason = f"does not hold this policy's weights: {_one_line(error)}"
        raise files.DamagedFileError(folder / POLICY, reason) from error
    policy.set_training_mode(False)
    trained = config.cell.setting
    setting = trained._replace(**(fields or {}))
    if setting != trained:
        if config.algorithm.features != "set":
            raise ConfigError(f"{folder} was trained {in_words(trained)}; asked for {in_words(setting)}")
        config = config.in_setting(setting)
        policy = fit_policy(policy, config)
    return LoadedRun(policy, config, record)


def load_weights(policy: MADDPGPolicy, data: bytes) -> None:
    """Put the weights of a ``policy.safetensors`` into the actors; raise an error unless it holds just those."""
    if int.from_bytes(data[:8], "little") > MAX_HEADER_BYTES:
        raise ValueError(f"its header is larger than the {MAX_HEADER_BYTES} bytes allowed")
    tensors = safetensors.torch.load(data)
    for name, weights in policy.actor_state_dict().items():
        if name in tensors and tensors[name].dtype != weights.dtype:
            raise ValueError(f"{name} has dtype {tensors[name].dtype}")
    policy.actor.load_state_dict(tensors)
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise ValueError("some are not finite")


def _no_run(path: Path) -> str:
    """Say why a file is not a run folder."""
    if not zipfile.is_zipfile(path):
        return "a file, not the folder of a run"
    return (
        "a zip-file, which can run code when it is loaded, and only safetensors and JSON are read; if it is a model "
        "that you trust: load_policy(..., trusted=True) in Python"
    )


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def config_of(record: dict[str, Any], folder: Path) -> Config:
    """Return the configuration that the run of a folder was made with.

    :raises DamagedFileError: if it is not a valid configuration
    """
    try:
        return Config.from_dict(record.get("config"))  # type: ignore[arg-type]  # it may be anything
    except (ValueError, RecursionError) as error:
        raise files.DamagedFileError(folder / RECORD, f"config: {str(error)[:500]}") from error
