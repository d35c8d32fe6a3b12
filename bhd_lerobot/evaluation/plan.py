"""How many episodes show a difference between two brains."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.stats import binom

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.results import RESULTS_NAME
from bhd_lerobot.evaluation.statistics import CONFIDENCE
from bhd_lerobot.options.parse import read_file

POWER = 0.8
_RATES = (0.05, 0.1, 0.3, 0.5, 0.7, 0.8, 0.85, 0.9, 0.95)
_CORRELATIONS = (0.0, 0.3, 0.6)
_MOST = 2**16  # pairs: beyond, no one waits for the answer


def power_of(pairs: int, difference: float, discordant: float, confidence: float = CONFIDENCE) -> float:
    """Return the probability that McNemar's exact test shows a difference in the right direction.

    `discordant`: share of the pairs in which exactly one of both succeeds, at least the difference.
    """
    counts = np.arange(pairs + 1)
    needed = binom.isf((1 - confidence) / 2, counts, 0.5) + 1
    shown = binom.sf(needed - 1, counts, min(1.0, (1 + difference / discordant) / 2))
    return float(binom.pmf(counts, pairs, discordant) @ shown)


def pairs_needed(
    difference: float, discordant: float, confidence: float = CONFIDENCE, power: float = POWER
) -> int | None:
    """Return the number of pairs with which McNemar's exact test shows a difference with a power; None beyond 2**16."""
    enough = 8
    while power_of(enough, difference, discordant, confidence) < power:
        enough *= 2
        if enough > _MOST:
            return None
    few = enough // 2 if enough > 8 else 0
    while enough - few > 1:
        middle = (few + enough) // 2
        if power_of(middle, difference, discordant, confidence) < power:
            few = middle
        else:
            enough = middle
    return enough


def discordant_share(one: float, other: float, correlation: float) -> float:
    """Return in which share of the pairs exactly one succeeds, by rates and phi coefficient; NaN without one."""
    both = one * other + correlation * math.sqrt(one * (1 - one) * other * (1 - other))
    return math.nan if both > min(one, other) + 1e-12 else max(one + other - 2 * both, abs(one - other))


def print_plan(config: EvalConfig, console: Console) -> None:
    """Print how many episodes of each brain are needed, for assumed success rates and those of earlier results."""
    difference, compared = config.plan_points / 100, len(config.chosen) - 1
    confidence = 1 - (1 - CONFIDENCE) / compared
    table = Table(
        title=f"Episodes of each brain that show a difference of {config.plan_points:g} points",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("success rates [%]", no_wrap=True)
    for correlation in _CORRELATIONS:
        table.add_column(f"correlation {correlation:g}", justify="right")
    for rate in _RATES:
        other = round(rate + difference, 9)
        if other > 1:
            continue
        shares = [discordant_share(rate, other, correlation) for correlation in _CORRELATIONS]
        cells = ["–" if math.isnan(share) else _number(difference, share, confidence) for share in shares]
        table.add_row(f"{100 * rate:g} and {100 * other:g}", *cells)
    console.print(table)
    more = f" Each of {compared} brains is compared with the baseline, at 95 % for all together." * (compared > 1)
    console.print(
        f"Power {100 * POWER:g} %, confidence 95 %, both brains on the same episodes, McNemar's exact test.{more} "
        "Correlation: that of the outcomes of both brains; it is high where they fail in the same scenes. "
        "–: there is none so high with these rates. With --sequential=true set --n_episodes to twice as many: the run "
        "ends as soon as the difference is certain, much earlier if it is larger.",
        soft_wrap=True,
        highlight=False,
    )
    for line in _earlier(config, difference, confidence):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def _number(difference: float, discordant: float, confidence: float) -> str:
    pairs = pairs_needed(difference, max(discordant, difference), confidence)
    return f"{pairs:,}" if pairs is not None else f"over {_MOST:,}"


def _earlier(config: EvalConfig, difference: float, confidence: float) -> list[str]:
    """Return what follows from the results in the output folder, a line for each pair of brains."""
    path = Path(config.output_dir or "").expanduser() / RESULTS_NAME
    if not config.output_dir or not path.is_file():
        return []
    try:
        paired: Mapping[str, Any] = read_file(path)["paired"]
        lines = []
        for label, one in paired.items():
            share = (one["differ"]["better"] + one["differ"]["worse"]) / max(1, one["episodes"])
            needed = _number(difference, share, confidence)
            lines.append(
                f"In {path}, {label} and {one['baseline']} differ in {100 * share:.1f} % of {one['episodes']} "
                f"episodes: with that, {needed} episodes show {config.plan_points:g} points."
            )
        return lines
    except (AttributeError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path} holds no results of bhd-eval: {error!r}. Set another --output_dir, or leave it out."
        ) from error
