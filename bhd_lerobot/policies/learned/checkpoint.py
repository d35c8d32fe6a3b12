"""Where a trained policy lies: in which folder of a run, or on the Hub."""

import re
from hashlib import file_digest
from pathlib import Path

from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from bhd_lerobot.errors import ConfigError

CONFIG_FILE = "config.json"
"""LeRobot's name of a policy's configuration."""

WEIGHT_FILES = ("model.safetensors", "adapter_model.safetensors")
"""LeRobot's and PEFT's names of a policy's weights."""

_HUB_ID = re.compile(r"[\w][\w.-]*/[\w][\w.-]*")


def weights_digest(folder: Path) -> str:
    """Return which weights a checkpoint's folder holds: ``sha256:`` and the digest of their file."""
    with (folder / WEIGHT_FILES[0]).open("rb") as file:
        return f"sha256:{file_digest(file, 'sha256').hexdigest()}"


def recorded_path(given: str, folder: Path) -> str:
    """Return what datasets and results call a policy: nothing of where it lies on this machine.

    That is ``RUN/checkpoints/STEP`` of a training run, the name of any other folder, or the name on the Hub. However a
    folder is named, this is the same; which weights are in it, `weights_digest` says.
    """
    if not Path(given).expanduser().is_dir():
        return given
    folder = folder.resolve()
    if folder.name == PRETRAINED_MODEL_DIR:
        folder = folder.parent
    if folder.parent.name == CHECKPOINTS_DIR:
        return "/".join(folder.parts[-3:])
    return folder.name


def find_checkpoint(path: str | Path, revision: str | None = None) -> Path:
    """Return the folder with a policy's configuration and weights.

    Args:
        path: that folder; a checkpoint's or a training run's folder, then its last checkpoint; or the name of a model
            on the Hub, `user/name`.
        revision: branch, tag or commit of a model on the Hub; its main branch if None.
    """
    text, folder = str(path), Path(path).expanduser()
    if folder.is_dir():
        return _complete(_in_folder(folder))
    if folder.exists():
        raise ConfigError(f"{text} is a file; name the folder that it is in, {str(folder.parent)!r}.")
    if not _HUB_ID.fullmatch(text):
        raise ConfigError(
            f"There is no policy at {text!r}: the folder does not exist. Name a training run's folder, one of its "
            "checkpoints, or a model on the Hub (user/name)."
        )
    from huggingface_hub import snapshot_download

    try:
        # What a policy consists of: neither the optimizer's state nor videos.
        patterns = ["*.json", "*.safetensors", "*.model", "*.txt"]
        return _complete(_in_folder(Path(snapshot_download(text, revision=revision, allow_patterns=patterns))))
    except ConfigError:
        raise
    except Exception as error:  # the Hub's client lets through whatever its transport raises
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ConfigError(
            f"There is no policy at {text!r}: no such folder is here, and it cannot be downloaded from the Hub "
            f"({reason}) Check the name, your login (hf auth login) and the network, or copy the checkpoint here."
        ) from error


def _in_folder(folder: Path) -> Path:
    if (folder / CONFIG_FILE).is_file():
        return folder
    if (folder / PRETRAINED_MODEL_DIR).is_dir():
        return folder / PRETRAINED_MODEL_DIR
    checkpoints = folder if folder.name == CHECKPOINTS_DIR else folder / CHECKPOINTS_DIR
    last = checkpoints / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
    if last.is_dir():
        return last
    # A copy may have lost the link.
    steps = [path for path in checkpoints.glob(f"*/{PRETRAINED_MODEL_DIR}") if path.parent.name.isdigit()]
    if steps:
        return max(steps, key=lambda one: int(one.parent.name))
    found = ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
    raise ConfigError(
        f"There is no policy in {folder}: neither {CONFIG_FILE}, {PRETRAINED_MODEL_DIR}/ nor "
        f"{CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}/{PRETRAINED_MODEL_DIR}/. There is: {found}. "
        "A training run that has not saved yet has none."
    )


def _complete(folder: Path) -> Path:
    missing = [] if (folder / CONFIG_FILE).is_file() else [CONFIG_FILE]
    if not any((folder / name).is_file() for name in WEIGHT_FILES):
        missing.append(WEIGHT_FILES[0])
    if missing:
        raise ConfigError(
            f"The checkpoint {folder} is not complete: {' and '.join(missing)} missing. It was perhaps interrupted "
            "while it was written or copied; use an earlier checkpoint of the run, or copy it again."
        )
    return folder
