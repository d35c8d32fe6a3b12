"""The section about picking from privileged state: what the rounds of aggregation make of a clone, from three seeds."""

from collections.abc import Sequence

from benchmarks.results.learning import TOOL, aggregation, evaluate, seeds_row, success_row
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section
from bhd_lerobot.errors import counted

EPISODES, SEEDS, ROUNDS = 500, (0, 1, 2), 3
_GOAL = 0.97
_SHORT, _STEPS = (120, 60, 8), 2500


def pick(run: Runner, section: Section) -> None:
    """Clone a rule, let the clone drive and the rule say what it would do, and learn from both, in rounds."""
    seeds, seconds, brains = run.seeds(SEEDS), [], {"clone": f"{_folder(0)}/round_0/policy"}
    for seed in seeds:
        name, config = f"pick_train_{seed}", "dagger_ur5_pick"
        brains[f"seed_{seed}"], time = aggregation(
            run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, steps=_STEPS
        )
        seconds.append(time)
    options: Sequence[str] = (*TOOL, "--task.order=random", "--brains.servo.type=pick_servo")
    results = evaluate(
        run,
        "pick_eval",
        "ur5_pick",
        brains,
        rules=("pick", "servo"),
        baseline="servo",
        options=options,
        episodes=EPISODES,
    )
    section.rows += [success_row(results, name) for name in ("pick", "servo", "clone")]
    for seed in seeds:
        row, low = success_row(results, f"seed_{seed}"), results["brains"][f"seed_{seed}"]["success"]["low"]
        section.rows.append(Row(row.what, row.value, f"lower end at least {_GOAL:.0%}", low >= _GOAL))
    section.rows.append(seeds_row(results, [f"seed_{seed}" for seed in seeds]))
    section.rows.append(Row("time from nothing to the first seed's policy", f"{seconds[0]:.0f} s"))
    section.remarks.append(
        "Privileged state: all of them read where the objects are from the simulator, in any order, and a flag that "
        f"says which is meant; none has seen an image or read a word. {counted(len(seeds), 'seed')} of recording and "
        f"training. `clone` learned from episodes of `pick_servo` alone. In {run.size(ROUNDS, 1)} further rounds the "
        "last policy drove, and the rule said in every frame what it would do. A `fault` is a stop by the cerebellum; "
        "the report gives its reason."
    )


def _folder(seed: int) -> str:
    return f"pick/seed_{seed}"
