"""The section about aggregation: what one round of it makes of a driver that was cloned, from three training seeds."""

from dataclasses import asdict

import numpy as np

from benchmarks.results.learning import TRAIL, evaluate, record, success_row, train, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean
from bhd_lerobot.evaluation.statistics import ratio_of_means

EPISODES, SEEDS = 1000, (0, 1, 2)
_EXPERT = ("--dataset.expert_action=true", *TRAIL)
_SUCCESS_GOAL, _SCORE_GOAL = 0.985, 0.97


def aggregate(run: Runner, section: Section) -> None:
    """Clone a rule, let the clone drive and the rule say what it would do, and learn from both."""
    rule = ("--seed=100", "--brain.type=gap_follower", *_EXPERT)
    record(run, "aggregate_record", "turtlebot3_avoid", "aggregate/expert", episodes=400, options=rule)
    train(run, "aggregate_clone", "bc_turtlebot3_avoid", "aggregate/clone", "aggregate/expert")
    learner = ("--seed=200", f"--brain.learner.path={run.path('aggregate/clone')}", *_EXPERT)
    record(run, "aggregate_drive", "turtlebot3_avoid_dagger", "aggregate/driven", episodes=200, options=learner)
    parts = [str(run.path(f"aggregate/{name}")) for name in ("expert", "driven")]
    run.run("aggregate_merge", ["bhd-data", "merge", *parts, "--output", str(run.path("aggregate/both"))])
    for seed in SEEDS:
        options = ("--dataset.repo_id=bhd/aggregate", "--selection.expert_action=true", f"--seed={seed}")
        train(run, f"aggregate_train_{seed}", "bc_turtlebot3_avoid", _folder(seed), "aggregate/both", options=options)
    brains = {"clone": "aggregate/clone", **{f"seed_{seed}": _folder(seed) for seed in SEEDS}}
    results = evaluate(
        run,
        "aggregate_eval",
        "turtlebot3_avoid",
        brains,
        rules=("gap_follower",),
        baseline="gap_follower",
        options=TRAIL,
        episodes=EPISODES,
    )
    section.rows += [success_row(results, name) for name in ("gap_follower", "clone")]
    scores = {name: np.array(values(results, name, "score"), float) for name in ("gap_follower", *brains)}
    for seed in SEEDS:
        name = f"seed_{seed}"
        success = results["brains"][name]["success"]
        row = success_row(results, name)
        is_met = success["low"] >= _SUCCESS_GOAL
        section.rows.append(Row(row.what, row.value, f"lower end at least {_SUCCESS_GOAL:.1%}", is_met))
        ratio = ratio_of_means(scores[name], scores["gap_follower"])
        what = f"{name} / gap_follower: mean score, paired"
        section.rows.append(Row(what, mean(asdict(ratio)), f"at least {_SCORE_GOAL}", ratio.value >= _SCORE_GOAL))
    rates = [results["brains"][f"seed_{seed}"]["success"]["value"] for seed in SEEDS]
    seconds = sum(one.seconds for one in run.commands[:5])
    section.rows.append(Row("time from nothing to the first seed's policy", f"{seconds:.0f} s"))
    section.remarks.append(
        f"{len(SEEDS)} seeds of the training; success from {min(rates):.1%} to {max(rates):.1%}. `clone` learned "
        "from 400 episodes of `gap_follower` alone. It drove 200 more, in which the rule took over before collisions "
        "and said in every frame what it would do; the others learned that, from all 600."
    )


def _folder(seed: int) -> str:
    return f"aggregate/seed_{seed}"
