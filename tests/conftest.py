"""One thread, as in the Makefile. Hypothesis: ``quick``, or HYPOTHESIS_PROFILE=thorough for 1,000 examples of a law.

With NUMBA_DISABLE_JIT=1 the kernels are plain Python, for coverage and for mutants. Tests that need machine code, by
kind or by the number of steps, are deselected then, and arithmetic on scalars warns as little as machine code.
"""

import os
import signal
import sys
from collections.abc import Iterator

os.environ["OMP_NUM_THREADS"] = "1"  # libraries read it when they are imported

import numba
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell leaves it in what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("quick", max_examples=25, deadline=None, derandomize=True, database=None)
unhurried = [HealthCheck.too_slow, HealthCheck.filter_too_much]
settings.register_profile(
    "thorough", max_examples=1000, deadline=None, suppress_health_check=unhurried, print_blob=True
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))

if numba.config.DISABLE_JIT:
    np.seterr(divide="ignore", invalid="ignore", over="ignore")


@pytest.fixture(autouse=True)
def _configurations_of_its_own() -> Iterator[None]:
    """Forget the configurations of a test's jobs: it may have made them tiny."""
    yield
    grid = sys.modules.get("marl_encircle.experiments.grid")
    if grid is not None:
        grid.forget_configs()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if numba.config.DISABLE_JIT:
        config.hook.pytest_deselected(items=[item for item in items if item.get_closest_marker("compiled")])
        items[:] = [item for item in items if not item.get_closest_marker("compiled")]
