"""The names of a robot's actions and observations: its arm's, then its drive's."""

from typing import Any

from bhd_lerobot.bodies.body import Arm, Body

TOOL_NAMES = (
    "tool_x.pos",
    "tool_y.pos",
    "tool_z.pos",
    "tool_qw.pos",
    "tool_qx.pos",
    "tool_qy.pos",
    "tool_qz.pos",
    "gripper.pos",
)
"""Position [m] and orientation (unit quaternion) of the tool frame in the base frame, and the gripper's opening [m]."""
TWIST_NAMES = ("x.vel", "theta.vel")
ODOMETRY_NAMES, GYRO_NAMES = ("x.pos", "y.pos", "theta.pos"), ("imu_x.vel", "imu_y.vel", "imu_z.vel")


def arm_action_names(config: Any, body: Body) -> tuple[str, ...]:
    """Return the names of an arm's actions, in order: positions, or tool poses with the gripper's opening if any."""
    arm = body.need(Arm)
    if config.action_space == "joint":
        return arm.limits.names
    return TOOL_NAMES if arm.gripper else TOOL_NAMES[:-1]


def arm_observation_names(config: Any, body: Body) -> tuple[str, ...]:
    """Return the names of the floats that an arm observes, in order."""
    positions = body.need(Arm).limits.names
    speeds = tuple(f"{name.removesuffix('.pos')}.vel" for name in positions)
    return (*positions, *speeds, *TOOL_NAMES[:-1] * config.tool_pose)


def drive_observation_names(config: Any) -> tuple[str, ...]:
    """Return the names of the floats that a drive and its lidar observe, in order."""
    scan = (f"scan_{beam:03d}.pos" for beam in range(config.beams))
    return (*TWIST_NAMES, *scan, *ODOMETRY_NAMES * config.odometry, *GYRO_NAMES * config.imu)


def action_names(config: Any, body: Body) -> tuple[str, ...]:
    """Return the names of a robot's actions, in order."""
    return (*(arm_action_names(config, body) if body.arm else ()), *(TWIST_NAMES if body.drive else ()))


def observation_names(config: Any, body: Body) -> tuple[str, ...]:
    """Return the names of the floats that a robot observes, in order."""
    arm = arm_observation_names(config, body) if body.arm else ()
    return (*arm, *(drive_observation_names(config) if body.drive else ()))
