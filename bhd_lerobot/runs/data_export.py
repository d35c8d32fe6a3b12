"""`bhd-data export`: episodes as ROS 2 bags, and what is known of our robots beside their data."""

import argparse
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur5 import JOINTS, ur5
from bhd_lerobot.control.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.poses import pose_vectors
from bhd_lerobot.data.bag_export import START_S, ExportOptions, export_bags
from bhd_lerobot.data.bag_write import FORMATS
from bhd_lerobot.data.inspect import dataset_info
from bhd_lerobot.data.ros2_arm import TOOL_FRAME
from bhd_lerobot.data.ros2_base import FOOTPRINT_FRAME, IMU_FRAME, SCAN_FRAME
from bhd_lerobot.data.ros2_views import RobotView, StaticFrame
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.runs.data_command import Commands, add_command, root_of
from bhd_lerobot.runs.episode_list import parse_episodes

_BASE_LINK = (0.0, 0.0, 0.010)  # [m] over the floor, turtlebot3_burger.urdf
_WHEELS = {"wheel_left_joint": ("qpos_7", "qvel_6"), "wheel_right_joint": ("qpos_8", "qvel_7")}


def add_to(commands: Commands) -> None:
    """Add `export`."""
    help_text = "write episodes as ROS 2 bags, which ros2 bag play, Foxglove and `bhd-data import` read"
    command = add_command(commands, "export", help_text, _run)
    command.set_defaults(stopped="no bag was written")
    command.add_argument("--format", choices=FORMATS, default="mcap", help="storage of the bags (default: mcap)")
    command.add_argument("--output", type=Path, required=True, help="folder to make: of a bag for each episode")
    command.add_argument("--episodes", metavar="LIST", help="which, such as 0,3,5-9; all if left out")
    command.add_argument("--one_bag", action="store_true", help="all episodes in one bag, which is --output itself")
    command.add_argument("--twist", action="store_true", help="commands of a base as Twist instead of TwistStamped")
    command.add_argument("--compressed_images", action="store_true", help="pictures as JPEG instead of raw")
    command.add_argument(
        "--start_time", type=float, default=START_S, metavar="S",
        help=f"when the first episode starts, seconds since 1970 (default: {START_S})",
    )  # fmt: skip


def _run(options: argparse.Namespace) -> int:
    if not 0 <= options.start_time < 2**31 - 1:  # ROS counts seconds in 32 bits
        raise ConfigError(f"--start_time is {options.start_time}; it must be from 0 to {2**31 - 2}.")
    root = root_of(options)
    robot_type = dataset_info(root).robot_type
    report = export_bags(
        root,
        options.output.expanduser(),
        view=robot_view(robot_type),
        repo_id=options.repo_id or "",
        options=ExportOptions(
            storage=options.format,
            episodes=None if options.episodes is None else parse_episodes(options.episodes),
            one_bag=options.one_bag,
            bare_twist=options.twist,
            compressed_images=options.compressed_images,
            start_s=options.start_time,
        ),
    )
    what = "1 episode" if report.episodes == 1 else f"{report.episodes} episodes"
    bags = "1 bag" if len(report.bags) == 1 else f"{len(report.bags)} bags"
    print(
        f"{options.output}: {what}, {report.messages} messages, in {bags}. Look at one: ros2 bag play {report.bags[0]}"
    )
    return 0


def robot_view(robot_type: str | None) -> RobotView:
    """Return what is known of a robot; nothing of those that are not ours."""
    if robot_type == "turtlebot3":
        return _turtlebot3()
    if robot_type == "ur5":
        return _ur5()
    return RobotView()


def _turtlebot3() -> RobotView:
    body = turtlebot3_burger()
    model = ElementTree.fromstring(body.mjcf)
    camera = _find(model, "camera", "front")
    return RobotView(
        lidar=body.lidar,
        frames=(
            StaticFrame(FOOTPRINT_FRAME, "base_link", _BASE_LINK),
            _on_base_link(SCAN_FRAME, _place(_find(model, "body", "lds"))),
            _on_base_link(IMU_FRAME, _place(_find(model, "site", "imu"))),
            _on_base_link("front_optical_frame", _place(camera), _optical(camera)),
        ),
        fovy={"front": math.radians(float(camera.get("fovy", "nan")))},
        wheels=_WHEELS,
    )


def _ur5() -> RobotView:
    body = ur5()
    model = ElementTree.fromstring(body.mjcf)
    camera = _find(model, "camera", "wrist")
    ahead = _place(camera) - _place(_find(model, "site", "tool"))
    kinematics = ForwardKinematics(body.chain)
    return RobotView(
        frames=(StaticFrame(TOOL_FRAME, "wrist_optical_frame", _three(ahead), _optical(camera)),),
        fovy={"wrist": math.radians(float(camera.get("fovy", "nan")))},
        tool_pose=lambda joints: pose_vectors(kinematics.tool(joints)),
        joints=JOINTS,
    )


def _find(model: ElementTree.Element, kind: str, name: str) -> ElementTree.Element:
    found = model.find(f".//{kind}[@name='{name}']")
    assert found is not None, (kind, name)
    return found


def _place(element: ElementTree.Element) -> NDArray[np.float64]:
    return np.array([float(number) for number in element.get("pos", "0 0 0").split()])


def _three(numbers: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = numbers.tolist()
    return x, y, z


def _on_base_link(
    child: str, place: NDArray[np.float64], rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
) -> StaticFrame:
    return StaticFrame("base_link", child, _three(np.round(place - np.array(_BASE_LINK), 9)), rotation)


def _optical(camera: ElementTree.Element) -> tuple[float, float, float, float]:
    """Return how a camera's optical frame (z ahead, x right, y down) is turned, a quaternion wxyz."""
    axes = np.array([float(number) for number in camera.get("xyaxes", "").split()]).reshape(2, 3)
    right, up = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([right, -up, np.cross(up, right)], axis=1)  # MuJoCo's cameras look along -z
    w, x, y, z = pose_vectors(frame)[3:].tolist()
    return w, x, y, z
