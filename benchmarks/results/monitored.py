"""The section about reinforcement learning behind the collision monitor, from drivers that learned by aggregation."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.results.aggregation import EPISODES, aggregated, beside_rule
from benchmarks.results.learning import evaluate, roaming, scores, seeds_rows, success_row, summary, train
from benchmarks.results.runner import REPOSITORY, Runner
from benchmarks.results.section import Row, Section, mean
from benchmarks.results.trainings import SEEDS, each
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.evaluation.statistics import ratio_of_means

_FAILURES_GOAL, _RULE_GOAL, _TEACHER_GOAL = 5, 1.5, 1.2
_KEPT = "; PPO kept the start"
_TASK, _RULE, _TEACHER = "turtlebot3_avoid", "avoidance", "gap_follower"
# Too few to learn anything by: they show that the commands work.
_SHORT = (
    *("--steps=8000", "--critic_warmup=4096", "--env.n_envs=32"),
    *("--validation.freq=4000", "--validation.n_episodes=4", "--validation.confirm=4"),
)


def monitored(run: Runner, section: Section) -> None:
    """Train drivers that learned by aggregation further, with PPO and the collision monitor."""
    teacher = beside_rule(run)

    def learn(seed: int) -> dict[str, Any]:
        clone = aggregated(run, seed).policy
        folder, name = f"monitored/seed_{seed}", f"monitored_train_{seed}"
        options = (f"--start_from={run.path(clone)}", f"--seed={seed}")
        seconds = train(run, name, "ppo_turtlebot3_monitor", folder, options=options, short=_SHORT)
        driving = roaming(run)
        alone = evaluate(
            run,
            f"monitored_eval/seed_{seed}/alone",
            _TASK,
            {"clone": clone},
            rules=(_RULE,),
            baseline=_RULE,
            options=driving,
            episodes=EPISODES,
        )
        behind = evaluate(
            run,
            f"monitored_eval/seed_{seed}/behind",
            _TASK,
            {"clone": clone, "ppo": f"{folder}/checkpoints/best"},
            baseline="clone",
            options=(*driving, "--robot.collision_monitor=true"),
            episodes=EPISODES,
        )
        return {
            "alone": summary(alone, _RULE, "clone"),
            "behind": summary(behind, "clone", "ppo"),
            "seconds": seconds,
            "best": _steps(REPOSITORY / run.path(f"{folder}/checkpoints/best")),
        }

    made = each(run, section, "monitored", SEEDS, learn)
    first, *_ = made.values()
    section.rows += [success_row(teacher, _TEACHER), success_row(first["alone"], _RULE)]
    for seed, one in made.items():
        section.rows += rows(one["alone"], one["behind"], teacher, seed, is_start=one.get("best") == 0)
    section.rows += seeds_rows({seed: one["behind"] for seed, one in made.items()}, "ppo, all seeds", "ppo")
    section.rows += [
        Row(f"ppo_{seed}: environment steps behind the best checkpoint", f"{steps:,}{_KEPT if steps == 0 else ''}")
        for seed, one in made.items()
        if (steps := one.get("best")) is not None
    ]
    section.rows += [Row(f"ppo_{seed}: time of PPO", f"{one['seconds']:.0f} s") for seed, one in made.items()]
    section.remarks.append(
        "`clone_N` learned from `gap_follower` by aggregation, `ppo_N` from there by PPO with the monitor in the loop"
        " (`robot.collision_monitor`); `gap_follower`, and `avoidance`, the simple rule, have no monitor. All drive "
        "the same arenas; the episodes of `gap_follower` are those of the section before. What ground they have "
        "visited is told to `clone_N` and `ppo_N` from the robot's true pose (`task.trail`, privileged). The start is"
        " a candidate like any other: where it fails least in the 512 episodes that decide, `ppo_N` is it, with "
        "inputs added whose weights are 0: sums round differently, and some episodes go another way. Its ratios tell "
        "what the monitor does, then, and nothing of PPO. While PPO learns, being stuck ends an episode after 2 s and"
        " 0.05 m, not 10 s and 0.1 m, and with a collision it costs 5, not 10; episodes here are scored as "
        "everywhere. There is no image and no instruction: deaf and blind by construction. The goal of 1.2 times "
        "`gap_follower` is about what driving could reach at most (docs/how_to/reinforcement_learning.md)."
    )


def _steps(checkpoint: Path) -> int | None:
    """Return the environment steps behind a checkpoint; None if there is none."""
    return int(checkpoint.resolve().name) if checkpoint.exists() else None


def rows(alone: Any, behind: Any, teacher: Any, seed: int, *, is_start: bool) -> list[Row]:
    """Return the rows of a training seed, with the goals of PPO.

    Args:
        alone: what `summary` returned of an evaluation without the monitor, of `avoidance` and `clone`.
        behind: of one with it, of `clone` and `ppo`.
        teacher: of one without it, of `gap_follower`.
        seed: the training seed.
        is_start: whether `ppo` is the policy that the training began with, as no other failed less.
    """
    found = []
    for results, name, where in (
        (alone, "clone", ""),
        (behind, "clone", "with the collision monitor, "),
        (behind, "ppo", "with the collision monitor, "),
    ):
        found.append(success_row(results, name, shown=f"{where}{name}_{seed}", privileged=True))
    brain, name = behind["brains"]["ppo"], f"ppo_{seed}"
    failures = int(brain["episodes"] - brain["successes"])
    is_met = failures <= _FAILURES_GOAL
    found.append(Row(f"{name}: failures", str(failures), f"at most {_FAILURES_GOAL} of {EPISODES}", is_met))
    score = scores(behind, "ppo")
    clone = ratio_of_means(score, scores(alone, "clone"), within=SCORE_RANGE)
    what = f"{name} / clone_{seed} without the monitor: mean score, paired"
    found.append(Row(what, mean(asdict(clone)), "at least 1", clone.value >= 1))
    both = ratio_of_means(score, scores(behind, "clone"), within=SCORE_RANGE)
    what = f"{name} / clone_{seed}, both with the monitor: mean score, paired"
    found.append(Row(what, f"{mean(asdict(both))}{_KEPT if is_start else ''}"))
    over = ratio_of_means(score, scores(alone, _RULE), within=SCORE_RANGE)
    what = f"{name} / avoidance, the simple rule: mean score, paired"
    found.append(Row(what, mean(asdict(over)), f"at least {_RULE_GOAL}", over.value >= _RULE_GOAL))
    ratio = ratio_of_means(score, scores(teacher, _TEACHER), within=SCORE_RANGE)
    is_met = ratio.value >= _TEACHER_GOAL and ratio.low > 1
    what, goal = f"{name} / {_TEACHER}: mean score, paired", f"at least {_TEACHER_GOAL}, its interval above 1"
    found.append(Row(what, mean(asdict(ratio)), goal, is_met))
    return found
