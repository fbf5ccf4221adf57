"""How the rounds end that a policy loses: how much of the circle is taken, and where the bodies are.

python examples/lost_rounds.py results/runs/model_c/ratio1.1_n3_m1_random/seed*

Rounds are played again: on another type of processor than the runs' the last digit may differ (docs/reproduce.md).
"""

import csv
import sys

import numpy as np

from marl_encircle.experiments.loading import load_run
from marl_encircle.replays.replay import record_first_rounds

ROUNDS, LAST = 100, 20
COLUMNS = ["run", "lost", "occupied", "closed", "least_r_m", "nearest_pursuer", "obstacle_gap", "wall", "wall_at_start"]

rows = csv.writer(sys.stdout, lineterminator="\n")
rows.writerow(COLUMNS)  # medians: shares of the last steps, scene units
for folder in sys.argv[1:]:
    policy, config, _ = load_run(folder)
    replays = record_first_rounds(policy, config, ROUNDS, config.evaluation.seed)
    lost = [replay for replay in replays if replay.success_step is None]
    measured = []
    for replay in lost:
        enclosure, target, (x, y, radius) = replay.enclosure[replay.closure], replay.target, replay.discs.T
        wall = replay.scenario.half_width - np.abs(target).max(axis=1)
        measured.append([
            enclosure.occupied_angle[-LAST:].mean() / (2 * np.pi),
            np.isfinite(enclosure.movement_range[-LAST:]).mean(),
            enclosure.movement_range.min(),
            np.linalg.norm(replay.pursuers[-1] - target[-1], axis=1).min(),
            (np.hypot(x - target[-1, 0], y - target[-1, 1]) - radius).min(initial=np.inf),
            wall[-1],
            wall[0],
        ])  # fmt: skip
    medians = np.median(measured, axis=0).round(3).tolist() if lost else []
    rows.writerow([folder, f"{len(lost)}/{ROUNDS}", *medians])
