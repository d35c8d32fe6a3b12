"""The section about fine-tuning: how much of what a shifted world costs do 10 episodes of it bring back?"""

from collections.abc import Sequence

import numpy as np

from benchmarks.results.learning import TOOL, evaluate, reach, record, train, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, rate

GOAL = 0.5
SHOWN = 10  # episodes of the shifted world that are learned from
_RESAMPLES, _SEED = 10_000, 0
# The camera that locates the target is not where it is taken to be: 18 mm off, the same way in every episode.
# Nothing else differs.
_ERROR = "camera_error_m=[0.012,-0.009,0.01]"
SHIFT = (
    "--task.randomisation.enabled=true",
    f"--task.randomisation.{_ERROR}",
    *(f"--task.randomisation.{name}=0" for name in ("sensor_noise_rad", "latency_s")),
)
_SHIFTED = "camera 18 mm off"


def fine_tune(run: Runner, section: Section) -> None:
    """Adapt the policy of the reach section, which is made if it was not yet, to a camera that is off.

    The policy gets the target from that camera. The rule that shows the episodes knows by how much it is off.
    """
    reach(run, Section("reach", ""))
    record(
        run,
        "fine_tune_record",
        "ur5_reach",
        "fine_tune/data",
        episodes=SHOWN,
        options=(*TOOL, "--seed=7", *SHIFT, "--task.hold_s=1.0", f"--brain.{_ERROR}"),
    )
    base = f"--fine_tune={run.path('reach/bc')}"
    seconds = train(run, "fine_tune_train", "fine_tune_ur5_reach", "fine_tune/bc", "fine_tune/data", options=(base,))
    brains = {"base": "reach/bc", "tuned": "fine_tune/bc"}
    original, shifted = (
        evaluate(run, f"fine_tune_{world}", "ur5_reach", brains, baseline="base", options=(*TOOL, *shift))
        for world, shift in (("original", ()), ("shifted", SHIFT))
    )
    before, lost, found = (
        values(results, name, "success")
        for results, name in ((original, "base"), (shifted, "base"), (shifted, "tuned"))
    )
    share, low, high = recovered(before, lost, found)
    for results, name, where in (
        (original, "base", "original world"),
        (shifted, "base", _SHIFTED),
        (shifted, "tuned", _SHIFTED),
        (original, "tuned", "original world"),
    ):
        brain = results["brains"][name]
        what = f"{name}, {where}: success in {len(before)}"
        section.rows.append(Row(what, rate(brain["success"], brain["outcomes"])))
    section.rows += [
        Row(
            f"recovered by {SHOWN} episodes, share of what the shift cost",
            f"{share:.0%} ({low:.0%} to {high:.0%})",
            f"at least {GOAL:.0%}",
            share >= GOAL,
        ),
        Row("time of fine-tuning", f"{seconds:.0f} s"),
    ]
    section.remarks.append(
        "The share is (tuned, shifted - base, shifted) / (base, original - base, shifted) over the same seeds; its "
        "interval is a bootstrap over them, which draws all three outcomes of a seed together."
    )


def recovered(before: Sequence[bool], lost: Sequence[bool], found: Sequence[bool]) -> tuple[float, float, float]:
    """Return which share of what a shift cost was recovered, with its 95 % interval by a paired bootstrap.

    Args:
        before: successes without the shift, by seed.
        lost: with it, of the same policy and the same seeds.
        found: with it, of the policy that was adapted.

    Returns:
        the share, and both ends of its interval; all NaN if the shift cost nothing. Where it costs nothing in a
        resample, the share of that is infinite, to the side of what was gained.
    """
    outcomes = np.array([before, lost, found], float)
    if outcomes.shape[1] == 0 or outcomes[0].mean() <= outcomes[1].mean():
        return float("nan"), float("nan"), float("nan")
    rng = np.random.default_rng(_SEED)
    picks = rng.integers(0, outcomes.shape[1], (_RESAMPLES, outcomes.shape[1]))
    means = np.array([row[picks].mean(axis=1) for row in outcomes])
    cost, gain = means[0] - means[1], means[2] - means[1]
    shares = np.where(gain >= 0, np.inf, -np.inf)
    np.divide(gain, cost, out=shares, where=cost > 0)
    low, high = np.quantile(shares, (0.025, 0.975), method="nearest")
    whole = outcomes.mean(axis=1)
    return float((whole[2] - whole[1]) / (whole[0] - whole[1])), float(low), float(high)
