"""Whether statistics are those of the data, within the rounding of single precision.

LeRobot adds the frames of an episode up in the precision of the column, float32 as a rule, one after the other, and
takes a variance as the mean of the squares minus the square of the mean. Of n numbers the rounding is at most n / 2
steps of float32 at the size of the largest. For a joint that rests at 1.57 rad this makes the mean wrong in the sixth
digit, and its standard deviation 1e-3 instead of 0; for a column of 10000 +- 0.1 nothing is left of the deviation. What
lies within these bounds is no fault of the dataset, and everything beyond them is of other data.
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


@dataclass
class Moments:
    """Least and largest value, sum, and sum of squares of each number of a feature, each of shape (d,)."""

    low: Array
    high: Array
    total: Array
    squares: Array

    @classmethod
    def of(cls, values: NDArray[Any]) -> Self:
        """Return those of finite values, shape (n, d)."""
        return cls(
            values.min(axis=0).astype(np.float64),
            values.max(axis=0).astype(np.float64),
            values.sum(axis=0, dtype=np.float64),
            np.einsum("ij,ij->j", values, values, dtype=np.float64),
        )

    def add(self, other: "Moments") -> None:
        """Take in those of more frames."""
        np.minimum(self.low, other.low, out=self.low)
        np.maximum(self.high, other.high, out=self.high)
        self.total += other.total
        self.squares += other.squares


def wrong_statistic(stored: Mapping[str, Array], found: Moments, frames: int, longest: int) -> str | None:
    """Return the name of the first statistic that is not that of the data; None if all are.

    Args:
        stored: statistics by name, each of shape (d,); what is not there is not judged.
        found: what was read.
        frames: how many frames that was.
        longest: frames of the longest episode; LeRobot computes the statistics of one at a time.
    """
    mean = found.total / frames
    variance = np.maximum(found.squares / frames - mean**2, 0)
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
