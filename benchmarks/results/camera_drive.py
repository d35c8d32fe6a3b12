"""The section about driving by the front camera: what its rounds of aggregation make of a driver, from three seeds."""

from dataclasses import asdict

import numpy as np

from benchmarks.results.learning import SHORTER, aggregation, success_row, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean
from bhd_lerobot.errors import counted
from bhd_lerobot.evaluation.statistics import mean_difference

EPISODES, SEEDS, ROUNDS = 500, (0, 1, 2), 2
_SHORT, _STEPS = (24, 12, 8), 400
_SUCCESS_GOAL, _TIME_GOAL_S = 0.9, 7200
_RULES = ("avoidance", "gap_follower")
_BLANKED = 100  # episodes of the driver that is blind


def camera_drive(run: Runner, section: Section) -> None:
    """Let a rule that reads the lidar correct a driver that sees with a camera."""
    seeds, seconds, brains = run.seeds(SEEDS), [], {"clone": f"{_folder(0)}/round_0/policy"}
    for seed in seeds:
        name, config = f"camera_drive_train_{seed}", "dagger_turtlebot3_camera"
        brains[f"seed_{seed}"], time = aggregation(
            run, name, config, _folder(seed), seed=seed, rounds=ROUNDS, short=_SHORT, steps=_STEPS, options=SHORTER
        )
        seconds.append(time)
    learned = [
        option
        for name, folder in brains.items()
        for option in (f"--brains.{name}.type=learned", f"--brains.{name}.path={run.path(folder)}")
    ]
    blind = [
        *("--brains.blind.type=blanked", "--brains.blind.images=true", "--brains.blind.brain.type=learned"),
        f"--brains.blind.brain.path={run.path(brains['seed_0'])}",
    ]
    results = _evaluate(run, "camera_drive_eval", learned, (*_RULES, *brains), EPISODES)
    blanked = _evaluate(run, "camera_drive_blind", blind, ("avoidance", "blind"), _BLANKED)
    rule = np.array(values(results, "avoidance", "score"), float)
    for name in (*_RULES, *brains):
        row, success = success_row(results, name), results["brains"][name]["success"]
        score = Row(f"{name}: mean score", mean(results["brains"][name]["means"]["score"]))
        if name not in brains or name == "clone":
            section.rows += [row, score]
            continue
        is_met = success["low"] >= _SUCCESS_GOAL
        more = mean_difference(np.array(values(results, name, "score"), float), rule)
        section.rows += [
            Row(row.what, row.value, f"lower end at least {_SUCCESS_GOAL:.0%}", is_met),
            score,
            Row(
                f"{name} - avoidance, which reads the lidar: mean score, paired",
                mean(asdict(more), "+"),
                "above 0 for certain",
                more.low > 0,
            ),
        ]
    section.rows.append(success_row(blanked, "blind"))
    section.rows.append(
        Row(
            "time from nothing to the first seed's policy",
            f"{seconds[0]:.0f} s",
            f"at most {_TIME_GOAL_S} s",
            seconds[0] <= _TIME_GOAL_S,
        )
    )
    rates = [results["brains"][f"seed_{seed}"]["success"]["value"] for seed in seeds]
    section.remarks.append(
        f"`bhd_cnn`, {counted(len(seeds), 'seed')} of recording and training; success from {min(rates):.1%} to "
        f"{max(rates):.1%}. It sees images of 64 x 48 pixels from the front camera, and the wheels' odometry. The "
        "lidar's ranges taught it how far away things are; they are no input, and neither is what ground it has "
        f"visited. `clone` learned from the rule's episodes alone; the others drove in {run.size(ROUNDS, 1)} further "
        "rounds, corrected by the rule. `blind` is seed 0 with black images."
    )


def _evaluate(run: Runner, name: str, brains: list[str], only: tuple[str, ...], episodes: int) -> dict:
    config = "--config_path=configs/eval/turtlebot3_avoid_camera.yaml"
    command = ["bhd-eval", config, *brains, f"--only=[{','.join(only)}]", "--baseline=avoidance", "--videos=0"]
    command += [f"--n_episodes={run.size(episodes, 8)}", f"--output_dir={run.path(name)}"]
    command += SHORTER if run.is_short else ()
    run.run(name, command, makes=(name,))
    return run.read(name, "results.json")


def _folder(seed: int) -> str:
    return f"camera_drive/seed_{seed}"
