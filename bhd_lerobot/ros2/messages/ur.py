"""What the topics of `ur_robot_driver` are called, and what they mean."""

import math

from bhd_lerobot.control.plant import SafetyStatus

TRAJECTORY_TOPIC = "/scaled_joint_trajectory_controller/joint_trajectory"
POSITION_TOPIC = "/forward_position_controller/commands"
GRIPPER_TOPIC = "/gripper_position_controller/commands"
"""Not of the driver: the opening of the gripper [m]."""
SCALING_TOPIC = "/speed_scaling_state_broadcaster/speed_scaling"
SAFETY_TOPIC = "/io_and_status_controller/safety_mode"

FLOAT, FLOATS = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
SAFETY_MODE = "ur_dashboard_msgs/msg/SafetyMode"

_STOPPED = (3, 4, 5, 12, 13)  # protective stop, recovery, safeguard stops, three-position enabling stop
_EMERGENCY = (6, 7)  # of the system, of the robot
_NORMAL = (1, 2)  # normal, reduced


def safety_status(mode: float, speed_scaling: float) -> SafetyStatus:
    """Return the status of a robot from its safety mode and its speed scaling [%]; NaN is what is not known."""
    if mode in _EMERGENCY:
        return SafetyStatus.EMERGENCY_STOP
    if not math.isnan(mode) and mode not in _NORMAL + _STOPPED:
        return SafetyStatus.FAULT
    return SafetyStatus.STOPPED if mode in _STOPPED or speed_scaling <= 0 else SafetyStatus.NORMAL
