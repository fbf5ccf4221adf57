"""The world in the shapes the ecosystem expects: PettingZoo environments and Stable-Baselines3 VecEnvs."""
