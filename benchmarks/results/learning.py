"""The sections about what is learned: recorded, trained and evaluated by the commands that a user has."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section

EPISODES = 500
_AVOID_TRAIN_S, _PPO_TRAIN_S, _PICK_TRAIN_S = 120, 1200, 3600
_REACH_GOAL, _PICK_GOAL, _PPO_GOAL, _RECOVERED_GOAL = 0.97, 0.85, 1.2, 0.5


def avoid(run: Runner, section: Section) -> None:
    """Cloning a rule, and reinforcement learning, on the avoid task."""
    _record(run, "avoid_record", "turtlebot3_avoid", "avoid/data", episodes=200, options=("--seed=100",))
    seconds = _train(run, "avoid_bc", "bc_turtlebot3_avoid", "avoid/bc", "avoid/data")
    ppo_seconds = _train(run, "avoid_ppo", "ppo_turtlebot3", "avoid/ppo")
    brains = {"bc": "avoid/bc", "ppo": "avoid/ppo"}
    results = _evaluate(
        run, "avoid_eval", "turtlebot3_avoid", brains, rules=("gap_follower", "avoidance"), baseline="gap_follower"
    )
    best = max(("gap_follower", "bc"), key=lambda name: float(_mean(results, name, "score")))
    against = (
        results
        if best == "gap_follower"
        else _evaluate(run, "avoid_eval_bc", "turtlebot3_avoid", brains, rules=("gap_follower",), baseline="bc")
    )
    for name in ("gap_follower", "avoidance", "bc", "ppo"):
        section.rows.append(_success_row(results, name))
        section.rows.append(Row(f"{name}: mean score", _estimate(results["brains"][name]["means"]["score"])))
    difference = results["paired"]["bc"]["score"]
    section.rows += [
        Row("bc: time of training", f"{seconds:.0f} s", f"at most {_AVOID_TRAIN_S} s", seconds <= _AVOID_TRAIN_S),
        Row(
            "bc - gap_follower, its teacher: mean score, paired",
            _estimate(difference, signed=True),
            "not below 0 for certain",
            difference["high"] >= 0,
        ),
        Row("ppo: time of training", f"{ppo_seconds:.0f} s", f"at most {_PPO_TRAIN_S} s", ppo_seconds <= _PPO_TRAIN_S),
    ]
    failures = {name: _failures(results, name) for name in ("gap_follower", "bc", "ppo")}
    least = min(failures["gap_follower"], failures["bc"])
    ratio = against["paired"]["ppo"]["ratio"]
    section.rows += [
        Row("ppo: failures", str(failures["ppo"]), f"at most {least}", failures["ppo"] <= least),
        Row(
            f"ppo / {best}: mean score, paired",
            _estimate(ratio),
            f"at least {_PPO_GOAL}, its interval above 1",
            ratio["value"] >= _PPO_GOAL and ratio["low"] > 1,
        ),
    ]


def reach(run: Runner, section: Section) -> None:
    """Cloning a rule on the reach task."""
    tool = ("--robot.action_space=tool",)
    options = (*tool, "--task.hold_s=1.0", "--seed=100")
    _record(run, "reach_record", "ur5_reach", "reach/data", episodes=10_000, options=options)
    seconds = _train(run, "reach_bc", "bc_ur5_reach", "reach/bc", "reach/data")
    results = _evaluate(
        run, "reach_eval", "ur5_reach", {"bc": "reach/bc"}, rules=("reach",), baseline="reach", options=tool
    )
    for name in ("reach", "bc"):
        section.rows.append(_success_row(results, name, _REACH_GOAL if name == "bc" else None))
    section.rows.append(Row("bc: time of training", f"{seconds:.0f} s"))


def pick(run: Runner, section: Section) -> None:
    """Cloning a rule on the pick task, from state."""
    _record(run, "pick_record", "ur5_pick", "pick/data", episodes=4000, options=("--seed=100",))
    seconds = _train(run, "pick_bc", "bc_ur5_pick", "pick/bc", "pick/data")
    results = _evaluate(run, "pick_eval", "ur5_pick", {"bc": "pick/bc"}, rules=("pick",), baseline="pick")
    section.rows.append(_success_row(results, "pick"))
    success = results["brains"]["bc"]["success"]
    section.rows += [
        Row(
            "bc: success",
            _percent(success),
            f"lower end at least {_PICK_GOAL:.0%}",
            success["low"] >= _PICK_GOAL,
        ),
        Row("bc: time of training", f"{seconds:.0f} s", f"at most {_PICK_TRAIN_S} s", seconds <= _PICK_TRAIN_S),
    ]


# --- commands ---------------------------------------------------------------------------------------------------------


def _record(run: Runner, name: str, config: str, root: str, *, episodes: int, options: Sequence[str] = ()) -> None:
    if run.is_short:
        episodes = max(8, episodes // 50)
    run.run(
        name,
        [
            *("bhd-record", f"--config_path=configs/record/{config}.yaml", f"--dataset.root={run.path(root)}"),
            *(f"--dataset.num_episodes={episodes}", "--n_envs=32", "--preview_video=false"),
            *(f"--output_dir={run.path(root + '_run')}", *options),
        ],
    )


def _train(run: Runner, name: str, config: str, output: str, root: str | None = None) -> float:
    """Train, and return how long that took, start-up included [s]."""
    data = () if root is None else (f"--dataset.root={run.path(root)}",)
    short = ("--steps=50",) if run.is_short else ()
    command = ["bhd-train", f"--config_path=configs/train/{config}.yaml", *data, f"--output_dir={run.path(output)}"]
    return run.run(name, [*command, *short]).seconds


def _evaluate(
    run: Runner,
    name: str,
    config: str,
    brains: Mapping[str, str],
    *,
    rules: Sequence[str],
    baseline: str,
    options: Sequence[str] = (),
) -> Any:
    """Evaluate checkpoints beside rules that the configuration names; return the results."""
    episodes = 16 if run.is_short else EPISODES
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
            *options,
        ],
    )
    return run.read(name, "results.json")


# --- rows -------------------------------------------------------------------------------------------------------------


def _mean(results: Any, name: str, what: str) -> float:
    return float(results["brains"][name]["means"][what]["value"])


def _failures(results: Any, name: str) -> int:
    brain = results["brains"][name]
    return int(brain["episodes"] - brain["successes"])


def _success_row(results: Any, name: str, goal: float | None = None) -> Row:
    brain = results["brains"][name]
    causes = ", ".join(f"{count} {cause}" for cause, count in brain["outcomes"].items() if cause != "success")
    value = f"{_percent(brain['success'])}{f'; {causes}' if causes else ''}"
    met = None if goal is None else brain["success"]["value"] >= goal
    return Row(f"{name}: success in {brain['episodes']}", value, "" if goal is None else f"at least {goal:.0%}", met)


def _percent(estimate: Mapping[str, float]) -> str:
    return f"{estimate['value']:.1%} ({estimate['low']:.1%} to {estimate['high']:.1%})"


def _estimate(estimate: Mapping[str, float], *, signed: bool = False) -> str:
    sign = "+" if signed else ""
    return f"{estimate['value']:{sign}.3f} ({estimate['low']:{sign}.3f} to {estimate['high']:{sign}.3f})"
