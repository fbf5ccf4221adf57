"""MADDPG and MATD3 for Stable-Baselines3."""

from marl_encircle.maddpg.buffers import JointReplayBuffer
from marl_encircle.maddpg.maddpg import MADDPG
from marl_encircle.maddpg.matd3 import MATD3
from marl_encircle.maddpg.policies import CnnPolicy, MADDPGPolicy, MlpPolicy
from marl_encircle.maddpg.saving import UntrustedFileWarning

__all__ = [
    "ALGORITHMS",
    "MADDPG",
    "MATD3",
    "CnnPolicy",
    "JointReplayBuffer",
    "MADDPGPolicy",
    "MlpPolicy",
    "UntrustedFileWarning",
]

ALGORITHMS: dict[str, type[MADDPG]] = {"maddpg": MADDPG, "matd3": MATD3}
"""Algorithms by the ``name`` in their configuration."""
