"""Encirclement as a PettingZoo environment: ``parallel_env`` (all pursuers at once), ``env`` and ``raw_env`` (in turn).

Registered as ``marl_encircle/encirclement-v0`` when ``marl_encircle`` is imported.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec, parallel_to_aec_wrapper

from marl_encircle.core.rewards import Reward
from marl_encircle.core.scenario import Scenario
from marl_encircle.core.simulator import Difficulty, Simulator
from marl_encircle.envs.arena import ACTION_SIZE, Arena, spaces_of
from marl_encircle.spelling import nearest

Array = NDArray[np.float32]
Weights = Mapping[str, float | Mapping[str, float] | None]


def parallel_env(
    scenario: Scenario | None = None,
    reward: Reward | Weights | None = None,
    max_cycles: int | None = None,
    render_mode: str | None = None,
    **scenario_fields: Any,
) -> "EncirclementEnv":
    """Return one world in which all pursuers act at once.

    :param scenario: the rules; the paper's by default
    :param reward: the reward, or only the weights of its terms; the paper's by default
    :param max_cycles: steps after which a round is truncated; the scenario's by default
    :param render_mode: None, ``human`` or ``rgb_array``
    :param scenario_fields: fields of the scenario to change, such as ``speed_ratio=1.3``
    :raises TypeError: for what is no scenario or reward, or a field that a scenario does not have, naming the nearest
    :raises ValueError: for a value out of range, an unknown term or render mode
    """
    if scenario is not None and not isinstance(scenario, Scenario):
        raise TypeError(f"scenario must be a Scenario or None; got {scenario!r:.80}")
    known = [f.name for f in fields(Scenario)]
    for name in scenario_fields:
        if name not in known:
            raise TypeError(f"{name:.80}: unknown scenario field{nearest(name, known)}")
    if max_cycles is not None:
        scenario_fields["max_cycles"] = max_cycles
    if isinstance(reward, str):
        raise TypeError(f"reward must be a Reward or weights; a method's: load_config({reward!r:.80}).reward.build()")
    if not isinstance(reward, Reward):
        reward = Reward() if reward is None else Reward(reward)
    return EncirclementEnv(replace(scenario or Scenario(), **scenario_fields), reward, render_mode)


def raw_env(**kwargs: Any) -> AECEnv[str, Array, Array | None]:
    """Return one world in which the pursuers act in turn, without PettingZoo's check of the order of calls.

    :param kwargs: see :func:`parallel_env`
    """
    return parallel_to_aec_wrapper(parallel_env(**kwargs))


def env(**kwargs: Any) -> AECEnv[str, Array, Array | None]:
    """Return one world in which the pursuers act in turn; they move once the last has chosen.

    :param kwargs: see :func:`parallel_env`
    """
    return parallel_to_aec(parallel_env(**kwargs))


class EncirclementEnv(ParallelEnv[str, Array, Array | None]):
    """N pursuers who close in on a faster target in one world.

    All agents end together: terminated when the encirclement is complete under the reward's closure rule, truncated
    after ``scenario.max_cycles`` steps. ``infos[agent]`` holds ``is_success`` at every step, and at the last one
    ``round``, the round's figures. Actions beyond [-1, 1] are clipped.

    :param scenario: the rules
    :param reward: the reward, and the closure rule that ends a round
    :param render_mode: None, ``human`` or ``rgb_array``
    :raises ValueError: for an unknown render mode
    :raises ImportError: if something is to be drawn and pygame-ce is missing
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]  # PettingZoo declares it per instance
        "name": "encirclement_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": True,
        "render_fps": 10,
    }

    def __init__(self, scenario: Scenario, reward: Reward, render_mode: str | None = None) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {', '.join(modes)}; got {render_mode!r:.80}")
        if render_mode is not None:
            _load_renderer()  # so that a missing pygame-ce is told here, not at the first picture
        self.render_mode = render_mode
        self._trail: list[NDArray[np.float64]] = []
        self._window: Any = None
        self.possible_agents = list(scenario.agents)
        self.agents: list[str] = []
        self._arena = Arena(scenario, reward, n_worlds=1)
        # Space objects of each agent's own, so that seeding one agent's samples leaves the others' alone.
        self._spaces = {agent: spaces_of(scenario) for agent in self.possible_agents}
        self.state_space = _state_space(scenario)

    @property
    def scenario(self) -> Scenario:
        """The rules. They stay: other rules need another environment."""
        return self._arena.scenario

    @property
    def reward(self) -> Reward:
        """The reward, and the closure rule that ends a round. It stays: another reward needs another environment."""
        return self._arena.reward

    @property
    def simulator(self) -> Simulator:
        """The simulator of this one world."""
        return self._arena.simulator

    def observation_space(self, agent: str) -> Space[Array]:
        """Return the space of what an agent sees."""
        space: Space[Any] = self._spaces[agent].observation
        return space

    def action_space(self, agent: str) -> Space[Array | None]:
        """Return the space of what an agent may do."""
        space: Space[Any] = self._spaces[agent].action
        return space

    def set_difficulty(self, difficulty: Difficulty) -> None:
        """Change speed ratio, safety distance or obstacle radius from the next round on.

        :raises ValueError: for another field, or a value that the scenario would not take
        """
        self._arena.simulator.set_difficulty(difficulty)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Start a new round.

        :param seed: starts a new stream of random numbers, as in any other engine's world with this seed; None goes on
        :param options: not used
        :return: observations and infos by agent
        :raises ValueError: for a negative seed
        :raises PlacementError: if the bodies cannot be placed
        """
        if seed is not None:
            self._arena.simulator.seed([seed])
        observations = self._arena.reset()
        self.agents = self.possible_agents[:]
        self._trail.clear()
        if self.render_mode is not None:
            self._show()
        return dict(zip(self.agents, observations[0], strict=True)), {
            agent: {"is_success": False} for agent in self.agents
        }

    def step(
        self, actions: Mapping[str, Array | None]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move the world by one step.

        :param actions: of every agent, (2,) each, in [-1, 1]
        :return: observations, rewards, terminations, truncations and infos by agent
        :raises ValueError: for an agent without action, an unknown agent, a wrong shape or a number that is not finite
        :raises RuntimeError: if no round is running
        """
        agents = self.agents
        if not agents:
            raise RuntimeError("no round is running: call reset() first")
        outcome = self._arena.step(self._joint(actions))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        infos: dict[str, dict[str, Any]] = {agent: {"is_success": terminated} for agent in agents}
        if terminated or truncated:
            figures = self._arena.rounds.summary(0)
            for info in infos.values():
                info["round"] = figures
            self.agents = []
        if self.render_mode is not None:
            self._show()
        return (
            dict(zip(agents, outcome.observations[0], strict=True)),
            dict(zip(agents, outcome.rewards[0].tolist(), strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next steps depend on, for an exact resume in the middle of a round."""
        return {**self._arena.get_state(), "running": bool(self.agents)}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on from what :meth:`get_state` returned, bit for bit."""
        self._arena.set_state(saved)
        self.agents = self.possible_agents[:] if saved["running"] else []
        self._trail.clear()

    def state(self) -> Array:
        """Return the world as a whole, in ``state_space``: what a central critic needs and no single pursuer sees.

        Positions of the pursuers, their velocities, the position of the target, then x, y and radius of every disc
        that obstacles consist of; absolute [scene units], (4 N + 2 + 3 D,).
        """
        s = self._arena.simulator.state
        parts = (s.pursuers, s.velocities, s.target, s.discs)
        return np.concatenate([part[0].ravel() for part in parts], dtype=np.float32)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the world.

        :return: the picture (H, W, 3) if the render mode is ``rgb_array``, else None
        :raises RuntimeError: if a window is wanted and there is no display
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: give render_mode='human' or 'rgb_array' to parallel_env")
            return None
        renderer = _load_renderer()
        success = self._arena.rounds.success_steps(0)
        view = renderer.view(self._arena.simulator, self.reward.closure, self._trail, success=success)
        if self.render_mode == "rgb_array":
            picture: NDArray[np.uint8] = renderer.picture(view)
            return picture
        if self._window is None:
            self._window = renderer.Window(self.metadata["name"], self.metadata["render_fps"])
        self._window.show(view)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        """Remember where everybody is, and keep the window, if there is one, up to date."""
        state = self._arena.simulator.state
        self._trail.append(np.concatenate([state.pursuers[0], state.target]))
        if self.render_mode == "human":
            self.render()

    def _joint(self, actions: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the actions of all agents, (1, N, 2), or raise a ValueError that names who is wrong."""
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions must be a dict of agents; got {type(actions).__name__}")
        try:
            joint = np.array([actions[agent] for agent in self.agents], np.float64)
        except (KeyError, TypeError, ValueError):
            joint = None
        if joint is None or joint.shape != (len(self.agents), ACTION_SIZE) or len(actions) != len(joint):
            raise ValueError(self._complaint(actions))
        return joint[None]

    def _complaint(self, actions: Mapping[str, Any]) -> str:
        for agent in self.agents:
            if agent not in actions:
                return f"no action for {agent}; got actions for {', '.join(map(str, actions)) or 'nobody'}"
        for agent in actions:
            if agent not in self.agents:
                return f"action for unknown agent {agent!r:.80}{nearest(str(agent), self.agents)}"
        for agent in self.agents:
            try:
                shape = np.asarray(actions[agent], np.float64).shape
            except (TypeError, ValueError):
                return f"the action of {agent} must be {ACTION_SIZE} numbers; got {actions[agent]!r:.80}"
            if shape != (ACTION_SIZE,):
                return f"the action of {agent} must have shape ({ACTION_SIZE},); got {shape}"
        raise AssertionError("these actions are in order")


def _state_space(scenario: Scenario) -> Box:
    """Return the space of :meth:`EncirclementEnv.state`."""
    # No radius exceeds the half width: bodies cover at most half of the scene.
    width = np.repeat(
        [scenario.half_width, scenario.max_speed, scenario.half_width],
        [2 * scenario.pursuers, 2 * scenario.pursuers, 2 + 3 * scenario.discs],
    )
    # As in the observation's bounds, one part in a million covers the rounding to single precision.
    high = (width * (1 + 1e-6)).astype(np.float32)
    return Box(-high, high)


def _load_renderer() -> Any:
    """Import the drawing, and with it pygame-ce, only once somebody wants to see something."""
    from marl_encircle.drawing import render

    return render
