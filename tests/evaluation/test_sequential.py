"""The sequential test by its laws: a fair game against equal brains, few false alarms however often it is looked at."""

import math

import numpy as np
import pytest
from scipy.stats import binom

from bhd_lerobot.evaluation.plan import discordant_share
from bhd_lerobot.evaluation.sequential import confidence_sequence, log_e_value
from tests.cases import each_case

COUNTS = [
    *((0, 0, 3), (5, 0, 5), (8, 0, 0), (0, 8, 2), (10, 2, 30), (3, 9, 0)),
    *((60, 30, 300), (300, 600, 3000), (6000, 0, 0)),
]


def test_against_equal_brains_the_bets_win_nothing_in_the_mean():
    for pairs in (1, 2, 7, 40, 300):
        better = np.arange(pairs + 1)
        mean = binom.pmf(better, pairs, 0.5) @ np.exp(log_e_value(better, pairs - better))
        assert mean == pytest.approx(1.0, rel=1e-9)


@pytest.mark.law
def test_e_values_by_hand_and_turned_round():
    assert np.exp(log_e_value(8, 0)) == pytest.approx(2**8 / 9)
    assert np.exp(log_e_value(1, 1)) == pytest.approx(2 / 3)
    for better, worse, _ in COUNTS:
        assert log_e_value(better, worse) == pytest.approx(log_e_value(worse, better))


def looked_at_every_pair(rates, correlation, pairs=300, runs=4000):
    """Return the numbers of pairs that favour either brain after each pair, both of shape (runs, pairs)."""
    drawn = np.random.default_rng(0).random((runs, pairs))
    discordant = discordant_share(*rates, correlation)
    first = (discordant + rates[0] - rates[1]) / 2
    return np.cumsum(drawn < first, 1), np.cumsum((drawn >= first) & (drawn < discordant), 1)


@each_case(("rate", "correlation"), [(r, c) for r in (0.1, 0.5, 0.9) for c in (0.0, 0.5)])
def test_equal_brains_are_rarely_told_apart_though_every_pair_is_looked_at(rate, correlation):
    better, worse = looked_at_every_pair((rate, rate), correlation)
    alarms = (log_e_value(better, worse) >= math.log(20)).any(axis=1).mean()
    assert alarms <= 0.05 - 3 * math.sqrt(0.05 * 0.95 / len(better))


def test_brains_that_differ_are_told_apart_and_sooner_the_more_they_differ():
    needed = []
    for rate in (0.65, 0.75, 0.85):
        certain = log_e_value(*looked_at_every_pair((rate, 0.5), 0.3)) >= math.log(20)
        assert certain.any(axis=1).mean() > 0.8
        needed.append(np.where(certain.any(axis=1), certain.argmax(axis=1) + 1, 300).mean())
    assert needed == sorted(needed, reverse=True)
    assert needed[-1] < needed[0] / 3


@each_case("counts", COUNTS)
def test_the_interval_holds_the_observed_difference_and_excludes_0_where_the_test_is_certain(counts):
    better, worse, same = counts
    for confidence in (0.95, 0.975):
        one = confidence_sequence(*counts, confidence)
        assert -1 <= one.low <= one.value <= one.high <= 1
        assert one.value == pytest.approx((better - worse) / sum(counts))
        is_certain = log_e_value(better, worse) >= -math.log(1 - confidence)
        assert (one.low > 0 or one.high < 0) == is_certain
        back = confidence_sequence(worse, better, same, confidence)
        assert (one.low, one.high) == pytest.approx((-back.high, -back.low), abs=1e-9)


def test_the_interval_gets_narrower_and_after_nothing_knows_nothing():
    widths = [one.high - one.low for one in (confidence_sequence(3 * k, k, 6 * k) for k in (1, 4, 16, 64))]
    assert widths == sorted(widths, reverse=True)
    nothing = confidence_sequence(0, 0, 0)
    assert math.isnan(nothing.value)
    assert (nothing.low, nothing.high) == (-1.0, 1.0)


def test_all_intervals_of_a_run_cover_the_true_difference_as_often_as_they_say():
    better, worse = looked_at_every_pair((0.7, 0.5), 0.3, pairs=80, runs=60)
    missed = 0
    for wins, losses in zip(better, worse, strict=True):
        steps = range(7, 80, 8)
        found = [confidence_sequence(int(wins[i]), int(losses[i]), int(i + 1 - wins[i] - losses[i])) for i in steps]
        missed += not all(one.low <= 0.2 <= one.high for one in found)
    assert missed <= 3
