"""The names of a robot: the types of its configuration, and what its class calls itself."""

import sys
from collections.abc import Iterator
from typing import Any

from lerobot.robots.config import RobotConfig


def name_of_robot(config: Any) -> str:
    """Return the name that LeRobot's own recorder writes into a dataset, as far as the robot's class is imported."""
    if hasattr(config, "rates"):  # of this package, whose robots are called what their types are
        return str(config.type)
    module = sys.modules.get("lerobot.robots.robot")  # if it is not imported, no robot's class is
    made_of = () if module is None else _classes(module.Robot)
    named = (made.name for made in made_of if getattr(made, "config_class", None) is type(config))
    return str(next(named, config.type))


def names_of_robot(config: Any) -> set[str]:
    """Return all names under which a robot may have been recorded.

    A configuration may have several types, of which it says one: LeRobot's `so101_follower` says `so100_follower`, and
    the robot's name is `so_follower`.
    """
    types = {name for name, choice in RobotConfig.get_known_choices().items() if choice is type(config)}
    return {*types, config.type, name_of_robot(config)}


def _classes(parent: Any) -> Iterator[Any]:
    for child in parent.__subclasses__():
        yield child
        yield from _classes(child)
