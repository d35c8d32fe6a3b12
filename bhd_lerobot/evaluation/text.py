"""An evaluation's numbers as text, for the terminal and for the report."""

import math

from bhd_lerobot.evaluation.perception import PerceptionSummary
from bhd_lerobot.evaluation.results import EvalResults, PairedSummary
from bhd_lerobot.evaluation.statistics import CONFIDENCE, Estimate


def percent(estimate: Estimate, *, sign: bool = False) -> str:
    """Return a rate, or with `sign` a difference of rates, with its interval."""
    if math.isnan(estimate.value):
        return "–"
    form = "+.1f" if sign else ".1f"
    unit = " points" if sign else " %"
    value, low, high = (format(100 * one + 0.0, form) for one in (estimate.value, estimate.low, estimate.high))
    return f"{value}{unit} ({low} to {high})".replace("-", "−")


def number(estimate: Estimate, digits: int, *, sign: bool = False) -> str:
    """Return a number with its interval, if it has one."""
    if math.isnan(estimate.value):
        return "–"
    form = f"{'+' if sign else ''}.{digits}f"
    if math.isnan(estimate.low):
        return format(estimate.value, form).replace("-", "−")
    return f"{estimate.value:{form}} ({estimate.low:{form}} to {estimate.high:{form}})".replace("-", "−")


def sentences(results: EvalResults) -> list[str]:
    """Return the results, a sentence for each brain."""
    found = []
    for label, one in results.brains.items():
        if not one.episodes:
            found.append(f"{label} ran no episode.")
            continue
        text = f"{label} succeeded in {one.successes} of {one.episodes} episodes, {percent(one.success)}"
        if one.starts < one.episodes:
            began = "all of which began alike" if one.starts == 1 else f"which began in {one.starts} different states"
            text += f", {began}: they are not independent, and the intervals are too narrow"
        pair = results.paired.get(label)
        if pair is not None and pair.episodes:
            text += f"; compared with {pair.baseline} {verdict(pair)}"
        found.append(text + ".")
    return found


def verdict(pair: PairedSummary) -> str:
    """Return whether a brain is better than the baseline, as text, by the intervals of success and score, or return."""
    rate = _direction(pair.success, "more often", "less often", "")
    points = f" ({percent(pair.success, sign=True).split(' (')[0]})" if rate else ""
    if pair.e_value is not None:  # what is known of the scores holds for a fixed number of episodes only
        return f"it succeeds {rate}{points}" if rate else "no difference in success is certain"
    what, estimate = ("return", pair.rewards["reward"]) if pair.rewards else ("score", pair.score)
    score = _direction(estimate, f"a higher {what}", f"a lower {what}", "")
    times = "" if math.isnan(pair.ratio.value) else f", {pair.ratio.value:.2f} times the mean"
    clauses = [
        f"it succeeds {rate}{points}" if rate else "no difference in success is certain",
        f"it has {score}{times}" if score else f"none in {what}" if not rate else f"no difference in {what} is certain",
    ]
    return " and ".join(clauses)


def sequential_sentence(results: EvalResults) -> str:
    """Return what a sequential test has found, and which intervals are exact."""
    needed = len(results.paired) / (1 - CONFIDENCE)
    values = ", ".join(f"{label} {pair.e_value:.3g}" for label, pair in results.paired.items())
    pairs = min(pair.episodes for pair in results.paired.values())
    ended = (
        f"The sequential test ended the run after {pairs} of {results.requested} pairs of episodes"
        if results.is_decided
        else f"The sequential test is not certain after {pairs} pairs of episodes"
    )
    return (
        f"{ended}: e-value against equal success {values}; a difference is certain from {needed:g} on. The intervals "
        "of differences in success hold whenever the run ends; all others are for a number of episodes that was fixed "
        "before, and are not exact."
    )


def _direction(estimate: Estimate, above: str, below: str, neither: str) -> str:
    if estimate.low > 0:
        return above
    return below if estimate.high < 0 else neither


def perception_sentence(one: PerceptionSummary) -> str:
    """Return the summary as text."""
    chose = f"chose an object in {percent(one.chosen)} of {one.episodes} episodes"
    if one.chosen.value == 0:
        return chose
    median, most, _ = (1000 * value for value in one.error_m)
    return (
        f"{chose}, the wrong one in {percent(one.wrong)}; median error {median:.1f} mm, 90 % below {most:.1f} mm; "
        f"within the radius stated for 90 % in {percent(one.in_90)}"
    )
