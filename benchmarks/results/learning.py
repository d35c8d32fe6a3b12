"""The sections about what is learned: recorded, trained and evaluated by the commands that a user has."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import yaml

from benchmarks.results.runner import REPOSITORY, Runner
from benchmarks.results.section import Row, Section, mean, over_seeds, rate
from benchmarks.results.trainings import SEEDS, each
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.evaluation.statistics import mean_difference

EPISODES = 500
TOOL = ("--robot.action_space=tool", "--robot.tool_pose=true")
_RULE = "avoidance"
_REACH_EPISODES, _FEW_EPISODES = (250, 750, 1500), (60, 240)
# A short run learns less exactly, and is asked for less.
_COARSE = ("--task.tolerance_m=0.02", "--task.tolerance_deg=10")
_FEW_REACH = (
    *("--steps=1500", "--eval_steps=1500", "--batch_size=256"),
    *("--policy.hidden_dims=[256,256,256]", "--policy.optimizer_lr=2e-3"),
)
_FEW = ("--steps=2500", "--eval_steps=2500")
SHORTER = ("--task.duration_s=30",)  # drives of a short run
SHORTER_PICKS = ("--task.duration_s=8",)  # a pick takes 5 s; those that are stuck would be most of the frames
_AVOID_TRAIN_S = 120
_HELPED = "dagger"
_REACH_GOAL = 0.97
_TIME_GOAL_S = 7200


def avoid(run: Runner, section: Section) -> None:
    """Clone the simple rule of the avoid task."""
    shorter = SHORTER if run.is_short else ()
    options = ("--seed=100", *shorter)
    record(run, "avoid_record", "turtlebot3_avoid", "avoid/data", episodes=run.size(200, 60), options=options)

    def learn(seed: int) -> dict[str, Any]:
        policy, own, name = f"avoid/seed_{seed}", (f"--seed={seed}",), f"seed_{seed}"
        seconds = train(
            run, f"avoid_train_{seed}", "bc_turtlebot3_avoid", policy, "avoid/data", options=own, short=_FEW
        )
        results = evaluate(
            run,
            f"avoid_eval/{name}",
            "turtlebot3_avoid",
            {name: policy},
            rules=(_RULE,),
            baseline=_RULE,
            options=shorter,
        )
        return {**summary(results, _RULE, name), "seconds": seconds}

    made = each(run, section, "avoid", SEEDS, learn)
    first, *_ = made.values()
    section.rows += [success_row(first, _RULE), _score_row(first, _RULE)]
    for seed, results in made.items():
        section.rows += _driving_rows(results, f"seed_{seed}")
    section.rows += seeds_rows(made)
    section.remarks.append(
        "Each seed is one of training, on the same episodes of `avoidance`. There is no image and no instruction: deaf "
        "and blind by construction."
    )


def _driving_rows(results: Any, name: str) -> list[Row]:
    """Return the rows of a training seed of the section `avoid`."""
    lost = {one: int(brain["episodes"] - brain["successes"]) for one, brain in results["brains"].items()}
    difference, more = (
        mean_difference(scores(results, name), scores(results, _RULE), within=SCORE_RANGE),
        lost[name] - lost[_RULE],
    )
    seconds = results["seconds"]
    return [
        success_row(results, name),
        _score_row(results, name),
        Row(
            f"{name}: time of training",
            f"{seconds:.0f} s",
            f"at most {_AVOID_TRAIN_S} s",
            seconds <= _AVOID_TRAIN_S,
        ),
        Row(
            f"{name} - avoidance, its teacher: mean score, paired",
            mean(asdict(difference), "+"),
            "upper end at least 0",
            math.isnan(difference.high) or difference.high >= 0,
        ),
        Row(f"{name}: failures beyond its teacher's", str(more), "at most 0", more <= 0),
    ]


def _score_row(results: Any, name: str) -> Row:
    return Row(f"{name}: mean score", mean(results["brains"][name]["means"]["score"]))


def reach(run: Runner, section: Section) -> None:
    """Clone a rule on the reach task, from few to many episodes, and let it help the clone where that gets stuck."""
    numbers = reach_numbers(run)
    recorded = {episodes: record_reach(run, episodes) for episodes in numbers}

    def learn(seed: int) -> dict[str, Any]:
        seconds = {f"bc_{episodes}": recorded[episodes] + train_reach(run, seed, episodes) for episodes in numbers}
        folders = {f"bc_{episodes}": reach_folder(seed, episodes) for episodes in numbers}
        folders[_HELPED], seconds[_HELPED], _ = aggregation(
            run,
            f"reach_dagger_{seed}",
            "dagger_ur5_reach",
            f"reach/seed_{seed}/dagger",
            seed=seed,
            rounds=1,
            short=(numbers[-1], numbers[-1], 8),  # from fewer nothing is seen to be learned
            policy=_FEW_REACH if run.is_short else (),
            options=_COARSE,
        )
        results = evaluate(
            run, f"reach_eval/seed_{seed}", "ur5_reach", folders, rules=("reach",), options=reaching(run), few=32
        )
        return {**summary(results, "reach", *folders), "seconds": seconds}

    made = each(run, section, "reach", SEEDS, learn)
    first, *_ = made.values()
    section.rows.append(success_row(first, "reach"))
    for name in (*(f"bc_{episodes}" for episodes in numbers), _HELPED):
        goal = _REACH_GOAL if name in (f"bc_{numbers[-1]}", _HELPED) else None
        for seed, results in made.items():
            section.rows.append(success_row(results, name, goal, shown=f"seed {seed}, {name}"))
        section.rows += seeds_rows(made, name, name)
        seconds = ", ".join(f"{results['seconds'][name]:.0f} s" for results in made.values())
        section.rows.append(Row(f"{name}: time from nothing", seconds))
    section.remarks.append(
        "`bc_N` learned from N episodes, all with the same number of steps; each seed is one of the training. `dagger` "
        f"learned from {numbers[-1]} others and from those in which the first policy drove and the rule took over "
        "where that got stuck; each seed is one of recording, too. What as many further episodes of the rule alone "
        "would do was not measured. All are told where the target is by the simulator (privileged state). There is no "
        "image and no instruction: deaf and blind by construction."
    )


def reach_folder(seed: int, episodes: int) -> str:
    """Return where what learned from so many episodes is."""
    return f"reach/seed_{seed}/bc_{episodes}"


def reach_numbers(run: Runner) -> Sequence[int]:
    """Return from how many episodes it is learned to reach; the last number is the recipe's."""
    return _FEW_EPISODES if run.is_short else _REACH_EPISODES


def reaching(run: Runner) -> tuple[str, ...]:
    """Return the options of episodes of the reach task."""
    return *TOOL, *(_COARSE if run.is_short else ())


def record_reach(run: Runner, episodes: int) -> float:
    """Record episodes of the rule of the reach task; return how long that took [s]."""
    options = (*reaching(run), "--task.hold_s=1.0", "--seed=100")
    name, data = f"reach_record_{episodes}", f"reach/data_{episodes}"
    return record(run, name, "ur5_reach", data, episodes=episodes, options=options)


def train_reach(run: Runner, seed: int, episodes: int) -> float:
    """Clone that rule from them; return how long the training took [s]."""
    name, own, data = f"reach_bc_{episodes}_{seed}", (f"--seed={seed}",), f"reach/data_{episodes}"
    return train(run, name, "bc_ur5_reach", reach_folder(seed, episodes), data, options=own, short=_FEW_REACH)


def roaming(run: Runner) -> tuple[str, ...]:
    """Return the options of episodes in which it is reported what ground a driver has visited."""
    return "--task.trail=true", *(SHORTER if run.is_short else ())


def picking(run: Runner) -> tuple[str, ...]:
    """Return the options of episodes of the pick task."""
    return SHORTER_PICKS if run.is_short else ()


# --- commands ---------------------------------------------------------------------------------------------------------


def record(run: Runner, name: str, config: str, root: str, *, episodes: int, options: Sequence[str] = ()) -> float:
    """Record episodes of the rule that the configuration names; return how long that took, start-up included [s]."""
    ran = run.run(
        name,
        [
            *("bhd-record", f"--config_path=configs/record/{config}.yaml", f"--dataset.root={run.path(root)}"),
            *(f"--dataset.num_episodes={episodes}", "--n_envs=32", "--preview_video=false"),
            *(f"--output_dir={run.path(root + '_run')}", *options),
        ],
        makes=(root, f"{root}_run"),
    )
    return ran.seconds


def train(
    run: Runner,
    name: str,
    config: str,
    output: str,
    root: str | None = None,
    *,
    options: Sequence[str] = (),
    short: Sequence[str] = (),
) -> float:
    """Train, with further options in a short run; return how long that took, start-up included [s]."""
    data = options if root is None else (f"--dataset.root={run.path(root)}", *options)
    command = ["bhd-train", f"--config_path=configs/train/{config}.yaml", *data, f"--output_dir={run.path(output)}"]
    return run.run(name, [*command, *(short if run.is_short else ())], makes=(output,)).seconds


class Aggregated(NamedTuple):
    """What learning by aggregation came to.

    Attributes:
        policy: the folder of the last round's policy.
        seconds: how long all rounds took [s].
        rounds: of each, from how many episodes it learned and its success on the validation episodes.
    """

    policy: str
    seconds: float
    rounds: list[dict[str, Any]]


def aggregation(
    run: Runner,
    name: str,
    config: str,
    output: str,
    *,
    seed: int,
    rounds: int,
    short: Sequence[int],
    steps: int | None = None,
    policy: Sequence[str] = (),
    data: Sequence[str] = (),
    options: Sequence[str] = (),
) -> Aggregated:
    """Learn by aggregation.

    Args:
        run: runs it.
        name: what its note is called.
        config: its configuration.
        output: its folder.
        seed: of recordings and trainings.
        rounds: beyond the expert's own episodes; one in a short run.
        short: in a short run, how many episodes the expert drives, the learner drives, and it is validated on.
        steps: of each training of a short run; those that `policy` or the configuration say if None.
        policy: options of each training, beside those of the configuration.
        data: datasets that are learned from in every round, too.
        options: of recordings and validations of a short run, beside those of the configuration.
    """
    rounds, path = run.size(rounds, 1), f"configs/train/{config}.yaml"
    command = ["bhd-train", f"--config_path={path}", f"--seed={seed}", f"--rounds={rounds}"]
    if run.is_short:
        names = ("expert_episodes", "episodes", "validation_episodes")
        command += [f"--{key}={value}" for key, value in zip(names, short, strict=True)]
        policy = (*policy, *(() if steps is None else (f"--steps={steps}",)))
    parts = yaml.safe_load((REPOSITORY / path).read_text(encoding="utf-8"))
    if run.is_short:
        unseen = ("--preview_video=false",)
        for part, more in {"expert": unseen, "learner": unseen, "evaluation": ()}.items():
            command.append(f"--{part}.options={json.dumps([*parts[part].get('options', ()), *more, *options])}")
    if data:
        command.append(f"--data=[{', '.join(data)}]")
    if policy:
        # How often to save and to look at what is held out is said for the configuration's number of steps.
        counted = ("--steps=", "--eval_steps=", "--save_freq=")
        own = [one for one in parts["policy"].get("options", ()) if not (run.is_short and one.startswith(counted))]
        command.append(f"--policy.options={json.dumps([*own, *policy])}")
    ran = run.run(name, [*command, f"--output_dir={run.path(output)}"], resumes=(output,))
    # Of all rounds, also of those that an earlier command made before it was stopped; rounds of an older version have
    # no time.
    curve = run.read(output, "rounds.json")["rounds"]
    wanted = ("round", "episodes", "success")
    return Aggregated(
        f"{output}/round_{rounds}/policy",
        float(curve[-1].get("seconds") or ran.seconds),
        [{key: row[key] for key in wanted} for row in curve],
    )


def evaluate(
    run: Runner,
    name: str,
    config: str,
    brains: Mapping[str, str],
    *,
    baseline: str = "",
    rules: Sequence[str] = (),
    options: Sequence[str] = (),
    episodes: int = EPISODES,
    few: int = 12,
) -> Any:
    """Evaluate checkpoints beside rules that the configuration names; return the results."""
    episodes = run.size(episodes, few)
    learned = [
        option
        for label, folder in brains.items()
        for option in (f"--brains.{label}.type=learned", f"--brains.{label}.path={run.path(folder)}")
    ]
    only = ",".join((*rules, *brains))
    run.run(
        name,
        [
            *("bhd-eval", f"--config_path=configs/eval/{config}.yaml", f"--n_episodes={episodes}", *learned),
            *(f"--only=[{only}]", *((f"--baseline={baseline}",) if baseline else ())),
            *(f"--output_dir={run.path(name)}", "--n_envs=32", "--videos=0"),
            *options,
        ],
        makes=(name,),
    )
    return run.read(name, "results.json")


# --- rows -------------------------------------------------------------------------------------------------------------


def values(results: Any, brain: str, key: str) -> list[Any]:
    """Return a value of each episode of a brain, in the order of the episodes."""
    own = [result for result in results["episodes"] if result["brain"] == brain]
    return [one[key] for one in sorted(own, key=lambda one: int(one["episode"]))]


def summary(results: Any, *names: str) -> dict[str, Any]:
    """Return of some brains what rows need: what the report sums up, and the score of every episode."""
    brains = {name: {**results["brains"][name], "scores": _scores(results, name)} for name in names}
    return {"brains": brains}


def scores(kept: Any, name: str) -> list[float]:
    """Return the score of each episode of a brain, of what `summary` returned."""
    return list(kept["brains"][name]["scores"])


def _scores(results: Any, name: str) -> list[float]:
    return [round(float(one), 6) for one in values(results, name, "score")]


def success_row(
    results: Any, name: str, goal: float | None = None, *, shown: str = "", privileged: bool = False
) -> Row:
    """Return the row of a brain's success.

    Args:
        results: what `summary` returned.
        name: of the brain.
        goal: what the rate should be; None if there is no goal.
        shown: what the row calls it; its name if nothing.
        privileged: whether it acts on privileged state, where results of an earlier version do not say it.
    """
    brain = results["brains"][name]
    met = None if goal is None else brain["success"]["value"] >= goal
    told = ", from privileged state" if brain.get("privileged", privileged) else ""
    what = f"{shown or name}{told}: success in {brain['episodes']}"
    return Row(what, rate(brain["success"], brain["outcomes"]), "" if goal is None else f"at least {goal:.0%}", met)


def time_rows(made: Mapping[int, Any]) -> list[Row]:
    """Return the rows of how long it took until a policy was there, recordings included, by training seed."""
    return [
        Row(
            f"seed_{seed}: time from nothing",
            f"{results['seconds']:.0f} s",
            f"at most {_TIME_GOAL_S} s",
            results["seconds"] <= _TIME_GOAL_S,
        )
        for seed, results in made.items()
    ]


def beside_rows(made: Mapping[int, Any], *names: str, privileged: bool = False) -> list[Row]:
    """Return the rows of brains that a section shows beside its own: of every training seed, and of all together.

    Args:
        made: what `summary` returned, by seed.
        names: of the brains in each.
        privileged: as `success_row` has it.
    """
    rows: list[Row] = []
    for name in names:
        rows += [
            success_row(results, name, shown=f"{name}_{seed}", privileged=privileged) for seed, results in made.items()
        ]
        rows += seeds_rows(made, name, name)
    return rows


def rounds_rows(made: Mapping[int, Any]) -> list[Row]:
    """Return the rows of the curve over the rounds, by seed; none of trainings whose rounds were not kept."""
    return [
        Row(
            f"seed_{seed}, round {row['round']}, from {row['episodes']} episodes: success in validation",
            rate(row["success"], {}),
        )
        for seed, results in made.items()
        for row in results.get("rounds", ())
    ]


def seeds_rows(made: Mapping[int, Any], what: str = "all seeds", name: str = "") -> list[Row]:
    """Return the row of the mean success of policies that differ in their training seeds only; none if there is one.

    Args:
        made: what `summary` returned, by seed.
        what: what they have in common, in words.
        name: of the brain in each; ``seed_N`` if nothing.
    """
    brains = [results["brains"][name or f"seed_{seed}"] for seed, results in made.items()]
    rates, episodes = [float(one["success"]["value"]) for one in brains], {int(one["episodes"]) for one in brains}
    what = f"{what}: mean success over {len(rates)} trainings"
    return [Row(what, over_seeds(rates, *episodes))] if len(rates) > 1 else []
