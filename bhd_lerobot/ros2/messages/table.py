"""One table of what the standard messages carry of our robots: which field of which type is which column."""

from collections.abc import Sequence

STAMPED_TWIST, TWIST_TYPE = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"  # the second is Humble's
ODOMETRY_TYPE, IMU_TYPE, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/LaserScan"
POSE_TYPE, JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"

FIELDS = {
    STAMPED_TWIST: {"x.vel": "twist.linear.x", "theta.vel": "twist.angular.z"},
    TWIST_TYPE: {"x.vel": "linear.x", "theta.vel": "angular.z"},
    ODOMETRY_TYPE: {
        "x.vel": "twist.twist.linear.x",
        "theta.vel": "twist.twist.angular.z",
        "x.pos": "pose.pose.position.x",
        "y.pos": "pose.pose.position.y",
        "theta.pos": "pose.pose.orientation",
    },
    IMU_TYPE: {f"imu_{axis}.vel": f"angular_velocity.{axis}" for axis in "xyz"},
    POSE_TYPE: {f"tool_{axis}.pos": f"pose.position.{axis}" for axis in "xyz"}
    | {f"tool_q{axis}.pos": f"pose.orientation.{axis}" for axis in "wxyz"},
}
"""Type -> column -> path of the field; of a JointState see `path_of`. Units are ROS's: SI and radians."""
_OF_JOINT = {"pos": "position", "vel": "velocity"}

TWIST = tuple(FIELDS[TWIST_TYPE])
ODOMETRY = tuple(FIELDS[ODOMETRY_TYPE])[2:]
GYRO = tuple(FIELDS[IMU_TYPE])
TOOL = tuple(FIELDS[POSE_TYPE])
ODOM_FRAME, FOOTPRINT_FRAME, SCAN_FRAME, IMU_FRAME = "odom", "base_footprint", "base_scan", "imu_link"
ARM_FRAME, TOOL_FRAME = "base", "tool"


def joint_columns(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of joints in a JointState; of wheels, turtlebot3_node has the speeds in m/s."""
    return tuple(f"{joint}.{end}" for end in _OF_JOINT for joint in joints)


def path_of(msgtype: str, column: str) -> str:
    """Return where a column is in messages of a type; joints are found by name."""
    if msgtype != JOINTS:
        return FIELDS[msgtype][column]
    joint, _, end = column.rpartition(".")
    return f"{_OF_JOINT[end]}[name={joint}_joint]"
