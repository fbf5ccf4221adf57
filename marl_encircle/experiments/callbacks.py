"""What happens beside a training: logs, the learning curve, checkpoints."""

import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from marl_encircle import files
from marl_encircle.envs.curriculum import CurriculumVecEnv
from marl_encircle.experiments.config import Config
from marl_encircle.experiments.evaluate import play_rounds
from marl_encircle.experiments.learning_curve import COLUMNS, curve_to_csv
from marl_encircle.experiments.metrics import summarise_run
from marl_encircle.experiments.signals import Stopped
from marl_encircle.maddpg import MADDPG
from marl_encircle.maddpg.policies import MADDPGPolicy

CHECKPOINT_SHARE = 0.02
SECONDS_BETWEEN_CHECKPOINTS = 60.0


def ended_rounds(callback: BaseCallback, curriculum: CurriculumVecEnv) -> list[dict[str, Any]]:
    """Return the info of one slot of each world whose round ended in this step."""
    n = curriculum.n_agents
    return [callback.locals["infos"][world * n] for world in np.flatnonzero(callback.locals["dones"][::n])]


class RoundLogger(BaseCallback):
    """Log the means of the figures of the rounds that ended since the last dump.

    ``rounds/length`` is over all of them, ``rounds/mean_episode_length`` (MEL) over those that succeeded.
    """

    model: MADDPG

    def __init__(self, curriculum: CurriculumVecEnv) -> None:
        super().__init__()
        self.curriculum = curriculum
        self._started = self._update_started = time.perf_counter()
        self._world_steps = self._updates = 0

    def _on_training_start(self) -> None:
        self._started, self._world_steps = time.perf_counter(), self.curriculum.world_steps
        self._updates = self.model._n_updates

    def _on_rollout_start(self) -> None:
        updates = self.model._n_updates - self._updates
        if updates:
            elapsed = time.perf_counter() - self._update_started
            self.logger.record_mean("time/update_ms", 1000 * elapsed / updates)

    def _on_rollout_end(self) -> None:
        self._update_started, self._updates = time.perf_counter(), self.model._n_updates

    def _on_step(self) -> bool:
        for info in ended_rounds(self, self.curriculum):
            for name, value in info["round"].items():
                self.logger.record_mean(name if "/" in name else f"rounds/{name}", value)
            if info["is_success"]:
                self.logger.record_mean("rounds/mean_episode_length", info["round"]["length"])
        for name, value in self.curriculum.difficulty.items():
            self.logger.record(f"curriculum/{name}", value)
        elapsed = time.perf_counter() - self._started
        self.logger.record("time/world_steps", self.curriculum.world_steps)
        self.logger.record(
            "time/world_steps_per_second", (self.curriculum.world_steps - self._world_steps) / max(elapsed, 1e-9)
        )
        return True


class LearningCurve(BaseCallback):
    """Play the selection rounds now and then and keep ``progress.csv``.

    :param config: of the run
    :param path: of the file
    :param rows: of an earlier part of the training
    :param add_pictures: called at every point with the policy, the point's number and the agents' steps
    """

    model: MADDPG

    def __init__(
        self,
        config: Config,
        curriculum: CurriculumVecEnv,
        path: Path,
        rows: list[list[float | None]],
        add_pictures: Callable[[MADDPGPolicy, int, int], None] | None = None,
    ) -> None:
        super().__init__()
        self.config, self.curriculum, self.path, self.rows = config, curriculum, path, rows
        self.add_pictures = add_pictures

    def _on_rollout_start(self) -> None:
        due = (len(self.rows) + 1) * self.config.training.curve_every
        if self.curriculum.world_steps >= due:
            self.add_point()

    def _on_step(self) -> bool:
        return True

    def add_point(self) -> None:
        """Evaluate the present policy and write the curve so far."""
        evaluation, settings = self.config.evaluation, self.config.settings
        n_rounds, seed = -(-evaluation.curve_episodes // len(settings)), evaluation.curve_seed
        policy = self.model.policy
        played = {each: play_rounds(policy, self.config, n_rounds, seed, each) for each in set(settings)}
        every = chain.from_iterable(played[each] for each in settings)  # those with more worlds count for more
        episodes = [episode._replace(round=i) for i, episode in enumerate(every)]
        own = summarise_run(episodes, self.config.reward.closure)
        rates = [summarise_run(episodes, rule).success for rule in ("all", "pursuers")]
        row = [self.curriculum.world_steps, own.success, own.mean_episode_length, *rates, own.sigma_c]
        self.rows.append(row)
        point = Logger(None, self.logger.output_formats)  # written at once: the training's own log comes later
        for name, value in zip(COLUMNS[1:], row[1:], strict=True):
            if value is not None:
                point.record(f"eval/{name}", value)
        point.dump(self.model.num_timesteps)
        self.write()
        if self.add_pictures:
            self.add_pictures(self.model.policy, len(self.rows), self.model.num_timesteps)

    def write(self) -> None:
        """Write the curve so far, even if it has no points yet."""
        files.write_text(self.path, curve_to_csv(self.rows))


class Checkpointer(BaseCallback):
    """Save everything from time to time and when a signal asks to stop; between two steps, where nothing is under way.

    :param save: writes the checkpoint
    :param every: seconds between checkpoints; None: a minute or more, so that all of them together, the next included,
        take at most ``CHECKPOINT_SHARE`` of the training's time
    :param caught: signals so far, see :func:`~marl_encircle.experiments.signals.stop_signals`
    :param clock: seconds since whenever
    """

    def __init__(
        self,
        save: Callable[[], None],
        every: float | None,
        caught: list[int],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self.save, self.every, self.caught, self.clock = save, every, caught, clock
        self._started = self._last = clock()
        self._latest_cost = self._costs = 0.0

    def _on_rollout_start(self) -> None:
        begun = self.clock()
        if self.caught or self._is_due(begun):
            self.save()
            self._last = self.clock()
            self._latest_cost = self._last - begun
            self._costs += self._latest_cost
        if self.caught:
            raise Stopped(self.caught[0])

    def _is_due(self, now: float) -> bool:
        if self.every is not None:
            return now - self._last >= self.every
        allowed = CHECKPOINT_SHARE * (now - self._started)
        return now - self._last >= SECONDS_BETWEEN_CHECKPOINTS and self._costs + self._latest_cost <= allowed

    def _on_step(self) -> bool:
        return True
