"""`bhd-eval` beside stock `lerobot-eval` on Gymnasium's SyncVectorEnv: `python -m benchmarks.evaluate`.

Both run the same policy on the same episodes, as many of them side by side, without video, and both are timed from the
configuration to the numbers: ours includes its intervals and its report. They run in turns, after a small run of each
that is not counted: what Python imports at first use belongs to neither. The ratio is the median over the turns.

What ours spends before and after the episodes hardly grows with their number, so the ratio does: the number of episodes
is part of the result. Without `--path` a small `bhd_mlp` is trained first, on episodes of a rule. The goal: at least 10
times the episodes a second. Exits with 3 if it is missed.
"""

import contextlib
import io
import logging
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy
from rich.console import Console

from benchmarks._report import Report, parse_options
from benchmarks._turns import spread
from bhd_lerobot.cli.record import main as record_main
from bhd_lerobot.cli.train import main as train_main
from bhd_lerobot.envs.config_env import BhdEnvConfig
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.evaluation.evaluate import EvalResult, evaluate
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.checkpoint_guard import check_checkpoint
from bhd_lerobot.policies.learned.contract import find_checkpoint

GOAL = 10.0
TASKS = {"avoid": ("turtlebot3", "TurtleBot3Avoid-v0", "gap_follower"), "reach": ("ur5", "UR5Reach-v0", "reach")}


def main() -> int:
    """Run both in turns, print episodes a second and their ratio, return 0 if the goal is met."""
    args = parse_options(
        __doc__,
        task={"choices": tuple(TASKS), "default": "avoid"},
        path={"help": "checkpoint of the policy; a small one is trained if none is given"},
        demonstrations=(40, "episodes that the small policy learns from"),
        steps=(500, "that it learns for"),
        episodes=(200, "episodes of a run, of both"),
        n_envs=(50, "simulations side by side, of both"),
        turns=3,
        seed=0,
    )
    logging.disable(logging.INFO)
    turns: list[Turn] = []
    with tempfile.TemporaryDirectory() as folder:
        path = args.path or train_policy(args.task, Path(folder), args.demonstrations, args.steps)
        for turn in range(-1, args.turns):
            # The first is not counted.
            episodes = min(2, args.n_envs) if turn < 0 else args.episodes
            n_envs = min(args.n_envs, episodes)
            stock_s, stock = run_stock(args.task, path, episodes, n_envs, args.seed)
            target = Path(folder) / f"eval_{turn}"
            ours_s, ours = run_ours(args.task, path, episodes, n_envs, seed=args.seed, folder=target)
            if turn >= 0:
                turns.append(Turn(stock_s, ours_s, stock, ours))
        kind = PreTrainedConfig.from_pretrained(find_checkpoint(path)).type
    what = f"{args.episodes} {args.task} episodes of {kind}, {args.n_envs} side by side"
    return summarise(what, turns, args.episodes).end(args.json)


@dataclass(frozen=True)
class Turn:
    """A run of each.

    Attributes:
        stock_s: duration of the stock evaluation [s].
        ours_s: duration of ours [s].
        stock: the stock evaluation's episodes.
        ours: what ours found.
    """

    stock_s: float
    ours_s: float
    stock: list[dict[str, Any]]
    ours: EvalResult


def summarise(what: str, turns: Sequence[Turn], episodes: int) -> Report:
    """Return what was measured."""
    report = Report("bhd-eval beside lerobot-eval on SyncVectorEnv")
    speeds = {
        "bhd-eval": [episodes / turn.ours_s for turn in turns],
        "lerobot-eval": [episodes / turn.stock_s for turn in turns],
    }
    report.compare(what, "episodes/s", speeds, ["lerobot-eval"], goal=GOAL, form=".2f")
    # Building, intervals and report: what is not the run of the episodes.
    around = spread([turn.ours_s - turn.ours.timing["brains"]["policy"]["wall_s"] for turn in turns])
    report.add(f"{what}: before and after the episodes", f"{around['median']:.1f} s")
    pairs = [pair for turn in turns for pair in zip(turn.stock, turn.ours.results.episodes, strict=True)]
    same = sum(one["success"] == our.success for one, our in pairs)
    differ = max(abs(one["sum_reward"] - our.reward) for one, our in pairs)
    report.add(f"{what}: ended the same with both", f"{same} of {len(pairs)}; returns differ by at most {differ:.2g}")
    return report


def run_ours(task: str, path: str, episodes: int, n_envs: int, *, seed: int, folder: Path) -> tuple[float, EvalResult]:
    """Run `bhd-eval`; return how long it took [s], and what it found."""
    robot = TASKS[task][0]
    options = [
        f"--robot.type={robot}",
        f"--task.type={task}",
        "--brains.policy.type=learned",
        f"--brains.policy.path={path}",
        f"--n_episodes={episodes}",
        f"--n_envs={n_envs}",
        f"--seed={seed}",
        "--videos=0",
        f"--output_dir={folder}",
    ]
    started = time.perf_counter()
    result = evaluate(parse(EvalConfig, options), Console(file=io.StringIO()))
    return time.perf_counter() - started, result


def run_stock(task: str, path: str, episodes: int, n_envs: int, seed: int) -> tuple[float, list[dict[str, Any]]]:
    """Run what `lerobot-eval` runs, without video; return how long it took [s], and its episodes."""
    started = time.perf_counter()
    env_config = BhdEnvConfig(task=TASKS[task][1], vector="sync", seed=seed)
    folder = find_checkpoint(path)
    check_checkpoint(folder)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = Path(folder), "cpu"
    ((envs,),) = (tuple(group.values()) for group in env_config.create_envs(n_envs=n_envs).values())
    policy = make_policy(cfg=config, env_cfg=env_config)
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    before, after = make_pre_post_processors(config, pretrained_path=str(folder), preprocessor_overrides=overrides)
    env_before, env_after = make_env_pre_post_processors(env_cfg=env_config, policy_cfg=config)
    with contextlib.closing(envs), torch.no_grad(), contextlib.redirect_stderr(io.StringIO()):
        # Seed k of an environment is episode k of its run: those that bhd-eval runs.
        info = eval_policy(envs, policy, env_before, env_after, before, after, episodes, start_seed=0)
    return time.perf_counter() - started, info["per_episode"]


def train_policy(task: str, folder: Path, demonstrations: int, steps: int) -> str:
    """Record episodes of a rule and train a small policy on them; return the run's folder."""
    robot, _, brain = TASKS[task]
    data, run = folder / "data", folder / "train"
    record = [
        f"--robot.type={robot}",
        f"--task.type={task}",
        f"--brain.type={brain}",
        "--dataset.repo_id=benchmark/evaluate",
        f"--dataset.root={data}",
        f"--dataset.num_episodes={demonstrations}",
        "--n_envs=20",
        "--preview_video=false",
        f"--output_dir={folder / 'record'}",
    ]
    train = [
        "--dataset.repo_id=benchmark/evaluate",
        f"--dataset.root={data}",
        "--policy.type=bhd_mlp",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.hidden_dims=[128, 128]",
        f"--steps={steps}",
        "--batch_size=64",
        f"--save_freq={steps}",
        f"--output_dir={run}",
    ]
    for program, options in ((record_main, record), (train_main, train)):
        status = program(options)
        if status:
            raise SystemExit(f"{program.__module__} ended with status {status}.")
    return str(run)


if __name__ == "__main__":
    np.set_printoptions(precision=3)
    sys.exit(main())
