import itertools
import math

import numpy as np
import pytest
from made_up import episode, rounds
from numpy.typing import NDArray
from scipy import stats

from marl_encircle.experiments import metrics
from marl_encircle.experiments.episodes import Episode
from marl_encircle.experiments.metrics import Interval

Shares = NDArray[np.float64]


def run(steps: list[int | None], **other: float) -> list[Episode]:
    """A run whose round r succeeds at ``steps[r]`` under the rule "all"."""
    return [episode(number, step, **other) for number, step in enumerate(steps)]


# one run


def test_a_run_is_summed_up_under_the_asked_closure_rule() -> None:
    episodes = [
        episode(0, step_all=10, step_pursuers=20, sigma_c=0.1),
        episode(1, step_all=30, step_pursuers=None, sigma_c=0.2),
        episode(2, step_all=None, step_pursuers=None, sigma_c=0.6),
        episode(3, step_all=20, step_pursuers=20, sigma_c=0.3),
    ]
    both = metrics.summarise_run(episodes, "all")
    assert (both.rounds, both.successes, both.success) == (4, 3, 0.75)
    assert both.mean_episode_length == 20  # (10 + 30 + 20) / 3
    assert both.sigma_c == pytest.approx(0.3)  # (.1 + .2 + .6 + .3) / 4
    assert both.sigma_c_solved == pytest.approx(0.2)  # (.1 + .2 + .3) / 3
    pursuers = metrics.summarise_run(episodes, "pursuers")
    assert (pursuers.successes, pursuers.success, pursuers.mean_episode_length) == (2, 0.5, 20)


def test_a_run_without_success_has_no_length() -> None:
    summary = metrics.summarise_run(run([None, None]), "all")
    assert (summary.success, summary.mean_episode_length, summary.sigma_c_solved) == (0, None, None)


@pytest.mark.parametrize("episodes", [[], [episode(0, 5), episode(0, 6)]], ids=["none", "twice"])
def test_rounds_must_be_there_and_be_different_ones(episodes: list[Episode]) -> None:
    with pytest.raises(ValueError, match="round"):
        metrics.summarise_run(episodes, "all")


def test_wilson_by_hand() -> None:
    # p = 0.9, n = 100, z = 1.959964, z^2 = 3.841459:
    # centre (0.9 + 3.841459/200) / 1.03841459 = 0.919207/1.038415 = 0.885203
    # half 1.959964 sqrt(0.09/100 + 3.841459/40000) / 1.038415 = 1.959964 * 0.0315601 / 1.038415 = 0.059569
    low, high = metrics.wilson_interval(0.9, 100)
    assert low == pytest.approx(0.825634, abs=2e-6)
    assert high == pytest.approx(0.944772, abs=2e-6)


@pytest.mark.parametrize(("successes", "rounds"), [(0, 10), (10, 10), (1, 3), (918, 1000), (1000, 1000)])
def test_wilson_equals_scipys(successes: int, rounds: int) -> None:
    expected = stats.binomtest(successes, rounds).proportion_ci(0.95, method="wilson")
    interval = metrics.wilson_interval(successes / rounds, rounds)
    assert interval == pytest.approx((expected.low, expected.high), abs=1e-12)
    assert 0 <= interval.low <= successes / rounds <= interval.high <= 1


# cells


def test_student_by_hand() -> None:
    # mean 0.9, s = 0.02, t(0.975, 2) = 4.302653: half = 4.302653 * 0.02 / sqrt(3) = 0.049683
    assert metrics.student_interval([0.88, 0.90, 0.92]) == pytest.approx((0.850317, 0.949683), abs=1e-6)
    assert metrics.student_interval([0.9]) is None


def test_a_cell_takes_students_interval_over_its_seed_means() -> None:
    # rounds enough that the seeds' spread, not the rounds, decides: Wilson at 0.9 of 1,000 is 0.0186 to each side
    runs = {seed: rounds(successes, 1000) for seed, successes in {5: 880, 6: 900, 7: 920}.items()}
    cell = metrics.summarise_cell(runs, "all")
    assert cell.success.mean == pytest.approx(0.9)
    assert cell.success.interval == pytest.approx((0.850317, 0.949683), abs=1e-6)
    assert cell.success.seeds == 3


def test_a_cells_interval_of_a_share_stays_a_share() -> None:
    runs = {seed: rounds(successes, 100) for seed, successes in {5: 90, 6: 100}.items()}
    interval = metrics.summarise_cell(runs, "all").success.interval
    # mean 0.95, s = 0.0707, t(0.975, 1) = 12.706: 0.95 +- 0.635
    assert interval == pytest.approx((0.95 - 12.7062 * 0.05, 1.0), abs=1e-4)


def test_seeds_that_agree_exactly_keep_the_noise_of_their_rounds() -> None:
    # 90 of the same 100 rounds, three times: t has no width, Wilson's 0.9 of 100 remains (worked out above)
    shared = metrics.summarise_cell({seed: rounds(90, 100) for seed in range(3)}, "all")
    assert shared.success.interval == pytest.approx((0.825634, 0.944772), abs=2e-6)
    # how many of the rounds are shared is not asked: the floor is that of one seed's rounds
    distinct = metrics.summarise_cell({seed: rounds(90, 100, offset=100 * seed) for seed in range(3)}, "all")
    assert distinct.success.interval == shared.success.interval


def test_seeds_that_all_win_every_round_are_not_certain() -> None:
    interval = metrics.summarise_cell({seed: rounds(100, 100) for seed in range(3)}, "all").success.interval
    assert interval is not None
    # Wilson at p = 1: low = n / (n + z^2) = 100 / 103.841459
    assert interval == pytest.approx((0.963007, 1.0), abs=1e-6)


def test_one_seed_has_no_interval() -> None:
    cell = metrics.summarise_cell({3: run([10, 20, None])}, "all")
    assert cell.success == (pytest.approx(2 / 3), None, 1)
    assert cell.mean_episode_length == (15, None, 1)
    assert cell.sigma_c == (0.25, None, 1)


def test_the_length_of_a_cell_is_the_mean_of_the_seeds_that_have_one() -> None:
    cell = metrics.summarise_cell({1: run([20, 22, None]), 2: run([24, 28, 26]), 3: run([None, None, None])}, "all")
    # seed means 21 and 26; s = 3.535534, t(0.975, 1) = 12.706205: half 12.706205 * 2.5 = 31.765512
    assert cell.mean_episode_length is not None
    assert cell.mean_episode_length.mean == 23.5
    assert cell.mean_episode_length.interval == pytest.approx((23.5 - 31.765512, 23.5 + 31.765512), abs=1e-5)
    assert cell.mean_episode_length.seeds == 2
    assert cell.success.mean == pytest.approx((2 / 3 + 1 + 0) / 3)


def test_lengths_on_which_the_seeds_agree_keep_the_noise_of_their_rounds() -> None:
    # both seeds: 10, 20, 30; mean 20, s = 10, t(0.975, 2) = 4.302653: half 4.302653 * 10 / sqrt(3) = 24.841377
    cell = metrics.summarise_cell({1: run([10, 20, 30]), 2: run([10, 20, 30])}, "all")
    assert cell.mean_episode_length is not None
    assert cell.mean_episode_length.interval == pytest.approx((20 - 24.841377, 20 + 24.841377), abs=1e-5)


def test_a_cell_without_success_has_no_length_and_one_without_runs_is_an_error() -> None:
    cell = metrics.summarise_cell({1: run([None]), 2: run([None])}, "all")
    assert (cell.mean_episode_length, cell.sigma_c_solved) == (None, None)
    with pytest.raises(ValueError, match="at least one run"):
        metrics.summarise_cell({}, "all")


# differences


def test_a_success_difference_on_which_the_seeds_agree_keeps_the_noise_of_its_rounds() -> None:
    # every seed differs by .10, so t has no width and the floor is Student's over the 1,000 rounds that all seeds play,
    # of which 100 differ by 1: s = sqrt(.1 * .9 * 1000/999) = 0.300150,
    # t(0.975, 999) = 1.962341: half 1.962341 * 0.300150 / sqrt(1000) = 0.018626
    first = {seed: rounds(900, 1000) for seed in range(3)}
    second = {seed: rounds(800, 1000) for seed in range(3)}
    difference = metrics.success_difference(first, second, "all", "all")
    assert difference is not None
    assert difference.mean == pytest.approx(0.1)
    assert difference.interval == pytest.approx((0.1 - 0.018626, 0.1 + 0.018626), abs=1e-6)
    assert (difference.seeds, difference.shown, difference.verdict) == (3, True, "higher")
    back = metrics.success_difference(second, first, "all", "all")
    assert back is not None
    assert (back.mean, back.verdict) == (pytest.approx(-0.1), "lower")


def test_students_interval_of_paired_differences_by_hand() -> None:
    # differences .02 .05 .08: mean .05, s = .03, half 4.302653 * .03 / sqrt(3) = .074524
    first = {1: rounds(820, 1000), 2: rounds(900, 1000), 3: rounds(980, 1000)}
    second = {1: rounds(800, 1000), 2: rounds(850, 1000), 3: rounds(900, 1000)}
    difference = metrics.success_difference(first, second, "all", "all")
    assert difference is not None
    assert difference.interval == pytest.approx((0.05 - 0.074524, 0.05 + 0.074524), abs=1e-6)
    assert (difference.shown, difference.verdict) == (False, "no difference shown")


def test_equal_methods_show_no_difference() -> None:
    runs = {seed: run([10, None, 30]) for seed in range(3)}
    for difference in (metrics.success_difference, metrics.length_difference):
        result = difference(runs, runs, "all", "all")
        assert result is not None
        assert (result.mean, result.interval, result.verdict) == (0, (0, 0), "no difference shown")


def test_a_difference_compares_common_seeds_only() -> None:
    difference = metrics.success_difference({1: run([10]), 2: run([10])}, {2: run([None]), 3: run([10])}, "all", "all")
    assert difference == (1.0, None, 1)
    assert difference is not None
    assert (difference.shown, difference.verdict) == (False, "too few seeds to say")
    assert metrics.success_difference({1: run([10])}, {2: run([10])}, "all", "all") is None


def test_each_method_may_have_its_own_closure_rule() -> None:
    first, second = {1: [episode(0, 10, 20)]}, {1: [episode(0, 10, 13)]}
    for closures, expected in {("all", "all"): 0, ("all", "pursuers"): -3, ("pursuers", "all"): 10}.items():
        difference = metrics.length_difference(first, second, *closures)
        assert difference is not None
        assert difference.mean == expected


def test_the_length_difference_is_over_rounds_that_both_solve() -> None:
    # seed 1: rounds 0 and 2, 10 - 20 = -10 and 12 - 14 = -2, mean -6; seed 2: round 0 only, 30 - 34 = -4; mean -5
    first = {1: run([10, None, 12]), 2: run([30, 9, 9])}
    second = {1: run([20, 11, 14]), 2: run([34, None, None])}
    difference = metrics.length_difference(first, second, "all", "all")
    assert difference is not None
    assert (difference.mean, difference.seeds) == (-5, 2)
    # the plain MELs would say the contrary in part: 11 against 15 and 16 against 34
    assert metrics.length_difference({1: run([10, None])}, {1: run([None, 10])}, "all", "all") is None


def test_differences_over_other_rounds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"training seed 1: .*not evaluated on the same rounds"):
        metrics.success_difference({1: rounds(5, 10)}, {1: rounds(5, 10, offset=1)}, "all", "all")


# do the intervals hold what they promise


def seed_qualities(rng: np.random.Generator, share: float, spread: float, studies: int, seeds: int) -> Shares:
    """Quality of each seed on the probit scale, such that its share has the given mean and about that spread."""
    middle = float(stats.norm.ppf(share))
    tau = spread / float(stats.norm.pdf(middle))
    return middle * math.sqrt(1 + tau**2) + tau * rng.standard_normal((studies, seeds))


def independent_study(share: float, spread: float, seeds: int, rounds: int, studies: int) -> Shares:
    """Seed shares (studies, seeds) when each seed plays rounds of its own."""
    rng = np.random.default_rng([11, seeds, rounds])
    quality = seed_qualities(rng, share, spread, studies, seeds)
    return rng.binomial(rounds, stats.norm.cdf(quality)) / rounds


def shared_study(share: float, spread: float, seeds: int, rounds: int, studies: int) -> Shares:
    """Seed shares (studies, seeds) when all seeds play the same rounds, some of which are hard for all."""
    rng = np.random.default_rng([12, seeds, rounds])
    quality = seed_qualities(rng, share, spread, studies, seeds)
    hardness = 0.8  # of the variance belongs to the round
    shares = np.empty((studies, seeds))
    for study in range(studies):
        luck = math.sqrt(hardness) * rng.standard_normal(rounds)
        own = math.sqrt(1 - hardness) * rng.standard_normal((seeds, rounds))
        shares[study] = (quality[study][:, None] > luck + own).mean(axis=1)
    return shares


def covered(intervals: list[Interval | None], share: float) -> float:
    return float(np.mean([interval is not None and interval.low <= share <= interval.high for interval in intervals]))


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize("share", [0.75, 0.9, 0.98])
@pytest.mark.parametrize("spread", [0.0, 0.005, 0.01])
def test_cell_intervals_cover_in_simulated_studies(share: float, spread: float, seeds: int) -> None:
    for each in (200, 1000):
        shares = independent_study(share, spread, seeds, each, studies=1000)
        intervals = [metrics.share_interval(row, each) for row in shares.tolist()]
        assert covered(intervals, share) >= 0.93
    shares = shared_study(share, spread, seeds, rounds=1000, studies=300)
    assert covered([metrics.share_interval(row, 1000) for row in shares.tolist()], share) >= 0.93


def test_student_alone_fails_when_all_seeds_play_the_same_rounds() -> None:
    shares = shared_study(0.9, 0.005, seeds=5, rounds=1000, studies=300)
    assert covered([metrics.student_interval(row) for row in shares.tolist()], 0.9) < 0.85


@pytest.mark.parametrize("seeds", [3, 5])
def test_a_percentile_bootstrap_over_seeds_fails(seeds: int) -> None:
    shares = independent_study(0.9, 0.01, seeds, rounds=1000, studies=400)
    every_resample = np.array(list(itertools.product(range(seeds), repeat=seeds)))
    low, high = np.percentile(shares[:, every_resample].mean(axis=2), [2.5, 97.5], axis=1)
    assert np.mean((low <= 0.9) & (high >= 0.9)) < 0.88


def test_p_is_a_twentieth_where_the_interval_ends_at_zero() -> None:
    def difference(mean: float) -> metrics.Difference:
        return metrics.Difference(mean, metrics.Interval(mean - 0.5, mean + 0.5), 4)

    assert difference(0.5).p_value == pytest.approx(0.05)
    assert difference(-0.5).p_value == pytest.approx(0.05)
    assert difference(0.0).p_value == pytest.approx(1.0)
    # t = 2 * 3.182446 at three degrees of freedom
    assert difference(1.0).p_value == pytest.approx(2 * stats.t.sf(2 * 3.182446, 3), abs=1e-6)
    assert metrics.Difference(0.3, metrics.Interval(0.3, 0.3), 2).p_value == 0.0
    assert metrics.Difference(0.0, metrics.Interval(0.0, 0.0), 2).p_value == 1.0
    assert metrics.Difference(0.3, None, 1).p_value is None


@pytest.mark.parametrize(
    ("p_values", "rejected"),
    [
        ([0.01, 0.04, 0.03, 0.005], [True, False, False, True]),  # .005 < .05/4, .01 < .05/3, .03 > .05/2
        ([0.04], [True]),
        ([0.04, 0.04], [False, False]),
        ([], []),
    ],
)
def test_holms_procedure_goes_down_from_the_smallest_p(p_values: list[float], rejected: list[bool]) -> None:
    assert metrics.holm(p_values) == rejected


def test_sigma_is_compared_over_all_rounds() -> None:
    first = {seed: [episode(0, 5, sigma_c=0.4), episode(1, None, sigma_c=0.6)] for seed in (0, 1)}
    second = {seed: [episode(0, None, sigma_c=0.2), episode(1, 9, sigma_c=0.2)] for seed in (0, 1)}
    difference = metrics.sigma_difference(first, second)
    assert difference is not None
    assert difference.mean == pytest.approx(0.3)
