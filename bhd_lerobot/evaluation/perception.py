"""How well a brain saw: what it said at an episode's start beside what was true then."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bhd_lerobot.bodies.tabletop import OBJECT_FIELDS
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.evaluation import statistics
from bhd_lerobot.evaluation.statistics import Estimate
from bhd_lerobot.policies.manipulation.grasp import read_objects
from bhd_lerobot.policies.manipulation.skills import scene_object
from bhd_lerobot.rollout.types import Episode

_SAME = 0.05  # [m] what is seen this near to an object is that object
NUMBERS = ("chosen", "wrong", "error_m", "in_50", "in_90", "objects", "seen", "named", "phantoms")


def measure_perception(episode: Episode) -> dict[str, float]:
    """Return how well a brain with a perception of its own saw; nothing of one without.

    Returns:
        `chosen`: 1 if it found an object that the instruction means, else 0; `wrong`: 1 if that was another one;
        `error_m`: how far what it chose is from where it said [m]; `in_50` and `in_90`: whether that is within the
        radius that it stated for 50 and 90 %; `objects`: how many there were; `seen`: how many of them it saw;
        `named`: of how many it knew kind and colour; `phantoms`: how many it saw where there was none. Of what was not
        chosen, NaN.
    """
    said = episode.plan.get("seen")
    if said is None or keys.ENVIRONMENT_STATE not in episode.columns:
        return {}
    true = read_objects(episode.columns[keys.ENVIRONMENT_STATE][0].astype(np.float64).reshape(-1, len(OBJECT_FIELDS)))
    apart = np.array([[math.dist(one["position"][:2], other.position[:2]) for other in true] for one in said])
    apart = apart.reshape(len(said), len(true))
    nearest = apart.argmin(axis=1) if len(true) else np.zeros(len(said), np.intp)
    is_one = apart.min(axis=1, initial=math.inf) < _SAME
    pairs = {int(nearest[place]): place for place in np.flatnonzero(is_one)[::-1]}  # the surest of several stays
    named = sum(scene_object(true[number]).name == said[place]["name"] for number, place in pairs.items())
    numbers = dict.fromkeys(NUMBERS, math.nan)
    numbers |= {"objects": len(true), "seen": len(pairs), "named": named, "phantoms": int((~is_one).sum())}
    chosen = episode.plan.get("chosen")
    numbers["chosen"] = float(chosen is not None)
    if chosen is not None:
        error = float(apart[chosen].min(initial=math.inf))
        is_right = bool(is_one[chosen]) and true[int(nearest[chosen])].target
        numbers |= {"wrong": float(not is_right), "error_m": error}
        numbers |= {f"in_{share}": float(error <= said[chosen][f"error_{share}_m"]) for share in (50, 90)}
    return numbers


@dataclass(frozen=True)
class PerceptionSummary:
    """How well a brain saw, over episodes.

    Attributes:
        episodes: in how many it looked.
        chosen: share in which it found an object that the instruction means.
        wrong: of these, share in which it was another one.
        error_m: median, 90 % and 99 % quantile of how far it was from where the brain said [m].
        in_50: share in which it was within the radius stated for 50 %.
        in_90: likewise 90 %.
        seen: share of all objects that it saw.
        named: of these, share of which it knew kind and colour.
        phantoms: how many objects it saw where there was none, in all.
    """

    episodes: int
    chosen: Estimate
    wrong: Estimate
    error_m: tuple[float, float, float]
    in_50: Estimate
    in_90: Estimate
    seen: Estimate
    named: Estimate
    phantoms: int


def summarise_perception(numbers: Sequence[Mapping[str, float]]) -> PerceptionSummary | None:
    """Return the summary of episodes; None if the brain did not look in any."""
    looked = [one for one in numbers if one]
    if not looked:
        return None
    column = {name: np.array([one[name] for one in looked]) for name in NUMBERS}
    chose = column["chosen"] > 0

    def share(name: str) -> Estimate:
        return statistics.wilson(int(column[name][chose].sum()), int(chose.sum()))

    errors = column["error_m"][chose]
    quantiles = np.quantile(errors, (0.5, 0.9, 0.99)) if len(errors) else np.full(3, math.nan)
    objects, seen, named = (int(column[name].sum()) for name in ("objects", "seen", "named"))
    return PerceptionSummary(
        episodes=len(looked),
        chosen=statistics.wilson(int(chose.sum()), len(looked)),
        wrong=share("wrong"),
        error_m=(float(quantiles[0]), float(quantiles[1]), float(quantiles[2])),
        in_50=share("in_50"),
        in_90=share("in_90"),
        seen=statistics.wilson(seen, objects),
        named=statistics.wilson(named, seen),
        phantoms=int(column["phantoms"].sum()),
    )
