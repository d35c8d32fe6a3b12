"""A bridge in front of a robot, and a brain, as one launch file: `ros2 launch bridge.launch.py`.

`bhd-ros2` is a program of its own environment, not a node of a ROS package: it is started as a process. The parameters
of a brain are those of its node; those of the bridge are its options.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return what is started."""
    robot = LaunchConfiguration("robot")
    return LaunchDescription(
        [
            DeclareLaunchArgument("robot", default_value="turtlebot3", description="ur5, with a brain for arms"),
            ExecuteProcess(
                cmd=["bhd-ros2", "bridge", ["--robot.type=", robot], "--robot.plant=ros2", "--articles=true"],
                sigterm_timeout="15",
                output="screen",
            ),
            # Your brain: its package, its node, and its parameters.
            Node(
                package="obstacle_avoidance",
                executable="obstacle_avoidance_brain",
                parameters=[{"safe_distance": 0.5, "linear_speed": 0.2, "angular_speed": 0.5}],
                remappings=[("/cmd_vel", "/brain/cmd_vel")],
            ),
        ]
    )
