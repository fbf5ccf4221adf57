"""Another algorithm: MATD3 in the place of MADDPG, everything else as it was.

python examples/swap_in_matd3.py            # a few minutes
python examples/swap_in_matd3.py 20000      # so many agent steps each, to see that it runs
"""

import sys

from stable_baselines3.common.evaluation import evaluate_policy

from marl_encircle import MADDPG, MATD3, make_vec_env

total_timesteps = int(sys.argv[1]) if sys.argv[1:] else 1_000_000

for algorithm in (MADDPG, MATD3):
    model = algorithm("MlpPolicy", make_vec_env("ours", pursuers=3, obstacles=1), seed=0)
    model.learn(total_timesteps)
    # Final worlds from the start, one round of each, the same for both.
    eval_env = make_vec_env("ours", n_worlds=200, pursuers=3, obstacles=1, curriculum=False, seed=1)
    mean, _ = evaluate_policy(model, eval_env, n_eval_episodes=eval_env.num_envs)
    print(f"{algorithm.__name__}: mean return {mean:.2f}")
