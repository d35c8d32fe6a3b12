"""A trained policy and its processors, loaded as they were saved, whatever LeRobot policy it is."""

import contextlib
import importlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot.policies  # noqa: F401 - registers LeRobot's own policies
import torch
from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.processor import NormalizerProcessorStep, RenameObservationsProcessorStep, UnnormalizerProcessorStep
from lerobot.utils.constants import (
    ACTION,
    OBS_ENV_STATE,
    OBS_IMAGES,
    OBS_STATE,
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.plugins import load_plugins
from bhd_lerobot.policies.learned.checkpoint_guard import check_checkpoint
from bhd_lerobot.policies.learned.contract import CONFIG_FILE, camera_name
from bhd_lerobot.stock import get_policy_class, is_torch_device_available, make_pre_post_processors

_OWN = ("bhd_cnn", "bhd_mlp", "bhd_perception", "bhd_pixels")


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy, ready to act.

    Attributes:
        before: what turns a batch of observations into its input.
        after: what gives its actions their units back.
        inputs: keys of the observations that it takes, under the names that they have before `before`.
        cameras: camera names of those inputs that are images, by key.
        shapes: of these images (channels, height, width), as the policy's configuration says; by key.
    """

    folder: Path
    policy: Any
    before: Any
    after: Any
    inputs: tuple[str, ...]
    cameras: dict[str, str]
    shapes: dict[str, tuple[int, ...]]

    @property
    def config(self) -> Any:
        """The policy's configuration."""
        return self.policy.config

    @property
    def kind(self) -> str:
        """LeRobot's name of the type of policy."""
        return str(self.config.type)

    def precision(self) -> Any:
        """Return the context of LeRobot's evaluation: lower precision where the policy was configured so."""
        device = torch.device(self.config.device).type
        return torch.autocast(device) if self.config.use_amp else contextlib.nullcontext()

    def width(self, key: str) -> int | None:
        """Return how many numbers a vector input, or the action, has; None if the policy does not say."""
        features = {**(self.config.input_features or {}), **(self.config.output_features or {})}
        return int(features[key].shape[0]) if key in features else None


def load_policy(
    folder: Path, device: str = "cpu", n_action_steps: int | None = None, *, for_robot: bool = True
) -> LoadedPolicy:
    """Return the policy of a checkpoint.

    Args:
        folder: a checkpoint's folder `pretrained_model`.
        device: where it runs: `cpu`, `cuda`, `cuda:1`, …
        n_action_steps: how many actions of a chunk are carried out; the checkpoint's own number if None.
        for_robot: refuse inputs that no robot gives; environments of LeRobot may return others.
    """
    _check_device("brain.device", device)
    config = _config(folder, device)
    if n_action_steps is not None:
        _set_action_steps(config, n_action_steps)
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME):
        if not (folder / f"{name}.json").is_file():
            raise ConfigError(
                f"The checkpoint {folder} has no {name}.json, so the normalisation of its inputs is unknown. Copy it "
                "again; if a LeRobot before 0.4 wrote it, convert it with LeRobot's migrate_policy_normalization.py."
            )
    check_checkpoint(folder)
    policy, before, after = _load(folder, config, device)
    check_statistics(f"The checkpoint {folder}", before, after)
    return LoadedPolicy(folder, policy, before, after, *_inputs(config, before, for_robot=for_robot))


def check_statistics(who: str, before: Any, after: Any) -> None:
    """Check that whatever a policy's processors normalise has statistics; LeRobot's pass it through where it has none.

    Args:
        who: the policy, as the subject of a sentence.
        before, after: its processors.

    Raises:
        ConfigError: statistics are missing; lists the names that there are.
    """
    for pipeline, is_input in ((before, True), (after, False)):
        for step in pipeline.steps:
            if not isinstance(step, NormalizerProcessorStep | UnnormalizerProcessorStep):
                continue
            only = step.normalize_observation_keys
            for key, feature in step.features.items():
                mode = step.norm_map.get(feature.type, NormalizationMode.IDENTITY)
                is_action = feature.type is FeatureType.ACTION
                is_given = is_input and (only is None or key in only) and not key.startswith(_EMPTY)
                if not (is_action or is_given):
                    continue
                there = (step.stats or {}).get(key) or {}
                if missing := [name for name in _STATISTICS.get(mode, ()) if name not in there]:
                    known = ", ".join(sorted(step.stats or {})) or "none"
                    raise ConfigError(
                        f"{who} normalises {key!r} by {mode.value}, and has no {' and '.join(missing)} of it, so it "
                        f"would be passed through in the robot's units. It has statistics of: {known}. Train it on a "
                        "dataset that has this feature, or rename the statistics in the processors' files."
                    )


_EMPTY = f"{OBS_IMAGES}.empty_camera"  # inputs that no camera gives
_STATISTICS = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}


def load_perception(folder: Path, device: str = "cpu", option: str = "brain.perception.path") -> Any:
    """Return the `bhd_perception` of a checkpoint, in evaluation mode."""
    _check_device("brain.perception.device", device)
    config = _config(folder, device)
    if config.type != "bhd_perception":
        raise ConfigError(
            f"{option} is {str(folder)!r}, a {config.type!r}; perception is a 'bhd_perception'. A policy "
            "that gives actions is a brain of its own: --brain.path."
        )
    check_checkpoint(folder)
    return _load(folder, config, device)[0]


def _check_device(option: str, device: str) -> None:
    try:
        is_there = is_torch_device_available(device)
    except (ValueError, RuntimeError):
        is_there = False
    if not is_there:
        raise ConfigError(f"{option} is {device!r}, which this machine does not have. Set --{option}=cpu.")


def _load(folder: Path, config: Any, device: str) -> tuple[Any, Any, Any]:
    """Return policy, in evaluation mode, and processors."""
    try:
        # LeRobot prints where it loads from, and without `strict` it would continue with weights that are not there.
        with contextlib.redirect_stdout(io.StringIO()):
            policy = get_policy_class(config.type).from_pretrained(str(folder), config=config, strict=True)
        before, after = make_pre_post_processors(
            config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": device}},
        )
    except ImportError as error:
        raise ConfigError(f"The policy type {config.type!r} needs a package that is not installed: {error}") from error
    except ConfigError:
        raise
    except Exception as error:  # whatever a policy's constructor, safetensors or torch find wrong with the files
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"The checkpoint {folder} cannot be loaded ({type(error).__name__}: {reason[:300]}). It was perhaps "
            "interrupted while it was written or copied: use an earlier checkpoint of the run, or copy it again. Or "
            "another version wrote it, with another network (CHANGELOG.md): train anew."
        ) from error
    policy.eval()
    return policy, before, after


def _config(folder: Path, device: str) -> Any:
    file = folder / CONFIG_FILE
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        kind = values["type"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{file} cannot be read ({error!r}). Copy the checkpoint again.") from error
    if kind in _OWN:
        importlib.import_module(f"bhd_lerobot.policies.{kind[4:]}.processor_{kind[4:]}")
    elif kind not in PreTrainedConfig.get_known_choices():
        load_plugins()
    if kind not in PreTrainedConfig.get_known_choices():
        known = ", ".join(sorted(PreTrainedConfig.get_known_choices()))
        raise ConfigError(
            f"The checkpoint {folder} is of the policy type {kind!r}, which is not installed. There is: {known}."
        )
    try:
        config: Any = PreTrainedConfig.from_pretrained(folder, cli_overrides=[f"--device={device}"])
    except Exception as error:  # draccus raises what it likes
        raise ConfigError(f"{file} cannot be used: {error}. It was perhaps written by another version.") from error
    if config.use_peft:
        raise ConfigError(
            f"The checkpoint {folder} holds a PEFT adapter only. Merge it into its base model and save that "
            "(PeftModel.merge_and_unload, then save_pretrained)."
        )
    config.pretrained_path = folder
    return config


def _set_action_steps(config: Any, steps: int) -> None:
    if not hasattr(config, "n_action_steps"):
        raise ConfigError(f"brain.n_action_steps was given, but a {config.type!r} gives no chunks. Leave it out.")
    predicted = getattr(config, "chunk_size", None)
    if predicted is None and hasattr(config, "horizon"):
        predicted = config.horizon - config.n_obs_steps + 1
    if steps < 1 or (predicted is not None and steps > predicted):
        raise ConfigError(f"brain.n_action_steps is {steps}; this {config.type!r} predicts chunks of {predicted}.")
    if steps > 1 and getattr(config, "temporal_ensemble_coeff", None) is not None:
        raise ConfigError(
            f"brain.n_action_steps is {steps}, but this policy averages over its chunks (temporal_ensemble_coeff), for "
            "which it looks at every frame. Leave brain.n_action_steps out."
        )
    config.n_action_steps = steps


def _inputs(
    config: Any, before: Any, *, for_robot: bool
) -> tuple[tuple[str, ...], dict[str, str], dict[str, tuple[int, ...]]]:
    """Return the inputs under the robot's names, which are cameras, and the shapes of their images."""
    renamed: dict[str, str] = {}
    for step in before.steps:
        if isinstance(step, RenameObservationsProcessorStep):
            renamed |= {new: old for old, new in step.rename_map.items()}
    inputs, cameras, shapes = [], {}, {}
    for key, feature in (config.input_features or {}).items():
        own = renamed.get(key, key)
        inputs.append(own)
        if feature.type == FeatureType.VISUAL:
            cameras[own], shapes[own] = camera_name(own), tuple(feature.shape)
        elif for_robot and own not in (OBS_STATE, OBS_ENV_STATE):
            raise ConfigError(
                f"The policy reads {own!r}, which no robot here gives. There is {OBS_STATE}, {OBS_ENV_STATE} and "
                "images."
            )
    if ACTION not in (config.output_features or {}):
        raise ConfigError(
            f"The policy gives no {ACTION!r}; it gives {', '.join(config.output_features or {}) or 'nothing'}."
        )
    return tuple(inputs), cameras, shapes


def torch_device(loaded: LoadedPolicy) -> torch.device:
    """Return where the policy runs."""
    return next(iter(loaded.policy.parameters())).device
