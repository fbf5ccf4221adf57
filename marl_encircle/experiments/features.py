"""What the networks read in place of the bare observation."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch.nn import functional

from marl_encircle.core.observations import layout
from marl_encircle.core.scenario import Scenario
from marl_encircle.experiments.sizes import BODY_SIZE, NEAREST, features_size


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
        directions = [_direction(offsets, self.softening) for offsets in seen_from_target]
        seen = [part.flatten(1) for both in zip(seen_from_target, directions, strict=True) for part in both]
        return th.cat([*parts.values(), *seen], dim=1)


RATIO_SCALE = 10.0
"""A target is a few tenths faster than its pursuers: what it is faster, times this, is as large as other inputs."""


class SetFeatures(BaseFeaturesExtractor):
    """The other pursuers and the obstacles as sets: weights for any number of them, in whichever order.

    Of each kind those that are nearest to the target, the nearest first, as many as ``NEAREST`` says, and zeros where
    there are fewer; each by its offset r and its direction r / (norm(r) + softening), as seen from the pursuer and from
    the target. Before them what the observation says of the pursuer, the target and the extras. A body whose offset is
    zero is not there, as ``MixedVecEnv`` has it.

    :param observation_space: of a pursuer
    :param scenario: whose observations these are
    """

    def __init__(self, observation_space: spaces.Space[object], scenario: Scenario) -> None:
        super().__init__(observation_space, features_size(scenario, "set"))
        self.parts = layout(scenario)
        self.softening = scenario.direction_softening

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return the features, shape (B, features).

        :param observations: shape (B, O)
        """
        parts = {name: observations[:, part] for name, part in self.parts.items()}
        if "speed_ratio" in parts:
            parts["speed_ratio"] = RATIO_SCALE * (parts["speed_ratio"] - 1)
        own = [part for name, part in parts.items() if not name.startswith(("pursuer", "obstacle"))]
        sets = [self._nearest(_pairs(parts[kind]), parts["target"][:, None], most) for kind, most in NEAREST.items()]
        return th.cat([*own, *sets], dim=1)

    def _nearest(self, offsets: th.Tensor, target: th.Tensor, most: int) -> th.Tensor:
        """Return what is seen of the nearest bodies of a kind, shape (B, most * BODY_SIZE).

        :param offsets: from the pursuer, shape (B, K, 2)
        :param target: its offset from the pursuer, shape (B, 1, 2)
        """
        there = (offsets != 0).any(dim=2)
        both = offsets, offsets - target
        seen = th.cat([*both, *(_direction(each, self.softening) for each in both)], dim=2) * there[..., None]
        distance = both[1].norm(dim=2).masked_fill(~there, th.inf)
        nearest = _in_order(seen, distance.argsort(dim=1)[:, :most]).flatten(1)
        return functional.pad(nearest, (0, most * BODY_SIZE - nearest.shape[1]))


def _direction(offsets: th.Tensor, softening: float) -> th.Tensor:
    """Return r / (norm(r) + softening) of each offset r, (B, K, 2)."""
    distance: th.Tensor = offsets.norm(dim=2, keepdim=True)
    return offsets / (distance + softening)


def _pairs(part: th.Tensor) -> th.Tensor:
    """Return vectors that lie side by side, (B, 2 K), below each other, (B, K, 2)."""
    pairs: th.Tensor = part.unflatten(1, (part.shape[1] // 2, 2))  # type: ignore[no-untyped-call]  # torch does not type it
    return pairs


def _in_order(rows: th.Tensor, order: th.Tensor) -> th.Tensor:
    """Return the rows (B, K, 2) of each world in its order, (B, K)."""
    return rows.gather(1, order[..., None].expand(-1, -1, rows.shape[2]))
