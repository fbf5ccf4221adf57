"""Checks of a ParallelEnv that PettingZoo's own tests leave out."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SEEDS = (0, 1, 12345)
EPISODES = 3


def random_actions(env: Any, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}


def check_worlds(env: Any, episodes: int = EPISODES) -> None:
    """Check names, spaces, dtypes, finite numbers and plain types at every step, and that episodes end in time."""
    rng = np.random.default_rng(0)
    for _ in range(episodes):
        observations, infos = env.reset()
        assert env.agents == env.possible_agents
        check_observations(env, observations)
        assert list(infos) == env.possible_agents
        limit = env.unwrapped.scenario.max_cycles
        steps, over = 0, False
        while not over:
            steps += 1
            assert steps <= limit
            kept = {agent: observation.copy() for agent, observation in observations.items()}
            following, *outcome = env.step(random_actions(env, rng))
            for agent, observation in observations.items():
                assert np.array_equal(observation, kept[agent]), f"an old observation of {agent} was written over"
            observations = following
            check_observations(env, observations)
            rewards, terminations, truncations, infos = outcome
            for told in outcome:
                assert list(told) == env.possible_agents
            for reward in rewards.values():
                assert type(reward) is float
                assert np.isfinite(reward)
            for flag in (*terminations.values(), *truncations.values()):
                assert type(flag) is bool
            ends = set(zip(terminations.values(), truncations.values(), strict=True))
            assert len(ends) == 1
            terminated, truncated = ends.pop()
            assert not (terminated and truncated)
            assert all(info.get("is_success") is terminated for info in infos.values())
            over = terminated or truncated
            assert all(("round" in info) is over for info in infos.values())
            assert env.agents == ([] if over else env.possible_agents)
        assert terminated or steps == limit


def check_observations(env: Any, observations: dict[str, np.ndarray]) -> None:
    assert list(observations) == env.possible_agents
    state = env.state()
    assert env.unwrapped.state_space.contains(state)
    for agent, observation in observations.items():
        space = env.observation_space(agent)
        assert isinstance(observation, np.ndarray)
        assert observation.dtype == space.dtype == np.float32
        assert np.isfinite(observation).all()
        assert space.contains(observation)


def fingerprint(make: Callable[[], Any]) -> str:
    """A hash of everything that an environment tells in several episodes from each of several seeds."""
    digest = hashlib.sha256()
    env = make()
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        observations, infos = env.reset(seed=seed)
        for episode in range(EPISODES):
            if episode:
                observations, infos = env.reset()
            told: Sequence[Any] = (infos,)
            while True:
                for array in (*observations.values(), env.state()):
                    digest.update(array.tobytes())
                digest.update(json.dumps(told, sort_keys=True).encode())
                if not env.agents:
                    break
                observations, *told = env.step(random_actions(env, rng))
    return digest.hexdigest()


def fingerprints(worlds: dict[str, Callable[[], Any]]) -> dict[str, str]:
    return {name: fingerprint(make) for name, make in worlds.items()}


def fingerprints_elsewhere(module: str, registry: str) -> dict[str, str]:
    """``fingerprints(module.registry)``, taken in another process with another hash seed."""
    program = f"import json, {module}, world_checks; print(json.dumps(world_checks.fingerprints({module}.{registry})))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    result: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return result
