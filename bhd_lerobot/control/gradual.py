"""Changes that change gradually: the arithmetic that the jerk limits of bases and of arms share."""

import numpy as np
from numpy.typing import NDArray


def largest_change(way: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest change of this tick from which changes can still fall to nothing at the end of a way.

    They may fall by 1 from tick to tick. Changes of 1, 2, … k add up to k (k + 1) / 2; what is left of the way is
    spread over these ticks.

    Args:
        way: what the changes have to add up to, not negative, in units of the largest difference of two changes; any
            shape. It is replaced by the result.
    """
    whole = way * 2.0
    whole += 0.25
    np.sqrt(whole, out=whole)
    whole -= 0.5
    np.floor(whole, out=whole)
    # whole + (way - whole (whole + 1) / 2) / (whole + 1)
    way /= whole + 1.0
    whole *= 0.5
    way += whole
    return way
