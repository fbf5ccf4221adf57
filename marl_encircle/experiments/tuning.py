"""A search for hyper-parameters with Optuna: trials that are given up early where others were better.

A trial is one training per tuning seed, in ``OUT/trials/<number>/``. Its points are the mean success of its seeds at
each point of their learning curves, and it is worth the mean of the last ones: selection rounds, never reported ones.
All that is known of the trials is in ``OUT/study.db``, for Optuna's own tools too. Whatever stops a search, the next
one goes on with the trials that were under way.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from subprocess import Popen
from typing import TYPE_CHECKING, Any

from marl_encircle import files, locks
from marl_encircle.experiments import checkpoint, sweep
from marl_encircle.experiments.config import difference
from marl_encircle.experiments.executors import LocalExecutor
from marl_encircle.experiments.grid import Job
from marl_encircle.experiments.learning_curve import count_points, read_curve
from marl_encircle.experiments.records import CURVE
from marl_encircle.experiments.search_space import Choices, Space
from marl_encircle.experiments.signals import Stopped, stop_signals
from marl_encircle.experiments.train import OtherRunError, ended_run, run_folder
from marl_encircle.experiments.trainable import check_trainings
from marl_encircle.experiments.trials import Outcome, Row, write_outcome
from marl_encircle.experiments.yaml_files import ConfigError

if TYPE_CHECKING:
    import optuna

STUDY = "study.db"


def tune(
    space: Space, out: str | Path, n_trials: int, n_workers: int, report: Callable[[Row], None] = lambda _: None
) -> Outcome:
    """Try values until there are ``n_trials`` trials, earlier calls' and pruned ones included.

    The first trial has the values of the files that are searched from, as far as they are among those tried.

    :param out: folder of the search; gets what :func:`~marl_encircle.experiments.trials.write_outcome` writes, anew
        after each trial
    :param n_workers: trainings at a time
    :param report: called whenever a trial starts, goes on after a stop, or ends
    :raises ConfigError: without Optuna; or if so many trainings at a time do not fit into this machine's memory
    :raises DamagedFileError: if what is there is no record of a search
    :raises OtherRunError: if ``out`` holds another search, with the difference
    :raises FolderLockedError: if another search works in ``out``
    :raises Stopped: after SIGINT or SIGTERM, when all workers have written their checkpoints
    """
    try:
        import optuna
        import sqlalchemy as sql
    except ImportError as error:
        raise ConfigError("a search needs Optuna: pip install 'marl-encircle[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    check_trainings([space.largest] * n_workers, n_workers)
    path = Path(out) / STUDY
    with locks.folder_lock(out):
        if path.is_symlink():  # SQLite would write where it leads to
            raise files.DamagedFileError(path, "a link, not the record of a search")
        try:
            storage = optuna.storages.RDBStorage(f"sqlite:///{path}")
        except sql.exc.DatabaseError as error:
            raise files.DamagedFileError(path, f"not the record of a search: {str(error.orig)[:200]}") from error
        try:
            study = _open_study(storage, space, Path(out))
            return _Search(space, Path(out), study, n_trials, n_workers, report).play()
        finally:
            storage.engine.dispose()


def _open_study(storage: "optuna.storages.RDBStorage", space: Space, out: Path) -> "optuna.Study":
    """Return the study of a folder; a new one starts with the values that are searched from."""
    import optuna

    study = optuna.create_study(
        storage=storage, study_name="tuning", direction="maximize", pruner=_pruner(space), load_if_exists=True
    )
    plan = space.to_dict()
    lines = difference(plan, study.user_attrs.get("plan", plan))
    if lines:
        listing = "\n  ".join(lines)
        raise OtherRunError(f"{out} already holds another search; choose another folder:\n  {listing}")
    if "plan" not in study.user_attrs:
        study.enqueue_trial({key: _as_param(space, key, value) for key, value in space.base.items()})
        study.set_user_attr("plan", plan)
    return study


def _pruner(space: Space) -> "optuna.pruners.BasePruner":
    from optuna.pruners import MedianPruner, NopPruner, SuccessiveHalvingPruner

    p = space.file.pruning
    if p is None:
        return NopPruner()
    if p.rule == "median":
        return MedianPruner(n_startup_trials=p.startup_trials, n_warmup_steps=p.warmup_points)
    return SuccessiveHalvingPruner(min_resource=p.warmup_points, reduction_factor=p.reduction)


def _distributions(space: Space) -> "dict[str, optuna.distributions.BaseDistribution]":
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    found: dict[str, optuna.distributions.BaseDistribution] = {}
    for key, dimension in space.dimensions.items():
        if isinstance(dimension, Choices):
            found[key] = CategoricalDistribution([_as_param(space, key, choice) for choice in dimension.choices])
        elif dimension.is_whole:
            step = int(dimension.step or 1)
            found[key] = IntDistribution(int(dimension.low), int(dimension.high), dimension.log, step)
        else:
            found[key] = FloatDistribution(dimension.low, dimension.high, dimension.log, dimension.step)
    return found


def _as_param(space: Space, key: str, value: Any) -> Any:
    """Return a value as Optuna knows it, whose choices are no lists."""
    return json.dumps(value) if isinstance(space.dimensions[key], Choices) else value


def _values(space: Space, params: Mapping[str, Any]) -> dict[str, Any]:
    """Return what Optuna's parameters stand for."""
    return {
        key: json.loads(params[key]) if isinstance(dimension, Choices) else params[key]
        for key, dimension in space.dimensions.items()
        if key in params
    }


@dataclass
class _Attempt:
    """A trial under way.

    :param folder: of its runs
    :param waiting: trainings that wait for a worker
    :param started: those that have had one
    :param reported: points that Optuna knows
    """

    trial: "optuna.Trial"
    folder: Path
    waiting: list[Job]
    started: list[Job] = field(default_factory=list)
    workers: dict[Job, Popen[bytes]] = field(default_factory=dict)
    reported: int = 0

    def run(self, job: Job) -> Path:
        """Return the run folder of a training."""
        return run_folder(job.config, job.seed, self.folder)

    def status(self, job: Job) -> str | None:
        """Return what became of a training, None until it has ended."""
        record = ended_run(self.run(job), job.config, job.seed)
        return None if record is None else str(record["status"])

    def curve(self, job: Job) -> list[float]:
        """Return a training's success at each point so far; once it has diverged, 0 at those that it has not reached.

        :raises DamagedFileError: if its learning curve is none
        """
        if not (self.run(job) / CURVE).exists():
            return []
        curve: list[float] = read_curve(self.run(job)).success.tolist()
        return curve + [0.0] * (count_points(job.config) - len(curve)) if self.status(job) == "diverged" else curve


class _Search:
    """One call of :func:`tune`."""

    def __init__(
        self,
        space: Space,
        out: Path,
        study: "optuna.Study",
        n_trials: int,
        n_workers: int,
        report: Callable[[Row], None],
    ) -> None:
        self.space, self.out, self.study, self.n_trials, self.n_workers = space, out, study, n_trials, n_workers
        self.report = report
        self.active: list[_Attempt] = []
        self.failed = 0
        self.retries: Counter[Job] = Counter()

    def play(self) -> Outcome:
        """Try until there are enough trials."""
        import optuna

        for frozen in self.study.get_trials(states=[optuna.trial.TrialState.RUNNING]):
            self._resume(optuna.Trial(self.study, frozen._trial_id))
        with LocalExecutor() as executor, stop_signals() as caught:
            while self._start(executor):
                time.sleep(sweep.POLL_SECONDS)
                if caught:
                    raise Stopped(caught[0])
                for attempt in list(self.active):
                    self._follow(attempt)
        return write_outcome(self.space, self.out, self._rows(), self.failed)

    def _resume(self, trial: "optuna.Trial") -> None:
        """Go on with a trial; one that was killed before all its values were drawn is given up."""
        import optuna

        if trial.params.keys() != self.space.dimensions.keys():
            self.study.tell(trial, state=optuna.trial.TrialState.FAIL)
            return
        attempt = self._attempt(trial)
        attempt.reported = max(self.study.trials[trial.number].intermediate_values, default=0)
        for job in attempt.waiting:
            if attempt.curve(job) or attempt.status(job):
                attempt.started.append(job)
        attempt.waiting = [job for job in attempt.waiting if attempt.status(job) is None]
        self._begin(attempt)

    def _ask(self) -> None:
        """Draw the values of a new trial."""
        from optuna.samplers import TPESampler

        # Anew each time: what a trial draws depends on the trials before it, not on when the search was stopped.
        seed = len(self.study.get_trials(deepcopy=False))
        self.study.sampler = TPESampler(seed=seed, n_startup_trials=self.space.file.random_trials)
        self._begin(self._attempt(self.study.ask(_distributions(self.space))))

    def _begin(self, attempt: _Attempt) -> None:
        self.active.append(attempt)
        self.report(self._rows()[attempt.trial.number])

    def _attempt(self, trial: "optuna.Trial") -> _Attempt:
        folder = self.out / "trials" / f"{trial.number:04}"
        return _Attempt(trial, folder, self.space.jobs(_values(self.space, trial.params)))

    def _start(self, executor: LocalExecutor) -> bool:
        """Give every free worker a training, the oldest trial's first; return whether anything is under way."""
        free = self.n_workers - sum(len(attempt.workers) for attempt in self.active)
        while free > 0:
            attempt = next((each for each in self.active if each.waiting), None)
            if attempt is None:
                if self._ended() + self.failed + len(self.active) >= self.n_trials:
                    break
                self._ask()
                continue
            job = attempt.waiting.pop(0)
            attempt.workers[job] = executor.start(job, attempt.folder)
            if job not in attempt.started:
                attempt.started.append(job)
            free -= 1
        return bool(self.active)

    def _ended(self) -> int:
        """Return how many trials have been trained to their end or given up."""
        from optuna.trial import TrialState

        return len(self.study.get_trials(deepcopy=False, states=[TrialState.COMPLETE, TrialState.PRUNED]))

    def _follow(self, attempt: _Attempt) -> None:
        """See how far a trial is, and whether it is to go on."""
        from optuna.trial import TrialState

        for job, worker in list(attempt.workers.items()):
            code = worker.poll()
            if code is None:
                continue
            del attempt.workers[job]
            if attempt.status(job) is None:
                self.retries[job] += 1
                if code >= 0 or self.retries[job] > sweep.MAX_RETRIES:
                    self.failed += 1
                    self._end(attempt, TrialState.FAIL)
                    return
                attempt.waiting.append(job)  # its process was killed
        if self._report_points(attempt):
            self._end(attempt, TrialState.PRUNED)
        elif not attempt.waiting and not attempt.workers:
            self._end(attempt, TrialState.COMPLETE, mean(self._worth(attempt, job) for job in attempt.started))

    def _report_points(self, attempt: _Attempt) -> bool:
        """Tell Optuna the new points, those that all seeds started so far have; return whether to give the trial up."""
        curves = [attempt.curve(job) for job in attempt.started]
        for point in range(attempt.reported + 1, min(map(len, curves), default=0) + 1):
            attempt.trial.report(mean(curve[point - 1] for curve in curves), point)
            attempt.reported = point
            if attempt.trial.should_prune():
                return True
        return False

    def _worth(self, attempt: _Attempt, job: Job) -> float:
        """Return what a training that has ended is worth: nothing if it has diverged.

        :raises DamagedFileError: if the learning curve of one that has finished is lost
        """
        if attempt.status(job) == "diverged":
            return 0.0
        curve = attempt.curve(job)
        if not curve:
            raise files.DamagedFileError(attempt.run(job) / CURVE, "no learning curve: the training has finished")
        return mean(curve[-self.space.file.last_points :])

    def _end(self, attempt: _Attempt, state: "optuna.trial.TrialState", worth: float | None = None) -> None:
        """Say what became of a trial; what it still trains is of no use."""
        for job, worker in attempt.workers.items():
            worker.kill()
            worker.wait()
            checkpoint.remove(attempt.run(job))
            files.remove_temporary(attempt.run(job))
        self.active.remove(attempt)
        self.study.tell(attempt.trial, worth, state=state)
        rows = self._rows()
        self.report(rows[attempt.trial.number])
        write_outcome(self.space, self.out, rows, self.failed)

    def _rows(self) -> list[Row]:
        return [
            Row(
                trial.number,
                trial.state.name.lower(),
                trial.value,
                max(trial.intermediate_values, default=0),
                _values(self.space, trial.params),
            )
            for trial in self.study.get_trials(deepcopy=False)
        ]
