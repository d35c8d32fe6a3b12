"""The section about reinforcement learning behind the collision monitor, from drivers that learned by aggregation."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from benchmarks.results.aggregation import EPISODES, SEEDS, aggregated
from benchmarks.results.learning import FEW_PPO, evaluate, roaming, success_row, train, values
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean
from bhd_lerobot.evaluation.statistics import ratio_of_means

_FAILURES_GOAL, _RULE_GOAL = 5, 1.5
_SHORT = (*FEW_PPO, "--validation.confirm=8")


def monitored(run: Runner, section: Section) -> None:
    """Train drivers that learned by aggregation further, with PPO and the collision monitor."""
    seeds, clones, learned, seconds = run.seeds(SEEDS), {}, {}, []
    for seed in seeds:
        clones[f"clone_{seed}"], _ = aggregated(run, seed)
        start = f"--start_from={run.path(clones[f'clone_{seed}'])}"
        options = (start, f"--seed={seed}")
        folder = f"monitored/seed_{seed}"
        name = f"monitored_train_{seed}"
        seconds.append(train(run, name, "ppo_turtlebot3_monitor", folder, options=options, short=_SHORT))
        learned[f"ppo_{seed}"] = f"{folder}/checkpoints/best"
    config, rule = "turtlebot3_avoid", "avoidance"
    driving = roaming(run)
    alone = evaluate(
        run, "monitored_alone_eval", config, clones, rules=(rule,), baseline=rule, options=driving, episodes=EPISODES
    )
    behind = evaluate(
        run,
        "monitored_eval",
        config,
        clones | learned,
        baseline=next(iter(clones)),
        options=(*driving, "--robot.collision_monitor=true"),
        episodes=EPISODES,
    )
    section.rows += [success_row(alone, name) for name in (rule, *clones)]
    section.rows += rows(alone, behind, seeds)
    section.rows.append(Row("time of PPO, the first seed", f"{seconds[0]:.0f} s"))
    section.remarks.append(
        "`clone_N` learned from `gap_follower` by aggregation, `ppo_N` from there by PPO with the monitor in the loop "
        "(`robot.collision_monitor`); `avoidance`, the rule of the articles, has no monitor. All drive the same arenas."
    )


def rows(alone: Mapping[str, Any], behind: Mapping[str, Any], seeds: Sequence[int]) -> list[Row]:
    """Return the rows of the brains behind the monitor, with the goals of the learned ones.

    Args:
        alone: results without the monitor, of `avoidance` and `clone_N`.
        behind: results with it, of `clone_N` and `ppo_N`.
        seeds: the N.
    """
    found = []
    rule = np.array(values(alone, "avoidance", "score"), float)
    for seed in seeds:
        for name in (f"clone_{seed}", f"ppo_{seed}"):
            success = success_row(behind, name)
            found.append(replace(success, what=f"with the collision monitor, {success.what}"))
        brain = behind["brains"][name]
        failures = int(brain["episodes"] - brain["successes"])
        is_met = failures <= _FAILURES_GOAL
        found.append(Row(f"{name}: failures", str(failures), f"at most {_FAILURES_GOAL} of {EPISODES}", is_met))
        score = np.array(values(behind, name, "score"), float)
        clone = ratio_of_means(score, np.array(values(alone, f"clone_{seed}", "score"), float))
        what = f"{name} / clone_{seed} without the monitor: mean score, paired"
        found.append(Row(what, mean(asdict(clone)), "at least 1", clone.value >= 1))
        over = ratio_of_means(score, rule)
        what = f"{name} / avoidance, the rule of the articles: mean score, paired"
        found.append(Row(what, mean(asdict(over)), f"at least {_RULE_GOAL}", over.value >= _RULE_GOAL))
    return found
