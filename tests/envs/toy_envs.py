"""Toy worlds whose numbers say where they come from, so that mixed-up worlds, agents or steps show."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

Dicts = tuple[dict[str, NDArray[np.float32]], dict[str, dict[str, Any]]]
Step = tuple[
    dict[str, NDArray[np.float32]], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]


class TallyEnv(ParallelEnv[str, NDArray[np.float32], NDArray[np.float32]]):
    """Observation (draw of the episode, agent, step), reward 100 * agent + step, an end for all after ``length`` steps.

    The draw comes from the world's stream; ``resets`` keeps the arguments of every reset, infos hold the action taken.
    The last step is won (``is_success``), and the infos of a reset say that nothing is won yet.
    """

    metadata: dict[str, Any] = {"name": "tally_v0", "render_modes": ["rgb_array"], "render_fps": 7}  # noqa: RUF012

    def __init__(
        self, n_agents: int = 3, length: int = 4, ending: str = "truncation", render_mode: str | None = None
    ) -> None:
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents = self.possible_agents[:]
        self.length = length
        self.ending = ending
        self.render_mode = render_mode
        self.np_random = np.random.default_rng()
        self.resets: list[tuple[int | None, dict[str, Any] | None]] = []
        self.calls = 0
        self.draw = 0.0
        self.step_count = 0

    def observation_space(self, agent: str) -> Box:
        return Box(-np.inf, np.inf, (3,), np.float32)

    def action_space(self, agent: str) -> Box:
        return Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Dicts:
        if seed is not None:
            self.np_random = np.random.default_rng(seed)
        self.resets.append((seed, options))
        self.agents = self.possible_agents[:]
        self.draw = self.np_random.random()
        self.step_count = 0
        return self.observe(), {agent: {"is_success": False, "start": self.draw} for agent in self.agents}

    def observe(self) -> dict[str, NDArray[np.float32]]:
        return {
            agent: np.array([self.draw, i, self.step_count], np.float32) for i, agent in enumerate(self.possible_agents)
        }

    def ends(self, agent: str) -> bool:
        return self.step_count >= self.length

    def step(self, actions: dict[str, NDArray[np.float32]]) -> Step:
        self.step_count += 1
        rewards = {agent: 100.0 * i + self.step_count for i, agent in enumerate(self.possible_agents)}
        ended = {agent: self.ends(agent) for agent in self.possible_agents}
        terminations = {agent: end and self.ending in ("termination", "both") for agent, end in ended.items()}
        truncations = {agent: end and self.ending in ("truncation", "both") for agent, end in ended.items()}
        infos = {agent: {"is_success": ended[agent], "action": actions[agent]} for agent in self.possible_agents}
        return self.observe(), rewards, terminations, truncations, infos

    def count_call(self, by: int) -> float:
        self.calls += by
        return self.draw

    def render(self) -> NDArray[np.uint8]:
        """Picture of 2 x 2 pixels, all as bright as the draw of the episode."""
        return np.full((2, 2, 3), round(255 * self.draw), np.uint8)


class StaggeredEnv(TallyEnv):
    """Agent 0 ends one step before the others."""

    def ends(self, agent: str) -> bool:
        return self.step_count >= self.length - (agent == "agent_0")


class VanishingEnv(TallyEnv):
    """Agent 1 is gone after the first step."""

    def observe(self) -> dict[str, NDArray[np.float32]]:
        observations = super().observe()
        if self.step_count > 0:
            del observations["agent_1"]
        return observations


class SpoiltEnv(TallyEnv):
    """From step ``since`` on agent 1 is told something else as its ``what``; nothing where that is None."""

    def __init__(self, what: str, told: Any, since: int = 2) -> None:
        super().__init__()
        self.what, self.told, self.since = what, told, since

    def spoil(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        if what == self.what and self.step_count >= self.since:
            values["agent_1"] = self.told
            if self.told is None:
                del values["agent_1"]
        return values

    def observe(self) -> dict[str, Any]:
        return self.spoil("observation", super().observe())

    def step(self, actions: dict[str, NDArray[np.float32]]) -> Step:
        observations, rewards, terminations, truncations, infos = super().step(actions)
        rewards, terminations = self.spoil("reward", rewards), self.spoil("termination", terminations)
        return observations, rewards, terminations, self.spoil("truncation", truncations), infos


class RecyclingEnv(TallyEnv):
    """Writes every observation into the same arrays and every info into the same dicts, as fast simulators do."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.buffers = super().observe()
        self.info_buffers: dict[str, dict[str, Any]] = {agent: {} for agent in self.possible_agents}

    def observe(self) -> dict[str, NDArray[np.float32]]:
        for agent, observation in super().observe().items():
            self.buffers[agent][:] = observation
        return self.buffers

    def step(self, actions: dict[str, NDArray[np.float32]]) -> Step:
        observations, rewards, terminations, truncations, infos = super().step(actions)
        return observations, rewards, terminations, truncations, self.recycle(infos)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Dicts:
        observations, infos = super().reset(seed=seed, options=options)
        return observations, self.recycle(infos)

    def recycle(self, infos: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for agent, info in infos.items():
            self.info_buffers[agent].update(info)
        return self.info_buffers


class UnequalEnv(TallyEnv):
    """Agent 2 sees one number more (``odd="observation"``) or has one action more (``odd="action"``)."""

    def __init__(self, odd: str) -> None:
        super().__init__()
        self.odd = odd

    def observation_space(self, agent: str) -> Box:
        size = 4 if self.odd == "observation" and agent == "agent_2" else 3
        return Box(-np.inf, np.inf, (size,), np.float32)

    def action_space(self, agent: str) -> Box:
        size = 3 if self.odd == "action" and agent == "agent_2" else 2
        return Box(-1.0, 1.0, (size,), np.float32)
