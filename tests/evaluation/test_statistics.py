"""Intervals against known values, and by the laws that they obey."""

import math

import numpy as np
import pytest

from bhd_lerobot.evaluation.statistics import (
    discordance,
    mean,
    mean_difference,
    rate_difference,
    ratio_of_means,
    wilson,
)


def outcomes(both: int, only_one: int, only_two: int, neither: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the paired outcomes that a table of four counts stands for."""
    one = np.repeat([True, True, False, False], [both, only_one, only_two, neither])
    two = np.repeat([True, False, True, False], [both, only_one, only_two, neither])
    return one, two


def test_wilson_of_no_trials_knows_nothing_and_of_nonsense_refuses():
    nothing = wilson(0, 0)
    assert math.isnan(nothing.value)
    assert (nothing.low, nothing.high) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 successes in 2 trials"):
        wilson(3, 2)
    with pytest.raises(ValueError, match="confidence is 95"):
        wilson(1, 2, 95)


def test_wilson_stays_within_0_and_1_and_is_a_mirror_image():
    for successes in range(31):
        one, other = wilson(successes, 30), wilson(30 - successes, 30)
        assert 0 <= one.low <= one.value <= one.high <= 1
        assert one.low == pytest.approx(1 - other.high, abs=1e-12)


@pytest.mark.law
def test_paired_rates_have_the_interval_of_newcombes_paper():
    # Newcombe 1998, method 10, of the table 36, 12, 2, 0: difference 0.2000, 0.0569 to 0.3404.
    estimate = rate_difference(*outcomes(36, 12, 2, 0))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.2, 0.0569, 0.3404), abs=5e-5)


def test_two_equal_brains_do_not_differ():
    one, _ = outcomes(80, 20, 0, 0)
    one[80:] = False
    estimate = rate_difference(one, one)
    assert estimate.value == 0
    assert estimate.low < 0 < estimate.high
    assert discordance(one, one).p == 1.0


def test_paired_rates_cover_the_truth_as_often_as_they_say():
    # True difference 0.1, strongly correlated outcomes; 95 % of 400 is 380, with a standard deviation of 4.4.
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(400):
        cells = rng.multinomial(80, [0.65, 0.15, 0.05, 0.15])
        estimate = rate_difference(*outcomes(*cells))
        covered += estimate.low <= 0.1 <= estimate.high
    assert 365 <= covered <= 398


def test_pairing_makes_the_interval_narrower_when_brains_fail_on_the_same_episodes():
    together = rate_difference(*outcomes(70, 10, 0, 20))
    apart = rate_difference(*outcomes(56, 24, 14, 6))
    assert together.value == apart.value == pytest.approx(0.1)
    assert together.high - together.low < 0.7 * (apart.high - apart.low)


def test_discordance_counts_the_episodes_that_differ():
    result = discordance(*outcomes(10, 9, 3, 5))
    assert (result.better, result.worse) == (9, 3)
    assert result.p == pytest.approx(2 * (1 + 12 + 66 + 220) / 2**12)
    assert discordance(*outcomes(10, 0, 0, 5)).p == 1.0
    assert discordance(*outcomes(0, 1300, 700, 0)).p > 0  # a sum of floats would underflow


def test_the_interval_of_a_mean_is_near_the_normal_one_with_many_values():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    estimate = mean(values)
    half = 1.96 * values.std() / 20
    assert estimate.value == pytest.approx(values.mean())
    assert (estimate.low, estimate.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.15 * half)


SCORES = {
    "fails one in ten": lambda rng, n: (rng.random(n) < 0.9).astype(float),
    "fails one in fifty": lambda rng, n: (rng.random(n) < 0.98).astype(float),
    "narrow": lambda rng, n: np.clip(rng.normal(0.2, 0.03, n), 0.0, 1.0),
    "nearly all good": lambda rng, n: np.where(rng.random(n) < 0.9, rng.normal(0.9, 0.02, n), 0.0),
    "skewed": lambda rng, n: rng.beta(0.3, 3.0, n),
}


@pytest.mark.parametrize("kind", SCORES)
def test_intervals_of_scores_cover_the_truth_as_often_as_they_say_however_few_there_are(kind):
    rng = np.random.default_rng(5)
    truth = SCORES[kind](rng, 1_000_000).mean()
    for count in (1, 2, 5, 20, 50, 100):
        estimates = [mean(SCORES[kind](rng, count), within=(0.0, 1.0)) for _ in range(400)]
        assert sum(one.low <= truth <= one.high for one in estimates) >= 365  # of 400: three standard deviations
        assert all(0.0 <= one.low < one.high <= 1.0 for one in estimates)  # never without a width


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("failures", [0.0, 0.02, 0.05])
def test_intervals_of_differences_and_ratios_cover_a_clone_that_rarely_fails(failures):
    """It does in all other episodes what its rule does, to the bit: the episodes seen may hold none of its failures."""
    rng = np.random.default_rng(6)
    scores = rng.beta(8.0, 4.0, 1_000_000)
    loss = failures * scores.mean()
    for count in (5, 20, 50, 100):
        covered = np.zeros(4, np.int64)
        for _ in range(400):
            rule = rng.beta(8.0, 4.0, count)
            clone = np.where(rng.random(count) < failures, 0.0, rule)
            for place, (one, two, sign) in enumerate(((clone, rule, -1), (rule, clone, 1))):
                difference = mean_difference(one, two, within=(0.0, 1.0))
                ratio = ratio_of_means(one, two, within=(0.0, 1.0))
                truth = (1 - failures) ** -sign
                covered[2 * place] += difference.low <= sign * loss <= difference.high
                covered[2 * place + 1] += ratio.low <= truth <= ratio.high
        assert (covered >= 365).all(), (count, covered)  # of 400: three standard deviations


def test_what_has_no_spread_and_no_bounds_has_no_interval():
    for estimate in (mean([3.0] * 9), mean_difference([0.5] * 9, [0.5] * 9), mean_difference([0.5] * 9, [0.25] * 9)):
        assert math.isnan(estimate.low)
        assert math.isnan(estimate.high)


def test_one_rule_says_whether_brains_differ_in_success():
    """The interval of a difference leaves out 0 if and only if McNemar's exact test finds one, at any confidence."""
    for confidence in (0.95, 0.99):
        for count, most in ((8, 8), (60, 12)):
            for better in range(most + 1):
                for worse in range(min(most, count - better) + 1):
                    rest = count - better - worse
                    for both in {0, rest}:
                        one, two = outcomes(both, better, worse, rest - both)
                        estimate = rate_difference(one, two, confidence)
                        found = discordance(one, two).p < 1 - confidence
                        assert (estimate.low > 0 or estimate.high < 0) == found, (count, better, worse, both)


def test_paired_differences_use_the_pairs():
    rng = np.random.default_rng(3)
    scene = rng.normal(10.0, 5.0, 200)  # what both share
    one, two = scene + 1.0 + rng.normal(0, 0.1, 200), scene
    difference = mean_difference(one, two)
    assert difference.value == pytest.approx(1.0, abs=0.02)
    assert difference.high - difference.low < 0.05  # unpaired it would be about 2
    assert mean_difference(two, one).low == pytest.approx(-difference.high, abs=1e-9)


def test_ratios_have_fiellers_interval_and_proportional_scores_none():
    rng = np.random.default_rng(4)
    values = rng.random(50) + 0.1
    ratio = ratio_of_means(1.5 * values, values)
    assert ratio.value == pytest.approx(1.5)
    assert math.isnan(ratio.low)
    covered = 0
    for _ in range(400):
        scene = rng.gamma(2.0, 0.1, 30)
        estimate = ratio_of_means(1.2 * scene + rng.normal(0, 0.02, 30), scene)
        covered += estimate.low <= 1.2 <= estimate.high
    assert 365 <= covered <= 398


def test_ratio_to_nothing_is_not_defined_and_to_nearly_nothing_is_open():
    assert math.isnan(ratio_of_means([1.0, 1.0], [0.0, 0.0]).value)
    open_above = ratio_of_means(np.ones(4), np.array([1.0, 0.0, 0.0, 0.0]))
    assert open_above.value == 4.0
    assert open_above.high == math.inf


def test_one_episode_has_no_interval_without_bounds_and_none_no_mean():
    one = mean([0.5])
    assert one.value == 0.5
    assert math.isnan(one.low)
    assert math.isnan(one.high)
    assert all(math.isnan(x) for x in (mean([]).value, mean([]).low, mean_difference([], []).value))
    unknown = rate_difference([], [])
    assert math.isnan(unknown.value)
    assert (unknown.low, unknown.high) == (-1.0, 1.0)


def test_samples_of_different_length_are_no_pairs():
    for function in (mean_difference, ratio_of_means, rate_difference, discordance):
        with pytest.raises(ValueError, match="same length"):
            function([1.0, 0.0], [1.0])
