"""Configuration of `bhd_perception`: an image in, the objects on the table out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE

from bhd_lerobot.bodies.body import Arm, Workspace
from bhd_lerobot.bodies.registry import body_with
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS, SCENE_CAMERA, CameraView, scene_camera
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, Finite, NotNegative, Range
from bhd_lerobot.policies.perception.camera import Projection, Region
from bhd_lerobot.policies.trained import TrainedConfig, names_of

STRIDE = 4  # [px] of the image for each cell of the grid that the network answers on
_TALLEST = 0.13  # [m] of the objects of a UR5
LABELS = tuple(f"object_{number}_{name}" for number in range(MAX_OBJECTS) for name in OBJECT_FIELDS)


@PreTrainedConfig.register_subclass("bhd_perception")
@dataclass
class PerceptionConfig(TrainedConfig):
    """Configuration of the policy type ``bhd_perception``.

    It reads one image. The true poses in `observation.environment_state` are what it learns to say, never an input.
    What is not said of camera and table is that of the arm that recorded the dataset, in simulation; `bhd-train` finds
    it out, and with other programs it is that of a UR5.

    Attributes:
        camera: name of the camera that it looks through.
        camera_position: where that camera stands unless it is moved, x, y, z in the base frame [m].
        camera_target: a point in the middle of its image, likewise.
        camera_fovy: its vertical field of view [deg].
        camera_roll: by which it is turned clockwise about its line of sight [rad].
        area: where objects stand, in the base frame: smallest x, smallest y, largest x, largest y [m].
        object_height: the tallest object [m]; the arm's if 0.
        scale: measures of the objects, compared with those of a UR5's; the arm's if 0.
        margin: by how much the camera may be moved, as a share of the image's width that is looked at around the area.
        channels: of the network where the image is finest.
        hidden: of the network where it is coarser.
        context: numbers that describe the whole image: where the camera stands, and the light.
        brightness: images are made brighter and darker by up to this share in training.
        recolour: share of the images that have other colours in training, of which no colours are learned.
        tint: the colours of the others are mixed with one another in training by up to this share, so that other shades
            of a colour are understood; grey stays grey.
        zoom: in training, in most of the images what is looked at closely is made up to 1 + this times larger, or up to
            1 + twice this times smaller, so that objects of other sizes than those that were recorded are understood.
        least_presence: probability from which on something counts as an object.
        optimizer_lr: learning rate of AdamW.
        optimizer_weight_decay: of weights.
        optimizer_grad_clip_norm: largest norm of the gradient.
        scheduler_warmup_steps: steps of the warm-up, after which the learning rate goes to 0 along a cosine.
    """

    learns_true_poses: ClassVar[bool] = True

    camera: str = "scene"
    camera_position: list[Finite] = field(default_factory=list)
    camera_target: list[Finite] = field(default_factory=list)
    camera_fovy: Annotated[float, Range("(0, 180)")] = SCENE_CAMERA.fovy
    camera_roll: float = SCENE_CAMERA.roll
    area: list[Finite] = field(default_factory=list)
    object_height: NotNegative = 0.0
    scale: NotNegative = 0.0
    margin: Annotated[float, Range("[0, 1)")] = 0.06
    channels: Count = 32
    hidden: Count = 48
    context: Count = 64
    brightness: Annotated[float, Range("[0, 1)")] = 0.2
    recolour: Annotated[float, Range("[0, 1)")] = 0.5
    tint: Annotated[float, Range("[0, 1)")] = 0.3
    zoom: Annotated[float, Range("[0, 1)")] = 0.5
    least_presence: Annotated[float, Range("(0, 1)")] = 0.3

    n_obs_steps: int = 1
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "ENV", "STATE", "ACTION"), NormalizationMode.IDENTITY)
    )
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 5.0
    scheduler_warmup_steps: int = 250

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        for name, count in (("camera_position", 3), ("camera_target", 3), ("area", 4)):
            values = getattr(self, name)
            if len(values) not in (0, count):
                raise ConfigError(f"policy.{name} is {values}; it must be {count} finite numbers [m].")
        if self.area and not (self.area[0] < self.area[2] and self.area[1] < self.area[3]):
            raise ConfigError(f"policy.area is {self.area}; it must be smallest x, smallest y, largest x, largest y.")
        self._check_view()

    def _check_view(self) -> None:
        position, target = self.camera_position, self.camera_target
        if position and (position[2] <= 0.0 or position[:2] == target[:2]):
            raise ConfigError(
                f"policy.camera_position is {self.camera_position} and policy.camera_target {self.camera_target}; the "
                "camera must stand above the table, and not look straight down."
            )

    @property
    def is_placed(self) -> bool:
        """Whether everything is said of the camera and the table."""
        return all((self.camera_position, self.camera_target, self.area, self.object_height, self.scale))

    def stand_before(self, workspace: Workspace) -> None:
        """Take what was not said of the camera and the table from an arm's."""
        view, (low, high) = scene_camera(workspace), workspace.table
        self.camera_position = self.camera_position or list(view.position)
        self.camera_target = self.camera_target or list(view.target)
        self.area = self.area or [*low, *high]
        self.scale = self.scale or workspace.handling.scale
        self.object_height = self.object_height or _TALLEST * self.scale
        self._check_view()  # one of the two may have been said

    def settle(self) -> None:
        """Take what nobody said from a UR5's, and check that the camera sees the table."""
        self.stand_before(body_with(Arm).need(Arm).workspace)
        _ = self.region

    @property
    def view(self) -> CameraView:
        """Where the camera stands unless it is moved."""
        position, target = (tuple(values) for values in (self.camera_position, self.camera_target))
        return CameraView(position, target, self.camera_fovy, self.camera_roll)  # type: ignore[arg-type]

    @property
    def projection(self) -> Projection:
        """The camera where it is not moved, with the size of its images."""
        return Projection(self.view, *self.image_size)

    @property
    def region(self) -> Region:
        """The part of the image in which objects may be."""
        x0, y0, x1, y1 = self.area
        try:
            return self.projection.region((x0, y0, 0.0), (x1, y1, self.object_height), self.margin, 2 * STRIDE)
        except ValueError as error:
            raise ConfigError(
                f"policy.area is {self.area}, of which the camera at {self.camera_position} that looks at "
                f"{self.camera_target} sees nothing."
            ) from error

    @property
    def observation_delta_indices(self) -> None:
        """Only the present image."""
        return None

    def set_dataset_feature_metadata(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Check that the dataset says where objects are, and keep that as output; LeRobot's `make_policy` calls it."""
        names = names_of(features, OBS_ENV_STATE)
        if tuple(names) != LABELS:
            raise ConfigError(
                f"bhd_perception learns from the true poses of objects ({LABELS[0]}, {LABELS[1]}, …, {LABELS[-1]} in "
                f"{OBS_ENV_STATE}), which this dataset does not have. Record the task 'pick' in simulation, with "
                "--robot.camera=true."
            )
        # LeRobot takes actions as outputs, and nothing else.
        labels = PolicyFeature(FeatureType.ENV, (len(LABELS),))
        self.output_features = {**(self.output_features or {}), OBS_ENV_STATE: labels}

    def validate_features(self) -> None:
        """Keep the image as input and the labels as output."""
        known = self.known_features()
        if OBS_ENV_STATE not in known or tuple(known[OBS_ENV_STATE].shape) != (len(LABELS),):
            raise ConfigError(
                f"bhd_perception learns from {OBS_ENV_STATE} of {len(LABELS)} numbers, the true poses of objects, "
                "which the dataset does not have. Record the task 'pick' in simulation."
            )
        self.input_features = {self.image_key: known[self.image_key]}
        self.output_features = {OBS_ENV_STATE: known[OBS_ENV_STATE]}
        self.settle()
