"""Drive to a goal pose among obstacles that are seen on the way.

- What was seen lies in a map around the goal, and ways are planned there as if all else were free; see goal_map.py.
- Candidates are short paths with the robot's true outline, an arc and then a straight line, free as far as a table
  says: C. Schlegel, IROS 1998; see clearance.py.
- Of those the one is driven that gets to the goal on the shortest way, itself and what is left from its best place, as
  in the global dynamic window approach (O. Brock and O. Khatib, "High-speed navigation using the global dynamic window
  approach", ICRA 1999).
- Near the goal, with nothing in between, the robot turns to it, drives there, and turns to the goal's heading.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Positive, Range, Share
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.navigation.clearance import (
    HEADINGS,
    LONGEST,
    QUANTUM,
    SPACING,
    Paths,
)
from bhd_lerobot.policies.navigation.driving import PLACE_SPACING, DrivingBrain, DrivingConfig
from bhd_lerobot.policies.navigation.goal_map import GoalMap
from bhd_lerobot.policies.navigation.steering import NARROW, Freedom, keep_heading, wrap

GOAL = ("goal_x", "goal_y", "goal_cos", "goal_sin")

_OPEN_M = 0.05  # [m] that a path is worth which is free as far as it is judged
_BEND = 0.02  # [m/rad] that turning costs beyond its way and time: the map is right to half a cell
_NO_WAY = np.float32(200.0)  # [m] that a path without a free place costs
_DETOUR = 0.15  # [m] that a way is longer, it is worth to pass through less room
_TIGHT_M = 0.5  # [m] from something seen, there may be less room than usual
_KEEP = 0.6  # spacings of headings; a heading chosen before is kept where the best one is that near
_SMEAR = 0.1  # [m] a reading that may have moved by more than this, while the robot turned, is not put on the map
_NEWS = 5  # cells seen newly, that are worth another plan
_BRAKE_S = 0.5  # [s] the goal is approached as fast as it could be reached in this time
_AIM = 0.3  # [rad] beside the goal, it is turned to on the spot
_LEAVE = 2.0  # times `arrive_m`, the robot is not at the goal any more
_TURN_BRAKE = 2.5  # [rad/s^2] of the last turn; the robot can do 3.2

Array = NDArray[np.float64]


@BrainConfig.register_subclass("navigator")
@dataclass
class NavigatorConfig(DrivingConfig):
    """Parameters of the navigator.

    Attributes:
        turn_weight: price of a turn, as a share of what its time is worth in metres.
        commit_m: price of leaving the heading chosen before [m].
        replan_s: time after which a way that is not blocked is planned again, if something new was seen [s].
        approach_m: nearer than this, with nothing in between, the goal is driven to straight [m].
        arrive_m: distance at which the robot turns to the goal's heading [m].
        arrive_rad: angle at which it rests [rad].
    """

    margin_m: NotNegative = 0.04
    stop_m: Share = 0.25
    horizon_m: Annotated[float, Range(f"[{PLACE_SPACING}, {LONGEST}]")] = 2.4
    turn_weight: NotNegative = 0.5
    commit_m: NotNegative = 0.05
    replan_s: NotNegative = 2.0
    approach_m: NotNegative = 0.8
    arrive_m: Positive = 0.04
    arrive_rad: Positive = 0.04


class NavigatorBrain(DrivingBrain):
    """Drive to the goal pose; blind, or without a goal: stop.

    It needs the scan, the measured twist, and the goal in the robot's frame, as the task navigate reports it. It
    remembers what it saw up to 10 m from the goal.
    """

    name = "navigator"
    _half_widths: tuple[float, ...] = ()  # of the robot, once it is known

    def __init__(self, config: NavigatorConfig | None = None) -> None:
        self.config = config or NavigatorConfig()
        self.reset(np.zeros(0, np.intp), [], 0)

    def _prepare(self, paths: Paths) -> None:
        config = self.config
        # Places after the turn: before its end, all paths to one side are alike.
        places = int(config.horizon_m / PLACE_SPACING + 1e-9)
        after = PLACE_SPACING * np.append(0.5, np.arange(1, places + 1))
        length = np.minimum(paths.turn + after[:, None], LONGEST)  # (points, K)
        self._reach = np.ceil(length / QUANTUM - 1e-9).astype(np.uint8)
        x, y = paths.points(length)
        self._path_x, self._path_y = x.astype(np.float32), y.astype(np.float32)
        # What a turn takes in time, beyond the way that it goes.
        lost = paths.turn - np.abs(paths.heading) * paths.radius
        price = _BEND * np.abs(paths.heading) - (1 - config.turn_weight) * lost
        self._length = (length + price).astype(np.float32)
        # The turn on the spot to each heading, by number; half a turn is both the last and the first of them.
        number = np.round(paths.heading / SPACING).astype(np.int64) % HEADINGS
        spot = (paths.radius == 0) | (number == 0)
        self._spot = np.array([np.flatnonzero(spot & (number == k))[0] for k in range(HEADINGS)])

    def bind(self, robot: RobotFeatures) -> None:
        """Find the scan, the twist and the goal, and prepare the look-up table for this number of beams."""
        super().bind(robot)
        self._goal_columns = find_columns(robot.environment_names, GOAL, self.name, "environment")
        self._half_widths = (max(half for _, _, half in self._paths.footprint.outline),)
        self._replan_frames = max(1, round(min(self.config.replan_s * robot.fps, 2**29)))

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Forget what was seen; the seeds are not used, the rule draws nothing."""
        if n != getattr(self, "_n", -1):
            self._n = n
            self._map = GoalMap(n, *self._half_widths)
            self._scan: Array = np.zeros((n, 0))  # the last one
            self._heading: Array = np.zeros(n)  # chosen before, in the goal's frame [rad]
            self._arrived: NDArray[np.bool_] = np.zeros(n, np.bool_)
            self._age = np.zeros(n, np.int64)  # frames since the last plan
        self._map.forget(ids)
        self._heading[ids] = math.nan
        self._arrived[ids] = False
        self._age[ids] = 0
        self._scan[ids] = math.nan

    def act(self, observation: Observation) -> Array:
        """Return the twist, shape (n, actions)."""
        self._check_count(observation)
        if observation.environment_state is None:
            raise ConfigError(f"The brain {self.name!r} was bound to a goal and received none.")
        goal = observation.environment_state[:, self._goal_columns]
        lost = ~np.isfinite(goal.sum(axis=1))
        x, y, cos, sin = np.where(lost[:, None], (0.0, 0.0, 1.0, 0.0), goal).T
        turn_left = np.arctan2(sin, cos)
        sin, cos = np.sin(turn_left), np.cos(turn_left)
        pose = np.stack([-cos * x - sin * y, sin * x - cos * y, -turn_left])  # in the goal's frame
        scan = observation.state[:, self._reader.columns]
        ranges, blind = self._reader.nearest(scan)
        blind |= lost
        awake = ~blind if observation.running is None else ~blind & observation.running
        self._update_map(scan, observation.state[:, self._measured[1]], pose, awake)
        self._plan(pose, awake)
        forward, turn, heading = motion = self._drive(ranges, pose)
        distance = np.hypot(x, y)
        self._approach(ranges, distance, np.arctan2(y, x), motion)
        self._arrive(distance, turn_left, motion)
        self._heading = np.where(awake, pose[2] + heading, self._heading)
        return self._twist(blind, forward, turn)

    def _update_map(self, scan: Array, rate: Array, pose: Array, awake: NDArray[np.bool_]) -> None:
        """Put what a new scan shows on the maps."""
        if self._scan.shape != scan.shape:
            self._scan = np.full(scan.shape, math.nan)
        new = (scan != self._scan).any(axis=1) & awake
        self._scan = scan.copy()  # what is seen is not written to
        hit = self._reader.valid(scan) & (scan < self.bound.range_max_m - 1e-3) & new[:, None]
        ranges = np.where(hit, scan, 0.0)
        # A scan is up to a frame old.
        smear = np.where(np.isfinite(rate), np.abs(rate), 1e3) * self._dt
        hit &= ranges * smear[:, None] <= _SMEAR
        px = self._paths.footprint.lidar_x + ranges * np.cos(self._reader.angles)
        py = ranges * np.sin(self._reader.angles)
        self._map.mark(*_to_goal(px, py, pose[:, :, None]), hit)

    def _plan(self, pose: Array, awake: NDArray[np.bool_]) -> None:
        """Plan where the way is blocked, or something new was seen and the last plan is old."""
        self._age += 1
        due = self._map.blocked | ((self._map.news >= _NEWS) & (self._age >= self._replan_frames))
        for sim in np.flatnonzero(due & awake).tolist():
            self._age[sim] = 0
            if not self._map.plan(sim, pose[0, sim], pose[1, sim]):
                # What the map shows cannot be right, as there is a way: begin again with the next scan.
                self._map.forget(np.array([sim]))
                self._map.plan(sim, pose[0, sim], pose[1, sim])
                self._scan[sim] = math.nan

    def _drive(self, ranges: Array, pose: Array) -> tuple[Array, Array, Array]:
        """Return forward speed [m/s], yaw rate [rad/s] and the heading chosen [rad], each of shape (n,)."""
        config, paths = self.config, self._paths
        toward = wrap(self._heading - pose[2])  # the heading chosen before, seen from the robot; NaN if none
        turn_off = np.abs(paths.heading - toward[:, None])
        turn_off = np.where(np.isfinite(turn_off), np.minimum(turn_off, 2 * math.pi - turn_off), 0.0)
        at = pose.astype(np.float32)[:, :, None, None]
        left = self._map.way_left(*_to_goal(self._path_x, self._path_y, at)) + self._length
        commit = config.commit_m * np.minimum(turn_off * 2.0, 1.0)
        freedom = self._steering.freedom(ranges)
        cost = self._cost(left, freedom) + commit
        # Where the way leads through a place with less room than usual, no usual path gets on.
        least = np.where(freedom.free, cost, math.inf).min(axis=1)
        ids = np.flatnonzero((freedom.level == 0) & (ranges.min(axis=1) < _TIGHT_M))
        if len(ids):
            other = self._steering.narrow(ranges[ids])
            price = self._cost(left[ids], other) + commit[ids]
            better = np.where(other.free, price, math.inf).min(axis=1) < least[ids] - _DETOUR
            into = ids[better]
            cost[into] = price[better]
            freedom.clear[into], freedom.free[into] = other.clear[better], other.free[better]
            freedom.level[into] = NARROW
        best = self._steering.choose(freedom, cost, turn_off)
        heading = keep_heading(toward, paths.heading[best], _KEEP * SPACING)
        return self._steering.drive(freedom, best, heading, ranges)

    def _cost(self, left: NDArray[np.float32], freedom: Freedom) -> Array:
        """Return what each path costs [m], shape (n, K): the way over the best of its free places, shape (n, ., K)."""
        clear = freedom.clear
        cost = np.where(clear[:, None, :] >= self._reach, left, _NO_WAY).min(axis=1)
        return cost - _OPEN_M * np.minimum(clear * (QUANTUM / self.config.horizon_m), 1.0)

    def _approach(self, ranges: Array, distance: Array, bearing: Array, motion: tuple[Array, Array, Array]) -> None:
        """Where the goal is near and nothing in between, drive there straight: changes that part of the motion."""
        config = self.bound
        ids = np.flatnonzero(distance < config.approach_m)
        if not len(ids):
            return
        path = self._spot[np.round(bearing[ids] / SPACING).astype(np.int64) % HEADINGS]
        free = self._steering.free_length(ranges[ids], path)
        ids = ids[free >= self._paths.turn[path] + distance[ids]]
        beside, away = np.abs(bearing[ids]), distance[ids]
        rate = np.minimum(beside / config.settle_s, config.turn_speed)
        rim = config.rim_speed - self._paths.footprint.half_track * rate
        speed = np.clip(np.minimum(rim, away / _BRAKE_S), 0.0, config.forward_speed)
        forward, turn, heading = motion
        forward[ids] = np.where(beside < _AIM, speed, 0.0)
        turn[ids], heading[ids] = np.copysign(rate, bearing[ids]), bearing[ids]

    def _arrive(self, distance: Array, turn_left: Array, motion: tuple[Array, Array, Array]) -> None:
        """Where the robot is at the goal, turn to the goal's heading, and rest: changes that part of the motion."""
        config = self.config
        self._arrived = distance <= np.where(self._arrived, _LEAVE, 1.0) * config.arrive_m
        ids = np.flatnonzero(self._arrived)
        left = turn_left[ids]
        off = np.abs(left)
        rate = np.minimum(np.minimum(off / config.settle_s, np.sqrt(2 * _TURN_BRAKE * off)), config.turn_speed)
        forward, turn, _ = motion
        forward[ids], turn[ids] = 0.0, np.where(off <= config.arrive_rad, 0.0, np.copysign(rate, left))


def _to_goal(x: NDArray, y: NDArray, pose: NDArray) -> tuple[NDArray, NDArray]:
    """Return places in the robots' frames in those of their goals.

    Args:
        x: the places [m], shape (..., points) or (n, ..., points).
        y: likewise.
        pose: x [m], y [m] and yaw [rad] of the robots in the goals' frames, shape (3, n, ..., 1).
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
