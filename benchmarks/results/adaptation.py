"""The sections about fine-tuning: how much of what a shifted world costs do a few episodes of it bring back?"""

from collections.abc import Sequence

import numpy as np

from benchmarks.results.learning import TOOL, evaluate, reach, record, train, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, rate
from benchmarks.results.seeing import record_tables, train_perception

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
TABLES, _CAMERA_GOAL = 20, 0.8
# Light, colours and sizes vary; the camera stands still in all episodes: where it was, or elsewhere.
_STILL = ("--task.randomisation.enabled=true", *(f"--task.randomisation.camera_{name}=0" for name in ("m", "rad")))
_MOVED = (
    "--task.randomisation.camera_shift_m=[0.02,-0.01,0.02]",
    "--task.randomisation.camera_turn_rad=[0.05,-0.06,0.039]",
)


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


def move_camera(run: Runner, section: Section) -> None:
    """Adapt the first perception of the section `see`, which is made if it was not yet, to a camera that was moved."""
    record_tables(run)
    base = train_perception(run, 0)
    moved = "camera/tables"
    options = ("--seed=31", *_STILL, *_MOVED)
    record(run, "camera_record", "ur5_look", moved, episodes=TABLES, options=options)
    start = (f"--fine_tune={run.path(base)}",)
    seconds = train(run, "camera_train", "fine_tune_perception", "camera/perception", moved, options=start)
    brains = []
    for name, folder in (("base", base), ("tuned", "camera/perception")):
        brains += [f"--brains.{name}.type=language", f"--brains.{name}.perception.path={run.path(folder)}"]
    brains += ["--robot.camera=true", "--task.language=any", "--videos=0"]
    original, elsewhere = (
        evaluate(run, f"camera_{world}", "ur5_pick", {}, rules=("base", "tuned"), baseline="base", options=options)
        for world, options in (("original", (*brains, *_STILL)), ("moved", (*brains, *_STILL, *_MOVED)))
    )
    before, lost, found = (
        values(results, name, "success")
        for results, name in ((original, "base"), (elsewhere, "base"), (elsewhere, "tuned"))
    )
    share, low, high = recovered(before, lost, found)
    for results, name, where in (
        (original, "base", "camera where it was"),
        (elsewhere, "base", "camera moved by 3 cm and 5 deg"),
        (elsewhere, "tuned", "camera moved by 3 cm and 5 deg"),
    ):
        brain = results["brains"][name]
        section.rows.append(
            Row(f"{name}, {where}: success in {len(before)}", rate(brain["success"], brain["outcomes"]))
        )
    section.rows += [
        Row(
            f"recovered by {TABLES} tables, share of what the move cost",
            f"{share:.0%} ({low:.0%} to {high:.0%})",
            f"at least {_CAMERA_GOAL:.0%}",
            share >= _CAMERA_GOAL,
        ),
        Row("time of fine-tuning", f"{seconds:.0f} s"),
    ]
    section.remarks.append(
        f"A table is one image with the true poses of what stands there; {TABLES} were seen through the camera where "
        "it is now. From them was found where that is (`fine_tune_camera`); then the weights were trained further. The "
        "tuned perception looks from where the camera was moved to, and is not meant for where it was before."
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
