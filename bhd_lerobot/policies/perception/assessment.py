"""How well a brain saw: what it said at an episode's start beside what stood there."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bhd_lerobot.bodies.tabletop import TableScene

_SAME = 0.05  # [m] what is seen this near to an object is that object
NUMBERS = ("chosen", "wrong", "error_m", "in_50", "in_90", "objects", "seen", "named", "phantoms")


def assess(plan: Mapping[str, Any], scene: TableScene) -> dict[str, float]:
    """Return how well a brain with a perception of its own saw; nothing of one without.

    Returns:
        `chosen`: 1 if it found an object that the instruction means, else 0; `wrong`: 1 if that was another one;
        `error_m`: how far what it chose is from where it said [m]; `in_50` and `in_90`: whether that is within the
        radius that it stated for 50 and 90 %; `objects`: how many there were; `seen`: how many of them it saw;
        `named`: of how many it knew kind and colour; `phantoms`: how many it saw where there was none. Of what was not
        chosen, NaN.
    """
    said = plan.get("seen")
    if said is None:
        return {}
    true = scene.objects
    apart = np.array([[math.dist(one["position"][:2], (other.x, other.y)) for other in true] for one in said])
    apart = apart.reshape(len(said), len(true))
    nearest = apart.argmin(axis=1) if len(true) else np.zeros(len(said), np.intp)
    is_one = apart.min(axis=1, initial=math.inf) < _SAME
    pairs = {int(nearest[place]): place for place in np.flatnonzero(is_one)[::-1]}  # the surest of several stays
    named = sum(true[number].name == said[place]["name"] for number, place in pairs.items())
    numbers = dict.fromkeys(NUMBERS, math.nan)
    numbers |= {"objects": len(true), "seen": len(pairs), "named": named, "phantoms": int((~is_one).sum())}
    chosen = plan.get("chosen")
    numbers["chosen"] = float(chosen is not None)
    if chosen is not None:
        error = float(apart[chosen].min(initial=math.inf))
        is_right = bool(is_one[chosen]) and int(nearest[chosen]) == scene.target_object
        numbers |= {"wrong": float(not is_right), "error_m": error}
        numbers |= {f"in_{share}": float(error <= said[chosen][f"error_{share}_m"]) for share in (50, 90)}
    return numbers
