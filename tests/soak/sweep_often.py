"""The ``marl-encircle`` command, whose sweeps write checkpoints every second and live with a clock that jumps."""

import itertools
import time

from marl_encircle.cli import main
from marl_encircle.experiments import executors

arguments, now, jumps = executors.arguments, time.time, itertools.cycle([0.0, 4e8, -3e8, -86_400.0])
executors.arguments = lambda job: [*arguments(job), "--checkpoint-every", "1"]
time.time = lambda: now() + next(jumps)
main()
