"""Mappings of the robots that this package has."""

from collections.abc import Callable, Mapping

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur5 import ur5 as ur5_body
from bhd_lerobot.ros2.messages.base import GYRO, ODOMETRY, TWIST, BareTwistPart, GyroPart, OdometryPart, TwistPart
from bhd_lerobot.ros2.messages.images import IMAGE
from bhd_lerobot.ros2.messages.mapping import SCAN, FieldConfig, ImageConfig, MappingConfig
from bhd_lerobot.ros2.messages.views import JOINT_STATE

_POSE = ("position.x", "position.y", "orientation")


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
        scan, odom, cmd, imu: topics; of odometry and IMU None if they are not observed.
        cameras: topics of images by name.
        beams: of a scan in the observation.
        pose: whether the odometry's pose is observed, too.
        stamped: whether commands are TwistStamped, as on Jazzy, or Twist, as on Humble.
    """
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    observation: dict[str, FieldConfig] = {}
    if odom is not None:
        kind = OdometryPart.msgtype
        fields = [f"twist.{field}" for field in TwistPart.fields]
        observation |= {name: FieldConfig(odom, kind, field) for name, field in zip(TWIST, fields, strict=True)}
    observation["scan"] = FieldConfig(
        scan, SCAN, "ranges", beams=beams, range_min=lidar.range_min, range_max=lidar.range_max
    )
    if odom is not None and pose:
        fields = [f"pose.pose.{field}" for field in _POSE]
        observation |= {name: FieldConfig(odom, kind, field) for name, field in zip(ODOMETRY, fields, strict=True)}
    if imu is not None:
        kind = GyroPart.msgtype
        observation |= {name: FieldConfig(imu, kind, field) for name, field in zip(GYRO, GyroPart.fields, strict=True)}
    part = TwistPart if stamped else BareTwistPart
    action = {name: FieldConfig(cmd, part.msgtype, field) for name, field in zip(TWIST, part.fields, strict=True)}
    images = {name: ImageConfig(topic, type=IMAGE) for name, topic in (cameras or {}).items()}
    return MappingConfig(observation, action, images)


def ur5() -> MappingConfig:
    """Return the mapping of a UR5 with a gripper, as `bhd-data export` writes it: joints by name."""
    joints = [name.removesuffix(".pos") for name in ur5_body().limits.names]
    place = {joint: f"[name={joint}_joint]" for joint in joints}
    observed = {"pos": "position", "vel": "velocity"}
    return MappingConfig(
        observation={
            f"{joint}.{end}": FieldConfig("/joint_states", JOINT_STATE, f"{field}{place[joint]}")
            for end, field in observed.items()
            for joint in joints
        },
        action={
            f"{joint}.pos": FieldConfig("/joint_command", JOINT_STATE, f"position{place[joint]}") for joint in joints
        },
    )


PRESETS: Mapping[str, Callable[[], MappingConfig]] = {"turtlebot3": turtlebot3, "ur5": ur5}
"""What makes the mapping of a robot, by its type."""
