"""A scene of one's own: every obstacle is a cross of nine discs.

python examples/own_scene.py            # a few minutes
python examples/own_scene.py 20000      # so many agent steps, to see that it runs
"""

import sys

import matplotlib.image
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

from marl_encircle import MADDPG, make_vec_env, parallel_env
from marl_encircle.core.scenes import SCENES, Array

total_timesteps = int(sys.argv[1]) if sys.argv[1:] else 1_000_000


def cross() -> Array:
    """Two bars of five discs that share the one in the middle: x, y, radius [obstacle radii], (9, 3)."""
    bar = np.array([-1.4, -0.7, 0.0, 0.7, 1.4])
    across = np.column_stack([bar, np.zeros(5), np.full(5, 0.4)])
    return np.vstack([across, np.delete(across, 2, axis=0)[:, [1, 0, 2]]])


SCENES["cross"] = cross

world = parallel_env(scene="cross", pursuers=3, obstacles=2, render_mode="rgb_array")
world.reset(seed=0)
matplotlib.image.imsave("cross.png", world.render())

env = make_vec_env("ours", scene="cross", pursuers=3, obstacles=2)
model = MADDPG("MlpPolicy", env, seed=0, verbose=1)
model.learn(total_timesteps, log_interval=40)

# Final worlds from the start, one round of each.
eval_env = make_vec_env("ours", n_worlds=200, scene="cross", pursuers=3, obstacles=2, curriculum=False, seed=1)
mean, _ = evaluate_policy(model, eval_env, n_eval_episodes=eval_env.num_envs)
print(f"mean return of {eval_env.num_envs // 3} rounds: {mean:.2f}")
