"""Measure how fast everything is, beside its peers, and write ``benchmarks/results.json``: what ``make bench`` runs.

One thread. What is compared takes turns, sample by sample, so that a noisy machine is unfair to nobody; reported are
medians. Seconds are processor seconds of this process: on a free core those of a clock, on a busy one still those that
the work takes. Random actions are drawn before the time starts, for all alike.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # libraries read it when they are imported

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import metadata
from itertools import cycle
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import torch as th
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from supersuit import concat_vec_envs_v1, pad_action_space_v0, pad_observations_v0, pettingzoo_env_to_vec_env_v1

from marl_encircle import files
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Simulator
from marl_encircle.envs import encirclement_v0
from marl_encircle.envs.vec_env import EncirclementVecEnv
from marl_encircle.experiments.build import make_vec_env
from marl_encircle.experiments.provenance import cpu_model, git_commit, versions
from marl_encircle.maddpg import MADDPG
from marl_encircle.maddpg.models import CriticKind

try:
    from mpe2 import simple_tag_v3
except ImportError as error:
    raise SystemExit("error: the benchmarks need mpe2, which the extra [dev] installs: make setup") from error

RESULTS = Path(__file__).with_name("results.json")
SCENARIO = Scenario(pursuers=3, obstacles=1, n_directions=72)
PEER_WORLDS = 8
BATCH_SIZE = 1024
BUFFER_WORLD_STEPS = 500_000
CHUNK = 60
"""Steps between two looks at the time: the length of a round, so that resets are in every chunk."""

Chunk = Callable[[], int]
"""Plays for a moment and returns the number of world-steps it played."""


class Aim(NamedTuple):
    """What a figure has to reach, and what it should."""

    at_least: float
    aim: float


AIMS = {
    "core_b256": Aim(1.5e6, 3e6),
    "core_b1": Aim(200e3, 200e3),
    "vec_env_b256": Aim(300e3, 300e3),
    "vec_env_b256 / mpe2_supersuit": Aim(100, 100),
    "parallel_env / mpe2_parallel": Aim(6, 10),
    "maddpg_update_gemm_fraction": Aim(0.30, 0.45),
    "training_loop": Aim(7e3, 14e3),
}


# World-steps per second


def core(n_worlds: int) -> Chunk:
    """Step the simulator itself: measurement and resets, float64, no reward and no observation.

    Every world is reset after ``max_cycles`` steps, a few worlds at each step.
    """
    simulator = Simulator(SCENARIO, n_worlds, seed=0)
    simulator.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (CHUNK, n_worlds, SCENARIO.pursuers, 2))
    worlds = np.arange(n_worlds)
    due = cycle([worlds[worlds % SCENARIO.max_cycles == step] for step in range(SCENARIO.max_cycles)])

    def play() -> int:
        for action, finished in zip(actions, due, strict=False):
            simulator.step(action)
            if len(finished):
                simulator.reset(finished)
        return CHUNK * n_worlds

    return play


def vec_env(n_worlds: int) -> Chunk:
    """Step the native VecEnv under SB3's VecMonitor: rewards, observations, infos."""
    return _play_vec_env(VecMonitor(EncirclementVecEnv(SCENARIO, n_worlds=n_worlds, seed=0)), n_worlds)


def mpe2_supersuit() -> Chunk:
    """Step MPE2's simple_tag_v3, padded, through SuperSuit to SB3."""
    world = pad_action_space_v0(pad_observations_v0(_simple_tag()))
    slots = pettingzoo_env_to_vec_env_v1(world)
    return _play_vec_env(concat_vec_envs_v1(slots, PEER_WORLDS, base_class="stable_baselines3"), PEER_WORLDS)


def parallel_env() -> Chunk:
    """Step one world as a PettingZoo environment."""
    return _play_parallel_env(encirclement_v0.parallel_env(SCENARIO))


def mpe2_parallel() -> Chunk:
    """Step one world of MPE2's simple_tag_v3."""
    return _play_parallel_env(_simple_tag())


def training_loop(n_worlds: int, buffer_world_steps: int) -> Chunk:
    """Learn in the native VecEnv as users get it, one update per 100 world-steps of three pursuers.

    Every 25 steps of 256 worlds, 6,400 world-steps, are followed by 64 updates.
    """
    vec_steps = 25
    updates = vec_steps * n_worlds // 100
    env = make_vec_env("ours", n_worlds, seed=0)
    model = _model_with_memory(env, buffer_world_steps, train_freq=vec_steps, gradient_steps=updates)
    world_steps = vec_steps * n_worlds

    def play() -> int:
        model.learn(world_steps * SCENARIO.pursuers, reset_num_timesteps=False)
        return world_steps

    return play


def _simple_tag() -> Any:
    """3 + 1 agents and 1 obstacle: the peer's nearest to our scene."""
    return simple_tag_v3.parallel_env(num_obstacles=1, continuous_actions=True)


def _play_vec_env(env: VecEnv, n_worlds: int) -> Chunk:
    """Step any VecEnv with random actions; it resets its worlds itself."""
    env.action_space.seed(0)
    actions = [np.stack([env.action_space.sample() for _ in range(env.num_envs)]) for _ in range(CHUNK)]
    env.reset()

    def play() -> int:
        for action in actions:
            env.step(action)
        return CHUNK * n_worlds

    return play


def _play_parallel_env(env: ParallelEnv[str, Any, Any]) -> Chunk:
    """Step any PettingZoo environment with random actions, and reset it when its round is over."""
    env.reset(seed=0)
    for number, agent in enumerate(env.possible_agents):
        env.action_space(agent).seed(number)
    actions = [{agent: env.action_space(agent).sample() for agent in env.possible_agents} for _ in range(CHUNK)]

    def play() -> int:
        for action in actions:
            env.step(action)
            if not env.agents:
                env.reset()
        return CHUNK

    return play


# Updates


def maddpg_update(critic: CriticKind, buffer_world_steps: int) -> Callable[[], None]:
    """One update: sampling, critics, actors, optimisers and targets; 12 observed numbers, networks of 2x64."""
    worlds = EncirclementVecEnv(Scenario(observe_directions=False), n_worlds=256, seed=0)
    model = _model_with_memory(worlds, buffer_world_steps, critic=critic)
    return lambda: model.train(1, BATCH_SIZE)


def gemm() -> Callable[[], object]:
    """One product of two matrices of 1024^2 in single precision, 2 * 1024^3 operations."""
    a, b = th.rand(1024, 1024), th.rand(1024, 1024)
    return lambda: th.mm(a, b)


GEMM_FLOP = 2 * 1024**3


def update_flop(n: int = 3, o: int = 12, u: int = 2, h: int = 64, b: int = BATCH_SIZE) -> int:
    """Return the operations that one MADDPG update needs in its matrix products, critic per agent: 338.17e6.

    A backward pass costs twice the forward pass, less the gradients that nobody needs: of the inputs of actors and
    critics, and, when the actors learn, of the critics' weights and of all inputs but the agent's own action.

    :param n: agents
    :param o: numbers in an observation
    :param u: numbers in an action
    :param h: width of both hidden layers
    :param b: batch size
    """
    joint = n * (o + u)
    actor, critic = (2 * b * n * (inputs * h + h * h + h * out) for inputs, out in ((o, u), (joint, 1)))
    actor_inputs, critic_inputs, own_action = (2 * b * n * inputs * h for inputs in (o, joint, u))
    targets = actor + critic
    critics_learn = 3 * critic - critic_inputs
    actors_learn = 3 * actor - actor_inputs + 2 * critic - critic_inputs + own_action
    return targets + critics_learn + actors_learn


def _model_with_memory(env: VecEnv, world_steps: int, **kwargs: Any) -> MADDPG:
    """Return a model with a buffer full of random play."""
    agent_steps = world_steps * SCENARIO.pursuers
    model = MADDPG(
        "MlpPolicy",
        env,
        buffer_size=agent_steps,
        learning_starts=agent_steps,
        batch_size=BATCH_SIZE,
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
        device="cpu",
        **kwargs,
    )
    return model.learn(agent_steps)


# Measuring


def rate(play: Chunk, seconds: float) -> float:
    """Return the world-steps per second over at least ``seconds`` and one chunk."""
    world_steps, elapsed, start = 0, 0.0, process_time()
    while not world_steps or elapsed < seconds:
        world_steps += play()
        elapsed = process_time() - start
    return world_steps / elapsed


def duration(work: Callable[[], object]) -> float:
    """Return the seconds that a piece of work takes."""
    start = process_time()
    work()
    return process_time() - start


def take_turns(rows: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Return samples of every row, in turns after one that does not count."""
    for sample in rows.values():
        sample()
    samples: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(repeats):
        for name, sample in rows.items():
            samples[name].append(sample())
    return samples


def measure_rates(
    seconds: float, repeats: int, n_worlds: int = 256, buffer_world_steps: int = BUFFER_WORLD_STEPS
) -> dict[str, list[float]]:
    """Return samples of all rows that are world-steps per second."""
    chunks = {
        "core_b256": core(n_worlds),
        "core_b1": core(1),
        "vec_env_b256": vec_env(n_worlds),
        "mpe2_supersuit": mpe2_supersuit(),
        "parallel_env": parallel_env(),
        "mpe2_parallel": mpe2_parallel(),
        "training_loop": training_loop(n_worlds, buffer_world_steps),
    }
    return take_turns({name: partial(rate, play, seconds) for name, play in chunks.items()}, repeats)


def measure_updates(repeats: int, buffer_world_steps: int = BUFFER_WORLD_STEPS) -> dict[str, list[float]]:
    """Return samples of one update's milliseconds and of the machine's rate at matrix products."""
    per_agent, shared = (maddpg_update(critic, buffer_world_steps) for critic in ("per_agent", "shared"))
    product = gemm()
    return take_turns(
        {
            "maddpg_update_ms": lambda: duration(per_agent) * 1e3,
            "gemm_gflops": lambda: GEMM_FLOP / duration(product) / 1e9,
            "maddpg_update_shared_ms": lambda: duration(shared) * 1e3,
        },
        repeats,
    )


def summarise(samples: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the medians of all rows, and the update's share of the rate at matrix products."""
    medians = {name: median(values) for name, values in samples.items()}
    gflops = update_flop() / (medians["maddpg_update_ms"] / 1e3) / 1e9
    return {**medians, "maddpg_update_gemm_fraction": gflops / medians["gemm_gflops"]}


def ratios(medians: Mapping[str, float]) -> dict[str, float]:
    """Return ours / theirs of the rows that do the same kind of work."""
    pairs = (("vec_env_b256", "mpe2_supersuit"), ("parallel_env", "mpe2_parallel"))
    return {f"{ours} / {theirs}": medians[ours] / medians[theirs] for ours, theirs in pairs}


def print_table(samples: Mapping[str, Sequence[float]], medians: Mapping[str, float]) -> None:
    """Print medians, extremes and ratios beside what is asked for."""
    print(f"{'':32}{'median':>13}{'min':>13}{'max':>13}{'at least':>13}{'aim':>13}")
    for name, value in {**medians, **ratios(medians)}.items():
        extremes = (min(samples[name]), max(samples[name])) if name in samples else ("", "")
        cells = (value, *extremes, *AIMS.get(name, ("", "")))
        print(f"{name:32}" + "".join(f"{cell if cell == '' else _short(cell):>13}" for cell in cells))


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--repeats", type=int, default=9, help="samples of each row of world-steps per second")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    samples = measure_rates(0.5, arguments.repeats) | measure_updates(20 * arguments.repeats)
    medians = summarise(samples)
    print_table(samples, medians)
    packages = {name: metadata.version(name) for name in ("mpe2", "supersuit")}
    about = {
        "machine": {"cpu": cpu_model(), "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2)},
        "versions": versions() | packages,
        "git_commit": git_commit(),
    }
    files.write_json(arguments.out, {name: float(f"{value:.4g}") for name, value in medians.items()} | about)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    main()
