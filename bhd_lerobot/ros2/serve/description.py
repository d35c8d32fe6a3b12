"""``/robot_description``: the robot as URDF, by which RViz and Foxglove draw it."""

from collections.abc import Iterable, Sequence
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Pose
from bhd_lerobot.ros2.live.network import LATCHED
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import ARM_FRAME, FOOTPRINT_FRAME
from bhd_lerobot.ros2.messages.views import JointFrame, RobotView
from bhd_lerobot.sim.description import Part, Solid

TOPIC, STRING = "/robot_description", "std_msgs/msg/String"


def publish_description(node: Node, name: str, view: RobotView, parts: Sequence[Part]) -> None:
    """Publish a robot's description once; nodes that come later receive it, too."""
    node.publisher(TOPIC, STRING, LATCHED).send(encode(STRING, {"data": urdf(name, view, parts)}, 1)[0])


def urdf(name: str, view: RobotView, parts: Sequence[Part]) -> str:
    """Return the description of a robot, whose links are the frames of ``/tf``.

    Args:
        parts: what it consists of, with all joints at zero, in the frame `base_footprint` or `base`.
    """
    frames = [*view.frames, *view.joints]
    [root] = {frame.parent for frame in frames} - {frame.child for frame in frames}
    poses = {root: np.eye(4)}
    while len(poses) <= len(frames):
        poses |= {
            frame.child: poses[frame.parent] @ Pose(frame.position, frame.rotation).matrix()
            for frame in frames
            if frame.parent in poses
        }
    world = poses[FOOTPRINT_FRAME if FOOTPRINT_FRAME in poses else ARM_FRAME]
    link_of: dict[str, str] = {}
    for part in parts:
        own = next((name for name in (part.name, f"{part.name}_link") if name in poses), "")
        link_of[part.name] = own or link_of.get(part.parent, root)

    robot = ElementTree.Element("robot", name=name)
    for link, pose in poses.items():
        element = ElementTree.SubElement(robot, "link", name=link)
        here = [part for part in parts if link_of[part.name] == link]
        into = np.linalg.inv(pose) @ world
        if here:
            _add_inertia(element, here, into)
        for solid in (solid for part in here for solid in part.solids):
            _add_solid(element, solid, into @ solid.pose)
    for frame in frames:
        turns = isinstance(frame, JointFrame)
        joint = ElementTree.SubElement(
            robot,
            "joint",
            name=frame.joint if isinstance(frame, JointFrame) else f"{frame.child}_fixed",
            type="continuous" if turns else "fixed",
        )
        ElementTree.SubElement(joint, "parent", link=frame.parent)
        ElementTree.SubElement(joint, "child", link=frame.child)
        _add_origin(joint, Pose(frame.position, frame.rotation).matrix())
        if turns:
            ElementTree.SubElement(joint, "axis", xyz="0 0 1")
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode", xml_declaration=True)


def _add_inertia(link: ElementTree.Element, parts: Sequence[Part], into: NDArray[np.float64]) -> None:
    """Add mass and inertia of what moves together; `into` is the pose of the parts' frame in the link's."""
    mass = sum(part.mass for part in parts)
    if not mass:
        return
    centre = np.sum([part.mass * part.centre for part in parts], axis=0) / mass
    inertia: NDArray[np.float64] = np.zeros((3, 3))
    for part in parts:
        away = part.centre - centre
        inertia += part.inertia + part.mass * (away @ away * np.eye(3) - np.outer(away, away))
    inertia = into[:3, :3] @ inertia @ into[:3, :3].T
    place = np.eye(4)
    place[:3, 3] = (into @ np.append(centre, 1.0))[:3]
    element = ElementTree.SubElement(link, "inertial")
    _add_origin(element, place)
    ElementTree.SubElement(element, "mass", value=f"{mass:.9g}")
    rows = {f"i{a}{b}": f"{inertia[i, k]:.9g}" for i, a in enumerate("xyz") for k, b in enumerate("xyz") if k >= i}
    ElementTree.SubElement(element, "inertia", rows)


def _add_solid(link: ElementTree.Element, solid: Solid, pose: NDArray[np.float64]) -> None:
    """Add a visual; a capsule is a cylinder between two spheres."""
    radius, half = solid.size[0], solid.size[1]
    if solid.kind == "box":
        _add_visual(link, "box", {"size": _text(2 * np.array(solid.size))}, pose, solid.rgba)
    if solid.kind in ("cylinder", "capsule"):
        _add_visual(link, "cylinder", {"radius": f"{radius:.9g}", "length": f"{2 * half:.9g}"}, pose, solid.rgba)
    for end in {"sphere": (0.0,), "capsule": (-half, half)}.get(solid.kind, ()):
        shift = np.eye(4)
        shift[2, 3] = end
        _add_visual(link, "sphere", {"radius": f"{radius:.9g}"}, pose @ shift, solid.rgba)


def _add_visual(
    link: ElementTree.Element, kind: str, size: dict[str, str], pose: NDArray[np.float64], rgba: Iterable[float]
) -> None:
    visual = ElementTree.SubElement(link, "visual")
    _add_origin(visual, pose)
    ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), kind, size)
    colour = _text(np.round(list(rgba), 3))
    material = ElementTree.SubElement(visual, "material", name=colour.replace(" ", "_"))
    ElementTree.SubElement(material, "color", rgba=colour)


def _add_origin(element: ElementTree.Element, pose: NDArray[np.float64]) -> None:
    """Add a pose in URDF's form: roll, pitch and yaw about the fixed axes x, y and z."""
    turn = pose[:3, :3]
    level = np.hypot(turn[0, 0], turn[1, 0])
    pitch = np.arctan2(-turn[2, 0], level)
    if level > 1e-9:
        roll, yaw = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    else:  # straight up or down, where only roll and yaw together count
        roll, yaw = np.arctan2(-turn[1, 2], turn[1, 1]), 0.0
    ElementTree.SubElement(element, "origin", xyz=_text(pose[:3, 3]), rpy=_text((roll, pitch, yaw)))


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{round(float(number), 12) + 0.0:.12g}" for number in numbers)
