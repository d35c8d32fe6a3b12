"""Configuration of `bhd_pixels`: an episode's first image, an instruction and the robot's state in, actions out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, NotNegative
from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.policies.trained import TOOL, names_of

FIRST = -100_000
"""Frames back in time: before every episode, where datasets give the first frame."""


@PreTrainedConfig.register_subclass("bhd_pixels")
@dataclass
class PixelsConfig(PerceptionConfig):
    """Configuration of the policy type ``bhd_pixels``.

    It sees by the network of ``bhd_perception``, whose options it has, too. The true poses in
    `observation.environment_state` are needed to learn, never to act.

    Attributes:
        perception: a checkpoint of ``bhd_perception`` whose weights the learning begins with; without one it begins
            from nothing.
        freeze: do not change the weights of `perception`: every first image is then looked at once in a training.
            Without one they are learned.
        chunk_size: actions that it predicts, one a frame.
        n_action_steps: how many of them are carried out before it predicts again.
        longest_instruction: bytes of the longest instruction, in UTF-8.
        text_dim: numbers that an instruction becomes.
        n_cells: cells of the image that are looked at: those in which an object is likeliest.
        n_heads: places of the image, beside the one of what is named, that actions may depend on.
        hidden_dims: widths of the layers that predict actions.
        ignore: numbers of `observation.state` that it does not look at, by name or pattern, as in ``bhd_mlp``.
        ignored_columns: their columns; found by their names.
        residual: actions of which it predicts by how much they differ from what is observed, as in ``bhd_mlp``.
        residual_columns: of each action the column of `observation.state`, -1 for none; found by their names.
        tool_columns: of the tool pose in `observation.state`, if it is observed: then actions also depend on where what
            is named is from there; found by their names.
        min_std: least standard deviation that a number of the state or an action is divided by, in its own unit.
        pointing_weight: of the loss of where it looks: at what the instruction names.
        perception_weight: of the loss of ``bhd_perception``, where its weights are learned as well.
    """

    perception: str | None = None
    freeze: bool = True
    chunk_size: Count = 8
    n_action_steps: Count = 8
    longest_instruction: Count = 128
    text_dim: Count = 64
    n_cells: Count = 96
    n_heads: Count = 4
    hidden_dims: list[Count] = field(default_factory=lambda: [512, 512, 512])
    ignore: list[str] = field(default_factory=lambda: ["*.vel"])
    ignored_columns: list[int] = field(default_factory=list)
    residual: list[str] = field(default_factory=list)
    residual_columns: list[int] = field(default_factory=list)
    tool_columns: list[int] = field(default_factory=list)
    min_std: NotNegative = 1e-3
    pointing_weight: NotNegative = 0.2
    perception_weight: NotNegative = 0.1

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            **dict.fromkeys(("VISUAL", "ENV"), NormalizationMode.IDENTITY),
            **dict.fromkeys(("STATE", "ACTION"), NormalizationMode.MEAN_STD),
        }
    )
    optimizer_lr: float = 1e-3
    optimizer_grad_clip_norm: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        self.check_chunk()

    @property
    def is_frozen(self) -> bool:
        """Whether the weights that see stay as they were read."""
        return self.freeze and self.perception is not None

    @property
    def observation_delta_indices(self) -> list[int]:  # type: ignore[override]
        """The first frame of the episode, and the present one."""
        return [FIRST, 0]

    @property
    def own_delta_indices(self) -> dict[str, list[int]]:
        """Of the image only the first frame, where a loader can give of each observation other frames."""
        return {self.image_key: [FIRST]}

    def set_dataset_feature_metadata(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Check that the dataset states where objects are, and find what is to be ignored by its name."""
        super().set_dataset_feature_metadata(features)
        self.find_columns(features)
        names = names_of(features, OBS_STATE)
        if not self.tool_columns and set(TOOL) <= set(names):
            self.tool_columns = [names.index(name) for name in TOOL]

    def validate_features(self) -> None:
        """Keep image and state as inputs, actions and, to learn from, labels as outputs."""
        known = self.known_features()
        for key in (OBS_STATE, ACTION):
            if key not in known or len(known[key].shape) != 1:
                raise ConfigError(f"bhd_pixels needs {key}, a vector; the dataset has {', '.join(known)}.")
        width = int(known[OBS_STATE].shape[0])
        self.check_columns(width)
        if self.tool_columns:
            self.check_scale("STATE")
        self.input_features = {self.image_key: known[self.image_key], OBS_STATE: known[OBS_STATE]}
        self.output_features = {key: known[key] for key in (ACTION, OBS_ENV_STATE) if key in known}
        self.settle()
