"""The sections about what is learned: recorded, trained and evaluated by the commands that a user has."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import yaml

from benchmarks.results.runner import REPOSITORY, FailedError, Runner
from benchmarks.results.section import Row, Section, mean, over_seeds, rate
from bhd_lerobot.evaluation.statistics import mean_difference, ratio_of_means

EPISODES = 500
TOOL = ("--robot.action_space=tool", "--robot.tool_pose=true")
_TEACHER = "gap_follower"
_ROAMING = (_TEACHER, "avoidance")
# What learned from that teacher.
_STUDENTS = {"gap_bc": "avoid/gap_bc", "ppo": "avoid/ppo/checkpoints/best"}
_REACH_EPISODES, _FEW_EPISODES = (250, 750, 1500), (30, 120)
_FEW = ("--steps=800", "--eval_steps=800")
# Too few to learn anything by: they show that the commands work.
FEW_PPO = (
    *("--steps=20000", "--critic_warmup=8192", "--env.n_envs=32"),
    *("--validation.freq=10000", "--validation.n_episodes=8"),
)
SHORTER = ("--task.duration_s=30",)  # episodes of a short run
_AVOID_TRAIN_S, _PPO_TRAIN_S = 120, 1200
_REACH_GOAL, _PPO_GOAL = 0.97, 1.2


def avoid(run: Runner, section: Section) -> None:
    """Cloning rules, and reinforcement learning, on the avoid task."""
    shorter = SHORTER if run.is_short else ()
    options = ("--seed=100", *shorter)
    record(run, "avoid_record", "turtlebot3_avoid", "avoid/data", episodes=run.size(200, 20), options=options)
    seconds = train(run, "avoid_bc", "bc_turtlebot3_avoid", "avoid/bc", "avoid/data", short=_FEW)
    gap = ("--seed=100", "--brain.type=gap_follower", *roaming(run))
    record(run, "avoid_gap_record", "turtlebot3_avoid", "avoid/gap_data", episodes=run.size(400, 40), options=gap)
    train(run, "avoid_gap_bc", "bc_turtlebot3_avoid", "avoid/gap_bc", "avoid/gap_data", short=_FEW)
    start = (
        *(f"--start_from={run.path('avoid/gap_bc')}", "--see_ignored=true"),
        *("--critic_warmup=65536", "--ppo.log_std_init=-1.0"),
    )
    ppo_seconds = train(run, "avoid_ppo", "ppo_turtlebot3", "avoid/ppo", options=start, short=FEW_PPO)

    config, rule = "turtlebot3_avoid", "avoidance"
    results = evaluate(run, "avoid_eval", config, {"bc": "avoid/bc"}, rules=_ROAMING, baseline=rule, options=shorter)
    with_trail, monitored = (
        evaluate(run, name, config, _STUDENTS, rules=(_TEACHER,), baseline=_TEACHER, options=(*roaming(run), *more))
        for name, more in (("avoid_trail_eval", ()), ("avoid_monitor_eval", ("--robot.collision_monitor=true",)))
    )
    # The task reports more to these two; the episodes are the same.
    if _scores(with_trail, _TEACHER) != _scores(results, _TEACHER):
        raise FailedError("A rule that does not use the trail did something else where the task reports it.")
    for name in _STUDENTS:
        results["brains"][name] = with_trail["brains"][name]
    results["episodes"] += [one for one in with_trail["episodes"] if one["brain"] in _STUDENTS]

    section.rows += _levels(results, monitored)
    difference = mean_difference(_scores(results, "bc"), _scores(results, rule))
    more = _failures(results, "bc") - _failures(results, rule)
    section.rows += [
        Row("bc: time of training", f"{seconds:.0f} s", f"at most {_AVOID_TRAIN_S} s", seconds <= _AVOID_TRAIN_S),
        Row(
            "bc - avoidance, its teacher: mean score, paired",
            mean(asdict(difference), "+"),
            "not below 0 for certain",
            difference.high >= 0,
        ),
        Row("bc: failures beyond its teacher's", str(more), "at most 0", more <= 0),
        Row("ppo: time of training", f"{ppo_seconds:.0f} s", f"at most {_PPO_TRAIN_S} s", ppo_seconds <= _PPO_TRAIN_S),
    ]
    failures = {name: _failures(results, name) for name in (_TEACHER, "bc", "ppo")}
    least = min(failures[_TEACHER], failures["bc"])
    best = max((_TEACHER, "bc"), key=lambda name: float(np.mean(_scores(results, name))))
    ratio = ratio_of_means(_scores(results, "ppo"), _scores(results, best))
    over = ratio_of_means(_scores(results, "ppo"), _scores(results, rule))
    section.rows += [
        Row("ppo: failures", str(failures["ppo"]), f"at most {least}", failures["ppo"] <= least),
        Row(
            f"ppo / {best}: mean score, paired",
            mean(asdict(ratio)),
            f"at least {_PPO_GOAL}, its interval above 1",
            ratio.value >= _PPO_GOAL and ratio.low > 1,
        ),
        Row("ppo / avoidance, the rule of the articles: mean score, paired", mean(asdict(over))),
    ]
    section.remarks += [
        "`bc` imitates `avoidance`, `gap_bc` imitates `gap_follower`. That rule remembers where it has been; a network "
        "does not, so the task reports to `gap_bc` and `ppo`, which starts from it, what ground around them "
        "they have visited (`task.trail`).",
        "With the collision monitor (`robot.collision_monitor`) no brain touches anything; it takes speed away and "
        "does not steer, so one that would have driven into something stands before it, and is stuck.",
    ]


def _levels(results: Any, monitored: Any) -> list[Row]:
    """Return the rows of success and score on the avoid task, without and with the collision monitor."""
    rows = []
    for found, names, where in (
        (results, (*_ROAMING, "bc", *_STUDENTS), ""),
        (monitored, (_TEACHER, *_STUDENTS), "with the collision monitor, "),
    ):
        for name in names:
            success = success_row(found, name)
            rows.append(replace(success, what=f"{where}{success.what}"))
            rows.append(Row(f"{where}{name}: mean score", mean(found["brains"][name]["means"]["score"])))
    return rows


def reach(run: Runner, section: Section) -> None:
    """Cloning a rule on the reach task, from few to many episodes; the last is the policy that others start from."""
    options = (*TOOL, "--task.hold_s=1.0", "--seed=100")
    seconds, folders = {}, {}
    numbers = _FEW_EPISODES if run.is_short else _REACH_EPISODES
    for episodes in numbers:
        data, folder = (
            f"reach/data_{episodes}",
            "reach/bc" if episodes == numbers[-1] else f"reach/bc_{episodes}",
        )
        record(run, f"reach_record_{episodes}", "ur5_reach", data, episodes=episodes, options=options)
        before = run.commands[-1].seconds
        seconds[episodes] = before + train(run, f"reach_bc_{episodes}", "bc_ur5_reach", folder, data, short=_FEW)
        folders[f"bc_{episodes}"] = folder
    results = evaluate(run, "reach_eval", "ur5_reach", folders, rules=("reach",), baseline="reach", options=TOOL)
    section.rows.append(success_row(results, "reach"))
    for episodes in numbers:
        is_last = episodes == numbers[-1]
        section.rows.append(success_row(results, f"bc_{episodes}", _REACH_GOAL if is_last else None))
        section.rows.append(Row(f"bc_{episodes}: time from nothing", f"{seconds[episodes]:.0f} s"))
    section.remarks.append("`bc_N` learned from N episodes, all with the same number of steps.")


def roaming(run: Runner) -> tuple[str, ...]:
    """Return the options of episodes in which it is reported what ground a driver has visited."""
    return "--task.trail=true", *(SHORTER if run.is_short else ())


# --- commands ---------------------------------------------------------------------------------------------------------


def record(run: Runner, name: str, config: str, root: str, *, episodes: int, options: Sequence[str] = ()) -> None:
    """Record episodes of the rule that the configuration names."""
    run.run(
        name,
        [
            *("bhd-record", f"--config_path=configs/record/{config}.yaml", f"--dataset.root={run.path(root)}"),
            *(f"--dataset.num_episodes={episodes}", "--n_envs=32", "--preview_video=false"),
            *(f"--output_dir={run.path(root + '_run')}", *options),
        ],
        makes=(root, f"{root}_run"),
    )


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


def aggregation(
    run: Runner,
    name: str,
    config: str,
    output: str,
    *,
    seed: int,
    rounds: int,
    short: Sequence[int],
    steps: int,
    policy: Sequence[str] = (),
    data: Sequence[str] = (),
    options: Sequence[str] = (),
) -> tuple[str, float]:
    """Learn by aggregation, and return the folder of the last round's policy and how long that took [s].

    Args:
        run: runs it.
        name: what its note is called.
        config: its configuration.
        output: its folder.
        seed: of recordings and trainings.
        rounds: beyond the expert's own episodes; one in a short run.
        short: in a short run, how many episodes the expert drives, the learner drives, and it is validated on.
        steps: of each training of a short run.
        policy: options of each training.
        data: datasets that are learned from in every round, too.
        options: of recordings and validations of a short run, beside those of the configuration.
    """
    rounds, path = run.size(rounds, 1), f"configs/train/{config}.yaml"
    command = ["bhd-train", f"--config_path={path}", f"--seed={seed}", f"--rounds={rounds}"]
    if run.is_short:
        names = ("expert_episodes", "episodes", "validation_episodes")
        command += [f"--{key}={value}" for key, value in zip(names, short, strict=True)]
        policy = (*policy, f"--steps={steps}")
    if run.is_short and options:
        parts = yaml.safe_load((REPOSITORY / path).read_text(encoding="utf-8"))
        for part in ("expert", "learner", "evaluation"):
            command.append(f"--{part}.options=[{', '.join([*parts[part].get('options', ()), *options])}]")
    if data:
        command.append(f"--data=[{', '.join(data)}]")
    if policy:
        command.append(f"--policy.options=[{', '.join(policy)}]")
    ran = run.run(name, [*command, f"--output_dir={run.path(output)}"])
    return f"{output}/round_{rounds}/policy", ran.seconds


def evaluate(
    run: Runner,
    name: str,
    config: str,
    brains: Mapping[str, str],
    *,
    baseline: str,
    rules: Sequence[str] = (),
    options: Sequence[str] = (),
    episodes: int = EPISODES,
) -> Any:
    """Evaluate checkpoints beside rules that the configuration names; return the results."""
    episodes = run.size(episodes, 16)
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
            *(f"--only=[{only}]", f"--baseline={baseline}", f"--output_dir={run.path(name)}", "--n_envs=32"),
            "--videos=0",
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


def _scores(results: Any, name: str) -> list[float]:
    return [float(one) for one in values(results, name, "score")]


def _failures(results: Any, name: str) -> int:
    brain = results["brains"][name]
    return int(brain["episodes"] - brain["successes"])


def success_row(results: Any, name: str, goal: float | None = None) -> Row:
    """Return the row of a brain's success."""
    brain = results["brains"][name]
    met = None if goal is None else brain["success"]["value"] >= goal
    what = f"{name}: success in {brain['episodes']}"
    return Row(what, rate(brain["success"], brain["outcomes"]), "" if goal is None else f"at least {goal:.0%}", met)


def seeds_row(results: Any, names: Sequence[str], what: str = "all seeds") -> Row:
    """Return the row of the mean success of policies that differ in their training seeds only."""
    rates = [float(results["brains"][name]["success"]["value"]) for name in names]
    return Row(f"{what}: mean success, interval over {len(names)} trainings", over_seeds(rates))
