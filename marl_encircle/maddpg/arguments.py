"""What the numbers that an algorithm is built with may be: a typing error is told before anything is trained."""

import math

import numpy as np
from stable_baselines3.common.type_aliases import Schedule


def check_range(name: str, value: float, least: float, most: float = math.inf) -> None:
    """Refuse a number outside of [least, most].

    :param name: of the argument
    :raises ValueError: with name, value and what is allowed
    """
    if not least <= value <= most:  # so written, nan is refused too
        allowed = f"at least {least}" if most == math.inf else f"between {least} and {most}"
        raise ValueError(f"{name} must be {allowed}, but got {value}")


def number_or_schedule(name: str, value: float | Schedule, most: float = math.inf) -> float | Schedule:
    """Return a number of [0, most] as a Python float; a function of the progress remaining as it is.

    :param name: of the argument
    :raises ValueError: for anything else
    """
    if callable(value):
        return value
    if not isinstance(value, int | float | np.number):
        raise ValueError(f"{name} must be a number or a function of the progress remaining, but got {value!r:.80}")
    check_range(name, float(value), 0, most)
    return float(value)
