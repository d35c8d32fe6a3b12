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


def test_paired_rates_have_the_interval_of_newcombes_paper():
    # Newcombe 1998, method 10, of the table 36, 12, 2, 0: difference 0.2000, 0.0569 to 0.3404.
    estimate = rate_difference(*outcomes(36, 12, 2, 0))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.2, 0.0569, 0.3404), abs=5e-5)


def test_paired_rates_turn_round_with_the_brains():
    one, two = outcomes(40, 9, 3, 8)
    forward, back = rate_difference(one, two), rate_difference(two, one)
    assert (forward.low, forward.high) == pytest.approx((-back.high, -back.low), abs=1e-12)


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


def test_bootstrap_of_a_mean_is_near_the_normal_interval():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    estimate = mean(values)
    half = 1.96 * values.std() / 20
    assert estimate.value == pytest.approx(values.mean())
    assert (estimate.low, estimate.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.15 * half)


def test_resampling_gives_the_same_interval_twice():
    values = np.random.default_rng(2).random(37)
    assert mean(values) == mean(values)
    assert ratio_of_means(values, values[::-1]) == ratio_of_means(values, values[::-1])


def test_paired_bootstrap_uses_the_pairs():
    rng = np.random.default_rng(3)
    scene = rng.normal(10.0, 5.0, 200)  # what both share
    one, two = scene + 1.0 + rng.normal(0, 0.1, 200), scene
    difference = mean_difference(one, two)
    assert difference.value == pytest.approx(1.0, abs=0.02)
    assert difference.high - difference.low < 0.05  # unpaired it would be about 2
    assert mean_difference(two, one).low == pytest.approx(-difference.high, abs=1e-9)


def test_ratio_of_proportional_scores_is_exact():
    values = np.random.default_rng(4).random(50) + 0.1
    ratio = ratio_of_means(1.5 * values, values)
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx((1.5, 1.5, 1.5), rel=1e-12)


def test_ratio_to_nothing_is_not_defined_and_to_nearly_nothing_is_open():
    assert math.isnan(ratio_of_means([1.0, 1.0], [0.0, 0.0]).value)
    open_above = ratio_of_means(np.ones(4), np.array([1.0, 0.0, 0.0, 0.0]))
    assert open_above.value == 4.0
    assert open_above.high == math.inf


def test_one_episode_has_no_interval_and_none_no_mean():
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
