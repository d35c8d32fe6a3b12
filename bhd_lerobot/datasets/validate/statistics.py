"""Whether statistics are those of the data, within the rounding of single precision.

LeRobot adds the frames of an episode up in the precision of the column, float32 as a rule, one after the other, and
takes a variance as the mean of the squares minus the square of the mean. Of n numbers the rounding is at most n / 2
steps of float32 at the size of the largest. For a joint that rests at 1.57 rad this makes the mean wrong in the sixth
digit, and its standard deviation 1e-3 instead of 0; for a column of 10000 +- 0.1 nothing is left of the deviation. What
lies within these bounds is rounding, and everything beyond them is of other data. Rounding matters all the same where
the deviation is another one than that of the data: by it policies are normalised.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNREAD = ("index", "episode_index", "task_index")
"""Columns that LeRobot renumbers when it merges, splits or deletes, without their statistics. No policy reads them,
so nothing wrong is learned from these."""

_RANGE = 1e-3  # of the range: histograms and samples of other programs
_ROUNDING = 2.0**-24  # relative, of one operation in single precision
_MORE = 4  # operations beside the sum
_TINY = 1e-6
_TOLERATED = 0.1  # relative, of a standard deviation: what is learned hardly depends on it
_BLOCK = 1 << 17  # numbers
_STEPS = 8  # of single precision: a number that changes by less is at rest


@dataclass
class Moments:
    """Least and largest value, mean, and sum of squares about it, of each number of a feature, each of shape (d,)."""

    low: Array
    high: Array
    mean: Array
    squares: Array
    frames: int

    @classmethod
    def of(cls, values: NDArray[Any]) -> Self:
        """Return those of finite values, shape (n, d)."""
        found: Self | None = None
        low, high = values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64)
        step = max(1, _BLOCK // values.shape[1])
        for start in range(0, len(values), step):  # blocks that fit the cache, and not all in double precision at once
            block = values[start : start + step].astype(np.float64)
            mean = block.mean(axis=0)
            block -= mean
            part = cls(low, high, mean, np.einsum("ij,ij->j", block, block), len(block))
            if found is None:
                found = part
            else:
                found.add(part)
        assert found is not None
        return found

    def add(self, other: "Moments") -> None:
        """Take in those of more frames."""
        np.minimum(self.low, other.low, out=self.low)
        np.maximum(self.high, other.high, out=self.high)
        frames, apart = self.frames + other.frames, other.mean - self.mean
        self.squares += other.squares + apart**2 * (self.frames * other.frames / frames)
        self.mean += apart * (other.frames / frames)
        self.frames = frames

    @property
    def variance(self) -> Array:
        """The variance of each number, shape (d,)."""
        return self.squares / self.frames


def wrong_statistic(stored: Mapping[str, Array], found: Moments, longest: int) -> str | None:
    """Return the name of the first statistic that is not that of the data; None if all are.

    Args:
        stored: statistics by name, each of shape (d,); what is not there is not judged.
        longest: frames of the longest episode; LeRobot computes the statistics of one at a time.
    """
    mean, variance = found.mean, found.variance
    size = np.maximum(np.abs(found.low), np.abs(found.high))
    rounding = _ROUNDING * (longest + _MORE)
    slack = _RANGE * (found.high - found.low) + _TINY
    # The squares and, twice, the mean are rounded; the root of what that leaves is far more than it where there is no
    # deviation. A deviation that was rounded to nothing is fine, too.
    of_variance = 3 * rounding * size**2
    bounds = {
        "min": (found.low - _ROUNDING * size, found.low + _ROUNDING * size),
        "max": (found.high - _ROUNDING * size, found.high + _ROUNDING * size),
        "mean": (mean - rounding * size, mean + rounding * size),
        "std": (np.sqrt(np.maximum(variance - of_variance, 0)), np.sqrt(variance + of_variance)),
    }
    for name, (least, most) in bounds.items():
        if name not in stored:
            continue
        if stored[name].shape != mean.shape or not np.all(
            (least - slack <= stored[name]) & (stored[name] <= most + slack)
        ):
            return name
    return None


def wrong_deviations(stored: Array, found: Moments) -> tuple[NDArray[np.bool_], Array]:
    """Return which standard deviations would change what is learned, and those of the data, each of shape (d,)."""
    deviation = np.sqrt(found.variance)
    size = np.maximum(np.abs(found.low), np.abs(found.high))
    is_at_rest = found.high - found.low <= _STEPS * _ROUNDING * size
    is_wrong = (np.abs(stored - deviation) > _TOLERATED * deviation) & ~is_at_rest
    return is_wrong | ((stored == 0) & (found.high > found.low)), deviation
