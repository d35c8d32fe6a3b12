"""A test of two brains that may be looked at after every pair of episodes, and ends when the answer is certain. Pure.

Of pairs in which exactly one brain succeeds, each favours either brain with probability 1/2 if both are equally good.
The e-value is what a gambler has who started with 1 and bet on one side of this coin, averaged over all stakes: its
mean is 1 if the brains are equal, whenever the run is stopped, and the probability that it ever reaches 1 / alpha is at
most alpha (J. Ville, "Étude critique de la notion de collectif", 1939). The confidence sequence holds every difference
against which the same bets have not won that much: I. Waudby-Smith and A. Ramdas, "Estimating means of bounded random
variables by betting", Journal of the Royal Statistical Society B 86 (2024).
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import betaln, logsumexp, roots_legendre

from bhd_lerobot.evaluation.statistics import CONFIDENCE, Estimate

_NODES, _WEIGHTS = map(np.asarray, roots_legendre(256))  # of the stakes: a sum over them is exact up to 511 pairs
_GRID = np.arange(-99, 100) / 100  # differences that are tried first
_EDGE = 1 - 1e-9  # the largest difference against which there are bets


def log_e_value(better: int | NDArray, worse: int | NDArray) -> NDArray[np.float64]:
    """Return the logarithm of the e-value against equality, by the pairs in which only one or the other succeeded."""
    found: NDArray[np.float64] = betaln(np.add(better, 1), np.add(worse, 1)) + np.add(better, worse) * math.log(2)
    return found


def confidence_sequence(better: int, worse: int, same: int, confidence: float = CONFIDENCE) -> Estimate:
    """Return the difference of two success rates with an interval that holds whenever the run is stopped.

    It excludes 0 if and only if the e-value has reached 1 / (1 - confidence).
    """
    count = better + worse + same
    if count == 0:
        return Estimate(math.nan, -1.0, 1.0)
    value, limit = (better - worse) / count, -math.log(1 - confidence)
    # No bet against what was observed has won.
    grid = np.union1d(_GRID, np.clip([-1.0, value, 1.0], -_EDGE, _EDGE))
    inside = np.flatnonzero(_log_wealth(grid, better, worse, same) < limit)
    first, last = int(inside[0]), int(inside[-1])

    def excess(difference: float) -> float:
        return float(_log_wealth(np.array([difference]), better, worse, same)[0]) - limit

    low = brentq(excess, grid[first - 1], grid[first]) if first else -1.0
    high = brentq(excess, grid[last], grid[last + 1]) if last + 1 < len(grid) else 1.0
    return Estimate(value, float(low), float(high))


def _log_wealth(differences: NDArray[np.float64], better: int, worse: int, same: int) -> NDArray[np.float64]:
    """Return the logarithm of what the bets against each difference have won, of its shape."""
    difference = differences[:, None]
    # A stake s turns 1 into 1 + s (x - difference), x = 1, 0, -1; the largest stakes are those that cannot end below 0.
    least, most = -1 / (1 - difference), 1 / (1 + difference)
    stakes = least + (most - least) * (1 + _NODES) / 2
    with np.errstate(divide="ignore"):
        won = sum(
            number * np.log1p(stakes * (outcome - difference))
            for outcome, number in ((1, better), (-1, worse), (0, same))
            if number
        )
    found: NDArray[np.float64] = logsumexp(won, axis=1, b=_WEIGHTS / 2)
    return found
