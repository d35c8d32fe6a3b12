"""Configuration of `bhd_cnn`: a base's camera and odometry in, a chunk of actions out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.utils.constants import OBS_STATE

from bhd_lerobot.bodies.turtlebot3 import RANGE_MAX, RANGE_MIN, SCANNER_AHEAD
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, NotNegative, Positive, Range
from bhd_lerobot.policies.brain import find_scan
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.trained import names_of

ODOMETRY = ("x.pos", "y.pos", "theta.pos")
_LEAST_SIZE = 16  # [px]
_SPACING_DEG = 2.0  # between two directions in which ranges are learned, at least


@PreTrainedConfig.register_subclass("bhd_cnn")
@dataclass
class CnnConfig(MlpConfig):
    """Configuration of the policy type ``bhd_cnn``.

    It is a ``bhd_mlp``, whose options it has, that looks at images in place of a range finder. To act it needs the
    camera and the wheels' odometry. The beams of a range finder are needed to learn, never to act: of every image the
    network also states how far away things are in the directions that it shows. Of the last `n_obs_steps` images it
    keeps this in mind, so that it knows about things that the camera does not show any more.

    Attributes:
        camera: name of the camera that it looks through.
        field_of_view: ranges are learned in directions up to half of this to either side [deg]; what the camera sees.
        range_minimum: nearer things count as being at this range [m].
        range_maximum: farther things count as being at this range [m].
        scanner_ahead: where the range finder is, ahead of the point that the robot turns about [m].
        channels: of the convolutions, each of which halves the image's width and height.
        image_dim: numbers that an image becomes.
        sectors: directions around the robot for each of which it keeps in mind the nearest thing.
        range_weight: of the loss of the ranges, beside that of the actions.
        range_columns: columns of `observation.state` that are the ranges to learn; found by their names.
        range_angles: their directions [rad], counter-clockwise from straight ahead.
        odometry_columns: columns that are the odometry, x [m], y [m] and yaw [rad]; found by their names.
    """

    n_obs_steps: Count = 8
    obs_stride: Count = 5
    chunk_size: Count = 1
    ignore: list[str] = field(default_factory=lambda: ["*.vel"])

    camera: str = "front"
    field_of_view: Annotated[float, Range("(0, 360]")] = 60.0
    range_minimum: Positive = RANGE_MIN
    range_maximum: Positive = RANGE_MAX
    scanner_ahead: float = SCANNER_AHEAD
    channels: list[Count] = field(default_factory=lambda: [12, 24, 32])
    image_dim: Count = 128
    sectors: Count = 36
    range_weight: NotNegative = 1.0
    range_columns: list[int] = field(default_factory=list)
    range_angles: list[float] = field(default_factory=list)
    odometry_columns: list[int] = field(default_factory=list)

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            **dict.fromkeys(("STATE", "ENV", "ACTION"), NormalizationMode.MEAN_STD),
        }
    )

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        if not self.channels:
            raise ConfigError("policy.channels is []; it must name at least one width.")
        if self.range_minimum >= self.range_maximum:
            raise ConfigError(
                f"policy.range_minimum is {self.range_minimum} and policy.range_maximum is {self.range_maximum}; the "
                "first must be positive and below the second [m]."
            )
        for name in ("yaw_harmonics", "sort_objects", "relative_target"):
            if getattr(self, name):
                raise ConfigError(f"policy.{name} is {getattr(self, name)}; a bhd_cnn does not do that. Leave it out.")
        if self.scan.is_used:
            raise ConfigError("bhd_cnn does not read a range finder; leave policy.scan out, or train a bhd_mlp.")

    @property
    def sight_size(self) -> int:
        """How many inputs of the perceptron are made of images: of the present one, and of all that is kept in mind."""
        return self.image_dim + self.sectors

    def set_dataset_feature_metadata(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Find odometry and ranges by their names, and read neither as numbers; LeRobot's `make_policy` calls it."""
        names = names_of(features, OBS_STATE)
        if missing := [name for name in ODOMETRY if name not in names]:
            raise ConfigError(
                f"bhd_cnn maps obstacles by the robot's odometry, but {OBS_STATE} of this dataset has no "
                f"{missing[0]!r}. Record it with --robot.odometry=true."
            )
        beams, angles = find_scan(names, self.type)
        super().set_dataset_feature_metadata(features)
        if self.range_columns:
            return
        self.odometry_columns = [names.index(name) for name in ODOMETRY]
        every = max(1, round(_SPACING_DEG * len(angles) / 360))
        seen = [i for i in range(0, len(angles), every) if abs(math.degrees(angles[i])) <= self.field_of_view / 2]
        seen.sort(key=lambda beam: float(angles[beam]))
        self.range_columns = [beams.start + beam for beam in seen]
        self.range_angles = [float(angles[beam]) for beam in seen]
        unread = {*self.ignored_columns, *self.odometry_columns, *range(beams.start, beams.stop)}
        self.ignored_columns = sorted(unread)

    def validate_features(self) -> None:
        """Keep the inputs that it reads, and refuse what it cannot be built for."""
        self.known_features()
        super().validate_features()
        if min(self.image_size) < _LEAST_SIZE:
            width, height = self.image_size
            raise ConfigError(
                f"The images of {self.image_key!r} are {width} x {height} px; bhd_cnn needs at least {_LEAST_SIZE} x "
                f"{_LEAST_SIZE}."
            )
        size = self.robot_state_feature.shape[0] if self.robot_state_feature else 0
        columns = [*self.range_columns, *self.odometry_columns]
        if not self.range_columns or len(self.odometry_columns) != len(ODOMETRY) or max(columns) >= size:
            raise ConfigError(
                f"bhd_cnn does not know which columns of {OBS_STATE} are ranges and odometry: make the policy with the "
                "metadata of its dataset."
            )
