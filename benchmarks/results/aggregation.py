"""The section about aggregation: what its rounds make of a driver that was cloned, from three seeds."""

from dataclasses import asdict
from typing import Any

from benchmarks.results.learning import (
    SHORTER,
    Aggregated,
    aggregation,
    beside_rows,
    evaluate,
    roaming,
    rounds_rows,
    scores,
    seeds_rows,
    success_row,
    summary,
    time_rows,
)
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean
from benchmarks.results.trainings import SEEDS, each
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.evaluation.statistics import ratio_of_means

EPISODES, ROUNDS = 1000, 3
_SHORT, _STEPS = (40, 20, 8), 800
_SUCCESS_GOAL, _SCORE_GOAL = 0.985, 0.97
_RULE = "gap_follower"


def aggregate(run: Runner, section: Section) -> None:
    """Clone a rule, let the clone drive and the rule say what it would do, and learn from both, in rounds."""

    def clone(seed: int) -> dict[str, Any]:
        return _evaluate(run, "clone", f"{_folder(seed)}/round_0/policy", where=f"clone/seed_{seed}")

    made = _learned(run, section)
    clones = each(run, section, "aggregate_clone", SEEDS, clone)
    first, *_ = made.values()
    section.rows.append(success_row(first, _RULE))
    section.rows += beside_rows(clones, "clone", privileged=True)
    for seed, results in made.items():
        name = f"seed_{seed}"
        row, success = success_row(results, name, privileged=True), results["brains"][name]["success"]
        is_met = success["low"] >= _SUCCESS_GOAL
        section.rows.append(Row(row.what, row.value, f"lower end at least {_SUCCESS_GOAL:.1%}", is_met))
        ratio = ratio_of_means(scores(results, name), scores(results, _RULE), within=SCORE_RANGE)
        what = f"{name} / {_RULE}: mean score, paired"
        section.rows.append(Row(what, mean(asdict(ratio)), f"at least {_SCORE_GOAL}", ratio.value >= _SCORE_GOAL))
    section.rows += seeds_rows(made)
    section.rows += rounds_rows(made)
    section.rows += time_rows(made)
    section.remarks.append(
        "Each seed is one of recording and training. `clone_N` learned from episodes of `gap_follower` alone. In the "
        "further rounds the last policy drove, the rule took over before collisions and said in every frame what it "
        "would do; the others learned that, from all episodes so far. The rule that taught them keeps 0.08 m away "
        "from things, `gap_follower` of this table 0.05 m. Privileged is what ground they have visited "
        "(`task.trail`), which the task computes from the robot's true pose; of obstacles they know what the lidar "
        "measures. There is no image and no instruction: deaf and blind by construction. The policy's modes and how "
        "far the rule keeps away were chosen after policies had failed in some of these episodes, which favours the "
        "numbers (docs/how_to/dagger.md)."
    )


def beside_rule(run: Runner) -> Any:
    """Return what the section measures of the rule; its commands are shown there."""
    commands = list(run.commands)
    first, *_ = _learned(run, Section("aggregate", "")).values()
    run.commands = commands
    return first


def _learned(run: Runner, section: Section) -> dict[int, Any]:
    def learn(seed: int) -> dict[str, Any]:
        policy, seconds, rounds = aggregated(run, seed)
        return {**_evaluate(run, f"seed_{seed}", policy, _RULE), "seconds": seconds, "rounds": rounds}

    return each(run, section, "aggregate", SEEDS, learn)


def aggregated(run: Runner, seed: int) -> Aggregated:
    """Clone a rule by aggregation."""
    name, config = f"aggregate_train_{seed}", "dagger_turtlebot3_avoid"
    return aggregation(
        run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, steps=_STEPS, options=SHORTER
    )


def _evaluate(run: Runner, name: str, policy: str, *rules: str, where: str = "") -> dict[str, Any]:
    results = evaluate(
        run,
        f"aggregate_eval/{where or name}",
        "turtlebot3_avoid",
        {name: policy},
        rules=rules,
        baseline=next(iter(rules), name),
        options=roaming(run),
        episodes=EPISODES,
    )
    return summary(results, *rules, name)


def _folder(seed: int) -> str:
    return f"aggregate/seed_{seed}"
