"""The folder of a reinforcement-learning run."""

import json
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import yaml

from bhd_lerobot.errors import ConfigError, quoted
from bhd_lerobot.training.rl.config import CONFIG_NAME, RlConfig, encode


def run_folder(config: RlConfig) -> Path:
    """Return the run's folder, made if it was not there; without `output_dir`, a new one, which the configuration gets.

    Raises:
        ConfigError: it is there and not to be resumed, or to be resumed and not there, or cannot be written.
    """
    if config.output_dir is None:
        config.output_dir = f"outputs/train/{datetime.now():%Y-%m-%d/%H-%M-%S}_ppo_{config.robot.type}"
    folder = Path(config.output_dir).expanduser()
    try:
        is_there = folder.exists()
    except OSError as error:  # a name that is too long
        raise ConfigError(f"The run folder {folder} cannot be used: {error.strerror}. Set --output_dir.") from error
    if is_there and not config.resume:
        raise ConfigError(
            f"The output folder {folder} exists. Set another --output_dir, or continue its run with "
            f"--resume=true --config_path={quoted(folder)}."
        )
    if config.resume and not folder.is_dir():
        raise ConfigError(f"There is no run to resume in {folder}.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f".{CONFIG_NAME}.part").touch()
        (folder / f".{CONFIG_NAME}.part").unlink()
    except OSError as error:
        raise ConfigError(f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir.") from error
    return folder


def write_config(config: RlConfig, folder: Path) -> None:
    """Write the resolved configuration; that of a run which cannot be resumed with another one stays as it was."""
    values = {**encode(config), "resume": False}
    text = yaml.safe_dump(json.loads(json.dumps(values)), sort_keys=False, default_flow_style=None, width=110)
    (folder / CONFIG_NAME).write_text(text, encoding="utf-8")


def remove_empty(folder: Path) -> None:
    """Remove the folder of a run that failed before it wrote anything, so that it can be started again."""
    with suppress(OSError):
        folder.rmdir()
