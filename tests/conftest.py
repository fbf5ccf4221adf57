"""One thread, as in the Makefile. Hypothesis: ``quick``, or HYPOTHESIS_PROFILE=thorough for 1,000 examples of a law."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # libraries read it when they are imported

from hypothesis import HealthCheck, settings

settings.register_profile("quick", max_examples=25, deadline=None, derandomize=True, database=None)
unhurried = [HealthCheck.too_slow, HealthCheck.filter_too_much]
settings.register_profile(
    "thorough", max_examples=1000, deadline=None, suppress_health_check=unhurried, print_blob=True
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))
