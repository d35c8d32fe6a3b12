"""The body of every robot, for whoever reads its data and makes no robot."""

from collections.abc import Callable

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.options.plugins import load_plugins
from bhd_lerobot.options.registry import Registry

_OWN: dict[str, Callable[[], Body]] = {"turtlebot3": turtlebot3_burger, "ur5": ur5}
BODIES = Registry("body", _OWN)
"""What makes the body of a robot with the options that it has by default, by the robot's type."""

_unknown: set[str] = set()  # types of robots that no plug-in has; to look for one takes hundredths of a second


def body_with(part: type) -> Body:
    """Return the first body that has a part: the one that stands for a robot that is not known."""
    return next(body for body in (make() for make in BODIES.values()) if part in body.parts)


def body_of(robot_type: str | None) -> Body | None:
    """Return the body of a robot as a dataset names it; None if it names none, or there is no such robot."""
    if robot_type is None:
        return None
    if robot_type not in BODIES and robot_type not in _unknown:
        load_plugins()
        _unknown.add(robot_type)
    return BODIES[robot_type]() if robot_type in BODIES else None
