"""Mappings of the robots that this package has."""

from collections.abc import Callable, Iterable, Mapping

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import JOINTS as UR_JOINTS
from bhd_lerobot.bodies.ur import MODELS
from bhd_lerobot.ros2.messages.images import IMAGE
from bhd_lerobot.ros2.messages.mapping import FieldConfig, ImageConfig, MappingConfig, TopicFields, fields_of
from bhd_lerobot.ros2.messages.table import (
    GYRO,
    IMU_TYPE,
    JOINTS,
    ODOMETRY,
    ODOMETRY_TYPE,
    SCAN,
    STAMPED_TWIST,
    TWIST,
    TWIST_TYPE,
    path_of,
)


def entries(topic: str, msgtype: str, columns: Iterable[str]) -> dict[str, FieldConfig]:
    """Return the entries of a mapping for columns that messages of a type carry, as the table has it."""
    return {name: FieldConfig(topic, msgtype, path_of(msgtype, name)) for name in columns}


def columns(topic: str, msgtype: str, names: Iterable[str]) -> TopicFields:
    """Return what reads and writes columns that a topic carries, as the table has it."""
    return fields_of(topic, msgtype, [path_of(msgtype, name) for name in names])


def turtlebot3(
    *,
    scan: str = "/scan",
    odom: str | None = "/odom",
    cmd: str = "/cmd_vel",
    imu: str | None = None,
    cameras: Mapping[str, str] | None = None,
    beams: int = 360,
    pose: bool = False,
    stamped: bool = True,
) -> MappingConfig:
    """Return the mapping of a TurtleBot3.

    Args:
        stamped: whether commands are TwistStamped, as on Jazzy, or Twist, as on Humble.
    """
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    observation: dict[str, FieldConfig] = {}
    if odom is not None:
        observation |= entries(odom, ODOMETRY_TYPE, TWIST)
    observation["scan"] = FieldConfig(
        scan, SCAN, "ranges", beams=beams, range_min=lidar.range_min, range_max=lidar.range_max
    )
    if odom is not None and pose:
        observation |= entries(odom, ODOMETRY_TYPE, ODOMETRY)
    if imu is not None:
        observation |= entries(imu, IMU_TYPE, GYRO)
    action = entries(cmd, STAMPED_TWIST if stamped else TWIST_TYPE, TWIST)
    images = {name: ImageConfig(topic, type=IMAGE) for name, topic in (cameras or {}).items()}
    return MappingConfig(observation, action, images)


def ur() -> MappingConfig:
    """Return the mapping of a UR with a gripper, as `bhd-data export` writes it: joints by name."""
    joints, speeds = ([f"{name}.{end}" for name in (*UR_JOINTS, "gripper")] for end in ("pos", "vel"))
    return MappingConfig(
        observation=entries("/joint_states", JOINTS, (*joints, *speeds)),
        action=entries("/joint_command", JOINTS, joints),
    )


PRESETS: Mapping[str, Callable[[], MappingConfig]] = {"turtlebot3": turtlebot3, **dict.fromkeys(MODELS, ur)}
"""What makes the mapping of a robot, by its type."""
