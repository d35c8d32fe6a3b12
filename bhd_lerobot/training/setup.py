"""What a training run is made of, from LeRobot's pieces: accelerator, policy, processors, and their checks."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator  # type: ignore[import-untyped]
from accelerate.utils import DistributedDataParallelKwargs, DistributedType  # type: ignore[import-untyped]
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType
from lerobot.processor import NormalizerProcessorStep
from lerobot.utils.constants import ACTION

from bhd_lerobot.datasets.loader.loader import Batch, Loader
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError, DatasetMismatchError, brief
from bhd_lerobot.policies.learned.checkpoint_guard import check_checkpoint
from bhd_lerobot.policies.learned.contract import PolicyContract, camera_name, find_checkpoint
from bhd_lerobot.policies.learned.policy import check_statistics
from bhd_lerobot.policies.trained_steps import floored
from bhd_lerobot.registry import ROBOTS, recorded_robot
from bhd_lerobot.stock import (
    LeRobotDatasetMetadata,
    dataset_to_policy_features,
    make_optimizer_and_scheduler,
    make_policy,
    make_pre_post_processors,
    set_seed,
)
from bhd_lerobot.tasks.sensing import SensingConfig
from bhd_lerobot.training.config import BhdTrainConfig

# Of `torch.cpu.get_capabilities`: what a processor computes bfloat16 with, x86 and Arm.
_BFLOAT16 = ("avx512_bf16", "amx_bf16", "avx_ne_convert", "bf16", "sve_bf16")


def has_bfloat16() -> bool:
    """Whether the processor has instructions for bfloat16; also true if this version of PyTorch does not tell.

    Without them it is emulated: a step of a ResNet18, 120 x 160 pixels, took 1.8 times as long as with float32 where
    there is AVX-512, and 13 times where there is AVX2 only; with them 0.55 times (PyTorch 2.11, one core of an EPYC,
    whose oneDNN was told to do without).
    """
    tell = getattr(torch.cpu, "get_capabilities", None)
    return tell is None or any(tell().get(name) for name in _BFLOAT16)


def make_accelerator(config: BhdTrainConfig) -> Accelerator:
    """Return accelerate's accelerator, set up as `lerobot-train` does."""
    policy: Any = config.policy
    mixed = {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}.get(getattr(policy, "dtype", None) or "")
    if not hasattr(policy, "dtype") and policy.use_amp:
        kind = torch.get_autocast_dtype(torch.device(policy.device).type)
        mixed = {torch.bfloat16: "bf16", torch.float16: "fp16"}[kind]
        if policy.device == "cpu" and not has_bfloat16():
            raise ConfigError(
                "policy.use_amp is true, but this processor has no instructions for bfloat16, and a step would take 2 "
                "to 13 times as long as without. Set --policy.use_amp=false."
            )
    accelerator = Accelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=mixed,
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
        cpu=policy.device == "cpu",
    )
    known = (DistributedType.NO, DistributedType.MULTI_CPU, DistributedType.MULTI_GPU)
    if accelerator.distributed_type not in known:
        raise ConfigError(
            f"accelerate was launched with {accelerator.distributed_type.value}; bhd-train shares the work by whole "
            "copies of the policy only (DDP). Use lerobot-train for FSDP."
        )
    torch.backends.cudnn.deterministic = config.cudnn_deterministic
    torch.backends.cudnn.benchmark = not config.cudnn_deterministic
    torch.backends.cuda.matmul.allow_tf32 = True
    return accelerator


# `lerobot-train`'s own; the last four have come after version 0.6.1.
_STOCK_ONLY = ("peft", "sample_weighting", "accelerator", "checkpoint_format", "ema", "parallelism")


def refuse_unsupported(config: BhdTrainConfig) -> None:
    """Refuse what only LeRobot's own loop does."""
    defaults = {one.name: one.default for one in fields(config)} | {
        one.name: one.default_factory() for one in fields(config) if one.default_factory is not MISSING
    }
    given = {name: getattr(config, name, None) != defaults.get(name) for name in _STOCK_ONLY}
    given["dataset.exclude_episodes"] = bool(getattr(config.dataset, "exclude_episodes", None))
    for name, is_given in given.items():
        if is_given:
            raise ConfigError(f"{name} is not for bhd-train; use lerobot-train, which reads the same configuration.")


def check_contract(path: str, policy: PreTrainedConfig, meta: LeRobotDatasetMetadata) -> None:
    """Check that a dataset is of what a checkpoint was trained on; of the cameras, those that the policy looks at."""
    trained, here = PolicyContract.load(path), PolicyContract.from_dataset(meta)
    looks = {camera_name(key) for key in policy.image_features} & (trained.cameras or {}).keys()
    trained = replace(
        trained, cameras={name: shape for name, shape in (trained.cameras or {}).items() if name in looks}
    )
    cameras = {name: shape for name, shape in (here.cameras or {}).items() if name in looks}
    units = [one.units or "unknown units" for one in (trained, here)]
    if trained.units is not None and units[0] != units[1]:
        raise DatasetMismatchError(
            f"The dataset {meta.repo_id} does not fit the checkpoint {path}: its values are in {units[1]}, and the "
            f"checkpoint was trained on values in {units[0]}. Convert them, or start with --policy.path, unchecked."
        )
    try:
        trained.check(
            here.observation_names,
            here.action_names,
            here.fps,
            here.environment_names,
            here.robot_type,
            cameras=cameras or None,
            robot=here.robot,
            who="The checkpoint",
        )
    except ConfigError as error:
        raise DatasetMismatchError(f"The dataset {meta.repo_id} does not fit the checkpoint {path}. {error}") from error


def check_features(policy: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str]) -> None:
    """Check that the dataset has what the policy's configuration names."""
    features = {rename_map.get(k, k): one for k, one in dataset_to_policy_features(meta.features).items()}
    there = ", ".join(features)
    if not any(feature.type is FeatureType.ACTION for feature in features.values()):
        raise DatasetError(f"{meta.root} has no {ACTION!r}, so there is nothing to imitate. It has {there}.")
    for key, wanted in {**(policy.input_features or {}), **(policy.output_features or {})}.items():
        if wanted.type is FeatureType.VISUAL and key not in features and getattr(policy, "empty_cameras", 0) > 0:
            continue
        if key not in features:
            raise DatasetError(
                f"The policy needs {key!r} of shape {tuple(wanted.shape)}, which {meta.root} lacks; it has {there}. "
                "Record it, or train a policy without it."
            )
        # Policies with a largest size pad what is smaller.
        is_fixed = wanted.type is not FeatureType.VISUAL and not hasattr(policy, "max_state_dim")
        if is_fixed and tuple(features[key].shape) != tuple(wanted.shape):
            raise DatasetError(
                f"The policy needs {key!r} of shape {tuple(wanted.shape)}; in {meta.root} it has the shape "
                f"{tuple(features[key].shape)}."
            )


_DIFFERS = "several values, in recordings that were merged"


def _check_truth(policy: Any, meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset whose task sensed something else than the truth, for a policy that learns what is true."""
    task: Any = PolicyContract.from_dataset(meta).task or {}
    given = {}
    if "sensing" in task:  # it is a task of an arm
        given = {f"sensing.{one.name}": task["sensing"].get(one.name, _DIFFERS) for one in fields(SensingConfig)}
    randomisation = task.get("randomisation") or {}
    if randomisation.get("enabled", True):
        given["randomisation.camera_error_m"] = randomisation.get("camera_error_m", 0.0)
    for name, value in given.items():
        if value is _DIFFERS or np.any(np.asarray(value, float)):
            raise DatasetError(
                f"{meta.root} was recorded with task.{name} = {value}: its object poses are not the true ones, and a "
                f"{policy.type!r} would learn them. Record it without this option."
            )


def _place_camera(policy: Any, meta: LeRobotDatasetMetadata) -> None:
    """Let a policy take from the arm of a simulation where its camera stands, and the table before it."""
    robot = PolicyContract.from_dataset(meta).robot or {}
    if policy.pretrained_path is None and not policy.is_placed and robot.get("type") in ROBOTS:
        arm = recorded_robot(robot).body().arm
        if arm is not None:
            policy.stand_before(arm.workspace)


def build_policy(config: BhdTrainConfig, meta: LeRobotDatasetMetadata, accelerator: Any = None) -> Any:
    """Return the policy, new or from its checkpoint, on its device; all of its randomness is the seed's."""
    policy: Any = config.policy
    check_features(policy, meta, config.rename_map)
    if getattr(policy, "learns_true_poses", False):
        _check_truth(policy, meta)
        _place_camera(policy, meta)
    if policy.pretrained_path is not None:
        # One folder on this machine, so that what is checked is what LeRobot loads.
        policy.pretrained_path = find_checkpoint(policy.pretrained_path, policy.pretrained_revision).resolve()
        check_checkpoint(policy.pretrained_path)
    if config.seed is not None:
        set_seed(config.seed, accelerator=accelerator)
    try:
        return make_policy(policy, ds_meta=meta, rename_map=config.rename_map)
    except BhdError:
        raise
    except Exception as error:  # each policy, safetensors and the Hub's client have their own
        whence = f" from {policy.pretrained_path}" if policy.pretrained_path else ""
        raise ConfigError(
            f"The policy {policy.type!r} cannot be made{whence} for {meta.root}, which has "
            f"{', '.join(dataset_to_policy_features(meta.features))}: {error}"
        ) from error


def select_parameters(policy: Any, patterns: Sequence[str]) -> None:
    """Let only some parameters be trained, by names or patterns like ``*.bias``; what the policy freezes stays so."""
    trained = {name: one for name, one in policy.named_parameters() if one.requires_grad}
    unknown = [pattern for pattern in patterns if not any(fnmatchcase(name, pattern) for name in trained)]
    if unknown or not patterns:
        names = list(trained)
        raise ConfigError(
            f"fine_tune_parameters is {list(patterns)}; {repr(unknown[0]) if unknown else 'it'} matches no "
            f"parameter of the policy, which has {brief(names, _NAMED)}. Give names, or ['*'] for all."
        )
    for name, one in trained.items():
        one.requires_grad_(any(fnmatchcase(name, pattern) for pattern in patterns))


_NAMED = 20  # parameters that a message names


def fit_camera(policy: Any, loader: Loader, prepare: Callable[[Batch], Batch], *, processes: int) -> str:
    """Let a policy find out where its camera stands; return what it found, as text. The loader stays where it is."""
    if not hasattr(policy, "fit_camera"):
        raise ConfigError(
            f"fine_tune_camera is true, but a {policy.config.type!r} does not know where its camera stands; a "
            "'bhd_perception' does. Leave it out."
        )
    if processes > 1:
        raise ConfigError(f"fine_tune_camera is for one process; {processes} would each find a different result.")
    state = loader.state_dict()
    found = policy.fit_camera([prepare(batch) for batch in islice(loader, _BATCHES)])
    loader.load_state_dict(state)
    policy.train()
    return str(found)


_BATCHES = 64  # from which the camera's place is found, at the most


def build_optimizer(config: BhdTrainConfig, policy: Any) -> tuple[Any, Any]:
    """Return the optimizer and the scheduler of the learning rate, or None for that."""
    try:
        return make_optimizer_and_scheduler(config, policy)
    except (ValueError, TypeError, ImportError) as error:
        options = "policy.optimizer_… and policy.scheduler_…" if config.use_policy_training_preset else "optimizer.…"
        raise ConfigError(f"The optimizer cannot be made: {error}. Change the options {options}.") from error


def build_processors(
    config: BhdTrainConfig, policy: Any, meta: LeRobotDatasetMetadata, device: torch.device, *, keep_statistics: bool
) -> tuple[Any, Any]:
    """Return pre- and postprocessor as `lerobot-train` makes them."""
    before, after = _build_processors(config, policy, meta, device, keep_statistics=keep_statistics)
    active: Any = config.policy
    check_statistics(f"The policy {active.pretrained_path or active.type}", before, after)
    if hasattr(policy, "use_statistics"):  # some are part of the weights
        policy.use_statistics(next(step.stats for step in before.steps if isinstance(step, NormalizerProcessorStep)))
    return before, after


def _build_processors(
    config: BhdTrainConfig, policy: Any, meta: LeRobotDatasetMetadata, device: torch.device, *, keep_statistics: bool
) -> tuple[Any, Any]:
    active: Any = config.policy
    stats: Any = meta.stats or {}
    stats = stats | {new: stats[old] for old, new in config.rename_map.items() if old in stats}
    if active.pretrained_path is None:
        return make_pre_post_processors(active, dataset_stats=stats)
    if hasattr(policy, "use_statistics"):
        stats = floored(stats, active.min_std)
    features = {**policy.config.input_features, **policy.config.output_features}
    norm_map = policy.config.normalization_mapping
    before: dict[str, dict[str, Any]] = {
        "device_processor": {"device": device.type},
        "normalizer_processor": {"features": features, "norm_map": norm_map},
        "rename_observations_processor": {"rename_map": config.rename_map},
    }
    after: dict[str, dict[str, Any]] = {
        "unnormalizer_processor": {"features": policy.config.output_features, "norm_map": norm_map},
    }
    if not keep_statistics:
        before["normalizer_processor"]["stats"] = stats
        after["unnormalizer_processor"]["stats"] = stats
    if getattr(active, "use_relative_actions", False):
        before["relative_actions_processor"] = {
            "enabled": True,
            "exclude_joints": getattr(active, "relative_exclude_joints", []),
            "action_names": getattr(active, "action_feature_names", None),
        }
        after["absolute_actions_processor"] = {"enabled": True}
    kwargs: dict[str, Any] = {} if keep_statistics else {"dataset_stats": stats}
    try:
        return make_pre_post_processors(
            active,
            pretrained_path=str(active.pretrained_path),
            pretrained_revision=active.pretrained_revision,
            preprocessor_overrides=before,
            postprocessor_overrides=after,
            **kwargs,
        )
    except Exception as error:  # LeRobot raises whatever a step raises
        raise ConfigError(f"The processors of {Path(active.pretrained_path)} cannot be used: {error}") from error
