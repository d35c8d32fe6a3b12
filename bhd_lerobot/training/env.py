"""Success in a simulated environment, measured by LeRobot's own evaluation while a policy is trained.

The episodes are of the split `validation` where the environment has splits and no other than `held_out` is asked for.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bhd_lerobot.envs.register import ENVIRONMENTS, NAMESPACE
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.stock import (
    close_envs,
    eval_policy_all,
    get_step_identifier,
    make_env,
    make_env_pre_post_processors,
    seeded_context,
)
from bhd_lerobot.training.checkpoint import TrainingParts
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.log import Row


class EnvEvaluation:
    """Runs the environment of a training configuration."""

    def __init__(self, config: BhdTrainConfig, parts: TrainingParts, accelerator: Any) -> None:
        """Prepare it."""
        _check_robot(config, parts.contract.robot_type)
        self._config, self._parts, self._accelerator = config, parts, accelerator
        self._env: Any = config.env
        if getattr(self._env, "split", None) == "held_out":
            # What is chosen by while training must not be what is reported in the end.
            self._env = replace(self._env, split="validation")
        self._before, self._after = make_env_pre_post_processors(env_cfg=config.env, policy_cfg=config.policy)

    def run(self, step: int) -> Row:
        """Evaluate after a step; the training continues as if that had not happened.

        Returns:
            `success` [%], `sum_reward` and `eval_s`, the time that it took [s].
        """
        config: Any = self._config
        row: Row = {}
        if self._accelerator.is_main_process:
            seed = config.seed or 0
            envs = make_env(self._env, n_envs=config.eval.batch_size, use_async_envs=config.eval.use_async_envs)
            try:
                with seeded_context(seed), torch.no_grad(), self._accelerator.autocast():
                    info = eval_policy_all(
                        envs=envs,
                        policy=self._parts.policy,
                        env_preprocessor=self._before,
                        env_postprocessor=self._after,
                        preprocessor=self._parts.preprocessor,
                        postprocessor=self._parts.postprocessor,
                        n_episodes=config.eval.n_episodes,
                        videos_dir=Path(config.output_dir)
                        / "eval"
                        / f"videos_{get_step_identifier(step, config.steps)}",
                        max_episodes_rendered=0,
                        start_seed=seed,
                        max_parallel_tasks=config.env.max_parallel_tasks,
                    )
            except BhdError:
                raise
            except Exception as error:  # of a policy, an environment, or a processor between them
                raise BhdError(
                    f"The policy cannot be evaluated in env.task={getattr(config.env, 'task', None)!r}: "
                    f"{' '.join(str(error).split())}. "
                    "Set --env_eval_freq=0, or the env of the dataset's robot and task."
                ) from error
            finally:
                close_envs(envs)
                self._parts.policy.train()
            overall = info["overall"]
            row = {
                "success": float(overall["pc_success"]),
                "sum_reward": float(overall["avg_sum_reward"]),
                "eval_s": float(overall["eval_s"]),
            }
        self._accelerator.wait_for_everyone()
        return row


def _check_robot(config: BhdTrainConfig, robot: str | None) -> None:
    pair = ENVIRONMENTS.get(str(getattr(config.env, "task", None)).removeprefix(f"{NAMESPACE}/"))
    if robot is not None and pair is not None and pair[0] != robot:
        fitting = ", ".join(sorted(name for name, (kind, _) in ENVIRONMENTS.items() if kind == robot)) or "none"
        raise ConfigError(
            f"env.task is {config.env.task!r}, which is for a {pair[0]}; the dataset is of a {robot}. Valid: {fitting}."
        )
