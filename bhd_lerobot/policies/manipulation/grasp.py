"""How to grasp an object that stands on a table, from above with two parallel fingers. Pure geometry."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Handling
from bhd_lerobot.control.commands import Pose
from bhd_lerobot.control.geometry.poses import pose_vectors

_ROOM = 0.026  # [m] by which the gripper is opened wider than the object
_FIT = 0.008  # [m] by which the open gripper must at least be wider than the object
_ENOUGH = 0.025  # [m] more room than this beside the fingers is of no use
_CUP_YAWS = 12


@dataclass(frozen=True)
class SeenObject:
    """One object as a brain sees it, in the base frame.

    Attributes:
        index: its place.
        kind: ``"cup"`` or ``"box"``.
        position: centre x, y, z [m].
        yaw: rotation about the vertical axis [rad].
        size: length, width and height [m].
        colour: red, green and blue, 0 to 1.
        target: whether the task is about it.
    """

    index: int
    kind: Literal["cup", "box"]
    position: tuple[float, float, float]
    yaw: float
    size: tuple[float, float, float]
    colour: tuple[float, float, float]
    target: bool

    @property
    def radius(self) -> float:
        """Radius of the circle around its outline [m]."""
        return self.size[0] / 2 if self.kind == "cup" else math.hypot(self.size[0], self.size[1]) / 2


@dataclass(frozen=True)
class Grasp:
    """A grasp from above.

    Attributes:
        x: of the tool centre point in the base frame [m].
        y: likewise [m].
        z: likewise [m].
        yaw: direction of the line through both fingers [rad].
        opening: what to open the gripper to before [m].
        width: thickness of the object between the fingers [m].
        room: free space beside the fingers [m]; negative if something is in the way.
        usual: by which the gripper is opened wider than an object whose pose is known exactly [m].
    """

    x: float
    y: float
    z: float
    yaw: float
    opening: float
    width: float
    room: float
    usual: float = _ROOM

    @property
    def wider(self) -> float:
        """By which the opening is wider than for an object whose pose is known exactly [m]; negative if narrower."""
        return self.opening - self.width - self.usual

    def opened(self, opening: float, handling: Handling) -> "Grasp":
        """Return the grasp with the fingers opened to another opening [m], the object still in their middle.

        Where one finger alone moves, the tool stands farther to its side, so that the other has as much room.
        """
        aside = 0.0 if handling.fixed is None else (opening - self.opening) / 2
        return replace(
            self, opening=opening, x=self.x + aside * math.cos(self.yaw), y=self.y + aside * math.sin(self.yaw)
        )

    def pose(self, height: float) -> Pose:
        """Return the tool's pose above the grasp, at a height over the table [m]."""
        return pointing_down(self.x, self.y, height, self.yaw)


def pointing_down(x: float, y: float, z: float, yaw: float) -> Pose:
    """Return the pose of a tool that points down, the line through its fingers in the direction `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    matrix = np.array([[-s, c, 0.0, x], [c, s, 0.0, y], [0.0, 0.0, -1.0, z], [0.0, 0.0, 0.0, 1.0]])
    values = pose_vectors(matrix).tolist()
    return Pose((x, y, z), (values[3], values[4], values[5], values[6]))


def pointing_ahead(x: float, y: float, z: float, yaw: float) -> Pose:
    """Return the pose of a level tool that points in the direction `yaw`, the line through its fingers level, too."""
    c, s = math.cos(yaw), math.sin(yaw)
    matrix = np.array([[0.0, s, c, x], [0.0, -c, s, y], [1.0, 0.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])
    values = pose_vectors(matrix).tolist()
    return Pose((x, y, z), (values[3], values[4], values[5], values[6]))


def plan_grasp(
    target: SeenObject,
    others: Sequence[SeenObject],
    max_opening: float,
    *,
    near: float | None = None,
    enough: float = _ENOUGH,
    wider: float = 0.0,
    least: float = 0.0,
    handling: Handling,
) -> Grasp | None:
    """Return the grasp with the most room for the fingers, and of those the one with the least turn of the wrist.

    Args:
        target: the object.
        others: what else stands on the table.
        max_opening: the gripper's largest opening [m].
        near: direction of the line through the fingers from which the turn is counted [rad]; that at home if None.
        enough: more room than this beside the fingers is of no use [m].
        wider: by which the gripper is opened wider than for an object whose pose is known exactly, if it can be [m].
        least: by which it must at least be possible, for a side of the object to be grasped at [m].
        handling: the arm's.

    Returns:
        The grasp, or None if the object does not fit between the fingers.
    """
    x, y, _ = target.position
    height = target.size[2]
    z, finger = max(height / 2, height - handling.palm, handling.lowest), handling.finger
    room, fit = _ROOM * handling.scale, _FIT * handling.scale
    grasps = []
    for yaw, width in _sides(target):
        opening = min(max_opening, width + room + wider)
        if width + fit + least > max_opening:
            continue
        reach = opening / 2 + finger
        fingers = [(x + sign * reach * math.cos(yaw), y + sign * reach * math.sin(yaw)) for sign in (-1, 1)]
        gaps = [
            math.hypot(fx - o.position[0], fy - o.position[1]) - o.radius - finger for fx, fy in fingers for o in others
        ]
        grasps.append(Grasp(x, y, z, yaw, opening, width, min(gaps, default=enough), room))
    if not grasps:
        return None
    neutral = neutral_yaw(x, y, handling) if near is None else near
    best = max(grasps, key=lambda grasp: (min(grasp.room, enough), -_turn(grasp.yaw, neutral)))
    # Fingers are alike: of the two ways to stand on that line, the one with the smaller turn of the wrist.
    away = (best.yaw - neutral + math.pi / 2) % math.pi - math.pi / 2
    best = replace(best, yaw=neutral + away)
    if handling.fixed is None:
        return best
    # Only one finger moves: the middle between them is elsewhere.
    aside = best.opening / 2 - handling.fixed
    return replace(best, x=best.x + aside * math.cos(best.yaw), y=best.y + aside * math.sin(best.yaw))


def neutral_yaw(x: float, y: float, handling: Handling) -> float:
    """Return the direction of the line through the fingers for which the wrist need not turn [rad]."""
    return math.atan2(y, x) + handling.neutral


def _sides(target: SeenObject) -> list[tuple[float, float]]:
    """Return directions of the line through the fingers, and the thickness of the object along each."""
    if target.kind == "cup":
        return [(math.pi * k / _CUP_YAWS, target.size[0]) for k in range(_CUP_YAWS)]
    return [(target.yaw, target.size[0]), (target.yaw + math.pi / 2, target.size[1])]


def _turn(first: float, second: float) -> float:
    """Return the angle between two lines, 0 to pi / 2."""
    return abs((first - second + math.pi / 2) % math.pi - math.pi / 2)


def read_objects(values: NDArray[np.float64]) -> list[SeenObject]:
    """Return the objects that an environment state of the pick task reports; not those with a NaN or an infinity.

    Args:
        values: 16 numbers for each place, shape (places, 16).
    """
    objects = []
    for index, row in enumerate(values.tolist()):
        present, target, box, x, y, z, qw, qx, qy, qz, length, width, height, red, green, blue = row
        if not present >= 0.5 or not all(math.isfinite(value) for value in row):
            continue  # what is not a number was not seen
        yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        objects.append(
            SeenObject(
                index=index,
                kind="box" if box > 0.5 else "cup",
                position=(x, y, z),
                yaw=yaw,
                size=(length, width, height),
                colour=(red, green, blue),
                target=target > 0.5,
            )
        )
    return objects
