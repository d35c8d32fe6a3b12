"""How far a differential drive of known shape gets on each of many paths, looked up in a table.

A path is a turn on an arc and then a straight line. The table holds, for a reading at some angle and range, how far the
robot gets on each path before its true outline comes too near to that point. A scan then needs no geometry, only
look-ups and a minimum.

Method: C. Schlegel, "Fast local obstacle avoidance under kinematic and dynamic constraints for a mobile robot", IROS
1998, with headings as in the turning circles of VFH+ (I. Ulrich and J. Borenstein, ICRA 1998).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Drive, LidarSpec

Array = NDArray[np.float64]

HEADINGS = 48  # directions all around
SPACING = 2 * math.pi / HEADINGS
# Radius of the first arc [m], and how far it turns at most [deg]. At 2.4 m the wheels do not limit the forward speed.
FAMILIES = ((0.25, 180.0), (0.1, 180.0), (0.0, 180.0), (0.5, 90.0), (1.2, 90.0), (2.4, 60.0))
QUANTUM = 0.02  # [m] of path, the unit of the table
LONGEST = 255 * QUANTUM  # [m]
_BIN = 0.02  # [m] of range
_ARC_STEP = 0.05  # [m] of arc, between two places where the outline is tested


class Footprint(NamedTuple):
    """What of a base decides where it fits, seen from above.

    Attributes:
        outline: rectangles around the middle of the wheel axis: rear, front, half the width [m].
        lidar_x: where the range finder is, ahead of the wheel axis [m].
        half_track: from the robot's middle to a wheel [m].
    """

    outline: tuple[tuple[float, float, float], ...]
    lidar_x: float
    half_track: float

    @classmethod
    def of(cls, body: Body) -> Self:
        """Return the footprint of a base with a lidar."""
        drive = body.need(Drive)
        return cls(drive.outline, body.need(LidarSpec).ahead, drive.wheel_separation / 2)

    def distance(self, x: Array, y: Array) -> Array:
        """Return the distance from points in the robot's frame to its outline [m], 0 inside."""
        distance = np.full(x.shape, np.inf)
        for rear, front, half in self.outline:
            beyond = np.maximum(np.maximum(rear - x, x - front), 0.0)
            beside = np.maximum(np.abs(y) - half, 0.0)
            np.minimum(distance, np.hypot(beyond, beside), out=distance)
        return distance

    def ahead(self, x: Array, y: Array, room: Array) -> Array:
        """Return how far the robot can go straight before a point is nearer than `room` [m]."""
        free = np.full(x.shape, LONGEST)
        for _, front, half in self.outline:
            met = (np.abs(y) < half + room) & (x > front)
            np.minimum(free, np.where(met, np.maximum(x - front - room, 0.0), LONGEST), out=free)
        return free


class Level(NamedTuple):
    """How much room a path must leave.

    Attributes:
        margin: between the outline and a point [m].
        slack: a point that is nearer already may come nearer by this much [m].
    """

    margin: float
    slack: float


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths in the robot's frame: K turns, each followed by a straight line.

    Lengths are "metres at full speed", so that a path that takes longer is longer: turning costs even on the spot.

    Attributes:
        heading: direction of the straight line [rad], positive to the left, shape (K,).
        radius: of the arc [m], 0 for a turn on the spot, shape (K,).
        turn: length of the turn [m], shape (K,).
        mirror: number of the path to the other side, shape (K,).
        ratio: full speed as a share of the wheels' highest rim speed.
        footprint: of the robot.
    """

    heading: Array
    radius: Array
    turn: Array
    mirror: NDArray[np.intp]
    ratio: float
    footprint: Footprint

    def points(self, length: Array) -> tuple[Array, Array]:
        """Return x and y of the robot after some lengths [m], each of shape (lengths, K).

        Args:
            length: the same for all paths, shape (lengths,), or for each its own, shape (lengths, K).
        """
        length = length[:, None] if length.ndim == 1 else length
        rate, side = _rate(self.radius, self.ratio, self.footprint.half_track), np.sign(self.heading)
        angle = np.minimum(length / rate, np.abs(self.heading))
        ahead = np.maximum(length - self.turn, 0.0)
        x = self.radius * np.sin(angle) + ahead * np.cos(angle)
        y = side * (self.radius * (1 - np.cos(angle)) + ahead * np.sin(angle))
        return x, y


def _rate(radius: Array, ratio: float, half_track: float) -> Array:
    """Return the length of a turn by one radian [m/rad]; the outer wheel or the speed limit decides."""
    return np.maximum(radius, (radius + half_track) * ratio)


def make_paths(full_speed: float, rim_speed: float, footprint: Footprint) -> Paths:
    """Return the paths of all families.

    `full_speed`: forward speed when driving straight [m/s]. `rim_speed`: highest speed of a wheel's rim [m/s].
    """
    steps: list[int] = []
    radius: list[float] = []
    for r, limit in FAMILIES:
        last = round(math.radians(limit) / SPACING)
        # Straight ahead is the same path in every family; half a turn is reached on the left.
        left = range(0 if not steps else 1, last + 1)
        right = range(1, min(last, HEADINGS // 2 - 1) + 1)
        sides = [*left, *(-k for k in right)]
        steps += sides
        radius += [r] * len(sides)
    index = {key: number for number, key in enumerate(zip(steps, radius, strict=True))}
    mirror = [index.get((-k, r), index[k, r]) for k, r in zip(steps, radius, strict=True)]
    heading, radii = np.array(steps) * SPACING, np.array(radius)
    ratio = full_speed / rim_speed
    turn = np.abs(heading) * _rate(radii, ratio, footprint.half_track)
    return Paths(heading, radii, turn, np.array(mirror, np.intp), ratio, footprint)


class ClearanceTable:
    """How far each path is free, given a scan.

    `spread`: a reading may lie this far to either side of its sector's middle [rad]. `range_max`: the largest range
    that can be looked up [m].
    """

    def __init__(self, paths: Paths, sectors: int, spread: float, levels: tuple[Level, ...], range_max: float) -> None:
        self._far = min(range_max, LONGEST + 0.5)  # what is further away blocks no path
        bins = math.ceil(self._far / _BIN) + 1
        angle = 2 * np.pi * np.arange(sectors) / sectors
        self._cos, self._sin = np.cos(angle), np.sin(angle)
        self._row = np.arange(sectors) * bins
        self._footprint = paths.footprint
        # Of the rectangles, the one that reaches the farthest back.
        self._rear, _, self._half = min(paths.footprint.outline)
        self._tables = _build(paths.footprint, paths.ratio, sectors, bins, spread=spread, levels=levels)

    def rows(self, ranges: Array) -> NDArray[np.intp]:
        """Return where to look up the ranges [m] of a scan, shape (n, sectors)."""
        return (np.minimum(ranges, self._far) * (1 / _BIN)).astype(np.intp) + self._row

    def clear(self, rows: NDArray[np.intp], level: int) -> NDArray[np.uint8]:
        """Return how far each path is free, in `QUANTUM`, shape (n, K)."""
        return self._tables[level].take(rows, axis=0).min(axis=1)

    def behind(self, ranges: Array) -> Array:
        """Return the room straight behind the hull [m], infinite where nothing is, shape (n,)."""
        x, y = self._footprint.lidar_x + ranges * self._cos, ranges * self._sin
        return np.where((x < self._rear) & (np.abs(y) < self._half + 0.01), self._rear - x, np.inf).min(axis=1)


@lru_cache(maxsize=4)
def _build(
    footprint: Footprint, ratio: float, sectors: int, bins: int, *, spread: float, levels: tuple[Level, ...]
) -> list[NDArray[np.uint8]]:
    """Return a table for each level, shape (sectors * bins, K)."""
    paths = make_paths(ratio, 1.0, footprint)
    reading = (np.arange(bins) + 0.5) * _BIN
    angle = 2 * np.pi * np.arange(sectors)[:, None] / sectors
    x, y = footprint.lidar_x + reading * np.cos(angle), reading * np.sin(angle)
    now = footprint.distance(x, y)
    rooms = [
        np.minimum(level.margin + reading * math.sin(spread), np.maximum(now - level.slack, 0.0)) for level in levels
    ]
    tables = [np.empty((sectors, bins, len(paths.heading)), np.uint8) for _ in levels]
    flipped = -np.arange(sectors) % sectors
    for radius, limit in FAMILIES:
        parts = max(1, math.ceil(SPACING * radius / _ARC_STEP))
        turned = [np.full(x.shape, LONGEST) for _ in levels]  # where on the arc a point is met
        for step in range(round(math.radians(limit) / SPACING) * parts + 1):
            phi = step * SPACING / parts
            length = phi * max(radius, (radius + footprint.half_track) * ratio)
            cos, sin = math.cos(phi), math.sin(phi)
            dx, dy = x - radius * sin, y - radius * (1 - cos)
            px, py = cos * dx + sin * dy, cos * dy - sin * dx  # the points, seen from a robot on the arc
            distance = footprint.distance(px, py)
            for met, room in zip(turned, rooms, strict=True):
                np.minimum(met, np.where(distance < room, length, LONGEST), out=met)
            if step % parts:
                continue
            column = np.flatnonzero((paths.radius == radius) & (np.abs(paths.heading - phi) < 1e-9))
            for table, met, room in zip(tables, turned, rooms, strict=True):
                whole = np.minimum(met, length + footprint.ahead(px, py, room))
                for k in column:
                    quanta = np.floor(np.minimum(whole, LONGEST) / QUANTUM + 1e-9).astype(np.uint8)
                    if paths.mirror[k] != k:
                        table[:, :, paths.mirror[k]] = quanta[flipped]
                    table[:, :, k] = quanta
    return [table.reshape(sectors * bins, -1) for table in tables]
