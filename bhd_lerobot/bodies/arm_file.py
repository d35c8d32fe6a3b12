"""What may be said of an arm whose model is a file of somebody else; everything else is read from the file."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GripperFile:
    """The gripper of a model.

    Attributes:
        name: of its actuator, of the tendon that this pulls, or of its joint; the one that the file has if empty,
            ``"none"`` for an arm without one.
        open: where its joint is when it is open [m or rad]; the end of its range that is farther open if None.
        closed: where its joint is when it is closed [m or rad]; the other end if None.
        opening: distance between the fingers where it is open [m]; the way of its fingers if None.
    """

    name: str = ""
    open: float | None = None
    closed: float | None = None
    opening: float | None = None


@dataclass(frozen=True)
class ArmFile:
    """An arm's model in a file, and what the file does not say.

    Attributes:
        name: the body's name.
        path: the file: MJCF, or URDF as MuJoCo reads it.
        tool: the site of the tool centre point, or a body; the only site on the last link if empty.
        tool_offset: x, y, z in that site or body [m].
        gripper: the gripper.
        home: posture that it starts in [rad]; the file's keyframe ``home``, or one in the middle of what it reaches, if
            empty.
        ranges: lowest and highest position [rad] of joints by name, in place of the file's.
        servos: stiffness [N m/rad], damping [N m s/rad] and friction [N m] of joints by name, in place of the file's.
        velocity: largest speed of each joint, or of all of them [rad/s]; that of a URDF, or 2 if empty.
        acceleration: largest acceleration, likewise [rad/s^2]; what the motors can give in any posture if empty.
        effort: largest torque, likewise [N m]; the file's if empty.
        payload: largest mass in the gripper [kg]; what the motors can carry anywhere if None.
    """

    name: str
    path: str
    tool: str = ""
    tool_offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    gripper: GripperFile = GripperFile()
    home: tuple[float, ...] = ()
    ranges: tuple[tuple[str, float, float], ...] = ()
    servos: tuple[tuple[str, float, float, float], ...] = ()
    velocity: tuple[float, ...] = ()
    acceleration: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    payload: float | None = None
