"""Checkpoints of a training run: LeRobot's, written so that a kill at any moment leaves the one before usable."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)

from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import BhdError, ConfigError, quoted
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.stock import get_step_checkpoint_dir, load_training_state, save_checkpoint
from bhd_lerobot.training.config import BhdTrainConfig

LOOP_STATE = "bhd_loop.json"
"""In `training_state`: where the loader was, and what had been measured since the last logged step."""


@dataclass
class TrainingParts:
    """What a checkpoint consists of."""

    policy: Any
    optimizer: Any
    scheduler: Any
    preprocessor: Any
    postprocessor: Any
    contract: PolicyContract


def save(config: BhdTrainConfig, step: int, parts: TrainingParts, loop: dict[str, Any], processes: int = 1) -> Path:
    """Write a checkpoint, point `last` at it, and return its folder."""
    assert config.output_dir is not None
    final = get_step_checkpoint_dir(Path(config.output_dir), config.steps, step)
    with writing(final) as part:
        save_checkpoint(part, step, config, parts, processes)
        parts.contract.save(part / PRETRAINED_MODEL_DIR)
        (part / TRAINING_STATE_DIR / LOOP_STATE).write_text(json.dumps(loop), encoding="utf-8")
    return final


def load(checkpoint: Path, parts: TrainingParts) -> tuple[int, dict[str, Any]]:
    """Load optimizer, scheduler and random states of a checkpoint; return its step and the state of the loop.

    The policy's weights and the processors are loaded when they are made.
    """
    try:
        step = load_training_state(checkpoint, parts.optimizer, parts.scheduler)
        path = checkpoint / TRAINING_STATE_DIR / LOOP_STATE
        loop = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except Exception as error:  # safetensors, JSON, PyTorch: each has its own
        raise ConfigError(f"Training cannot be resumed from {checkpoint}: {error}") from error
    return step, loop


def clean(output_dir: Path) -> None:
    """Remove what a kill left of unfinished checkpoints."""
    for path in (output_dir / CHECKPOINTS_DIR).glob(".*"):
        if path.is_symlink():
            path.unlink()
        else:
            shutil.rmtree(path, ignore_errors=True)


def last_checkpoint(run: Path) -> Path | None:
    """Return the folder of a run's last checkpoint, also where a copy lost the link, or made a folder of it."""
    checkpoints = run / CHECKPOINTS_DIR
    last = (checkpoints / LAST_CHECKPOINT_LINK).resolve()
    if last.is_dir() and last.name.isdigit():
        return last
    numbered = [one for one in checkpoints.glob("*") if one.name.isdigit()]
    return max(numbered, key=lambda one: int(one.name), default=None)


def resume_command(checkpoint: Path) -> str:
    """Return the command that continues from a run's last checkpoint."""
    last = checkpoint.parent / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR / "train_config.json"
    return f"bhd-train --resume=true --config_path={quoted(last)}"


@contextmanager
def writing(final: Path) -> Iterator[Path]:
    """Give a new folder for a checkpoint; complete, it is renamed and `last` leads to it: there is never half one."""
    part, old = (final.with_name(f".{final.name}.{suffix}") for suffix in ("part", "old"))
    disk = Disk()
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        _flush(part)
        shutil.rmtree(old, ignore_errors=True)
        if final.exists():  # a kill between the renaming and the link; `last` still points at one before
            disk.move(final, old)
        disk.move(part, final)
        shutil.rmtree(old, ignore_errors=True)
        point(final, LAST_CHECKPOINT_LINK)
    except Exception as error:  # for a full disk, PyTorch and safetensors raise errors of their own
        shutil.rmtree(part, ignore_errors=True)
        raise BhdError(
            f"The checkpoint of step {int(final.name)} cannot be written to {final.parent}: {error}. Those before it "
            "are intact."
        ) from error


def point(checkpoint: Path, name: str) -> None:
    """Have a link beside a checkpoint, such as `last`, lead to it."""
    link, target = checkpoint.with_name(f".{name}.part"), checkpoint.with_name(name)
    link.unlink(missing_ok=True)
    link.symlink_to(checkpoint.name)
    if target.is_dir() and not target.is_symlink():  # of a copy that followed the link
        shutil.rmtree(target)
    Disk().move(link, target)


def _flush(folder: Path) -> None:
    """Have the system write the files to disk before they get their final name, in case the power fails."""
    disk = Disk(fsync=True)
    for path in (p for p in folder.rglob("*") if p.is_file()):
        disk.flush(path)
