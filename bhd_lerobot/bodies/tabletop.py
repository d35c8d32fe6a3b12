"""What can lie on the table before an arm, and how one episode's world differs from the next."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from bhd_lerobot.bodies.body import Workspace
from bhd_lerobot.errors import ConfigError, unknown_name

MAX_OBJECTS = 5  # all simulations of a batch share one model, so the number of bodies is fixed

# The colours that objects have and that an instruction may name: red, green and blue from 0 to 1.
COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.80, 0.13, 0.12),
    "green": (0.13, 0.58, 0.22),
    "blue": (0.12, 0.30, 0.75),
    "yellow": (0.93, 0.78, 0.12),
    "orange": (0.92, 0.48, 0.10),
    "purple": (0.48, 0.20, 0.62),
    "white": (0.92, 0.92, 0.90),
    "black": (0.10, 0.10, 0.11),
}
KINDS: tuple[Literal["cup", "box"], ...] = ("cup", "box")

STYLES = ("usual", "plain", "across", "marked", "other")
"""How objects look: ``usual``: a cup with a handle and a dark mouth, a box with a light tape along it; ``plain``:
neither; ``across``: the tape lies across, not along; ``marked``: instead a stripe around it and a patch on its top;
``other``: a cup with a lid and a knob, a box with a dark band across it."""

OBJECT_FIELDS = (
    *("present", "target", "box", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("length", "width", "height", "red", "green", "blue"),
)
"""What a task reports about each place of an object, in order: whether there is one, whether it is the target, whether
it is a box; its pose in the base frame [m, unit quaternion]; its measures [m]; its colour, 0 to 1."""


@dataclass(frozen=True)
class CameraView:
    """Where a fixed camera stands, and what it sees: a pinhole without distortion.

    Attributes:
        position: of its centre in the base frame [m].
        target: a point in the middle of its image, in the base frame [m].
        fovy: vertical field of view [deg].
        roll: by which it is turned clockwise about its line of sight; upright at 0 [rad].
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fovy: float
    roll: float = 0.0


SCENE_CAMERA = CameraView((1.22, -0.62, 0.78), (0.37, 0.02, 0.15), 48.0)
"""The camera `scene` beside a UR5's table, where a scene's `Variation` does not move it."""
_CORNER = math.hypot(0.65, 0.30)  # [m] from a UR5's base to the farther corners of the part where things stand


def scene_camera(workspace: Workspace) -> CameraView:
    """Return the camera `scene` beside an arm's table: of one that is half as large it stands half as far away."""
    k = math.hypot(*workspace.table[1]) / _CORNER
    (px, py, pz), (tx, ty, tz) = SCENE_CAMERA.position, SCENE_CAMERA.target
    return replace(SCENE_CAMERA, position=(k * px, k * py, k * pz), target=(k * tx, k * ty, k * tz))


@dataclass(frozen=True)
class TableObject:
    """One object that stands on the table.

    Attributes:
        kind: ``"cup"``, an upright cylinder, or ``"box"``.
        colour: a name from `COLOURS`.
        size_x: radius of a cup, or half the length of a box [m].
        size_y: half the width of a box [m]; the radius again for a cup.
        height: [m].
        x: centre in the base frame [m].
        y: centre in the base frame [m].
        yaw: rotation about the vertical axis [rad].
        mass: [kg].
        friction: sliding friction against table and fingers.
        shade: what is added to each of red, green and blue of the colour.
        style: one of `STYLES`.
        marks: of a ``marked`` one: how high the middle of its stripe is and how broad the stripe, as shares of the
            height; how light the stripe is, from -1 (dark) over 0 (the object's colour) to 1 (white); the share of the
            top that the patch covers along each of its sides; and how light the patch is.
    """

    kind: Literal["cup", "box"]
    colour: str
    size_x: float
    size_y: float
    height: float
    x: float
    y: float
    yaw: float = 0.0
    mass: float = 0.2
    friction: float = 0.9
    shade: tuple[float, float, float] = (0.0, 0.0, 0.0)
    style: str = "usual"
    marks: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(unknown_name("kind of object", self.kind, KINDS))
        if self.colour not in COLOURS:
            raise ConfigError(unknown_name("colour", self.colour, COLOURS))
        if self.style not in STYLES:
            raise ConfigError(unknown_name("style of object", self.style, STYLES))
        if len(self.marks) != (5 if self.style == "marked" else 0):
            raise ConfigError(f"marks of a {self.colour} {self.kind} in the style {self.style!r} are {self.marks}.")
        for name in ("size_x", "size_y", "height", "mass", "friction"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} of a {self.colour} {self.kind} is {getattr(self, name)}; it must be > 0.")

    @property
    def name(self) -> str:
        """What an instruction calls it, for example ``"red cup"``."""
        return f"{self.colour} {self.kind}"


MAX_LATENCY_S = 0.05
"""So late at the most do the servos of an arm get their commands [s]."""


@dataclass(frozen=True)
class Variation:
    """How one episode's world differs from the nominal one; the defaults are no difference.

    Attributes:
        light: factor on the lights' brightness.
        light_direction: what is added to the direction of the main light, x and y.
        camera_shift: what is added to the scene camera's position [m].
        camera_turn: by what the scene camera is turned, a rotation vector in its own frame [rad].
        wrist_turn: by what the wrist camera is turned on its mount, likewise [rad].
        sensor_noise: standard deviation of the noise on observed joint positions [rad], on speeds ten times that
            [rad/s].
        latency_s: time by which what the cerebellum commands reaches the servos late, in whole control ticks [s].
        finger_friction: factor on the fingers' friction.
        camera_error: added to every position that the task reports, x, y, z in the base frame [m]: in front of a real
            arm these come from a camera, whose place may be known wrongly. Images stay as they are.
        surface: what is added to the red, green and blue of the table's top, which are between 0 and 1.
    """

    light: float = 1.0
    light_direction: tuple[float, float] = (0.0, 0.0)
    camera_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wrist_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor_noise: float = 0.0
    latency_s: float = 0.0
    finger_friction: float = 1.0
    camera_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    surface: tuple[float, float, float] = (0.0, 0.0, 0.0)


MAX_CAMERA_ERROR = 0.2  # [m] along an axis; a camera that is off by more was set up wrongly, not calibrated badly


def check_camera_error(name: str, error: Sequence[float]) -> None:
    """Refuse what is no error that a camera's calibration can have.

    Args:
        name: of the option.
        error: x, y, z in the base frame [m].

    Raises:
        ConfigError: it is not three finite numbers, or one of them is too large.
    """
    if len(error) != 3 or not all(abs(value) <= MAX_CAMERA_ERROR for value in error):
        raise ConfigError(
            f"{name} is {list(error)}; it must be three numbers, x, y and z in the base frame [m], each between "
            f"-{MAX_CAMERA_ERROR} and {MAX_CAMERA_ERROR}."
        )


@dataclass(frozen=True)
class TableScene:
    """Objects on the table, the arm's start, and what the episode's task is about.

    Attributes:
        name: which kind of scene it is.
        objects: at most `MAX_OBJECTS`.
        posture: joint angles [rad] and gripper opening [m] at the start.
        target_object: number of the object that the task is about, or None.
        target_pose: tool pose in the base frame that the task asks for: x, y, z [m] and a quaternion w, x, y, z; or
            None. It is drawn, and touches nothing.
        instruction: what a person would ask for.
        variation: how this world differs from the nominal one.
        report_seed: of the noise on what the task senses, where there is any.
    """

    name: str
    objects: tuple[TableObject, ...]
    posture: tuple[float, ...]
    target_object: int | None = None
    target_pose: tuple[float, ...] | None = None
    instruction: str = ""
    variation: Variation = field(default_factory=Variation)
    report_seed: int = 0

    @property
    def stand_m(self) -> float:
        """Height of what the objects stand on, in the frame that they are placed in [m]."""
        return 0.0

    def __post_init__(self) -> None:
        if len(self.objects) > MAX_OBJECTS:
            raise ConfigError(f"The scene has {len(self.objects)} objects; a table holds at most {MAX_OBJECTS}.")
        if self.target_object is not None and not 0 <= self.target_object < len(self.objects):
            raise ConfigError(f"target_object is {self.target_object}; the scene has {len(self.objects)} objects.")
