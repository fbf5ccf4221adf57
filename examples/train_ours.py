"""Train the paper's method with three pursuers, evaluate it while it learns, then play a round with it.

python examples/train_ours.py            # a few minutes
python examples/train_ours.py 20000      # so many agent steps, to see that it runs
"""

import sys

from stable_baselines3.common.callbacks import EvalCallback

from marl_encircle import MADDPG, make_vec_env, parallel_env

total_timesteps = int(sys.argv[1]) if sys.argv[1:] else 1_000_000

env = make_vec_env("ours", pursuers=3, obstacles=1)
# Training worlds start easy: judge on final ones. As many episodes as slots: one of each world, the long ones too.
eval_env = make_vec_env("ours", n_worlds=50, pursuers=3, obstacles=1, curriculum=False, seed=1)
callback = EvalCallback(eval_env, n_eval_episodes=eval_env.num_envs, eval_freq=1000)

model = MADDPG("MlpPolicy", env, seed=0)
model.learn(total_timesteps, callback=callback, progress_bar=True)
model.save("ours")

world = parallel_env(pursuers=3, obstacles=1)
observations, _ = world.reset(seed=2)
while world.agents:
    actions, _ = model.predict(observations)
    observations, rewards, terminations, truncations, infos = world.step(actions)
length = infos["pursuer_0"]["round"]["length"]
print(f"{'enclosed' if terminations['pursuer_0'] else 'not enclosed'} after {length:.0f} steps")
