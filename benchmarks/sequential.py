"""How often `bhd-eval --sequential=true` errs, and how many episodes it saves, by simulated outcomes of two brains.

`python -m benchmarks.sequential`. False alarms: two brains with equal success rates, looked at after every pair of
episodes; beside it McNemar's exact test, looked at as often, as by somebody who watches a run and ends it at p < 0.05.
Saving: brains that differ, beside the number of pairs that `bhd-eval --plan=true` fixes in advance for just this
difference, and for one of 10 points.
"""

import math
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from benchmarks._report import Report, parse_options
from bhd_lerobot.evaluation.plan import POWER, discordant_share, pairs_needed
from bhd_lerobot.evaluation.sequential import log_e_value
from bhd_lerobot.evaluation.statistics import CONFIDENCE

ALPHA = 1 - CONFIDENCE
RATES, CORRELATIONS = (0.1, 0.5, 0.8, 0.95), (0.0, 0.25, 0.5)
DIFFERENCES = (0.1, 0.2, 0.3)
AT_MOST = 2  # times the fixed plan: the number of pairs after which the sequential test is given up
_BLOCK = 2_000  # runs that are simulated at once


def sequential_shows(pairs: int) -> NDArray[np.bool_]:
    """Return whether the sequential test is certain, by numbers of pairs that favour either brain."""
    counts = np.arange(pairs + 1)
    return np.asarray(log_e_value(counts[:, None], counts) >= -math.log(ALPHA))


def mcnemar_shows(pairs: int) -> NDArray[np.bool_]:
    """Return whether McNemar's exact test has p < 0.05, likewise."""
    counts = np.arange(pairs + 1)
    total = counts[:, None] + counts
    return np.asarray(2 * binom.cdf(np.minimum(counts[:, None], counts), total, 0.5) < ALPHA)


def ends(
    shows: Sequence[NDArray[np.bool_]], rates: tuple[float, float], correlation: float, runs: int, seed: int
) -> list[NDArray[np.int64]]:
    """Return after how many pairs each test ends each run, shape (runs,), 0 if it never does.

    Args:
        shows: of each test, whether it is certain, by the numbers of pairs that favour either brain.
        rates: success rates of the two brains.
        correlation: of their outcomes.
        runs: number of runs.
        seed: of the outcomes.
    """
    pairs = len(shows[0]) - 1
    discordant, difference = discordant_share(*rates, correlation), rates[0] - rates[1]
    first, rng = (discordant + difference) / 2, np.random.default_rng(seed)
    ended: list[list[NDArray[np.int64]]] = [[] for _ in shows]
    for start in range(0, runs, _BLOCK):
        drawn = rng.random((min(_BLOCK, runs - start), pairs), np.float32)
        better = np.cumsum(drawn < first, axis=1, dtype=np.int16)
        worse = np.cumsum((drawn >= first) & (drawn < discordant), axis=1, dtype=np.int16)
        for found, certain in zip(ended, shows, strict=True):
            hit = certain[better, worse]
            found.append(np.where(hit.any(axis=1), hit.argmax(axis=1) + 1, 0))
    return [np.concatenate(found) for found in ended]


def false_alarms(report: Report, pairs: int, runs: int) -> None:
    """Add a row for each success rate and correlation of two equal brains."""
    tests = sequential_shows(pairs), mcnemar_shows(pairs)
    for rate in RATES:
        for correlation in CORRELATIONS:
            ended = ends(tests, (rate, rate), correlation, runs, seed=0)
            share, watched = (float((one > 0).mean()) for one in ended)
            what = f"equal brains, success {100 * rate:g} %, correlation {correlation:g}: false alarms"
            value = f"{100 * share:.2f} %; McNemar at every pair {100 * watched:.1f} %"
            report.add(what, value, f"at most {100 * ALPHA:g} %", met=share <= ALPHA)
            report.numbers[what] = {"sequential": share, "mcnemar": watched, "pairs": pairs, "runs": runs}


def savings(report: Report, runs: int) -> None:
    """Add a row for each difference and correlation."""
    for correlation in CORRELATIONS:
        planned = pairs_needed(DIFFERENCES[0], discordant_share(0.5 + DIFFERENCES[0], 0.5, correlation))
        for difference in DIFFERENCES:
            rates = (0.5 + difference, 0.5)
            fixed = pairs_needed(difference, discordant_share(*rates, correlation))
            if fixed is None or planned is None:
                raise AssertionError("These differences are shown by some hundred pairs.")
            most = AT_MOST * fixed
            (ended,) = ends([sequential_shows(most)], rates, correlation, runs, seed=1)
            needed = np.where(ended, ended, most)
            shown, mean = float((ended > 0).mean()), float(needed.mean())
            within = float(((ended > 0) & (ended <= fixed)).mean())
            what = f"{100 * rates[0]:g} % beside 50 %, correlation {correlation:g}: pairs of episodes"
            value = (
                f"{mean:.0f} in the mean, {np.median(needed):.0f} in the median, shown in {100 * shown:.0f} % "
                f"({100 * within:.0f} % within the plan); plan {fixed}: {mean / fixed:.2f} x; "
                f"plan for 10 points {planned}: {mean / planned:.2f} x"
            )
            report.add(what, value, f"shown in {100 * POWER:g} %", met=shown >= POWER)
            plans = {"fixed": fixed, "fixed for 10 points": planned}
            report.numbers[what] = {"mean": mean, "shown": shown, "within": within, **plans}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure both; return the exit status."""
    options = parse_options(
        __doc__, arguments, runs=(20_000, "simulated evaluations of each row"), pairs=(500, "of equal brains")
    )
    report = Report(f"Sequential test, {options.runs:,} simulated evaluations a row, alpha {ALPHA:g}")
    false_alarms(report, options.pairs, options.runs)
    savings(report, options.runs)
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
