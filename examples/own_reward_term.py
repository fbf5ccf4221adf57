"""A reward term of one's own: pursuers are paid for every bit that they come nearer to the target.

python examples/own_reward_term.py            # a few minutes
python examples/own_reward_term.py 20000      # so many agent steps, to see that it runs
"""

import sys

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from marl_encircle import MADDPG, make_vec_env
from marl_encircle.core.rewards import TERMS, Array, Transition

total_timesteps = int(sys.argv[1]) if sys.argv[1:] else 1_000_000


def approach(t: Transition, *, limit: float = 0.1) -> Array:
    """How much nearer each pursuer came to the target [scene units], (B, N).

    :param limit: highest reward
    """
    return np.minimum(t.former_measure.target_distance - t.measure.target_distance, limit)


TERMS["approach"] = approach

# The paper's method with another contraction; the same two lines may stand in a YAML file.
own = ["reward.terms.contraction=null", "reward.terms.approach={weight: 20.0, limit: 0.05}"]
env = make_vec_env("ours", pursuers=3, obstacles=1, overrides=own)

model = MADDPG("MlpPolicy", env, seed=0, verbose=1)
model.learn(total_timesteps, log_interval=40)

# Final worlds from the start, one round of each.
eval_env = make_vec_env("ours", n_worlds=200, pursuers=3, obstacles=1, overrides=own, curriculum=False, seed=1)
mean, _ = evaluate_policy(model, eval_env, n_eval_episodes=eval_env.num_envs)
print(f"mean return of {eval_env.num_envs // 3} rounds: {mean:.2f}")
