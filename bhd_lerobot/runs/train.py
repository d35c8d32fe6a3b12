"""`bhd-train`: a policy learns from a LeRobotDataset."""

import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from lerobot.common.train_utils import push_checkpoint_to_hub
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.import_utils import register_third_party_plugins
from rich.console import Console
from rich.markup import escape

import bhd_lerobot.plugin  # noqa: F401  registers our policies and environments
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.policies.contract import PolicyContract
from bhd_lerobot.runs import train_checkpoint
from bhd_lerobot.runs.config_train import BhdTrainConfig, plain
from bhd_lerobot.runs.configuration import describe
from bhd_lerobot.runs.rl.config import is_rl
from bhd_lerobot.runs.signals import StopRequest, stop_on_signals
from bhd_lerobot.runs.train_arguments import Request, parse_train
from bhd_lerobot.runs.train_checkpoint import TrainingParts, resume_command
from bhd_lerobot.runs.train_data import TrainingData, open_data, open_metadata, select_episodes
from bhd_lerobot.runs.train_env import EnvEvaluation
from bhd_lerobot.runs.train_log import (
    METRICS_NAME,
    PLOT_NAME,
    MetricsFile,
    Row,
    TrainingProgress,
    draw_loss,
    read_metrics,
)
from bhd_lerobot.runs.train_loop import Hooks, LoopOptions, TrainingLoop
from bhd_lerobot.runs.train_setup import (
    build_policy,
    build_processors,
    check_contract,
    make_accelerator,
    refuse_unsupported,
)
from bhd_lerobot.runs.train_step import Learner
from bhd_lerobot.runs.train_summary import tell_start, tell_summary


@dataclass
class TrainResult:
    """What became of a training run.

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


def train(request: Request, console: Console | None = None) -> TrainResult:
    """Train what a command line asks for.

    Args:
        request: the configuration, and the checkpoint whose contract the dataset must fit.
        console: where progress is shown; standard error if None.

    Raises:
        BhdError: the configuration cannot be honoured, or training failed. Checkpoints saved before are intact.
    """
    config = request.config
    config.validate()
    refuse_unsupported(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    accelerator = make_accelerator(config)
    console = console or Console(stderr=True, quiet=not accelerator.is_main_process)
    with accelerator.main_process_first():  # whoever comes later finds what the first one downloaded
        meta = open_metadata(config)
    if request.contract is not None:
        check_contract(request.contract, meta)
    select_episodes(config, meta)
    policy = build_policy(config, meta, accelerator)
    keep = config.resume or (request.contract is not None and config.fine_tune_statistics == "checkpoint")
    preprocessor, postprocessor = build_processors(config, policy, meta, accelerator.device, keep_statistics=keep)
    optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
    data = open_data(
        config,
        policy.config,
        meta,
        device=accelerator.device,
        rank=accelerator.process_index,
        world_size=accelerator.num_processes,
        say=lambda message: console.print(escape(message), soft_wrap=True, highlight=False),
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
    options = LoopOptions(
        steps=config.steps,
        batch_size=config.batch_size * accelerator.num_processes,
        frames=data.frames,
        log_freq=config.log_freq,
        eval_freq=config.eval_steps,
        save_freq=config.save_freq,
        env_eval_freq=config.env_eval_freq,
        seed=config.seed or 0,
        held_out=data.held_out_episodes,
    )
    result = TrainResult(Path(str(config.output_dir)), step, config.checkpoint_path, contract=parts.contract)
    environment = EnvEvaluation(config, parts, accelerator) if config.env and config.env_eval_freq > 0 else None
    hooks = Hooks(
        held_out=None if data.held_out is None else data.held_out.__iter__,
        evaluate=None if environment is None else environment.run,
    )
    loop = TrainingLoop(learner, data.train, options, hooks)
    if config.checkpoint_path:
        loop.load_state_dict(step, state)
    if step >= config.steps:
        raise ConfigError(f"The run has done {step} of {config.steps} steps. To go on, set more with --steps.")
    metrics = _open_run_folder(config, step) if accelerator.is_main_process else None
    wandb = _wandb(config) if accelerator.is_main_process else None
    tell_start(console, config, parts.policy, data, step)

    def log(row: Row) -> None:
        if metrics is None:
            return
        metrics.append(row)
        progress.log(row)
        if wandb is not None:
            wandb.log_dict({key: one for key, one in row.items() if key != "step"}, row["step"])

    def save(at: int, loop_state: dict[str, Any]) -> None:
        if metrics is not None:
            result.checkpoint = train_checkpoint.save(config, at, parts, loop_state, accelerator.num_processes)
            draw_loss(metrics.rows, result.output_dir / PLOT_NAME, _heading(config, at))
            _share(config, result.checkpoint, wandb)
        accelerator.wait_for_everyone()

    hooks.log, hooks.save = log, save if config.save_checkpoint else None
    if accelerator.num_processes > 1:
        hooks.mean = lambda values: accelerator.reduce(values.float().to(accelerator.device), reduction="mean").cpu()
    started = time.perf_counter()
    with TrainingProgress(console, config.steps, step) as progress, stop_on_signals() as stop:
        hooks.progress = progress.advance
        hooks.should_stop = _agreement(stop, accelerator)
        result.stopped_by = stop
        try:
            loop.run()
        finally:
            result.step, result.wall_s = loop.step, time.perf_counter() - started
            if metrics is not None:
                result.rows = metrics.rows
                draw_loss(metrics.rows, result.output_dir / PLOT_NAME, _heading(config, loop.step))
    tell_summary(console, config, result)
    push = config.policy is not None and config.policy.push_to_hub
    if not loop.interrupted and accelerator.is_main_process and push:
        _push(config, parts, result)
    accelerator.wait_for_everyone()
    accelerator.end_training()
    return result


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


def _open_run_folder(config: BhdTrainConfig, step: int) -> MetricsFile:
    folder = Path(str(config.output_dir))
    source = config.checkpoint_path.parent.parent if config.checkpoint_path else folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        train_checkpoint.clean(folder)
        text = yaml.safe_dump(plain(config), sort_keys=False, default_flow_style=None, width=110)
        (folder / "config.yaml").write_text(text, encoding="utf-8")
        config._save_pretrained(folder)
        return MetricsFile(folder / METRICS_NAME, read_metrics(source / METRICS_NAME, step))
    except OSError as error:
        raise ConfigError(f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error


def _heading(config: BhdTrainConfig, step: int) -> str:
    return f"{config.job_name} on {config.dataset.repo_id}, step {step} of {config.steps}"


def _wandb(config: BhdTrainConfig) -> Any:
    if not (config.wandb.enable and config.wandb.project):
        return None
    from lerobot.common.wandb_utils import WandBLogger

    return WandBLogger(config)


def _share(config: BhdTrainConfig, checkpoint: Path, wandb: Any) -> None:
    if config.save_checkpoint_to_hub and config.policy is not None:
        try:
            push_checkpoint_to_hub(checkpoint, config.policy.repo_id, private=config.policy.private)
        except Exception as error:  # of the Hub's client or the network
            raise BhdError(f"The checkpoint is complete at {checkpoint}, but it was not uploaded: {error}") from error
    if wandb is not None:
        wandb.log_policy(checkpoint)


def _push(config: BhdTrainConfig, parts: TrainingParts, result: TrainResult) -> None:
    policy: Any = config.policy
    try:
        parts.policy.push_model_to_hub(config)
        parts.preprocessor.push_to_hub(policy.repo_id)
        parts.postprocessor.push_to_hub(policy.repo_id)
        if result.checkpoint is not None:
            from huggingface_hub import HfApi

            file = result.checkpoint / PRETRAINED_MODEL_DIR / "bhd.json"
            HfApi().upload_file(path_or_fileobj=file, path_in_repo=file.name, repo_id=policy.repo_id)
    except Exception as error:  # of the Hub's client or the network
        raise BhdError(f"The policy is complete at {result.checkpoint}, but it was not uploaded: {error}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-train`; return the exit status: 0, 2 after an error, 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if is_rl(arguments):
        from bhd_lerobot.runs.rl.train import main as learn_by_trial

        return learn_by_trial(arguments)
    if any(one in ("-h", "--help") for one in arguments):
        print(describe(BhdTrainConfig))
        return 0
    try:
        register_third_party_plugins()
        return train(parse_train(arguments)).exit_status
    except BhdError as error:
        Console(stderr=True).print(f"error: {escape(str(error))}", soft_wrap=True, highlight=False)
        return 2
    except KeyboardInterrupt:
        print("Interrupted before the first step; nothing was written.", file=sys.stderr)
        return 128 + signal.SIGINT


__all__ = ["TrainResult", "main", "resume_command", "train"]

if __name__ == "__main__":
    sys.exit(main())
