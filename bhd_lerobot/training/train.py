"""`bhd-train`: a policy learns from a LeRobotDataset."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape

import bhd_lerobot.plugin  # noqa: F401  registers our policies and environments
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.command import Program
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals
from bhd_lerobot.training import checkpoint as train_checkpoint
from bhd_lerobot.training.arguments import parse_train
from bhd_lerobot.training.checkpoint import TrainingParts, resume_command
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.data import TrainingData, open_data, open_metadata, select_episodes
from bhd_lerobot.training.env import EnvEvaluation
from bhd_lerobot.training.log import SHOWN, Row, RunProgress, format_numbers
from bhd_lerobot.training.loop import Hooks, TrainingLoop
from bhd_lerobot.training.output import RunOutput
from bhd_lerobot.training.setup import (
    build_optimizer,
    build_policy,
    build_processors,
    check_contract,
    fit_camera,
    make_accelerator,
    refuse_unsupported,
    select_parameters,
)
from bhd_lerobot.training.step import Learner
from bhd_lerobot.training.summary import print_start, print_summary


@dataclass
class TrainResult:
    """The outcome of a training run.

    Attributes:
        output_dir: the run's folder.
        step: steps that were done.
        checkpoint: the last checkpoint; None if there is none.
        rows: rows of `metrics.jsonl`.
        stopped_by: the signal that ended it, if one did.
        wall_s: how long the loop ran [s].
        contract: what the policy was trained on.
    """

    output_dir: Path
    step: int = 0
    checkpoint: Path | None = None
    rows: list[Row] = field(default_factory=list)
    stopped_by: StopRequest = field(default_factory=StopRequest)
    wall_s: float = 0.0
    contract: PolicyContract = field(default_factory=PolicyContract)

    @property
    def exit_status(self) -> int:
        """The exit status of the program."""
        return self.stopped_by.exit_status


def train(config: BhdTrainConfig, console: Console | None = None) -> TrainResult:
    """Train what a configuration asks for."""
    config.validate()
    refuse_unsupported(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    accelerator = make_accelerator(config)
    console = console or Console(stderr=True, quiet=not accelerator.is_main_process)
    with accelerator.main_process_first():  # whoever comes later finds what the first one downloaded
        meta = open_metadata(config)
    tuned = config.policy.pretrained_path if config.policy and config.fine_tune and not config.resume else None
    if tuned is not None:
        check_contract(str(tuned), config.policy, meta)
    select_episodes(config, meta)
    policy = build_policy(config, meta, accelerator)
    select_parameters(policy, config.fine_tune_parameters)
    keep = config.resume or (tuned is not None and config.fine_tune_statistics == "checkpoint")
    preprocessor, postprocessor = build_processors(config, policy, meta, accelerator.device, keep_statistics=keep)
    optimizer, scheduler = build_optimizer(config, policy)
    data = open_data(
        config,
        policy.config,
        meta,
        device=accelerator.device,
        rank=accelerator.process_index,
        world_size=accelerator.num_processes,
        report=lambda message: console.print(escape(message), soft_wrap=True, highlight=False),
        by_own_statistics=not keep,
    )
    contract = PolicyContract.from_dataset(meta, trainer="bhd-train")
    parts = TrainingParts(policy, optimizer, scheduler, preprocessor, postprocessor, contract)
    step, state = train_checkpoint.load(config.checkpoint_path, parts) if config.checkpoint_path else (0, {})
    return _run(
        config,
        accelerator,
        parts,
        data=data,
        step=step,
        state=state,
        camera_keys=tuple(meta.camera_keys),
        console=console,
    )


def _run(
    config: BhdTrainConfig,
    accelerator: Any,
    parts: TrainingParts,
    *,
    data: TrainingData,
    step: int,
    state: dict[str, Any],
    camera_keys: tuple[str, ...],
    console: Console,
) -> TrainResult:
    assert config.optimizer is not None
    learner = Learner(
        parts.policy,
        parts.optimizer,
        parts.scheduler,
        accelerator,
        preprocessor=parts.preprocessor,
        grad_clip_norm=config.optimizer.grad_clip_norm,
        camera_keys=camera_keys,
    )
    parts.optimizer, parts.scheduler = learner.optimizer, learner.scheduler
    if config.fine_tune_camera and not config.resume:
        found = fit_camera(parts.policy, data.train, learner.prepare, processes=accelerator.num_processes)
        console.print(escape(found), soft_wrap=True, highlight=False)
    environment = EnvEvaluation(config, parts, accelerator) if config.env and config.env_eval_freq > 0 else None
    hooks = Hooks(evaluate=None if environment is None else environment.run)
    if accelerator.num_processes > 1:
        hooks.mean = lambda values: accelerator.reduce(values.float().to(accelerator.device), reduction="mean").cpu()
    loop = TrainingLoop(learner, config, data, hooks, accelerator.num_processes)
    if config.checkpoint_path:
        loop.load_state_dict(step, state)
    if step >= config.steps:
        raise ConfigError(f"The run has done {step} of {config.steps} steps. To continue, set more with --steps.")
    is_main = accelerator.is_main_process
    output = RunOutput(config, parts, step, is_main=is_main, processes=accelerator.num_processes)
    print_start(console, config, parts.policy, data, step)
    result = TrainResult(output.folder, step, contract=parts.contract)
    _follow(loop, output, result, config, accelerator=accelerator, console=console)
    print_summary(console, config, result)
    if not loop.interrupted:
        output.push()
    accelerator.wait_for_everyone()
    accelerator.end_training()
    return result


def _follow(
    loop: TrainingLoop,
    output: RunOutput,
    result: TrainResult,
    config: BhdTrainConfig,
    *,
    accelerator: Any,
    console: Console,
) -> None:
    """Run the loop, show and write what comes of it, and keep the result up to date, also when it fails."""
    started = time.perf_counter()
    slow = _ON_CPU if accelerator.device.type == "cpu" else ""
    with RunProgress(console, "training", config.steps, loop.step, slow=slow) as progress, stop_on_signals() as stop:

        def log(row: Row) -> None:
            output.log(row)
            progress.log(f"step {row['step']}/{config.steps}", format_numbers(row, SHOWN))

        def save(at: int, loop_state: dict[str, Any]) -> None:
            output.save(at, loop_state)
            accelerator.wait_for_everyone()

        hooks = loop.hooks
        hooks.log, hooks.save = log, save if config.save_checkpoint else None
        hooks.progress, hooks.should_stop = progress.advance, _agreement(stop, accelerator)
        result.stopped_by = stop
        try:
            loop.run()
        finally:
            result.step, result.wall_s = loop.step, time.perf_counter() - started
            result.checkpoint, result.rows = output.checkpoint, output.rows
            output.draw(loop.step)


_ON_CPU = (
    "The device is a CPU. The configurations in configs/train without _gpu in their names are small enough for one; an "
    "ACT with --policy.dim_model=128 --policy.dim_feedforward=512 and a smaller --batch_size is many times as fast."
)


def _agreement(stop: StopRequest, accelerator: Any) -> Any:
    """Return whether to stop after a step; several processes ask each other now and then, to stop together."""
    if accelerator.num_processes == 1:
        return lambda step: bool(stop)

    def agreed(step: int) -> bool:
        if step % 10:
            return False
        flag = torch.tensor(float(bool(stop)), device=accelerator.device)
        return bool(accelerator.reduce(flag, reduction="sum") > 0)

    return agreed


PROGRAM = Program(
    BhdTrainConfig,
    lambda config: train(config).exit_status,
    parse_train,
    # Ctrl-C before the first step, or a second time while a step or a checkpoint was under way.
    "Stopped; checkpoints that were written before are complete.",
)

__all__ = ["PROGRAM", "TrainResult", "resume_command", "train"]
