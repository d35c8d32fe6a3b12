"""Statistics of brains over a number of episodes: rates, means, paired differences, with intervals. Pure.

All intervals are two-sided at the confidence given, 95 % by default. They are made for few episodes as well: none has
no width, and each covers the truth about as often as it says, see `tests/evaluation/test_statistics.py`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest
from scipy.stats import t as student

CONFIDENCE = 0.95
_FLAT = 1e-12  # of the values' size: a spread that is less is rounding


@dataclass(frozen=True)
class Estimate:
    """A number with its interval.

    Attributes:
        value: the number; NaN where it is not defined.
        low, high: lower and upper end of the interval.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Discordance:
    """On how many episodes two brains differed in success; `p`: two-sided, of McNemar's exact test."""

    better: int
    worse: int
    p: float


def wilson(successes: int, count: int, confidence: float = CONFIDENCE) -> Estimate:
    """Return a share with its Wilson score interval; after no trials it is 0 to 1."""
    if not 0 <= successes <= count:
        raise ValueError(f"{successes} successes in {count} trials.")
    if not 0 < confidence < 1:
        raise ValueError(f"The confidence is {confidence}; it must be between 0 and 1.")
    if count == 0:
        return Estimate(math.nan, 0.0, 1.0)
    interval = binomtest(successes, count).proportion_ci(confidence, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high))


def mean(
    values: ArrayLike, confidence: float = CONFIDENCE, *, within: tuple[float, float] = (-math.inf, math.inf)
) -> Estimate:
    """Return a mean with its interval: Student's, corrected for skewness.

    The correction is that of P. Hall, "On the removal of skewness by transformation", Journal of the Royal Statistical
    Society B 54 (1992). Where the values have bounds, the interval also holds what would be the mean if a share of the
    episodes that easily stays unseen, 3 / n of them for 95 %, had the value of a bound: twenty equal scores do not
    prove that there are no others. Where they have none, equal values, or a single one, have no interval: NaN.
    """
    sample = np.asarray(values, np.float64)
    count = len(sample)
    if not count:
        return Estimate(math.nan, math.nan, math.nan)
    value, spread = float(sample.mean()), float(sample.std(ddof=1)) if count > 1 else 0.0
    low = high = math.nan
    if spread > _FLAT * np.abs(sample).max():
        quantile = float(student.ppf((1 + confidence) / 2, count - 1))
        skewness = float(((sample - value) ** 3).mean()) / spread**3
        low, high = (value - spread * _corrected(one, skewness, count) for one in (quantile, -quantile))
    lower, upper = within
    unseen = unseen_share(count, confidence)
    if math.isfinite(lower):
        low = max(lower, np.fmin(low, value - unseen * (value - lower)))
    if math.isfinite(upper):
        high = min(upper, np.fmax(high, value + unseen * (upper - value)))
    return Estimate(value, float(low), float(high))


def _corrected(quantile: float, skewness: float, count: int) -> float:
    """Return the quantile of a mean of skewed values, in their standard deviations."""
    if abs(skewness) < 1e-9:
        return quantile / math.sqrt(count)
    return float(np.cbrt(1 + skewness * (quantile / math.sqrt(count) - skewness / (6 * count))) - 1) * 3 / skewness


def unseen_share(count: int, confidence: float = CONFIDENCE) -> float:
    """Return the share of episodes that easily stays unseen in a number of them: about 3 / n for 95 %."""
    return 1 - (1 - confidence) ** (1 / count)


def mean_difference(
    values: ArrayLike,
    baseline: ArrayLike,
    confidence: float = CONFIDENCE,
    *,
    within: tuple[float, float] = (-math.inf, math.inf),
) -> Estimate:
    """Return the mean of paired differences, values minus baseline, with the interval of `mean`."""
    one, two = _paired(np.asarray(values, np.float64), np.asarray(baseline, np.float64))
    width = within[1] - within[0]
    return mean(one - two, confidence, within=(-width, width))


def ratio_of_means(
    values: ArrayLike,
    baseline: ArrayLike,
    confidence: float = CONFIDENCE,
    *,
    within: tuple[float, float] = (0.0, math.inf),
) -> Estimate:
    """Return the ratio of two means over the same episodes, neither negative, with Fieller's interval for pairs.

    Where the baseline's mean may be 0 the upper end is infinite; where it is, nothing is defined. Where the values have
    an upper bound, the interval also holds the ratio if a share of the episodes that easily stays unseen, as in `mean`,
    had the value of a bound.
    """
    one, two = _paired(np.asarray(values, np.float64), np.asarray(baseline, np.float64))
    count = len(one)
    if count == 0 or two.mean() == 0:
        return Estimate(math.nan, math.nan, math.nan)
    found = _fieller(one, two, confidence)
    lower, upper = within
    if count == 1 or not math.isfinite(upper):
        return found
    unseen = unseen_share(count, confidence)
    top, bottom = float(one.mean()), float(two.mean())
    least, most = top - unseen * (top - lower), top + unseen * (upper - top)
    low = min(least / bottom, top / (bottom + unseen * (upper - bottom)))
    high = max(most / bottom, top / (bottom - unseen * (bottom - lower)))
    return Estimate(found.value, float(np.fmin(found.low, low)), float(np.fmax(found.high, high)))


def _fieller(one: NDArray[np.float64], two: NDArray[np.float64], confidence: float) -> Estimate:
    count = len(one)
    ratio = float(one.mean() / two.mean())
    if count == 1 or np.ptp(one - ratio * two) <= _FLAT * np.abs(one).max():
        return Estimate(ratio, math.nan, math.nan)
    square = float(student.ppf((1 + confidence) / 2, count - 1)) ** 2 / count
    spread = square * np.cov(one, two)
    # Ratios r with a r^2 - 2 b r + c <= 0 cannot be told from the true one.
    a, b, c = two.mean() ** 2 - spread[1, 1], one.mean() * two.mean() - spread[0, 1], one.mean() ** 2 - spread[0, 0]
    root = math.sqrt(max(0.0, b * b - a * c))
    if a > 0:
        return Estimate(ratio, max(0.0, (b - root) / a), (b + root) / a)
    return Estimate(ratio, max(0.0, (b - root) / a) if a < 0 < c else 0.0, math.inf)


def rate_difference(successes: ArrayLike, baseline: ArrayLike, confidence: float = CONFIDENCE) -> Estimate:
    """Return the difference of two success rates over the same episodes, with Newcombe's interval.

    It is the method 10 of R. G. Newcombe, "Improved confidence intervals for the difference between binomial
    proportions based on paired data", Statistics in Medicine 17 (1998): the Wilson intervals of both rates, put
    together with the correlation of the outcomes. Where McNemar's exact test does not find a difference, it is widened
    to hold 0: of 5 episodes that differ and all in one direction nothing is certain.
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
    if discordance(one, two).p >= 1 - confidence:
        low, high = min(low, 0.0), max(high, 0.0)
    return Estimate(difference, max(-1.0, low), min(1.0, high))


def discordance(successes: ArrayLike, baseline: ArrayLike) -> Discordance:
    """Return on how many episodes two brains differed in success, with McNemar's exact test."""
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


def _paired(*samples: NDArray) -> tuple[NDArray, ...]:
    lengths = {len(sample) for sample in samples}
    if len(lengths) > 1:
        raise ValueError(f"Paired samples must have the same length; got {sorted(lengths)}.")
    return samples
