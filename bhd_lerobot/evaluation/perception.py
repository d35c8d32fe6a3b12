"""How well a brain saw, over episodes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bhd_lerobot.evaluation import statistics
from bhd_lerobot.evaluation.statistics import Estimate
from bhd_lerobot.policies.perception.assessment import NUMBERS


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
