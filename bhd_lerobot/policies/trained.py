"""What the configurations of the trained policies have in common."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, brief
from bhd_lerobot.options.declared import check_options

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TOOL = tuple(f"tool_{name}.pos" for name in _POSE)
"""Where the tool is, in `observation.state`."""
TARGET = tuple(f"target_{name}" for name in _POSE)
"""Where it is to go, in `observation.environment_state`."""

_OPTIMIZER = "optimizer_"
_SHOWN = 8  # names in a message


@dataclass
class TrainedConfig(PreTrainedConfig):
    """Base of the configurations of ``bhd_mlp``, ``bhd_cnn``, ``bhd_perception`` and ``bhd_pixels``.

    It has no options of its own: a type has those of the options used here that it declares.
    """

    option_prefix: ClassVar[str] = "policy."

    # LeRobot's class says so as well, but without types.
    input_features: dict[str, PolicyFeature] | None = field(default_factory=dict)
    output_features: dict[str, PolicyFeature] | None = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        check_options(self)

    def check_chunk(self: Any) -> None:
        """Refuse to carry out more actions than are predicted."""
        if self.n_action_steps > self.chunk_size:
            raise ConfigError(
                f"policy.n_action_steps is {self.n_action_steps}, but only policy.chunk_size = {self.chunk_size} "
                "actions are predicted."
            )

    @property
    def image_key(self) -> str:
        """The image's key in datasets and batches; empty without a camera."""
        camera = getattr(self, "camera", None)
        return f"{OBS_IMAGES}.{camera}" if camera else ""

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the image [px]."""
        _, height, width = (self.input_features or {})[self.image_key].shape
        return int(width), int(height)

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Which actions it predicts, the present frame's being 0."""
        chunk_size = getattr(self, "chunk_size", None)
        return None if chunk_size is None else list(range(chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return AdamW."""
        own = {key.removeprefix(_OPTIMIZER): one for key, one in vars(self).items() if key.startswith(_OPTIMIZER)}
        return AdamWConfig(**own)

    def get_scheduler_preset(self: Any) -> LRSchedulerConfig | None:
        """Return the schedule of the learning rate: a warm-up, and a cosine to 0; none if it is constant."""
        if getattr(self, "scheduler", None) == "constant":
            return None
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    def known_features(self: Any) -> dict[str, PolicyFeature]:
        """Return all features, among which the image is."""
        known = {**(self.input_features or {}), **(self.output_features or {})}
        cameras = [key for key, one in known.items() if one.type == FeatureType.VISUAL]
        if self.image_key not in cameras:
            raise ConfigError(
                f"policy.camera is {self.camera!r}, and the dataset has no {self.image_key!r}. It has "
                f"{', '.join(cameras) or 'no images'}. Record it with --robot.camera=true, or set --policy.camera."
            )
        return known

    def find_columns(self: Any, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Find what is to be ignored, and what actions are changes of, by their names."""
        observed, actions = names_of(features, OBS_STATE), names_of(features, ACTION)
        if self.ignore and not self.ignored_columns:
            self.ignored_columns = _matching_columns(self.ignore, observed)
        if self.residual and not self.residual_columns:
            self.residual_columns = residual_columns(self.residual, actions, observed)

    def check_columns(self: Any, width: int) -> None:
        """Refuse columns that are not known, or not among the `width` columns of the state."""
        if self.ignore and not self.ignored_columns:
            raise ConfigError(
                f"policy.ignore is {self.ignore}, but the names of the columns of {OBS_STATE} are unknown: make the "
                "policy with the metadata of its dataset, or give policy.ignored_columns."
            )
        if not all(0 <= column < width for column in self.ignored_columns):
            raise ConfigError(
                f"policy.ignored_columns is {self.ignored_columns}; {OBS_STATE} has the columns 0 to {width - 1}."
            )
        if self.residual:
            self.check_scale("STATE", "ACTION")
        columns, actions = self.residual_columns, int(self.action_feature.shape[0])
        if self.residual and (len(columns) != actions or max(columns, default=-1) >= width):
            raise ConfigError(
                f"policy.residual is {self.residual}, and policy.residual_columns is {columns}; it must have a column "
                f"of {OBS_STATE}, below {width}, or -1, for each of the {actions} actions. Make the policy with the "
                "metadata of its dataset."
            )

    def check_scale(self: Any, *kinds: str) -> None:
        """Refuse numbers that are given their units back and are not normalised by mean and standard deviation."""
        for kind in kinds:
            mode = NormalizationMode(self.normalization_mapping.get(kind, NormalizationMode.IDENTITY))
            if mode is not NormalizationMode.MEAN_STD:
                raise ConfigError(
                    f"policy.normalization_mapping has {mode.value} for {kind}; a {self.type} that computes "
                    "with numbers in their units knows their mean and standard deviation: set MEAN_STD."
                )


def names_of(features: Mapping[str, Mapping[str, Any]], key: str) -> list[str]:
    """Return the names of a feature's columns in a dataset's metadata; none if they are not known."""
    return list(keys.names_of(features.get(key) or {}))


def _matching_columns(patterns: Sequence[str], names: Sequence[str]) -> list[int]:
    """Return the columns of `observation.state` whose names match a pattern."""
    for pattern in patterns:
        if not any(fnmatch.fnmatchcase(name, pattern) for name in names):
            raise ConfigError(f"policy.ignore: {pattern!r} matches no number of {OBS_STATE}: {brief(names, _SHOWN)}.")
    return [i for i, name in enumerate(names) if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]


def residual_columns(patterns: Sequence[str], actions: Sequence[str], observed: Sequence[str]) -> list[int]:
    """Return of each action the column of the observation that has its name, if its name matches; else -1."""
    places = {name: place for place, name in enumerate(observed)}
    both = [name for name in actions if name in places]
    for pattern in patterns:
        if not fnmatch.filter(both, pattern):
            raise ConfigError(
                f"policy.residual: {pattern!r} matches no action that is observed under the same name; there is: "
                f"{', '.join(both) or 'none'}. For tool poses record with --robot.action_space=tool "
                "--robot.tool_pose=true."
            )
    is_wanted = [any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns) for name in actions]
    return [places.get(name, -1) if wanted else -1 for name, wanted in zip(actions, is_wanted, strict=True)]
