"""From the records of evaluation rounds to S %, MEL, sigma_c and their intervals; pure functions.

Shares are in [0, 1], lengths in steps, sigma_c in radians. All intervals are two-sided at 95 %.

Three kinds of interval, not to be mixed:

- one run, ``summarise_run``: Wilson's interval over its rounds. It holds evaluation noise only: it says nothing about
  what another training seed would give.
- one cell, ``summarise_cell``: Student's t over the means of the training seeds, cut to [0, 1] where the value is a
  share, and never narrower than the noise of the evaluation rounds themselves. That floor matters when the seeds happen
  to agree (in the extreme, all the same: t has no width then) and when all seeds play the same rounds: luck with the
  rounds moves all of them together, so the spread between seeds cannot show it. A share's floor is Wilson's interval
  for the rounds of one seed, another mean's is Student's over the distinct rounds.
- two methods, ``success_difference``, ``length_difference`` and ``sigma_difference``: the same over the paired
  differences, round by round and seed by seed. "No difference shown" where the interval covers zero.

A percentile bootstrap over three to five seeds is far too narrow and is not used; the tests show both. The limit of the
cell's interval: where the seeds spread as widely as their distance to 100 % (98 % on average with 2 points of spread),
three to five of them rarely include the bad one, and it covers about 88 % instead of 95 %.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import stats

from marl_encircle.core.geometry import Closure
from marl_encircle.experiments.episodes import Episode

CONFIDENCE = 0.95
UNBOUNDED = (-math.inf, math.inf)

ValueByRound = Mapping["RoundKey", float]


class RoundKey(NamedTuple):
    """What makes a round the same round for every method and training seed."""

    round: int
    seed: int


class Interval(NamedTuple):
    """Two-sided interval, of 95 % unless another is asked for."""

    low: float
    high: float


class RunSummary(NamedTuple):
    """One run.

    :param rounds: rounds played
    :param successes: rounds in which the closure rule held at some step
    :param success: share of the rounds, in [0, 1]
    :param success_interval: Wilson's interval; evaluation noise only
    :param mean_episode_length: MEL, mean success step of the successful rounds [steps]; None without any
    :param sigma_c: mean of sigma_c over all rounds [rad]
    :param sigma_c_solved: the same over the successful rounds; None without any
    """

    rounds: int
    successes: int
    success: float
    success_interval: Interval
    mean_episode_length: float | None
    sigma_c: float
    sigma_c_solved: float | None


class Estimate(NamedTuple):
    """Mean over training seeds.

    :param mean: mean of the seeds' means
    :param interval: where the mean over all possible seeds is; None with fewer than two seeds
    :param seeds: seeds that have a value
    """

    mean: float
    interval: Interval | None
    seeds: int


class CellSummary(NamedTuple):
    """All training seeds of one method in one setting; None where no seed has a successful round.

    :param success: share of successful rounds, in [0, 1]
    :param mean_episode_length: MEL over the seeds that have one [steps]
    :param sigma_c: over all rounds [rad]
    :param sigma_c_solved: over successful rounds [rad]
    """

    success: Estimate
    mean_episode_length: Estimate | None
    sigma_c: Estimate
    sigma_c_solved: Estimate | None


class Difference(NamedTuple):
    """Paired difference of two methods, first minus second.

    :param mean: mean over the training seeds that both have
    :param interval: of the mean; None with fewer than two seeds
    :param seeds: training seeds compared
    """

    mean: float
    interval: Interval | None
    seeds: int

    @property
    def shown(self) -> bool:
        """Whether there is an interval and it leaves zero out."""
        return self.interval is not None and not self.interval.low <= 0.0 <= self.interval.high

    @property
    def verdict(self) -> str:
        """The difference in words."""
        if self.interval is None:
            return "too few seeds to say"
        if not self.shown:
            return "no difference shown"
        return "higher" if self.mean > 0 else "lower"

    @property
    def p_value(self) -> float | None:
        """Two-sided p of no difference, by Student's t from the interval, at whose end it is 0.05; None without."""
        if self.interval is None:
            return None
        half = max(self.interval.high - self.mean, self.mean - self.interval.low)
        if half == 0:
            return float(self.mean == 0)
        return float(2 * stats.t.sf(abs(self.mean) / half * _student_quantile(self.seeds - 1), self.seeds - 1))


def holm(p_values: Sequence[float]) -> list[bool]:
    """Return which hypotheses Holm's step-down procedure rejects: the error over all of them is at most 5 %.

    :param p_values: of each hypothesis
    """
    rejected = [False] * len(p_values)
    for k, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        if p_values[i] > (1 - CONFIDENCE) / (len(p_values) - k):
            break
        rejected[i] = True
    return rejected


def summarise_run(episodes: Sequence[Episode], closure: Closure) -> RunSummary:
    """S, MEL and sigma_c of one run under a closure rule.

    :param episodes: the run's evaluation rounds
    :param closure: rule that counts as success
    :raises ValueError: without rounds or with a duplicate round number
    """
    lengths = _lengths(episodes, closure)
    sigmas, solved_sigmas = _sigmas(episodes), _solved_sigmas(episodes, closure)
    rounds, successes = len(sigmas), len(lengths)
    return RunSummary(
        rounds=rounds,
        successes=successes,
        success=successes / rounds,
        success_interval=wilson_interval(successes / rounds, rounds),
        mean_episode_length=_mean(lengths) if lengths else None,
        sigma_c=_mean(sigmas),
        sigma_c_solved=_mean(solved_sigmas) if solved_sigmas else None,
    )


def summarise_cell(runs: Mapping[int, Sequence[Episode]], closure: Closure) -> CellSummary:
    """S, MEL and sigma_c of one method in one setting.

    :param runs: training seed -> its evaluation rounds
    :param closure: rule that counts as success
    :raises ValueError: without runs, or as ``summarise_run``
    """
    if not runs:
        raise ValueError("a cell needs at least one run")
    successes = [_successes(episodes, closure) for episodes in runs.values()]
    return CellSummary(
        success=_share(successes),
        mean_episode_length=_estimate_if_any([_lengths(episodes, closure) for episodes in runs.values()]),
        sigma_c=_estimate([_sigmas(episodes) for episodes in runs.values()]),
        sigma_c_solved=_estimate_if_any([_solved_sigmas(episodes, closure) for episodes in runs.values()]),
    )


def success_difference(
    first: Mapping[int, Sequence[Episode]],
    second: Mapping[int, Sequence[Episode]],
    closure_first: Closure,
    closure_second: Closure,
) -> Difference | None:
    """Paired difference of success shares, first minus second.

    :param first: training seed -> rounds of the first method
    :param second: the same of the second, on the same rounds
    :param closure_first: rule that counts as the first one's success
    :param closure_second: rule that counts as the second one's success
    :return: the difference over the training seeds both have, in [-1, 1]; None without a common seed
    :raises ValueError: when the rounds of a common seed are not the same
    """
    return _difference(
        first,
        second,
        lambda episodes: _successes(episodes, closure_first),
        lambda episodes: _successes(episodes, closure_second),
        bounds=(-1.0, 1.0),
    )


def length_difference(
    first: Mapping[int, Sequence[Episode]],
    second: Mapping[int, Sequence[Episode]],
    closure_first: Closure,
    closure_second: Closure,
) -> Difference | None:
    """Paired difference of success steps over the rounds that both methods solve, first minus second [steps].

    The parameters are those of ``success_difference``. Each method's own MEL is over other rounds: one that fails the
    hard rounds has the shorter MEL. Here both are over the same.

    :return: the difference over the training seeds with rounds that both solve; None without such a seed
    :raises ValueError: when the rounds of a common seed are not the same
    """
    return _difference(
        first,
        second,
        lambda episodes: _lengths(episodes, closure_first),
        lambda episodes: _lengths(episodes, closure_second),
    )


def sigma_difference(
    first: Mapping[int, Sequence[Episode]], second: Mapping[int, Sequence[Episode]]
) -> Difference | None:
    """Paired difference of sigma_c over all rounds, first minus second [rad].

    :param first: training seed -> rounds of the first method
    :param second: the same of the second, on the same rounds
    :return: the difference over the training seeds both have; None without a common seed
    :raises ValueError: when the rounds of a common seed are not the same
    """
    return _difference(first, second, _sigmas, _sigmas)


def same_rounds(first: Sequence[Episode], second: Sequence[Episode]) -> bool:
    """Whether two runs were evaluated on the same rounds, so that they can be compared round by round."""
    return {_key(episode) for episode in first} == {_key(episode) for episode in second}


def wilson_interval(share: float, rounds: int, confidence: float = CONFIDENCE) -> Interval:
    """Wilson's score interval of a share; evaluation noise only.

    With z the normal quantile: ((p + z^2/2n) +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).

    :param share: successes / rounds, in [0, 1]
    :param rounds: independent rounds behind the share
    :param confidence: of the two-sided interval
    """
    z = float(stats.norm.ppf(0.5 + confidence / 2))
    centre = share + z * z / (2 * rounds)
    half = z * math.sqrt(share * (1 - share) / rounds + z * z / (4 * rounds * rounds))
    scale = 1 + z * z / rounds
    return _hull(Interval((centre - half) / scale, (centre + half) / scale), share, bounds=(0.0, 1.0))


def student_interval(values: Sequence[float]) -> Interval | None:
    """Student's t interval of a mean: mean +- t(n - 1) s / sqrt(n).

    :param values: independent values, one per training seed
    :return: None with fewer than two values
    """
    if len(values) < 2:
        return None
    mean = float(np.mean(values))
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = _student_quantile(len(values) - 1) * error
    return Interval(mean - half, mean + half)


@cache
def _student_quantile(freedom: int) -> float:
    """Two-sided quantile of Student's t at the module's confidence."""
    return float(stats.t.ppf(0.5 + CONFIDENCE / 2, freedom))


def share_interval(seed_shares: Sequence[float], rounds: int) -> Interval | None:
    """Interval of a mean share over training seeds: Student's t, at least as wide as Wilson's, cut to [0, 1].

    :param seed_shares: share of each training seed, in [0, 1]
    :param rounds: rounds that each seed played, be they the same for all or not
    :return: None with fewer than two seeds
    """
    interval = student_interval(seed_shares)
    if interval is None:
        return None
    return _hull(interval, *wilson_interval(float(np.mean(seed_shares)), rounds), bounds=(0.0, 1.0))


def _share(seeds: Sequence[ValueByRound]) -> Estimate:
    """Estimate of a share."""
    means = [_mean(rounds) for rounds in seeds]
    return Estimate(float(np.mean(means)), share_interval(means, min(map(len, seeds))), len(means))


def _estimate(seeds: Sequence[ValueByRound], bounds: tuple[float, float] = UNBOUNDED) -> Estimate:
    """Estimate of a mean; its floor is Student's interval over the distinct rounds, each a mean over the seeds."""
    means = [_mean(rounds) for rounds in seeds]
    mean = float(np.mean(means))
    interval = student_interval(means)
    floor = student_interval([float(np.mean(values)) for values in _by_round(seeds).values()])
    if interval is not None and floor is not None:
        half = (floor.high - floor.low) / 2
        interval = _hull(interval, mean - half, mean + half, bounds=bounds)
    return Estimate(mean, interval, len(means))


def _estimate_if_any(seeds: Sequence[ValueByRound], bounds: tuple[float, float] = UNBOUNDED) -> Estimate | None:
    """Estimate over the seeds that have a value in some round; None without any."""
    seeds = [rounds for rounds in seeds if rounds]
    return _estimate(seeds, bounds) if seeds else None


def _difference(
    first: Mapping[int, Sequence[Episode]],
    second: Mapping[int, Sequence[Episode]],
    values_first: Callable[[Sequence[Episode]], ValueByRound],
    values_second: Callable[[Sequence[Episode]], ValueByRound],
    bounds: tuple[float, float] = UNBOUNDED,
) -> Difference | None:
    """Difference over the common seeds and, within each, over the rounds for which both have a value."""
    seeds = []
    for seed in sorted(first.keys() & second.keys()):
        if not same_rounds(first[seed], second[seed]):
            raise ValueError(f"training seed {seed}: the two methods were not evaluated on the same rounds")
        left, right = values_first(first[seed]), values_second(second[seed])
        seeds.append({key: value - right[key] for key, value in left.items() if key in right})
    estimate = _estimate_if_any(seeds, bounds)
    if estimate is None:
        return None
    difference = Difference(*estimate)
    return difference._replace(mean=round(difference.mean, 12) + 0.0)  # what is zero but for rounding has no sign


def _hull(interval: Interval, *points: float, bounds: tuple[float, float] = UNBOUNDED) -> Interval:
    """Smallest interval around another one and some points, cut to bounds."""
    return Interval(max(bounds[0], min(interval.low, *points)), min(bounds[1], max(interval.high, *points)))


def _by_round(seeds: Sequence[ValueByRound]) -> dict[RoundKey, list[float]]:
    """Values of each distinct round over the seeds that have one."""
    values: dict[RoundKey, list[float]] = {}
    for rounds in seeds:
        for key, value in rounds.items():
            values.setdefault(key, []).append(value)
    return values


def _mean(rounds: ValueByRound) -> float:
    return float(np.mean(list(rounds.values())))


def _key(episode: Episode) -> RoundKey:
    return RoundKey(episode.round, episode.seed)


def _successes(episodes: Sequence[Episode], closure: Closure) -> ValueByRound:
    """1 or 0 for each round."""
    return _values(episodes, lambda episode: float(episode.success_step(closure) is not None))


def _lengths(episodes: Sequence[Episode], closure: Closure) -> ValueByRound:
    """Success step of each successful round [steps]."""
    return _values(episodes, lambda episode: episode.success_step(closure))


def _sigmas(episodes: Sequence[Episode]) -> ValueByRound:
    """sigma_c of each round [rad]."""
    return _values(episodes, lambda episode: episode.sigma_c)


def _solved_sigmas(episodes: Sequence[Episode], closure: Closure) -> ValueByRound:
    """sigma_c of each successful round [rad]."""
    return _values(episodes, lambda episode: None if episode.success_step(closure) is None else episode.sigma_c)


def _values(episodes: Sequence[Episode], value: Callable[[Episode], float | None]) -> ValueByRound:
    """Value of each round that has one."""
    if not episodes:
        raise ValueError("no evaluation rounds")
    if len({episode.round for episode in episodes}) != len(episodes):
        raise ValueError("duplicate round number")
    pairs = ((_key(episode), value(episode)) for episode in episodes)
    return {key: float(value) for key, value in pairs if value is not None}
