"""Statistics of brains over a number of episodes: rates, means, paired differences, with intervals. Pure.

All intervals are two-sided at the confidence given, 95 % by default. Resampling draws from a generator with a fixed
seed, so that the same numbers give the same interval.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, bootstrap

CONFIDENCE = 0.95
RESAMPLES = 10_000
_SEED = 0
_BLOCK = 2_000_000  # values resampled at a time: bounds the memory


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; NaN where it is not defined.

    Attributes:
        value: the estimate.
        low: lower end of its interval.
        high: upper end.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Discordance:
    """On how many episodes two brains differed in success.

    Attributes:
        better: episodes in which the first succeeded and the second failed.
        worse: episodes in which the second succeeded and the first failed.
        p: two-sided p-value of McNemar's exact test that neither is more frequent.
    """

    better: int
    worse: int
    p: float


def wilson(successes: int, count: int, confidence: float = CONFIDENCE) -> Estimate:
    """Return a share with its Wilson score interval.

    Args:
        successes: how many of them were a success.
        count: number of independent trials; nothing is known after none: 0 to 1.
        confidence: probability that the interval covers the truth.

    Raises:
        ValueError: more successes than trials, fewer than none, or a confidence that is not between 0 and 1.
    """
    if not 0 <= successes <= count:
        raise ValueError(f"{successes} successes in {count} trials.")
    if not 0 < confidence < 1:
        raise ValueError(f"The confidence is {confidence}; it must be between 0 and 1.")
    if count == 0:
        return Estimate(math.nan, 0.0, 1.0)
    interval = binomtest(successes, count).proportion_ci(confidence, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high))


def mean(values: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Return a mean with its percentile bootstrap interval.

    Args:
        values: one for each episode, shape (episodes,).
        confidence: probability that the interval covers the truth, with enough episodes.
    """
    return _bootstrap(np.positive, confidence, values)


def mean_difference(values: ArrayLike, baseline: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Return the mean of paired differences, values minus baseline, with its percentile bootstrap interval.

    Args:
        values: one for each episode, shape (episodes,).
        baseline: of the same episodes, in the same order.
        confidence: probability that the interval covers the truth, with enough episodes.
    """
    return _bootstrap(np.subtract, confidence, values, baseline)


def ratio_of_means(values: ArrayLike, baseline: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Return the ratio of two means over the same episodes, with its paired percentile bootstrap interval.

    Where resamples of the baseline have the mean 0 the upper end is infinite; where the baseline itself has, nothing
    is defined.

    Args:
        values: one for each episode, shape (episodes,).
        baseline: of the same episodes, in the same order.
        confidence: probability that the interval covers the truth, with enough episodes.
    """
    if np.size(baseline) == 0 or np.mean(np.asarray(baseline, float)) == 0:
        return Estimate(math.nan, math.nan, math.nan)

    def ratio(over: NDArray[np.float64], under: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.divide(over, under, out=np.full_like(over, math.inf), where=under != 0)

    return _bootstrap(ratio, confidence, values, baseline)


def rate_difference(successes: ArrayLike, baseline: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Return the difference of two success rates over the same episodes, with Newcombe's interval.

    It is the method 10 of R. G. Newcombe, "Improved confidence intervals for the difference between binomial
    proportions based on paired data", Statistics in Medicine 17 (1998): the Wilson intervals of both rates, put
    together with the correlation of the outcomes.

    Args:
        successes: whether each episode was a success, shape (episodes,).
        baseline: of the same episodes, in the same order.
        confidence: probability that the interval covers the truth.
    """
    one, two = _paired(np.asarray(successes, bool), np.asarray(baseline, bool))
    count = len(one)
    if count == 0:
        return Estimate(math.nan, -1.0, 1.0)
    both, only_one = int(np.sum(one & two)), int(np.sum(one & ~two))
    only_two, neither = int(np.sum(two & ~one)), int(np.sum(~one & ~two))
    first, second = wilson(both + only_one, count, confidence), wilson(both + only_two, count, confidence)
    phi = _correlation(both, only_one, only_two, neither)

    def spread(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))

    difference = (only_one - only_two) / count
    low = difference - spread(first.value - first.low, second.high - second.value)
    high = difference + spread(first.high - first.value, second.value - second.low)
    return Estimate(difference, max(-1.0, low), min(1.0, high))


def discordance(successes: ArrayLike, baseline: ArrayLike) -> Discordance:
    """Return on how many episodes two brains differed in success, with McNemar's exact test.

    Args:
        successes: whether each episode was a success, shape (episodes,).
        baseline: of the same episodes, in the same order.
    """
    one, two = _paired(np.asarray(successes, bool), np.asarray(baseline, bool))
    better, worse = int(np.sum(one & ~two)), int(np.sum(two & ~one))
    total = better + worse
    return Discordance(better, worse, float(binomtest(better, total).pvalue) if total else 1.0)


def _correlation(both: int, only_one: int, only_two: int, neither: int) -> float:
    """Return the phi coefficient as method 10 wants it: corrected for continuity if positive, 0 at an empty margin."""
    margins = (both + only_one) * (only_two + neither) * (both + only_two) * (only_one + neither)
    if margins == 0:
        return 0.0
    product, count = float(both * neither - only_one * only_two), both + only_one + only_two + neither
    if product > 0:
        product = max(product - count / 2, 0.0)
    return product / math.sqrt(margins)


def _bootstrap(statistic: Callable[..., NDArray[np.float64]], confidence: float, *samples: ArrayLike) -> Estimate:
    """Return a statistic of the means of paired samples with its percentile interval."""
    values = _paired(*(np.asarray(sample, np.float64) for sample in samples))
    count = len(values[0])
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan)

    def of_means(*resamples: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        return statistic(*(np.mean(resample, axis=axis, keepdims=True) for resample in resamples)).squeeze(axis)

    estimate = float(of_means(*values))
    if count == 1:  # resampling one episode would pretend that it is known exactly
        return Estimate(estimate, math.nan, math.nan)
    with np.errstate(invalid="ignore"):  # scipy's standard error, of infinite ratios
        resampled = bootstrap(
            values,
            of_means,
            n_resamples=RESAMPLES,
            batch=max(1, _BLOCK // count),
            vectorized=True,
            paired=True,
            method="percentile",
            rng=_SEED,
        )
    # Not scipy's interval, which interpolates: between a number and infinity there is none.
    tail = (1 - confidence) / 2
    low, high = np.quantile(resampled.bootstrap_distribution, (tail, 1 - tail), method="nearest")
    return Estimate(estimate, float(low), float(high))


def _paired(*samples: NDArray) -> tuple[NDArray, ...]:
    lengths = {len(sample) for sample in samples}
    if len(lengths) > 1:
        raise ValueError(f"Paired samples must have the same length; got {sorted(lengths)}.")
    return samples
