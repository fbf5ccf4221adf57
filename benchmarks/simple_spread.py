"""Train MADDPG on MPE2's ``simple_spread_v3`` through SuperSuit, and parameter-shared TD3 beside it.

Both learn from the same number of world-steps with the same number of updates on one core, and play the same fresh
rounds afterwards, as do random actions. MADDPG has one actor for all agents, and a critic for each. TD3 is
Stable-Baselines3's: one policy for every agent's slot, each slot an environment of its own. The hyper-parameters were
chosen for either in short trainings with seed 100.

Finished trainings are kept in the result's file: a run that was interrupted goes on with those that are missing.

    python benchmarks/simple_spread.py --minutes 10 --seeds 0 1 2
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # libraries read it when they are imported

import argparse
import json
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from marl_encircle import files
from marl_encircle.envs.supersuit_vec_env import SuperSuitVecEnv
from marl_encircle.experiments.metrics import student_interval
from marl_encircle.experiments.provenance import cpu_model, git_commit, versions
from marl_encircle.maddpg import MADDPG

try:
    from mpe2 import simple_spread_v3
except ImportError as error:
    raise SystemExit("error: the benchmarks need mpe2, which the extra [dev] installs: make setup") from error

RESULTS = Path(__file__).with_name("simple_spread.json")
N_AGENTS = 3
N_ACTIONS = 5
N_WORLDS = 8
MAX_CYCLES = 25
WORLD_STEPS_PER_MINUTE = 30_000
"""What MADDPG learns from in a minute of one core; a fixed number, so that every machine gives the same training."""

FIRST_ROUND = 5_000_000
"""Seed of the first evaluation round; the next ones follow."""

COMMON: dict[str, Any] = {
    "batch_size": 512,
    "gamma": 0.95,
    "tau": 0.01,
    "train_freq": 1,
    "gradient_steps": 2,
    "learning_starts": 3_000 * N_AGENTS,
    "buffer_size": 500_000 * N_AGENTS,
    "policy_kwargs": {"net_arch": [64, 64]},
}
"""Two updates per step of the 8 worlds. Time limits are bootstrapped by either."""

LEARNING_RATE = {"maddpg": 1e-3, "td3": 3e-3}
"""At the start; it falls to zero in a straight line. Each did worse with the other's."""

MADDPG_ONLY: dict[str, Any] = {
    "policy_kwargs": {**COMMON["policy_kwargs"], "share_parameters": True},
    "critic": "per_agent",
    "policy_delay": 1,
    "exploration_noise": 0.4,
    "exploration_random": 0.05,
    "actor_regularization": 1e-3,
}
TD3_ONLY: dict[str, Any] = {"policy_delay": 2, "target_policy_noise": 0.2, "target_noise_clip": 0.5}
TD3_NOISE = 0.2

Returns = NDArray[np.float64]
"""Return of each round, mean over the agents."""

Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""From the observations of one world's agents (N, O) to their actions (N, U)."""


def world() -> Any:
    """Return three agents that are to spread over three landmarks."""
    return simple_spread_v3.parallel_env(N=N_AGENTS, max_cycles=MAX_CYCLES, continuous_actions=True)


def maddpg(seed: int) -> OffPolicyAlgorithm:
    """Return MADDPG over worlds of three agents."""
    return MADDPG("MlpPolicy", **_arguments("maddpg", seed) | MADDPG_ONLY)


def td3(seed: int) -> OffPolicyAlgorithm:
    """Return SB3's TD3 over the same slots, one network for all of them."""
    noise = NormalActionNoise(np.zeros(N_ACTIONS), np.full(N_ACTIONS, TD3_NOISE))
    return TD3("MlpPolicy", **_arguments("td3", seed), action_noise=noise, **TD3_ONLY)


ALGORITHMS: dict[str, Callable[[int], OffPolicyAlgorithm]] = {"maddpg": maddpg, "td3": td3}


def _arguments(algorithm: str, seed: int) -> dict[str, Any]:
    """Return what both have in common, and the learning rate."""
    env = SuperSuitVecEnv(world, N_WORLDS)
    learning_rate = LinearSchedule(LEARNING_RATE[algorithm], 0.0, 1.0)
    return {"env": env, "learning_rate": learning_rate, "seed": seed, "device": "cpu", **COMMON}


def train(algorithm: str, seed: int, world_steps: int, rounds: int) -> dict[str, Any]:
    """Train once and play the evaluation's rounds."""
    start = process_time()
    model = ALGORITHMS[algorithm](seed)
    model.learn(world_steps * N_AGENTS)
    cpu_seconds = process_time() - start
    returns = play_rounds(lambda observations: model.predict(observations, deterministic=True)[0], rounds)
    return {
        "algorithm": algorithm,
        "seed": seed,
        "world_steps": model.num_timesteps // N_AGENTS,
        "updates": model._n_updates,
        "cpu_seconds": round(cpu_seconds, 1),
        "mean_return": round(float(returns.mean()), 3),
        "returns": returns.round(4).tolist(),
    }


def play_rounds(act: Act, rounds: int) -> Returns:
    """Return what each round brought, round r in a world of seed ``FIRST_ROUND + r``."""
    env = world()
    agents = env.possible_agents
    returns = np.zeros(rounds)
    for number in range(rounds):
        observations, _ = env.reset(seed=FIRST_ROUND + number)
        while env.agents:
            actions = act(np.stack([observations[agent] for agent in agents]))
            observations, rewards, *_ = env.step(dict(zip(agents, actions, strict=True)))
            returns[number] += np.mean([rewards[agent] for agent in agents])
    return returns


def play_randomly(rounds: int) -> Returns:
    """Return what uniformly random actions bring in the same rounds."""
    rng = np.random.default_rng(0)
    return play_rounds(lambda observations: rng.random((len(observations), N_ACTIONS), np.float32), rounds)


def difference(first: Sequence[Sequence[float]], second: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Compare two methods round by round: mean difference and its 95 % interval.

    Student's interval over the training seeds, or over the rounds where that one is wider: chance in the rounds moves
    all seeds together, and with one seed there is nothing else.

    :param first: returns, (seeds, rounds)
    :param second: returns in the same rounds, (seeds, rounds) or (1, rounds)
    """
    differences = np.subtract(first, second)
    over_seeds = student_interval(differences.mean(axis=1).tolist())
    over_rounds = student_interval(differences.mean(axis=0).tolist())
    intervals = [interval for interval in (over_seeds, over_rounds) if interval is not None]
    low, high = max(intervals, key=lambda interval: interval.high - interval.low)
    return {"difference": round(float(differences.mean()), 3), "interval": [round(low, 3), round(high, 3)]}


def compare(runs: Sequence[dict[str, Any]], random: Sequence[float]) -> dict[str, Any]:
    """Compare every run with random actions, each algorithm with them, and the two with each other."""
    returns = {name: {r["seed"]: r["returns"] for r in runs if r["algorithm"] == name} for name in ALGORITHMS}
    comparisons: dict[str, Any] = {}
    for name, seeds in returns.items():
        if seeds:
            comparisons[f"{name} - random"] = difference(list(seeds.values()), [random])
        for seed, values in seeds.items():
            comparisons[f"{name} - random, seed {seed}"] = difference([values], [random])
    if common := [seed for seed in returns["maddpg"] if seed in returns["td3"]]:
        ours, theirs = ([returns[name][seed] for seed in common] for name in ("maddpg", "td3"))
        comparisons["maddpg - td3"] = difference(ours, theirs)
    return comparisons


def settings(world_steps: int, rounds: int) -> dict[str, Any]:
    """Return all that the results depend on but the seeds."""
    return {
        "environment": f"mpe2 {metadata.version('mpe2')} simple_spread_v3, N={N_AGENTS}, {MAX_CYCLES} steps a round",
        "n_worlds": N_WORLDS,
        "world_steps": world_steps,
        "rounds": rounds,
        "common": COMMON,
        "maddpg": {"learning_rate": [LEARNING_RATE["maddpg"], 0.0], **MADDPG_ONLY},
        "td3": {"learning_rate": [LEARNING_RATE["td3"], 0.0], **TD3_ONLY, "action_noise": TD3_NOISE},
    }


def finished_runs(path: Path, plan: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the trainings that a file holds; none where there is no file.

    :raises SystemExit: if they were made with other settings
    """
    if not path.exists():
        return []
    saved = json.loads(files.read_bytes(path))
    if saved["settings"] != plan:
        raise SystemExit(f"error: {path} has other settings: remove it, or choose another file by --out")
    runs: list[dict[str, Any]] = saved["runs"]
    return runs


def run(world_steps: int, seeds: Sequence[int], rounds: int, out: Path) -> dict[str, Any]:
    """Train what is missing; write the results after every training."""
    plan = settings(world_steps, rounds)
    runs = finished_runs(out, plan)
    done = {(r["algorithm"], r["seed"]) for r in runs}
    random = play_randomly(rounds).round(4).tolist()
    result: dict[str, Any] = {}
    for algorithm, seed in [(algorithm, seed) for seed in seeds for algorithm in ALGORITHMS]:
        if (algorithm, seed) not in done:
            record = {"versions": versions(), "cpu": cpu_model(), "git_commit": git_commit()}
            runs.append(train(algorithm, seed, world_steps, rounds) | record)
        result = {
            "settings": plan,
            "comparisons": compare(runs, random),
            "random": {"mean_return": round(float(np.mean(random)), 3), "returns": random},
            "runs": runs,
        }
        files.write_json(out, result)
        print(f"{algorithm}, seed {seed}: done", flush=True)
    return result


def print_results(result: dict[str, Any]) -> None:
    """Print the runs and the comparisons."""
    print(f"\n{'':12}{'seed':>5}{'mean return':>13}{'world-steps':>13}{'updates':>9}{'cpu seconds':>13}")
    for r in result["runs"]:
        print(
            f"{r['algorithm']:12}{r['seed']:>5}{r['mean_return']:>13.2f}{r['world_steps']:>13,}{r['updates']:>9,}"
            f"{r['cpu_seconds']:>13.0f}"
        )
    print(f"{'random':12}{'':5}{result['random']['mean_return']:>13.2f}\n")
    for name, comparison in result["comparisons"].items():
        low, high = comparison["interval"]
        print(f"{name:26}{comparison['difference']:>8.2f}   95 % interval {low:.2f} to {high:.2f}")


def main() -> None:
    """Train, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of one core, for a training of MADDPG")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rounds", type=int, default=200, help="evaluation rounds")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    world_steps = round(arguments.minutes * WORLD_STEPS_PER_MINUTE)
    print_results(run(world_steps, arguments.seeds, arguments.rounds, arguments.out))


if __name__ == "__main__":
    main()
