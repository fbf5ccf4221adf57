"""Encircling a faster target with multi-agent reinforcement learning."""

import pettingzoo

_ENVIRONMENT = "marl_encircle.envs.encirclement_v0"
pettingzoo.register("parallel", "marl_encircle/encirclement-v0", f"{_ENVIRONMENT}:parallel_env")
pettingzoo.register("aec", "marl_encircle/encirclement-v0", f"{_ENVIRONMENT}:env")
