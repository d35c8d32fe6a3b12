"""Configuration of `bhd_mlp`: numbers in, a chunk of actions out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from bhd_lerobot.control.geometry.poses import quaternion_columns
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, NotNegative, OneOf, Options, Positive, Range, Whole
from bhd_lerobot.policies.mlp.objects_mlp import FIELDS, object_columns
from bhd_lerobot.policies.trained import TARGET, TOOL, TrainedConfig, names_of


@dataclass
class ScanConfig(Options, prefix="policy.scan."):
    """How the beams of a range finder become inputs.

    What decides whether a robot has to turn is near, and normalised metres tell near things badly apart: 0.2 m and
    0.4 m differ as much as 3.0 m and 3.2 m.

    Attributes:
        transform: ``"none"``: the beams are normalised like the other numbers; ``"inverse"``: `scale` / range;
            ``"log"``: log(range / `scale`).
        start: column of the first beam in `observation.state`; found by its name (`scan_000.pos`) if not set.
        beams: how many beams there are, evenly spaced over a full turn; found by their names if 0.
        scale: range at which the input is 1 or 0 [m].
        minimum: ranges below this count as this [m].
        channels: output channels of circular convolutions over the beams, in front of the network; none if empty.
        kernel_size: width of each convolution [beams], odd.
        stride: step of each convolution [beams].
    """

    transform: Annotated[str, OneOf(("none", "inverse", "log"))] = "none"
    start: Whole | None = None
    beams: Whole = 0
    scale: Positive = 0.5
    minimum: Positive = 0.05
    channels: list[Count] = field(default_factory=list)
    kernel_size: Count = 5
    stride: Count = 2

    @property
    def is_used(self) -> bool:
        """Whether the beams are treated otherwise than the other numbers."""
        return self.transform != "none" or bool(self.channels)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kernel_size % 2 == 0:
            raise ConfigError(f"policy.scan.kernel_size is {self.kernel_size}; it must be odd: 1, 3, 5, …")
        if (self.start is None) != (self.beams == 0):
            raise ConfigError(
                f"policy.scan.start is {self.start} and policy.scan.beams is {self.beams}; give both or neither. "
                "Without them the beams are found by their names in the dataset."
            )


@PreTrainedConfig.register_subclass("bhd_mlp")
@dataclass
class MlpConfig(TrainedConfig):
    """Configuration of the policy type ``bhd_mlp``.

    It reads `observation.state` and `observation.environment_state` and nothing else; cameras of a dataset are left
    alone.

    Attributes:
        n_obs_steps: observations that it looks at.
        obs_stride: frames from each of them to the next.
        chunk_size: actions that it predicts, one a frame.
        n_action_steps: how many of them are carried out before it looks again.
        hidden_dims: widths of the hidden layers.
        activation: of the hidden layers.
        layer_norm: normalise each hidden layer before its activation.
        dropout: share of hidden values that are dropped in training.
        feature_clip: normalised inputs beyond ± this count as this: a number that never changed in the dataset has no
            scale; null turns it off.
        min_std: least standard deviation that an input or an action is divided by, in its own unit: what varies by less
            than a millimetre or a milliradian is noise, and would be blown up to the size of everything else. An input
            that stays within twice of it in the whole dataset has no influence.
        loss: if not set, ``"nll"``, which needs `gaussian`, with it and ``"l1"`` without.
        huber_delta: where ``"huber"`` goes from a square to a line, in normalised actions.
        modes: chunks that it predicts, of which it carries out the likeliest: where a rule passes something now on the
            left and now on the right, the mean of both is neither.
        gaussian: also learn how much actions scatter, as a standard deviation for every action of the chunk that does
            not depend on the observation.
        initial_log_std: its logarithm before training, in normalised actions.
        sample: with `gaussian`, act on a sample instead of the mean.
        scan: how a range finder's beams become inputs.
        ignore: numbers of `observation.state` that it does not look at, by name or pattern: ``["*.vel"]``. What the
            robot measures of its own motion is nearly the last action, and a network that imitates learns to repeat it
            instead of looking where it goes (P. de Haan et al., "Causal confusion in imitation learning", 2019).
        ignored_columns: their columns; found by their names.
        yaw_harmonics: of every quaternion among the inputs (`…_qw` to `…_qz`), cosine and sine of 1 to this many times
            its yaw become inputs, too; none if 0. A box looks the same after half a turn, and how to grasp it depends
            on twice its yaw, which a network learns badly from a quaternion.
        state_quaternions: columns of `observation.state` at which quaternions begin; found by their names.
        environment_quaternions: likewise of `observation.environment_state`.
        residual: actions, by name or pattern, of which it predicts by how much they differ from what is observed under
            the same name: where a robot is to go next is near where it is. Not for what is opened and closed at once,
            such as a gripper: a small error in each frame would add up.
        residual_columns: of each action the column of `observation.state`, -1 for none; found by their names.
        residual_quaternions: columns of the action at which quaternions begin that are predicted so: of the two signs
            of each, it learns the one nearer to what is observed; found by their names.
        sort_objects: sort the objects that a task reports (`object_0_present`, …): what is meant first, then the
            nearest to it. Their order in the observation is then of no account. Where the robot observes its tool pose,
            it also sees where what is meant is from there.
        objects: where they are in `observation.environment_state`: first column, how many, how many numbers each, and
            which of these are `present`, `target` and the pose; found by their names.
        relative_target: it also sees where the target pose of the task `reach` is from the tool, which the robot has
            to observe.
        target_columns: of that pose in `observation.environment_state`; found by their names.
        tool_columns: of the tool pose in `observation.state`; found by their names.
        optimizer_lr: learning rate of AdamW.
        optimizer_betas: of AdamW.
        optimizer_eps: of AdamW.
        optimizer_weight_decay: of weights; biases and standard deviations do not decay.
        optimizer_grad_clip_norm: largest norm of the gradient.
        scheduler: ``"cosine"``: to 0 over the training, after a warm-up; ``"constant"``.
        scheduler_warmup_steps: steps of the warm-up.
    """

    n_obs_steps: Count = 1
    obs_stride: Count = 1
    chunk_size: Count = 8
    n_action_steps: Count = 1
    hidden_dims: list[Count] = field(default_factory=lambda: [256, 256])
    activation: Annotated[str, OneOf(("relu", "tanh", "gelu", "silu", "elu"))] = "relu"
    layer_norm: bool = False
    dropout: Annotated[float, Range("[0, 1)")] = 0.0
    feature_clip: Annotated[float, Range("(0, inf]")] | None = 10.0
    min_std: NotNegative = 1e-3
    loss: Annotated[str, OneOf(("l1", "mse", "huber", "nll"))] | None = None
    huber_delta: Positive = 0.5
    modes: Count = 1
    gaussian: bool = False
    initial_log_std: float = 0.0
    sample: bool = False
    scan: ScanConfig = field(default_factory=ScanConfig)
    ignore: list[str] = field(default_factory=list)
    ignored_columns: list[int] = field(default_factory=list)
    yaw_harmonics: Whole = 0
    state_quaternions: list[int] = field(default_factory=list)
    environment_quaternions: list[int] = field(default_factory=list)
    residual: list[str] = field(default_factory=list)
    residual_columns: list[int] = field(default_factory=list)
    residual_quaternions: list[int] = field(default_factory=list)
    sort_objects: bool = False
    objects: list[int] = field(default_factory=list)
    relative_target: bool = False
    target_columns: list[int] = field(default_factory=list)
    tool_columns: list[int] = field(default_factory=list)

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    optimizer_lr: float = 1e-3
    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 1.0
    scheduler: Annotated[str, OneOf(("cosine", "constant"))] = "cosine"
    scheduler_warmup_steps: int = 100

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        self.check_chunk()
        for name, is_set in (("loss=nll", self.loss == "nll"), ("sample", self.sample)):
            if is_set and not self.gaussian:
                raise ConfigError(f"policy.{name} needs a distribution; set --policy.gaussian=true.")

    @property
    def sight_size(self) -> int:
        """How many inputs of the perceptron are made of images."""
        return 0

    @property
    def quaternions(self) -> int:
        """How many quaternions there are among the inputs, as far as is known."""
        return len(self.state_quaternions) + len(self.environment_quaternions)

    @property
    def loss_name(self) -> str:
        """The loss that is trained with."""
        return self.loss or ("nll" if self.gaussian else "l1")

    @property
    def history(self) -> int:
        """How many frames back it looks, the present one included."""
        return (self.n_obs_steps - 1) * self.obs_stride + 1

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Which frames it looks at, oldest first, the present one being 0; nothing if only that."""
        if self.n_obs_steps == 1:
            return None
        return [-back * self.obs_stride for back in reversed(range(self.n_obs_steps))]

    def set_dataset_feature_metadata(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Find beams, quaternions and what is to be ignored by their names; LeRobot's `make_policy` calls it."""
        is_known = bool(self.residual_columns)
        self.find_columns(features)
        if self.residual and not is_known:
            firsts = quaternion_columns(names_of(features, ACTION))
            self.residual_quaternions = [one for one in firsts if min(self.residual_columns[one : one + 4]) >= 0]
        names, told = names_of(features, OBS_STATE), names_of(features, OBS_ENV_STATE)
        if self.yaw_harmonics and not self.quaternions:
            self.state_quaternions = quaternion_columns(names)
            self.environment_quaternions = quaternion_columns(told)
        if self.sort_objects and not self.objects:
            start, count, size, fields = object_columns(told)
            self.objects = [start, count, size, *fields] if count else []
        if self.relative_target and not self.target_columns and set(TARGET) <= set(told):
            self.target_columns = [told.index(name) for name in TARGET]
        if (self.sort_objects or self.relative_target) and not self.tool_columns and set(TOOL) <= set(names):
            self.tool_columns = [names.index(name) for name in TOOL]
        if not self.scan.is_used or self.scan.beams:
            return
        columns = [i for i, name in enumerate(names) if name.startswith("scan_") and name.endswith(".pos")]
        if not columns or columns != list(range(columns[0], columns[0] + len(columns))):
            raise ConfigError(
                "policy.scan treats the beams of a range finder (scan_000.pos, scan_001.pos, …), which "
                f"{OBS_STATE} of this dataset does not have. Set --policy.scan.transform=none and leave "
                "policy.scan.channels empty, or name the columns with policy.scan.start and policy.scan.beams."
            )
        self.scan.start, self.scan.beams = columns[0], len(columns)

    def validate_features(self) -> None:
        """Keep the inputs that it reads, and refuse what it cannot be built for."""
        known: dict[str, PolicyFeature] = self.input_features or {}
        kept = {key: feature for key, feature in known.items() if key in (OBS_STATE, OBS_ENV_STATE, self.image_key)}
        self.input_features = kept
        if not kept:
            raise ConfigError(f"{self.type} reads {OBS_STATE} and {OBS_ENV_STATE}; the dataset has neither.")
        if self.action_feature is None:
            raise ConfigError(f"{self.type} needs an action to predict; the dataset has none.")
        for key, feature in {**kept, **(self.output_features or {})}.items():
            if feature.type != FeatureType.VISUAL and len(feature.shape) != 1:
                raise ConfigError(f"{self.type} reads and writes vectors; {key} has the shape {tuple(feature.shape)}.")
        state = self.robot_state_feature
        width = state.shape[0] if state else 0
        self.check_columns(width)
        if self.yaw_harmonics and not self.quaternions:
            raise ConfigError(
                f"policy.yaw_harmonics is {self.yaw_harmonics}, but no quaternion (…_qw, …_qx, …_qy, …_qz) is known "
                "among the inputs. Set it to 0, or name the columns with policy.state_quaternions and "
                "policy.environment_quaternions."
            )
        for key, columns in ((OBS_STATE, self.state_quaternions), (OBS_ENV_STATE, self.environment_quaternions)):
            size = kept[key].shape[0] if key in kept else 0
            if not all(0 <= column <= size - 4 for column in columns):
                raise ConfigError(f"Quaternions at the columns {columns} do not fit into the {size} of {key}.")
        told = kept[OBS_ENV_STATE].shape[0] if OBS_ENV_STATE in kept else 0
        self._check_objects(told)
        self._check_target(width, told)
        if len(set(self.ignored_columns)) == width and OBS_ENV_STATE not in kept and not self.sight_size:
            raise ConfigError(f"policy.ignore is {self.ignore}, which leaves no input.")
        scan = self.scan
        if scan.is_used and (not scan.beams or scan.start is None or scan.start + scan.beams > width):
            raise ConfigError(
                f"policy.scan has start {scan.start} and beams {scan.beams}; they must lie among the {width} columns "
                f"of {OBS_STATE}."
            )

    def _check_objects(self, width: int) -> None:
        """Refuse to sort objects that are not among the `width` columns of the environment state."""
        if not self.sort_objects:
            return
        if len(self.objects) != 3 + len(FIELDS) or self.objects[0] + self.objects[1] * self.objects[2] > width:
            raise ConfigError(
                f"policy.sort_objects is true, but {OBS_ENV_STATE} of this dataset describes no objects with "
                f"{', '.join(f'object_0_{one}' for one in FIELDS)}. Leave it false, or record the task 'pick'."
            )

    def _check_target(self, width: int, told: int) -> None:
        """Refuse a target that is told or a tool that is observed nowhere among as many columns."""
        if not self.relative_target:
            return
        poses = ((self.tool_columns, width), (self.target_columns, told))
        if not all(len(columns) == len(TARGET) and max(columns) < size for columns, size in poses):
            raise ConfigError(
                f"policy.relative_target is true, but {OBS_ENV_STATE} of this dataset has no {', '.join(TARGET)}, or "
                f"{OBS_STATE} no {', '.join(TOOL)}. Leave it false, or record the task 'reach' with "
                "--robot.tool_pose=true."
            )
