"""Follow the gap that leads to most new ground.

Three published ideas together:

- Candidates are short paths with the robot's true outline, an arc and then a straight line, and their free lengths
  come from a table: C. Schlegel, IROS 1998; see clearance.py.
- A candidate is judged as in VFH+ (I. Ulrich and J. Borenstein, "VFH+: reliable obstacle avoidance for fast mobile
  robots", ICRA 1998) and the dynamic window (D. Fox, W. Burgard and S. Thrun, 1997): the gap's depth, the price of
  turning, and loyalty to what was chosen before.
- In place of VFH+'s goal stands new ground: a grid, filled by dead reckoning, remembers where the robot has been, and
  what a candidate leads to counts as far as it is new, as in frontier-based exploration (B. Yamauchi, 1997).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.options.declared import NotNegative, Positive, Range
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures
from bhd_lerobot.policies.navigation.clearance import QUANTUM, SPACING, Paths
from bhd_lerobot.policies.navigation.driving import PLACE_SPACING, DrivingBrain, DrivingConfig
from bhd_lerobot.policies.navigation.steering import keep_heading, wrap

_CELL = 0.125  # [m] edge length of the memory's cells
_SIDE = 128  # cells along an edge of the memory, a power of two; it wraps around after 16 m
_MARK = 0.2  # [m] around the robot that counts as visited
_AROUND = np.arange(8) * math.pi / 4
_MARK_X = np.append(np.cos(_AROUND), 0.0) * (_MARK / _CELL)
_MARK_Y = np.append(np.sin(_AROUND), 0.0) * (_MARK / _CELL)
_NEVER = -(2**30)
_KEEP = 1.01  # spacings of headings; a heading chosen before is kept where the best one is that near

Array = NDArray[np.float64]


@BrainConfig.register_subclass("gap_follower")
@dataclass
class GapFollowerConfig(DrivingConfig):
    """Parameters of the gap follower.

    Attributes:
        discount: weight of what lies 0.2 m further on, as a share.
        memory_s: what was visited longer ago is new again [s].
        turn_weight: price of half a turn on the spot; the new ground of a path counts from 0 to 1.
        clear_weight: reward for a path that is free up to the horizon.
        commit_weight: price of leaving the heading chosen before.
    """

    discount: Annotated[float, Range("(0, 1]")] = 0.9
    memory_s: Positive = 120.0
    turn_weight: NotNegative = 1.0
    clear_weight: NotNegative = 0.3
    commit_weight: NotNegative = 0.15


class GapFollowerBrain(DrivingBrain):
    """Drive the free path that leads to most new ground for the least turning; blind: stop.

    It needs the scan and the measured twist. Where no path leaves the margin, it asks for less room, drives slower, and
    at last turns on the spot or backs off.
    """

    name = "gap_follower"
    uses_privileged_state = False
    has_narrow = False

    def __init__(self, config: GapFollowerConfig | None = None) -> None:
        self.config = config or GapFollowerConfig()
        self.reset(np.zeros(0, np.intp), [], 0)

    def _prepare(self, paths: Paths) -> None:
        config = self.config
        # What a path's turn takes away from its length, as a share of half a turn on the spot.
        lost = paths.turn - np.abs(paths.heading) * paths.radius
        self._price = config.turn_weight * lost / (paths.footprint.half_track * math.pi)
        length = PLACE_SPACING * np.arange(1, int(config.horizon_m / PLACE_SPACING + 1e-9) + 1, dtype=np.float64)
        x, y = paths.points(length)
        self._path_x, self._path_y = (x / _CELL).astype(np.float32), (y / _CELL).astype(np.float32)  # (points, K)
        self._reach = np.ceil(length / QUANTUM - 1e-9).astype(np.uint8)[:, None]
        # Whole numbers, so that their sums are exact. Turning on the spot leads nowhere.
        moved = np.hypot(np.diff(x, axis=0, prepend=0.0), np.diff(y, axis=0, prepend=0.0)) > PLACE_SPACING / 2
        weight = np.round(1000 * config.discount ** np.arange(len(length))).astype(np.int16)
        self._weight, self._all = weight[:, None] * moved, float(weight.sum())

    def bind(self, robot: RobotFeatures) -> None:
        """Find the scan and the twist, and prepare the look-up table for this number of beams."""
        super().bind(robot)
        self._memory_frames = max(1, round(min(self.config.memory_s * robot.fps, 2**29)))

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Forget where the robots have been; the seeds are not used, the rule draws nothing."""
        if n != getattr(self, "_n", -1):
            self._n = n
            self._x, self._y, self._yaw = np.zeros((3, n))  # dead reckoning [cells], [cells], [rad]
            self._last: Array = np.zeros((2, n))  # twist at the last frame
            self._visited = np.full((n, _SIDE * _SIDE), _NEVER, np.int32)  # frame of the last visit
            self._offset = np.arange(n, dtype=np.int32) * (_SIDE * _SIDE)
            self._goal: Array = np.zeros(n)  # heading chosen before [rad]
            self._frame = np.zeros(n, np.int32)
        for memory in (self._x, self._y, self._yaw, self._goal, self._frame):
            memory[ids] = 0
        self._last[:, ids], self._visited[ids] = 0.0, _NEVER

    def act(self, observation: Observation) -> Array:
        """Return the twist, shape (n, actions)."""
        config, paths = self.config, self._paths
        self._check_count(observation)
        self._remember(observation.state[:, self._measured])
        ranges, blind = self._reader.nearest(observation.state[:, self._reader.columns])
        freedom = self._steering.freedom(ranges)
        toward = wrap(self._goal - self._yaw)  # the heading chosen before, seen from the robot
        turn_off = np.abs(paths.heading - toward[:, None])
        turn_off = np.minimum(turn_off, 2 * math.pi - turn_off)
        score = self._new_ground(freedom.clear) - self._price
        score += config.clear_weight * np.minimum(freedom.clear * (QUANTUM / config.horizon_m), 1.0)
        score -= config.commit_weight * np.minimum(turn_off * 2.0, 1.0)
        best = self._steering.choose(freedom, -score, turn_off)
        heading = keep_heading(toward, paths.heading[best], _KEEP * SPACING)
        forward, turn, heading = self._steering.drive(freedom, best, heading, ranges)
        self._goal = np.where(blind, self._goal, self._yaw + heading)
        return self._twist(blind, forward, turn)

    def _remember(self, twist: Array) -> None:
        """Move on by what the wheels did since the last frame, and mark the place as visited."""
        now: Array = np.array(np.where(np.isfinite(twist), twist, 0.0).T)
        speed, rate = np.where(self._frame > 0, (now + self._last) * (self._dt / 2), 0.0)
        self._last = now
        halfway = self._yaw + rate / 2
        self._x += speed * np.cos(halfway) / _CELL
        self._y += speed * np.sin(halfway) / _CELL
        self._yaw += rate
        self._frame += 1
        x, y = ((p % _SIDE + _SIDE)[:, None] for p in (self._x, self._y))
        cell = _cell(x, y, _MARK_X, _MARK_Y)
        self._visited.ravel()[cell + self._offset[:, None]] = self._frame[:, None]

    def _new_ground(self, clear: NDArray[np.uint8]) -> Array:
        """Return how much new ground each path leads to, from 0 to 1, shape (n, K)."""
        cos, sin = (f(self._yaw).astype(np.float32)[:, None, None] for f in (np.cos, np.sin))
        x, y = ((p % _SIDE + _SIDE).astype(np.float32)[:, None, None] for p in (self._x, self._y))
        cell = _cell(x, y, cos * self._path_x - sin * self._path_y, sin * self._path_x + cos * self._path_y)
        cell += self._offset[:, None, None]
        new = self._visited.ravel().take(cell) < (self._frame - self._memory_frames)[:, None, None]
        new &= clear[:, None, :] >= self._reach
        return (new * self._weight).sum(axis=1, dtype=np.int16) / self._all


def _cell(x: NDArray[Any], y: NDArray[Any], dx: NDArray[Any], dy: NDArray[Any]) -> NDArray[np.int32]:
    """Return the memory's cells at places (x, y) + (dx, dy), all in cells; x and y from _SIDE to 2 _SIDE."""
    # Positive, so that cutting off the fraction rounds down.
    row = (dy + y).astype(np.int32)
    row &= _SIDE - 1
    row *= _SIDE
    column = (dx + x).astype(np.int32)
    column &= _SIDE - 1
    row += column
    return row
