"""MADDPG on somebody else's environment: MPE2's simple_spread, where three agents share out three landmarks.

python examples/own_environment.py            # a few minutes
python examples/own_environment.py 20000      # so many agent steps, to see that it runs
"""

import sys

from mpe2 import simple_spread_v3
from stable_baselines3.common.vec_env import VecMonitor

from marl_encircle import MADDPG, SuperSuitVecEnv

total_timesteps = int(sys.argv[1]) if sys.argv[1:] else 600_000

# Any PettingZoo ParallelEnv will do whose agents have equal Box spaces and end together.
env = SuperSuitVecEnv(lambda: simple_spread_v3.parallel_env(continuous_actions=True), n_worlds=8)

model = MADDPG("MlpPolicy", VecMonitor(env), seed=0, verbose=1)
model.learn(total_timesteps, log_interval=40)

world = simple_spread_v3.parallel_env(continuous_actions=True)
observations, _ = world.reset(seed=1)
total = 0.0
while world.agents:
    actions, _ = model.predict(observations)
    observations, rewards, _, _, _ = world.step(actions)
    total += sum(rewards.values()) / len(rewards)
print(f"return of one round: {total:.1f}")
