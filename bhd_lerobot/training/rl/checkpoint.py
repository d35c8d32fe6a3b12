"""Checkpoints of a reinforcement learning run: a policy that runs anywhere, and the learner's state beside it."""

import json
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.stock import load_rng_state, save_rng_state
from bhd_lerobot.training.checkpoint import writing
from bhd_lerobot.training.rl.parts import RlParts

BEST = "best"
LEARNER, RUN = "learner.zip", "run.json"
"""In `training_state`: parameters of actor, critic and optimizer, in stable-baselines3's format; where the run was."""


def folder_of(output_dir: Path, step: int) -> Path:
    """Return the folder of the checkpoint after some environment steps."""
    return output_dir / CHECKPOINTS_DIR / f"{step:09d}"


def save(output_dir: Path, parts: RlParts, learner: Any, next_episode: int) -> Path:
    """Write a checkpoint, point `last` at it, and return its folder."""
    from stable_baselines3.common.save_util import save_to_zip_file

    final = folder_of(output_dir, learner.num_timesteps)
    with writing(final) as part:
        export(part / PRETRAINED_MODEL_DIR, parts, learner.policy.log_std)
        state = part / TRAINING_STATE_DIR
        state.mkdir()
        save_to_zip_file(state / LEARNER, params=learner.get_parameters())
        save_rng_state(state)
        (state / RUN).write_text(json.dumps({"next_episode": next_episode}), encoding="utf-8")
    return final


def export(folder: Path, parts: RlParts, log_std: torch.Tensor) -> None:
    """Write the policy in LeRobot's form: configuration, weights, processors, and the contract."""
    folder.mkdir(parents=True, exist_ok=True)
    if parts.actor.log_std is not None:
        with torch.no_grad():
            parts.actor.log_std.copy_(log_std.expand_as(parts.actor.log_std))
    parts.actor.save_pretrained(folder)
    parts.before.save_pretrained(folder)
    parts.after.save_pretrained(folder)
    parts.contract.save(folder)


def read_next_episode(output_dir: Path) -> int:
    """Return the number of the episode that a resumed run begins with."""
    try:
        run = json.loads((_last(output_dir) / TRAINING_STATE_DIR / RUN).read_text(encoding="utf-8"))
        return int(run["next_episode"])
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"There is no run to resume in {output_dir}: {error}") from error


def load(output_dir: Path, learner: Any) -> None:
    """Load the last checkpoint of a run into a learner."""
    folder = _last(output_dir)
    try:
        learner.set_parameters(str(folder / TRAINING_STATE_DIR / LEARNER), device="cpu")  # tensors only, no pickle
        learner.num_timesteps = int(folder.name)
        load_rng_state(folder / TRAINING_STATE_DIR)
    except Exception as error:  # zip, PyTorch, safetensors: each has its own
        raise ConfigError(
            f"The run in {output_dir} cannot be resumed: {' '.join(str(error).split())[:300]}. Resume with the "
            "configuration that it was started with, or start a new one in another --output_dir."
        ) from error


def _last(output_dir: Path) -> Path:
    return (output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK).resolve()
