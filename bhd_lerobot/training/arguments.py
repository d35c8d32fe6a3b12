"""From the command line of `bhd-train` to its configuration: also `policy.path`, and `resume` from a checkpoint."""

import contextlib
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lerobot.policies  # noqa: F401  registers LeRobot's own
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from bhd_lerobot.datasets.format.identity import local_name
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options import parse as configuration
from bhd_lerobot.policies.learned.contract import find_checkpoint
from bhd_lerobot.training.checkpoint import last_checkpoint
from bhd_lerobot.training.config import OWN_CONFIG_NAME, BhdTrainConfig


def parse_train(arguments: Sequence[str] | configuration.CommandLine) -> BhdTrainConfig:
    """Return the configuration, not validated; to resume, its path is a checkpoint's file or folder, or a run."""
    line = configuration.read_line(arguments)
    checkpoint: Path | None = None
    if line.options.get("resume") is True:
        if line.path is None:
            raise ConfigError(f"resume needs --config_path, the {TRAIN_CONFIG_NAME} of a checkpoint or its folder.")
        checkpoint = _resumed(line.path, line.options.get("output_dir"))
        values = _read_checkpoint(checkpoint)
        values["output_dir"] = str(checkpoint.parent.parent)  # the run may have been moved
        _refuse_ignored(line.options, values)
    else:
        values = {**line.file, "resume": False}  # only a command line resumes a run
    return config_of(line.over(values), checkpoint)


def _resumed(path: Path, output_dir: Any) -> Path:
    """Return the checkpoint to go on with; the message names the run's folder where `output_dir` was given instead."""
    try:
        return resumed_checkpoint(path)
    except ConfigError as error:
        run = None if output_dir is None else Path(str(output_dir)).expanduser()
        if run is None or not (run / CHECKPOINTS_DIR).is_dir():
            raise
        raise ConfigError(
            f"{error} To continue the run in {run}: bhd-train --resume=true --config_path={shlex.quote(str(run))}"
        ) from None


def resumed_checkpoint(path: Path) -> Path:
    """Return the folder of the checkpoint that a path means: a file in it, a folder of it, itself, or its run."""
    folder = path.parent if path.is_file() else path
    for one in (folder.parent, folder, last_checkpoint(folder)):
        if one is not None and (one / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME).is_file():
            return one.resolve()
    raise ConfigError(
        f"No checkpoint to resume at {path}: neither {TRAIN_CONFIG_NAME} in it, nor in {PRETRAINED_MODEL_DIR}/, nor "
        f"in {CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}/{PRETRAINED_MODEL_DIR}/."
    )


def _refuse_ignored(options: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Refuse options that a resumed run does not take: where it started, and what its optimizer's state says."""
    for name, given in options.items():
        wanted = given
        theirs = ("policy.optimizer_", "policy.scheduler", "optimizer.")  # the policy's are of its optimizer's making
        is_of_optimizer = name.startswith(theirs) and name != "optimizer.grad_clip_norm"
        was: Any = values
        for key in name.split("."):
            was = was.get(key) if isinstance(was, Mapping) else None
        with contextlib.suppress(TypeError, ValueError):
            wanted = float(wanted)  # YAML takes 1e-3 for text
        if (is_of_optimizer or name in ("fine_tune", "policy.path")) and wanted != was:
            raise ConfigError(
                f"{name} is {given!r}, and a run that is resumed continues with {was!r}. Leave it out, or start a new "
                "run with --fine_tune=CHECKPOINT."
            )


def _read_checkpoint(checkpoint: Path) -> dict[str, Any]:
    folder = checkpoint / PRETRAINED_MODEL_DIR
    values = configuration.read_file(folder / TRAIN_CONFIG_NAME)
    own = folder / OWN_CONFIG_NAME  # a checkpoint of lerobot-train has none
    values |= configuration.read_file(own) if own.is_file() else {}
    # Where it is missing, LeRobot's rule was the only one.
    values["selection"] = {"hold_out": "instruction", **(values.get("selection") or {})}
    return values


def config_of(values: dict[str, Any], checkpoint: Path | None = None) -> BhdTrainConfig:
    """Return the configuration that plain values, nested, stand for, to go on with a checkpoint if there is one."""
    values.pop("checkpoint_path", None)
    dataset = values.get("dataset") or {}
    known = {name for name, _, _ in configuration.options_of(BhdTrainConfig)}
    is_missing = isinstance(dataset, dict) and not (dataset.get("root") or dataset.get("repo_id"))
    if is_missing and known.issuperset(values):  # a misspelt option is named first
        raise ConfigError("No dataset is given; set --dataset.root=FOLDER, or --dataset.repo_id=user/name.")
    if isinstance(dataset, dict) and dataset.get("root") and not dataset.get("repo_id"):
        values["dataset"] = {**dataset, "repo_id": local_name(dataset["root"])}
    if isinstance(output_dir := values.get("output_dir"), str):
        values["output_dir"] = str(Path(output_dir).expanduser())
    _start_from(values, resume=checkpoint is not None)
    selection = values.get("selection")
    if isinstance(selection, dict) and isinstance(selection.get("outcome"), str):
        selection["outcome"] = [selection["outcome"]]
    _drop_defaults(BhdTrainConfig, values)
    config = configuration.decode(BhdTrainConfig, values)
    if checkpoint is not None:
        config.checkpoint_path, config.started_from = checkpoint, config.policy.pretrained_path
        config.policy.pretrained_path = checkpoint / PRETRAINED_MODEL_DIR
    return config


def _drop_defaults(config_class: type, values: dict[str, Any]) -> None:
    """Leave out what the chosen classes say themselves: LeRobot's defaults do not all have the type of their field."""
    for key, kind, _ in configuration.options_of(config_class):
        value = values.get(key)
        if not isinstance(value, dict):
            continue
        chosen = configuration.choices_of(kind).get(str(value.get("type")))
        if chosen is not None:
            defaults = {name: default for name, _, default in configuration.options_of(chosen)}
            values[key] = {
                name: one
                for name, one in value.items()
                if name == "type" or name not in defaults or not _is_same(one, defaults[name])
            }


def _is_same(value: Any, default: Any) -> bool:
    return type(value) is type(default) and bool(value == default)


def _start_from(values: dict[str, Any], *, resume: bool) -> None:
    """Complete the policy's configuration from the checkpoint that a new run starts from."""
    policy = values.get("policy")
    if policy is not None and not isinstance(policy, dict):
        raise ConfigError(f"policy is {policy!r}; it has keys of its own, such as policy.type.")
    policy = dict(policy or {})
    path = policy.pop("path", None)
    fine_tune = values.get("fine_tune")
    source = fine_tune or path
    if ("type" in policy or source is not None) and "device" not in policy:
        accelerator = torch.accelerator.current_accelerator(check_available=True)
        policy["device"] = "cpu" if accelerator is None else accelerator.type
    if resume or source is None:
        if policy:
            policy.setdefault("push_to_hub", bool(policy.get("repo_id")))
            values["policy"] = policy
        return
    if fine_tune and path and fine_tune != path:
        raise ConfigError(f"fine_tune is {fine_tune!r} and policy.path is {path!r}; give one of them.")
    folder = str(find_checkpoint(source).resolve())  # `last` may move on
    own = _policy_values(folder)
    wanted = policy.get("type", own["type"])
    if wanted != own["type"]:
        raise ConfigError(f"policy.type is {wanted!r}, but the checkpoint {source} is of type {own['type']!r}.")
    policy.setdefault("push_to_hub", bool(policy.get("repo_id")))
    values["policy"] = {**own, "repo_id": None, **policy, "pretrained_path": folder}


def _policy_values(source: str) -> dict[str, Any]:
    try:
        config = PreTrainedConfig.from_pretrained(source)
        return {"type": config.type, **configuration.encode(config)}
    except Exception as error:  # draccus, for a type that is not installed or a field that does not exist
        raise ConfigError(f"The configuration of the checkpoint {source} cannot be used: {error}") from error
