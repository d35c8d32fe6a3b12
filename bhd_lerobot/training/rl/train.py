"""`bhd-train` with `algorithm: ppo`: a policy learns by trial and error."""

import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from rich.console import Console

import bhd_lerobot.plugin  # noqa: F401  registers our policies and environments
from bhd_lerobot.errors import BhdError, ConfigError, install_extra, quoted
from bhd_lerobot.options.command import Program
from bhd_lerobot.policies.learned.inference import use_threads
from bhd_lerobot.rollout.signals import StopRequest, stop_on_signals
from bhd_lerobot.training.config import refuse_existing
from bhd_lerobot.training.log import Row
from bhd_lerobot.training.rl.config import RlConfig, parse_rl

PLOT_NAME = "learning_curve.png"


@dataclass
class RlResult:
    """The outcome of a run.

    Attributes:
        output_dir: the run's folder.
        step: environment steps that were done.
        checkpoint: the last checkpoint.
        best: the checkpoint that was best on the validation episodes.
        rows: rows of `metrics.jsonl`.
        rule: level of the rule on the validation episodes, with the keys of a row.
        stopped_by: the signal that ended it, if one did.
    """

    output_dir: Path
    step: int = 0
    checkpoint: Path | None = None
    best: Path | None = None
    rows: list[Row] = field(default_factory=list)
    rule: Row = field(default_factory=dict)
    stopped_by: StopRequest = field(default_factory=StopRequest)


def train(config: RlConfig, console: Console | None = None) -> RlResult:
    """Learn what a configuration asks for."""
    try:
        import stable_baselines3  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"Reinforcement learning needs stable-baselines3, which is not installed. {install_extra('rl')}"
        ) from error
    from bhd_lerobot.training.rl.run import Run

    folder = _run_folder(config)
    try:
        with use_threads(config.threads), stop_on_signals() as stop:
            return Run(config, folder, console or Console(stderr=True), stop).go()
    except OSError as error:
        raise BhdError(
            f"The run in {folder} cannot be written: {error.strerror or error}. Checkpoints saved before are intact. "
            f"Make room, and continue with --resume=true --config_path={quoted(folder)}."
        ) from error
    finally:
        if not config.resume:
            with suppress(OSError):  # a run that failed before it wrote anything can be started again
                folder.rmdir()


def _run_folder(config: RlConfig) -> Path:
    """Return the run's folder, made if it was not there; without `output_dir`, a new one."""
    if config.output_dir is None:
        config.output_dir = f"outputs/train/{datetime.now():%Y-%m-%d/%H-%M-%S}_ppo_{config.robot.type}"
    folder = Path(config.output_dir).expanduser()
    if not config.resume:
        refuse_existing(folder)
    try:
        if config.resume and not folder.is_dir():
            raise ConfigError(f"There is no run to resume in {folder}.")
        folder.mkdir(parents=True, exist_ok=config.resume)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:  # also a name that is too long
        raise ConfigError(f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error
    return folder


PROGRAM = Program(
    RlConfig,
    lambda config: train(config).stopped_by.exit_status,
    parse_rl,
    "Stopped; checkpoints that were written before are complete.",
)
