"""Where an arm on a base fetches things: an arena with two stands, one with an object on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bhd_lerobot.bodies.arenas import CLEARANCE, Arena, outer_walls
from bhd_lerobot.bodies.body import Arm, Body, Drive, GripperSpec, Shape
from bhd_lerobot.bodies.tabletop import COLOURS, KINDS, TableObject, TableScene
from bhd_lerobot.errors import ConfigError

MOST_OBSTACLES = 4
_TRIES = 200
_APART = 1.2  # [m] between the places in front of the two stands
_BEFORE = 0.42  # [m] from the object to the place in front of its stand
_FREE = 0.25  # [m] around the spots, no obstacle
_NEAR = 0.08  # [m] a place of the grid that is nearer is there


@dataclass(frozen=True)
class Stand:
    """A low table against a wall.

    Attributes:
        x: of the spot on it that something stands on, or is to stand on, in the world frame [m].
        y: likewise [m].
        height: [m].
        yaw: direction in which one looks who stands before it [rad].
    """

    x: float
    y: float
    height: float
    yaw: float

    def before(self, away: float) -> tuple[float, float, float]:
        """Return the pose x [m], y [m], yaw [rad] of who looks at the spot from some distance [m]."""
        return self.x - away * math.cos(self.yaw), self.y - away * math.sin(self.yaw), self.yaw


_NOWHERE, _NO_ARENA = Stand(0.0, 0.0, 0.0, 0.0), Arena("", (), (0.0,) * 4, (0.0,) * 3)


@dataclass(frozen=True)
class FetchScene(TableScene):
    """An arena with stands; the objects are on the first of them, in the world frame.

    Attributes:
        arena: all obstacles, stands included, and where the robot starts.
        pick: the stand that the target is on.
        place: the spot that it is to be brought to.
    """

    arena: Arena = _NO_ARENA
    pick: Stand = _NOWHERE
    place: Stand = _NOWHERE

    @property
    def stand_m(self) -> float:
        """Height of what the objects stand on [m]."""
        return self.pick.height


def make_fetch_scene(seed: int, body: Body, obstacles: int = MOST_OBSTACLES) -> FetchScene:
    """Return a scene that the robot can drive through.

    Args:
        seed: decides everything; equal seeds give equal scenes.
        body: the robot, whose arm and gripper the stands and objects fit.
        obstacles: largest number of obstacles in the room.
    """
    drive, arm, gripper = body.need(Drive), body.need(Arm), body.need(GripperSpec)
    rng = np.random.default_rng(np.random.SeedSequence([0xFE7C4, int(seed)]))
    room = drive.radius + CLEARANCE
    for _ in range(_TRIES):
        half_x, half_y = half = rng.uniform(1.5, 2.1, 2).tolist()
        (first, pick), (second, place) = (_draw_stand(rng, half, room) for _ in range(2))
        ends = [stand.before(_BEFORE)[:2] for stand in (pick, place)]
        if math.dist(*ends) < _APART:
            continue
        x, y, turned = rng.uniform((room - half_x, room - half_y, -math.pi), (half_x - room, half_y - room, math.pi))
        others = tuple(_draw_obstacle(rng, half) for _ in range(rng.integers(obstacles + 1)))
        arena = Arena(
            name="fetch",
            shapes=(*outer_walls(half_x, half_y), first, second, *others),
            extent=(-half_x, half_x, -half_y, half_y),
            start=(float(x), float(y), float(turned)),
            robot_radius=drive.radius,
        )
        spots = np.array([(pick.x, pick.y), (place.x, place.y)])
        if (Arena("", others, arena.extent, arena.start).clearance(spots) < _FREE).any():
            continue
        points, free = arena.reachable
        near = [(free & (np.hypot(*(points - end).transpose(2, 0, 1)) < _NEAR)).any() for end in ends]
        if not all(near) or (arena.clearance(np.array([(x, y), *ends])) < room).any():
            continue
        thing = _draw_object(rng, pick, gripper)
        spot = (place.x, place.y, place.height, math.cos(place.yaw / 2), 0.0, 0.0, math.sin(place.yaw / 2))
        return FetchScene(
            name="fetch",
            objects=(thing,),
            posture=arm.home,
            target_object=0,
            target_pose=spot,
            instruction=f"bring the {thing.name} to the other table",
            arena=arena,
            pick=pick,
            place=place,
        )
    raise ConfigError(f"No scene to fetch something in could be generated from seed {seed}.")


def _draw_stand(rng: np.random.Generator, half: Sequence[float], room: float) -> tuple[Shape, Stand]:
    """Return a stand against one of the walls, and the spot on it."""
    yaw = float(rng.integers(4)) * math.pi / 2
    c, s = round(math.cos(yaw)), round(math.sin(yaw))
    deep, wide, height = rng.uniform((0.10, 0.15, 0.145), (0.18, 0.30, 0.17)).tolist()  # half of the first two
    wall, along = half if c else half[::-1]
    offset, from_edge, beside = rng.uniform((-1.0, 0.05, -1.0), (1.0, 0.09, 1.0)).tolist()
    aside, ahead = offset * (along - max(wide, room)), wall - deep
    shape = Shape("box", c * ahead - s * aside, s * ahead + c * aside, yaw, deep, wide, height)
    ahead, aside = wall - 2 * deep + from_edge, aside + beside * (wide - 0.06)
    return shape, Stand(c * ahead - s * aside, s * ahead + c * aside, height, yaw)


def _draw_obstacle(rng: np.random.Generator, half: Sequence[float]) -> Shape:
    x, y, yaw, a, b = rng.uniform((-half[0], -half[1], 0.0, 0.05, 0.05), (*half, math.pi, 0.15, 0.15)).tolist()
    return Shape("box", x, y, yaw, a, b) if rng.integers(2) else Shape("cylinder", x, y, 0.0, a, a)


def _draw_object(rng: np.random.Generator, stand: Stand, gripper: GripperSpec) -> TableObject:
    """Return an object that fits between the fingers of who looks at it."""
    kind, colour = KINDS[int(rng.integers(2))], tuple(COLOURS)[int(rng.integers(len(COLOURS)))]
    size = rng.uniform(0.6, 0.85) * gripper.widest / 2
    return TableObject(
        kind=kind,
        colour=colour,
        size_x=float(size),
        size_y=float(size),
        height=float(rng.uniform(0.055, 0.09)),
        x=stand.x,
        y=stand.y,
        yaw=stand.yaw + float(rng.uniform(-0.15, 0.15)),
        mass=float(rng.uniform(0.02, 0.08)),
        friction=float(rng.uniform(0.7, 1.0)),
    )
