"""What the networks read in place of the bare observation."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.config import features_size


class RelativeFeatures(BaseFeaturesExtractor):
    """The observation with every other body also as seen from the target, and the obstacles sorted, the nearest first.

    From the target: the offset r and its direction r / (norm(r) + softening), of the other pursuers in index order,
    then of the obstacles in the order of their distance from the target, in which the observed parts stand too. So the
    order in which obstacles were placed means nothing to the networks.

    :param observation_space: of a pursuer
    :param scenario: whose observations these are
    """

    def __init__(self, observation_space: spaces.Space[object], scenario: Scenario) -> None:
        super().__init__(observation_space, features_size(scenario, "relative"))
        self.parts = layout(scenario)
        self.softening = scenario.direction_softening

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features, shape (B, features).

        :param observations: shape (B, O)
        """
        parts = {name: observations[:, part] for name, part in self.parts.items()}
        others, obstacles = (_pairs(parts[name]) - parts["target"][:, None] for name in ("pursuers", "obstacles"))
        nearest_first = obstacles.norm(dim=2).argsort(dim=1)
        for name in self.parts.keys() & {"obstacles", "obstacle_directions"}:
            parts[name] = _in_order(_pairs(parts[name]), nearest_first).flatten(1)
        seen_from_target = others, _in_order(obstacles, nearest_first)
        seen = [part.flatten(1) for offsets in seen_from_target for part in (offsets, self._direction(offsets))]
        return th.cat([*parts.values(), *seen], dim=1)

    def _direction(self, offsets: th.Tensor) -> th.Tensor:
        distance: th.Tensor = offsets.norm(dim=2, keepdim=True)
        return offsets / (distance + self.softening)


def _pairs(part: th.Tensor) -> th.Tensor:
    """Return vectors that lie side by side, (B, 2 K), below each other, (B, K, 2)."""
    pairs: th.Tensor = part.unflatten(1, (part.shape[1] // 2, 2))  # type: ignore[no-untyped-call]  # torch does not type it
    return pairs


def _in_order(rows: th.Tensor, order: th.Tensor) -> th.Tensor:
    """Return the rows (B, K, 2) of each world in its order, (B, K)."""
    return rows.gather(1, order[..., None].expand_as(rows))
