"""The body of every robot, for whoever reads its data and makes no robot."""

from collections.abc import Callable, Set
from functools import partial

from bhd_lerobot.bodies.body import Arm, Body, GripperSpec
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.bodies.ur import MODELS, ur, ur5
from bhd_lerobot.options.plugins import load_plugins
from bhd_lerobot.options.registry import Registry

_OWN: dict[str, Callable[[], Body] | str] = {  # those of files are added by `bhd_lerobot.registry`
    "turtlebot3": turtlebot3_burger,
    "ur5": ur5,  # the first arm: it stands for a robot that is not known
    **{name: partial(ur, name) for name in MODELS if name != "ur5"},
    "arm": ur5,  # stands for the arms that are files
    "turtlebot3_manipulation": turtlebot3_manipulation,
}
OF_FILES = ("arm", "so101")
"""Types whose bodies take seconds to be made."""
BODIES: Registry[Callable[[], Body]] = Registry("body", _OWN)
"""What makes the body of a robot with the options that it has by default, by the robot's type."""


def parts_of_type(robot_type: str) -> Set[type]:
    """Return the parts that robots of a type have by default."""
    return {Arm, GripperSpec} if robot_type in OF_FILES else BODIES[robot_type]().parts.keys()


_unknown: set[str] = set()  # types of robots that no plug-in has; to look for one takes hundredths of a second


def body_with(*parts: type) -> Body:
    """Return the first body that has some parts: the one that stands for a robot that is not known."""
    return next(body for body in (make() for make in BODIES.values()) if body.parts.keys() >= set(parts))


def body_of(robot_type: str | None) -> Body | None:
    """Return the body of a robot as a dataset names it; None if it names none, or there is no such robot."""
    # A file's joints are known where the file is; and others record an SO-101 in degrees under that name.
    if robot_type is None or robot_type in OF_FILES:
        return None
    if robot_type not in BODIES and robot_type not in _unknown:
        load_plugins()
        _unknown.add(robot_type)
    return BODIES[robot_type]() if robot_type in BODIES else None
