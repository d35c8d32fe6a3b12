"""The section about picking from privileged state: what the rounds of aggregation make of a clone, from three seeds."""

from typing import Any

from benchmarks.results.learning import (
    SHORTER_PICKS,
    TOOL,
    Aggregated,
    aggregation,
    beside_rows,
    evaluate,
    picking,
    rounds_rows,
    seeds_rows,
    success_row,
    summary,
    time_rows,
)
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section
from benchmarks.results.trainings import SEEDS, each

EPISODES, ROUNDS = 500, 3
_GOAL = 0.97
_ANY_ORDER = "--task.order=random"
_RULES = ("pick", "servo")
# Of a short run. What the corrections add is not learned from fewer episodes, or in fewer steps, of which small batches
# are more in the same time.
_SHORT, _FEW = (100, 100, 8), ("--steps=8000", "--batch_size=64")
_FEW_EPISODES = 48


def pick(run: Runner, section: Section) -> None:
    """Clone a rule, let the clone drive and the rule say what it would do, and learn from both, in rounds."""
    driving = (*TOOL, _ANY_ORDER, *picking(run))

    def learn(seed: int) -> dict[str, Any]:
        policy, seconds, rounds = _learned(run, seed)
        name = f"seed_{seed}"
        results = evaluate(
            run,
            f"pick_eval/{name}",
            "ur5_pick",
            {name: policy},
            options=driving,
            episodes=EPISODES,
            few=_FEW_EPISODES,
        )
        return {**summary(results, name), "seconds": seconds, "rounds": rounds}

    def others(seed: int) -> dict[str, Any]:
        _learned(run, seed)
        results = evaluate(
            run,
            f"pick_eval/others/seed_{seed}",
            "ur5_pick",
            {"clone": f"{_folder(seed)}/round_0/policy"},
            rules=_RULES,
            options=(*driving, "--brains.servo.type=pick_servo"),
            episodes=EPISODES,
            few=_FEW_EPISODES,
        )
        return summary(results, *_RULES, "clone")

    made = each(run, section, "pick", SEEDS, learn)
    beside = each(run, section, "pick_others", SEEDS, others)
    first, *_ = beside.values()
    section.rows += [success_row(first, name, privileged=True) for name in _RULES]
    section.rows += beside_rows(beside, "clone", privileged=True)
    for seed, results in made.items():
        row = success_row(results, f"seed_{seed}", privileged=True)
        low = results["brains"][f"seed_{seed}"]["success"]["low"]
        section.rows.append(Row(row.what, row.value, f"lower end at least {_GOAL:.0%}", low >= _GOAL))
    section.rows += seeds_rows(made)
    section.rows += rounds_rows(made)
    section.rows += time_rows(made)
    section.remarks.append(
        "Privileged state: all of them read where the objects are from the simulator, in any order, and a flag that "
        "says which is meant; none has seen an image or read a word: deaf and blind by construction. Each seed is one "
        "of recording and training. `clone_N` learned from episodes of `pick_servo` alone. In "
        f"{run.size(ROUNDS, 1)} further rounds the last policy drove, and the rule said in every frame what it would "
        "do. A `fault` is a stop by the cerebellum; the report gives its reason."
    )


def _learned(run: Runner, seed: int) -> Aggregated:
    name, config = f"pick_train_{seed}", "dagger_ur5_pick"
    few = _FEW if run.is_short else ()
    return aggregation(
        run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, policy=few, options=SHORTER_PICKS
    )


def _folder(seed: int) -> str:
    return f"pick/seed_{seed}"
