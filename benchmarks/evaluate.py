"""`bhd-eval` beside stock `lerobot-eval` on Gymnasium's SyncVectorEnv: `python -m benchmarks.evaluate`.

Both run the same policy on the same episodes, without films, and both are timed from the configuration to the numbers:
ours includes its intervals and its report. Without `--path` a small `bhd_mlp` is trained first, on episodes of a rule.
The goal: at least 10 times the episodes a second. Exits with 1 if it is missed.
"""

import argparse
import contextlib
import io
import json
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.factory import make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy
from rich.console import Console

from bhd_lerobot.envs.config_env import BhdEnvConfig
from bhd_lerobot.policies.contract import find_checkpoint
from bhd_lerobot.runs.config_eval import EvalConfig
from bhd_lerobot.runs.configuration import parse
from bhd_lerobot.runs.evaluate import EvalResult, evaluate
from bhd_lerobot.runs.record import main as record_main
from bhd_lerobot.runs.train import main as train_main

GOAL = 10.0
TASKS = {"avoid": ("turtlebot3", "TurtleBot3Avoid-v0", "gap_follower"), "reach": ("ur5", "UR5Reach-v0", "reach")}


def main() -> int:
    """Run both, print episodes a second and their ratio, return 0 if the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=tuple(TASKS), default="avoid")
    parser.add_argument("--path", help="checkpoint of the policy; a small one is trained if none is given")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--stock_episodes", type=int, default=50, help="how many of them the stock program runs")
    parser.add_argument("--n_envs", type=int, default=50, help="simulations side by side, of both")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    logging.disable(logging.INFO)
    with tempfile.TemporaryDirectory() as folder:
        path = args.path or train_policy(args.task, Path(folder))
        stock_s, stock = run_stock(args.task, path, args.stock_episodes, args.n_envs, args.seed)
        ours_s, result = run_ours(
            args.task, path, args.episodes, args.n_envs, seed=args.seed, folder=Path(folder) / "eval"
        )
    ours = result.results.episodes
    stock_rate, ours_rate = args.stock_episodes / stock_s, args.episodes / ours_s
    ratio = ours_rate / stock_rate
    same = [one["success"] == our.success for one, our in zip(stock, ours, strict=False)]
    rewards = [abs(one["sum_reward"] - our.reward) for one, our in zip(stock, ours, strict=False)]
    print(f"{args.task}, policy {PreTrainedConfig.from_pretrained(find_checkpoint(path)).type}, seed {args.seed}")
    print(f"lerobot-eval, SyncVectorEnv of {args.n_envs:<4} {args.stock_episodes:>5} episodes in {stock_s:>6.1f} s")
    print(f"bhd-eval, n_envs = {args.n_envs:<13} {args.episodes:>5} episodes in {ours_s:>6.1f} s")
    print(f"episodes a second: {stock_rate:.2f} and {ours_rate:.2f}; ratio {ratio:.1f}, goal {GOAL:.0f}")
    print(
        f"of the {len(same)} episodes of both, {sum(same)} ended the same; returns differ by at most {max(rewards):.2g}"
    )
    timing = result.timing["brains"]["policy"]
    print(f"bhd-eval's run alone: {timing['episodes_per_s']:.2f} episodes a second, {timing['real_time_factor']:.0f} x")
    print(json.dumps({"episodes_per_s": {"lerobot-eval": stock_rate, "bhd-eval": ours_rate}, "ratio": ratio}))
    met = ratio >= GOAL
    print("goal met" if met else "GOAL MISSED")
    return 0 if met else 1


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
    """Run what `lerobot-eval` runs, without films; return how long it took [s], and its episodes."""
    started = time.perf_counter()
    env_config = BhdEnvConfig(task=TASKS[task][1], vector="sync", seed=seed)
    folder = find_checkpoint(path)
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


def train_policy(task: str, folder: Path) -> str:
    """Record episodes of a rule and train a small policy on them; return the run's folder."""
    robot, _, brain = TASKS[task]
    data, run = folder / "data", folder / "train"
    record = [
        f"--robot.type={robot}",
        f"--task.type={task}",
        f"--brain.type={brain}",
        "--dataset.repo_id=benchmark/evaluate",
        f"--dataset.root={data}",
        "--dataset.num_episodes=40",
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
        "--steps=500",
        "--batch_size=64",
        "--save_freq=500",
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
