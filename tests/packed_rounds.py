"""A plainer reader of the report's packed rounds: the numbers one after the other, then their meaning."""

import base64
import itertools
from typing import Any

import numpy as np


def whole_numbers(text: str) -> list[int]:
    """Undo base 128 and zigzag."""
    numbers, digits = [], []
    for byte in base64.b64decode(text, validate=True):
        digits.append(byte & 127)
        if byte < 128:
            value = sum(digit * 128**place for place, digit in enumerate(digits))
            numbers.append(value // 2 if value % 2 == 0 else -(value // 2) - 1)
            digits = []
    assert not digits, "cut off"
    return numbers


def unpacked(round_: dict[str, Any], world: dict[str, Any], units: dict[str, float]) -> dict[str, Any]:
    """A round of the player's data as arrays: the names of ``Replay``, T + 1 moments each."""
    numbers = whole_numbers(round_["data"])
    t, n = round_["moments"], world["pursuers"]

    def take(count: int) -> list[int]:
        taken = numbers[:count]
        assert len(taken) == count
        del numbers[:count]
        return taken

    def series(bodies: int) -> np.ndarray:
        return np.array([list(itertools.accumulate(take(t))) for _ in range(2 * bodies)]).T.reshape(t, bodies, 2)

    discs = np.array(take(3 * world["discs"])).reshape(-1, 3) * units["position"]
    bodies, velocities = series(n + 1) * units["position"], series(n) * units["velocity"]
    states, areas, angles, owners, reaches = [], [], [], [], []
    for _ in range(t):
        states += take(1)
        areas += take(1)
        angles.append(take(world["entities"]))
        [stretches] = take(1)
        pairs = [take(2) for _ in range(stretches)]
        owner = np.array([entity - 1 for length, entity in pairs for _ in range(length)])
        reach = np.full(len(owner), np.inf)
        reach[owner >= 0] = np.array(list(itertools.accumulate(take(int((owner >= 0).sum()))))) * units["reach"]
        owners.append(owner)
        reaches.append(reach)
    assert not numbers, "left over"
    return {
        "discs": discs,
        "pursuers": bodies[:, :n],
        "target": bodies[:, n],
        "velocities": velocities,
        "state": np.array(states),
        "area": np.array(areas) * units["area"],
        "angles": np.array(angles) * units["angle"],
        "owner": np.array(owners),
        "reach": np.array(reaches),
    }
