"""Checkpoints of a reinforcement learning run: a policy that runs anywhere, and the learner's state beside it."""

import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR

from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.training.rl.parts import RlParts

BEST = "best"
LEARNER, RUN = "learner.pt", "run.json"


def save(output_dir: Path, step: int, parts: RlParts, learner: Any, run: dict[str, Any]) -> Path:
    """Write a checkpoint, point `last` at it, and return its folder.

    Args:
        output_dir: the run's folder.
        step: environment steps that were done.
        parts: the policy, whose weights are the learner's, and what belongs to it.
        learner: the `AnchoredPPO`.
        run: state of the run, JSON values.

    Raises:
        BhdError: it cannot be written; those before it are intact.
    """
    final = output_dir / CHECKPOINTS_DIR / f"{step:09d}"
    part = final.with_name(f".{final.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        (part / TRAINING_STATE_DIR).mkdir(parents=True)
        export(part / PRETRAINED_MODEL_DIR, parts, learner.policy.log_std)
        torch.save(_state(learner), part / TRAINING_STATE_DIR / LEARNER)
        (part / TRAINING_STATE_DIR / RUN).write_text(json.dumps(run), encoding="utf-8")
        shutil.rmtree(final, ignore_errors=True)
        os.replace(part, final)
        point(final, LAST_CHECKPOINT_LINK)
    except Exception as error:  # for a full disk, PyTorch and safetensors raise errors of their own
        shutil.rmtree(part, ignore_errors=True)
        raise BhdError(
            f"The checkpoint of step {step} cannot be written to {final.parent}: {error}. Those before it are intact."
        ) from error
    return final


def export(folder: Path, parts: RlParts, log_std: torch.Tensor | None = None) -> None:
    """Write the policy in LeRobot's form: configuration, weights, processors, and the contract.

    Args:
        folder: where it goes.
        parts: the policy and what belongs to it.
        log_std: the learner's exploration noise, shape (actions,); the policy's own if None.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if log_std is not None and parts.actor.log_std is not None:
        with torch.no_grad():
            parts.actor.log_std.copy_(log_std.expand_as(parts.actor.log_std))
    parts.actor.save_pretrained(folder)
    parts.before.save_pretrained(folder)
    parts.after.save_pretrained(folder)
    parts.contract.save(folder)


def load(output_dir: Path, learner: Any) -> tuple[int, dict[str, Any]]:
    """Load the last checkpoint of a run into a learner; return its step and the state of the run.

    Raises:
        ConfigError: there is none that fits.
    """
    folder = (output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK).resolve()
    try:
        run = json.loads((folder / TRAINING_STATE_DIR / RUN).read_text(encoding="utf-8"))
        state = torch.load(folder / TRAINING_STATE_DIR / LEARNER, weights_only=True)
        learner.policy.load_state_dict(state["policy"])
        learner.policy.optimizer.load_state_dict(state["optimizer"])
        learner.num_timesteps, learner._n_updates = state["step"], state["updates"]
        torch.set_rng_state(state["torch"])
        kind, words, position, has_gauss, cached = state["numpy"]
        numpy_state = kind, np.array(words, np.uint32), position, has_gauss, cached
        np.random.set_state(numpy_state)  # noqa: NPY002
        version, internal, following = state["python"]
        random.setstate((version, tuple(internal), following))
    except Exception as error:  # JSON, pickle, PyTorch: each has its own
        raise ConfigError(
            f"The run in {output_dir} cannot be resumed: {' '.join(str(error).split())[:300]}. Resume with the "
            "configuration that it was started with, or start a new one in another --output_dir."
        ) from error
    return int(folder.name), run


def point(checkpoint: Path, name: str) -> None:
    """Have a link beside a checkpoint lead to it."""
    link = checkpoint.with_name(f".{name}.part")
    link.unlink(missing_ok=True)
    link.symlink_to(checkpoint.name)
    os.replace(link, checkpoint.with_name(name))


def _state(learner: Any) -> dict[str, Any]:
    # Stable-baselines3 draws its minibatches from NumPy's global generator.
    kind, words, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002
    version, internal, following = random.getstate()
    return {
        "policy": learner.policy.state_dict(),
        "optimizer": learner.policy.optimizer.state_dict(),
        "step": int(learner.num_timesteps),
        "updates": int(learner._n_updates),
        "torch": torch.get_rng_state(),
        "numpy": (kind, [int(word) for word in np.asarray(words)], int(position), int(has_gauss), float(cached)),
        "python": (version, list(internal), following),
    }
