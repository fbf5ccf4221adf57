"""PettingZoo's own tests, imported without the warning that they cause themselves."""

import warnings

with warnings.catch_warnings():
    # pettingzoo.test makes an environment of its own in the way that PettingZoo 1.27 deprecates.
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import api_test, max_cycles_test, parallel_api_test, parallel_seed_test, render_test
    from pettingzoo.test.state_test import state_test

__all__ = ["api_test", "max_cycles_test", "parallel_api_test", "parallel_seed_test", "render_test", "state_test"]
