"""The section about aggregation: what its rounds make of a driver that was cloned, from three seeds."""

from dataclasses import asdict

import numpy as np

from benchmarks.results.learning import SHORTER, aggregation, evaluate, roaming, success_row, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean
from bhd_lerobot.errors import counted
from bhd_lerobot.evaluation.statistics import ratio_of_means

EPISODES, SEEDS, ROUNDS = 1000, (0, 1, 2), 2
_SHORT, _STEPS = (40, 20, 8), 800
_SUCCESS_GOAL, _SCORE_GOAL = 0.985, 0.97


def aggregate(run: Runner, section: Section) -> None:
    """Clone a rule, let the clone drive and the rule say what it would do, and learn from both, in rounds."""
    made = {seed: aggregated(run, seed) for seed in run.seeds(SEEDS)}
    brains = {"clone": f"{_folder(0)}/round_0/policy"}
    brains |= {f"seed_{seed}": policy for seed, (policy, _) in made.items()}
    results = evaluate(
        run,
        "aggregate_eval",
        "turtlebot3_avoid",
        brains,
        rules=("gap_follower",),
        baseline="gap_follower",
        options=roaming(run),
        episodes=EPISODES,
    )
    section.rows += [success_row(results, name) for name in ("gap_follower", "clone")]
    scores = {name: np.array(values(results, name, "score"), float) for name in ("gap_follower", *brains)}
    for seed in made:
        name = f"seed_{seed}"
        success = results["brains"][name]["success"]
        row = success_row(results, name)
        is_met = success["low"] >= _SUCCESS_GOAL
        section.rows.append(Row(row.what, row.value, f"lower end at least {_SUCCESS_GOAL:.1%}", is_met))
        ratio = ratio_of_means(scores[name], scores["gap_follower"])
        what = f"{name} / gap_follower: mean score, paired"
        section.rows.append(Row(what, mean(asdict(ratio)), f"at least {_SCORE_GOAL}", ratio.value >= _SCORE_GOAL))
    rates = [results["brains"][f"seed_{seed}"]["success"]["value"] for seed in made]
    section.rows.append(Row("time from nothing to the first seed's policy", f"{made[0][1]:.0f} s"))
    section.remarks.append(
        f"{counted(len(made), 'seed')} of recording and training; success from {min(rates):.1%} to {max(rates):.1%}. "
        "`clone` learned from episodes of `gap_follower` alone. In the further rounds the last policy drove, the rule "
        "took over before collisions and said in every frame what it would do; the others learned that, from all "
        "episodes so far."
    )


def aggregated(run: Runner, seed: int) -> tuple[str, float]:
    """Clone a rule by aggregation, and return the folder of the policy and how long that took [s]."""
    name, config = f"aggregate_train_{seed}", "dagger_turtlebot3_avoid"
    return aggregation(
        run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, steps=_STEPS, options=SHORTER
    )


def _folder(seed: int) -> str:
    return f"aggregate/seed_{seed}"
