"""A rectangular room with pillars, a lidar in it, and a differential drive."""

import math
from dataclasses import dataclass, field

import numpy as np

WHEEL_RADIUS, WHEEL_SEPARATION = 0.033, 0.160  # [m], the Burger's data sheet
MOST_FORWARD, MOST_TURNING = 0.22, 2.84  # [m/s], [rad/s], the Burger's data sheet
BODY_RADIUS = 0.105  # [m], of the circle around the axle's centre that holds the body; an estimate
LIDAR_X = -0.032  # [m], of the lidar in front of the axle


@dataclass(frozen=True)
class Room:
    """Walls at x = ±half and y = ±half [m], and pillars, rows of x, y, radius [m]."""

    half: float = 2.0
    pillars: np.ndarray = field(
        default_factory=lambda: np.array([[0.9, 0.6, 0.15], [-0.8, 1.0, 0.15], [0.3, -1.1, 0.15]])
    )

    def ranges(self, x: float, y: float, angles: np.ndarray) -> np.ndarray:
        """Return the distance from a point to what a ray in each direction [rad] meets first [m]."""
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        point = np.array([x, y])
        with np.errstate(divide="ignore"):
            walls = (np.sign(direction) * self.half - point) / direction
        nearest = np.where(np.isfinite(walls), walls, math.inf).min(axis=-1)
        # |point + t direction - centre| = radius, for t
        offset = self.pillars[:, :2] - point
        along = direction @ offset.T
        inside = along**2 - (offset**2).sum(axis=1) + self.pillars[:, 2] ** 2
        hits = along - np.sqrt(np.where(inside >= 0, inside, math.nan))
        hits = np.where(hits >= 0, hits, math.inf)
        return np.minimum(nearest, hits.min(axis=-1, initial=math.inf))

    def clearance(self, x: float, y: float) -> float:
        """Return the distance from a point to the nearest surface, negative inside of one [m]."""
        walls = self.half - max(abs(x), abs(y))
        pillars = np.hypot(self.pillars[:, 0] - x, self.pillars[:, 1] - y) - self.pillars[:, 2]
        return min(walls, float(pillars.min(initial=math.inf)))


@dataclass
class Base:
    """A differential drive, which goes on with its last command for ever."""

    room: Room
    x: float = -1.2
    y: float = -0.6
    yaw: float = 0.0
    forward: float = 0.0  # [m/s]
    turning: float = 0.0  # [rad/s]
    command: tuple[float, float] = (0.0, 0.0)  # [m/s], [rad/s]
    contacts: int = 0
    touching: bool = False
    most_acceleration: float = 1.0  # [m/s^2], an estimate
    most_angular_acceleration: float = 8.0  # [rad/s^2], an estimate

    def step(self, dt: float) -> tuple[float, float]:
        """Move for a time [s], and return how far the base drove [m] and turned [rad]."""
        limit, angular_limit = self.most_acceleration * dt, self.most_angular_acceleration * dt
        self.forward += float(np.clip(self.command[0] - self.forward, -limit, limit))
        self.turning += float(np.clip(self.command[1] - self.turning, -angular_limit, angular_limit))
        driven, turned = self.forward * dt, self.turning * dt
        middle = self.yaw + turned / 2
        x, y = self.x + driven * math.cos(middle), self.y + driven * math.sin(middle)
        self.yaw = math.remainder(self.yaw + turned, math.tau)
        clearance = self.room.clearance(x, y)
        if driven and clearance < BODY_RADIUS and clearance < self.room.clearance(self.x, self.y):
            self.contacts += not self.touching
            self.touching, self.forward, driven = True, 0.0, 0.0
        else:
            self.touching = self.touching and clearance < BODY_RADIUS + 0.01
            self.x, self.y = x, y
        return driven, turned
