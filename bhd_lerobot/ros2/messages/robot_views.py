"""What is known of our robots beside their data: links, cameras, scanner and noise."""

import math
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, ArmChain, Body, Drive
from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.bodies.ur import MODELS
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.ros2.messages.base import BaseNoise
from bhd_lerobot.ros2.messages.table import ARM_FRAME, FOOTPRINT_FRAME, IMU_FRAME, SCAN_FRAME, TOOL_FRAME
from bhd_lerobot.ros2.messages.views import JointFrame, RobotView, StaticFrame

_BASE_LINK = (0.0, 0.0, 0.010)  # [m] over the floor, turtlebot3_burger.urdf
_CASTER = (-0.081, 0.0, -0.004)  # [m] in base_link, the same
_WHEEL_TURN = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # their z axes are the axles, the same; it rounds to 1.57 rad

# Universal Robots' ROS 2 description, ur_macro.xacro: base_link is as REP-103 wants it, x to the front; the frames
# of the controller, base and base_link_inertia, look back. The flange's x axis points out of it, as tool0's z does.
_ORIGIN, _HALF_TURN = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_WRISTS = ("wrist_1_link", "wrist_2_link", "wrist_3_link")


def robot_view(robot_type: str | None, recording: Mapping[str, Any] | None = None) -> RobotView:
    """Return what is known of a robot; of a plug-in's base its scanner, of robots without a body here nothing."""
    body = body_of(robot_type)
    if body is None:
        return RobotView()
    if robot_type == "turtlebot3":
        robot = (recording or {}).get("robot")
        return _turtlebot3(body, is_simulated=isinstance(robot, dict) and robot.get("type") == robot_type)
    return _ur(body) if robot_type in MODELS else RobotView(lidar=body.lidar)


def _turtlebot3(body: Body, *, is_simulated: bool) -> RobotView:
    drive = body.need(Drive)
    model = ElementTree.fromstring(body.mjcf)
    camera = _find(model, "camera", "front")
    return RobotView(
        lidar=body.lidar,
        noise=_base_noise(drive) if is_simulated else None,
        frames=(
            StaticFrame(FOOTPRINT_FRAME, "base_link", _BASE_LINK),
            StaticFrame("base_link", "caster_back_link", _CASTER, _WHEEL_TURN),
            _on_base_link(SCAN_FRAME, _place(_find(model, "body", "lds"))),
            _on_base_link(IMU_FRAME, _place(_find(model, "site", "imu"))),
            _on_base_link("front_optical_frame", _place(camera), _optical(camera)),
        ),
        joints=tuple(
            JointFrame(**vars(_on_base_link(f"{wheel}_link", _place(_find(model, "body", wheel)), _WHEEL_TURN)),
                       joint=f"{wheel}_joint")
            for wheel in drive.joints
        ),
        fovy={"front": math.radians(float(camera.get("fovy", "nan")))},
        wheels={f"{wheel}_joint": (f"qpos_{7 + i}", f"qvel_{6 + i}") for i, wheel in enumerate(drive.joints)},
    )  # fmt: skip


def _base_noise(drive: Drive) -> BaseNoise:
    """Return the noise of the simulated base. Its speed sensors and gyroscope have none but that of single precision.

    Of odometry it is the rounding of the encoders' counts, at the start and now, each uniform over one count. Slip is
    not in it, as it is not known.
    """
    count = 2 * math.pi * drive.wheel_radius / drive.encoder_ticks
    wheel = count * math.sqrt(2 / 12)
    speed, turn = drive.limits.velocity
    rounding = 2.0**-24 / math.sqrt(3)
    return BaseNoise(
        distance=wheel / math.sqrt(2),
        yaw=wheel * math.sqrt(2) / drive.wheel_separation,
        speed=speed * rounding,
        turn=turn * rounding,
        gyro=turn * rounding,
    )


def _ur(body: Body) -> RobotView:
    chain = body.need(Arm).chain
    model = ElementTree.fromstring(body.mjcf)
    camera = _find(model, "camera", "wrist")
    ahead = _place(camera) - _place(_find(model, "site", "tool"))
    return RobotView(
        frames=(
            StaticFrame("base_link", "base_link_inertia", _ORIGIN, _HALF_TURN),
            StaticFrame("base_link", ARM_FRAME, _ORIGIN, _HALF_TURN),
            StaticFrame("wrist_3_link", "flange", _ORIGIN, (0.5, -0.5, -0.5, -0.5)),
            StaticFrame("flange", "tool0", _ORIGIN, (0.5, 0.5, 0.5, 0.5)),
            StaticFrame("tool0", TOOL_FRAME, chain.tool.position),
            StaticFrame(TOOL_FRAME, "wrist_optical_frame", _three(ahead), _optical(camera)),
        ),
        joints=_links(chain),
        fovy={"wrist": math.radians(float(camera.get("fovy", "nan")))},
    )


def _links(chain: ArmChain) -> tuple[JointFrame, ...]:
    """Return the links of an arm as `ur_description` has them: each turns about its own z axis.

    That of joint i is Denavit-Hartenberg frame i - 1, moved along its z axis by d of the joint, and turned.
    """
    names = ("base_link_inertia", "shoulder_link", "upper_arm_link", "forearm_link", *_WRISTS)
    links, length, twist = [], 0.0, 0.0
    for parent, child, joint, link in zip(names, names[1:], chain.joints, chain.links, strict=False):
        a, _, d = link.position
        place = (length, round(-math.sin(twist) * d, 12), round(math.cos(twist) * d, 12))
        turn = (math.cos(twist / 2), math.sin(twist / 2), 0.0, 0.0)
        links.append(JointFrame(parent, child, place, turn, joint=f"{joint}_joint"))
        length, twist = a, math.atan2(link.rotation[2][1], link.rotation[1][1])
    return tuple(links)


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
