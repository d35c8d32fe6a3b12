"""The section about driving by the front camera: what its rounds of aggregation make of a driver, from three seeds."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.results.learning import (
    SHORTER,
    Aggregated,
    aggregation,
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
from bhd_lerobot.evaluation.statistics import mean_difference

EPISODES, ROUNDS = 500, 2
_SHORT, _STEPS = (20, 10, 2), 600
_SUCCESS_GOAL = 0.9
_RULE, _TEACHER = "avoidance", "gap_follower"
_BESIDE = ("clone", "blind")
_BLANKED = 100  # episodes of the driver that is blind


def camera_drive(run: Runner, section: Section) -> None:
    """Let a rule that reads the lidar correct a driver that sees with a camera."""

    def learn(seed: int) -> dict[str, Any]:
        (policy, seconds, rounds), name = _learned(run, seed), f"seed_{seed}"
        results = _evaluate(run, name, _brain(run, name, policy), (_RULE, name))
        return {**results, "seconds": seconds, "rounds": rounds}

    def others(seed: int) -> dict[str, Any]:
        policy = _learned(run, seed).policy
        inner = _brain(run, "blind.brain", policy)
        blind = ("--brains.blind.type=blanked", "--brains.blind.images=true", *inner)
        clone = _brain(run, "clone", f"{_folder(seed)}/round_0/policy")
        beside = _evaluate(run, f"clone/seed_{seed}", clone, (_TEACHER, "clone"))
        return {
            "brains": beside["brains"] | _evaluate(run, f"blind/seed_{seed}", blind, ("blind",), _BLANKED)["brains"]
        }

    made = each(run, section, "camera_drive", SEEDS, learn)
    beside = each(run, section, "camera_drive_others", SEEDS, others)
    section.rows += _level_rows(next(iter(made.values())), _RULE, _RULE)
    section.rows += _level_rows(next(iter(beside.values())), _TEACHER, _TEACHER)
    for name in _BESIDE:
        for seed, results in beside.items():
            section.rows += _level_rows(results, name, f"{name}_{seed}")
        section.rows += seeds_rows(beside, name, name)
    for seed, results in made.items():
        name = f"seed_{seed}"
        (score, row), brain = _level_rows(results, name, name), results["brains"][name]
        more = mean_difference(scores(results, name), scores(results, _RULE), within=SCORE_RANGE)
        is_met = brain["success"]["low"] >= _SUCCESS_GOAL
        section.rows += [
            score,
            Row(
                f"{name} - avoidance, which reads the lidar: mean score, paired",
                mean(asdict(more), "+"),
                "lower end above 0",
                more.low > 0,
            ),
            Row(row.what, row.value, f"lower end at least {_SUCCESS_GOAL:.0%}", is_met),
        ]
    section.rows += seeds_rows(made)
    section.rows += rounds_rows(made)
    section.rows += time_rows(made)
    section.remarks.append(
        "`bhd_cnn`; each seed is one of recording and training. It sees images of 64 x 48 pixels from the front "
        "camera, and the wheels' odometry. The "
        "lidar's ranges taught it how far away things are; they are no input, and neither is what ground it has "
        f"visited. Policies drove in {run.size(ROUNDS, 1)} further rounds, corrected by the rule; `clone_N` learned "
        "from the rule's episodes alone. There is no instruction: deaf by construction."
    )
    section.remarks.append(
        "What counts is the score. Success alone says little: `blind_N`, seed N with black images, may drive a small "
        "circle, touches nothing, gets nowhere and succeeds."
    )


def _level_rows(results: Any, name: str, shown: str) -> list[Row]:
    """Return the rows of a brain's score and of its success, by the name that it is shown with."""
    score = Row(f"{shown}: mean score", mean(results["brains"][name]["means"]["score"]))
    return [score, success_row(results, name, shown=shown)]


def _learned(run: Runner, seed: int) -> Aggregated:
    name, config = f"camera_drive_train_{seed}", "dagger_turtlebot3_camera"
    return aggregation(
        run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, steps=_STEPS, options=SHORTER
    )


def _evaluate(
    run: Runner, name: str, brain: Sequence[str], names: Sequence[str], episodes: int = EPISODES
) -> dict[str, Any]:
    output = f"camera_drive_eval/{name}"
    command = ["bhd-eval", "--config_path=configs/eval/turtlebot3_avoid_camera.yaml", *brain]
    command += [f"--only=[{','.join(names)}]", "--videos=0", f"--n_episodes={run.size(episodes, 6)}"]
    command += [f"--output_dir={run.path(output)}", *(SHORTER if run.is_short else ())]
    run.run(output, command, makes=(output,))
    return summary(run.read(output, "results.json"), *names)


def _brain(run: Runner, name: str, policy: str) -> tuple[str, str]:
    return f"--brains.{name}.type=learned", f"--brains.{name}.path={run.path(policy)}"


def _folder(seed: int) -> str:
    return f"camera_drive/seed_{seed}"
