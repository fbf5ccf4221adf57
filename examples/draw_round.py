"""Play one round with a trained policy and draw its last step.

python examples/draw_round.py results/runs/ours/ratio1.1_n3_m1_random/seed900 round.png --seed 7
"""

import argparse
from pathlib import Path

import matplotlib.image

from marl_encircle import parallel_env
from marl_encircle.experiments.build import load_run


def main() -> None:
    """Draw the state in which the target is enclosed, or the last one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("picture", type=Path, help="PNG file to write")
    parser.add_argument("--seed", type=int, default=0, help="seed of the round")
    arguments = parser.parse_args()

    policy, config, _ = load_run(arguments.run)
    env = parallel_env(config.scenario, config.reward.build(), render_mode="rgb_array")
    observations, _ = env.reset(seed=arguments.seed)
    while env.agents:
        actions, _ = policy.predict(observations)
        observations, _, _, _, _ = env.step(actions)
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    matplotlib.image.imsave(arguments.picture, env.render())


if __name__ == "__main__":
    main()
