"""Success in a simulated environment, measured by LeRobot's own evaluation while a policy is trained."""

from pathlib import Path
from typing import Any

import torch
from lerobot.common.train_utils import get_step_identifier
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import seeded_context

from bhd_lerobot.runs.config_train import BhdTrainConfig
from bhd_lerobot.runs.train_checkpoint import TrainingParts
from bhd_lerobot.runs.train_log import Row


class EnvEvaluation:
    """Runs the environment of a training configuration."""

    def __init__(self, config: BhdTrainConfig, parts: TrainingParts, accelerator: Any) -> None:
        """Prepare it.

        Args:
            config: with `env` and `eval`.
            parts: the policy and its processors.
            accelerator: accelerate's; only its main process evaluates.
        """
        self._config, self._parts, self._accelerator = config, parts, accelerator
        self._before, self._after = make_env_pre_post_processors(env_cfg=config.env, policy_cfg=config.policy)

    def run(self, step: int) -> Row:
        """Evaluate after a step; the training goes on as if that had not happened.

        Returns:
            `success` [%], `sum_reward` and `eval_s`, the time that it took [s].
        """
        config: Any = self._config
        row: Row = {}
        if self._accelerator.is_main_process:
            seed = config.seed or 0
            envs = make_env(config.env, n_envs=config.eval.batch_size, use_async_envs=config.eval.use_async_envs)
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
