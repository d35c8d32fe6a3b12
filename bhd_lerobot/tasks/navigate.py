"""Drive to a goal pose among obstacles."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import ARENAS, Arena
from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, OneOf, Positive, Range
from bhd_lerobot.tasks.geodesic import WayField, interpolate
from bhd_lerobot.tasks.sensing import Sensing, SensingConfig
from bhd_lerobot.tasks.task import BaseTask, Event, Outcome, PathLengths, TaskConfig

ENVIRONMENT = ("goal_x", "goal_y", "goal_cos", "goal_sin")

_PROGRESS = 0.5  # the share of the reward that the way to the goal earns, and what a collision costs
_TURN_M_PER_RAD = 0.08  # [m/rad] a turn on the spot, as the way of a wheel
_TURN_WITHIN_M = 0.5  # [m] from the goal, the turn to its heading begins to count
_FARTHEST = 2.0  # times the way at the start; beyond, the reward does not see where the robot is
_ARENA_TRIES = 50


@TaskConfig.register_subclass("navigate")
@dataclass
class NavigateConfig(TaskConfig):
    """What the navigate task asks for.

    Attributes:
        arena: the layout.
        random_start: start at a random free pose in the fixed layouts too.
        duration_s: longest duration of an episode [s].
        min_distance_m: straight distance of the goal from the start, at least [m].
        goal_clearance_m: distance from the goal to the nearest obstacle, at least [m].
        tolerance_m: distance from the goal that counts as there [m].
        tolerance_deg: angle between the robot's and the goal's heading that counts as there [deg].
        rest_speed: speed below which the robot counts as at rest [m/s].
        rest_turn_speed: yaw rate below which the robot counts as at rest [rad/s].
        hold_s: time that the robot must be there and at rest [s].
        stuck_path_m: a path shorter than this in `stuck_time_s` means stuck [m].
        stuck_time_s: see `stuck_path_m` [s].
        sensing: what is wrong with what the task senses of the goal.
    """

    arena: Annotated[str, OneOf(ARENAS)] = "random"
    random_start: bool = False
    duration_s: Positive = 60.0
    min_distance_m: NotNegative = 1.5
    goal_clearance_m: NotNegative = 0.2
    tolerance_m: Positive = 0.1
    tolerance_deg: Annotated[float, Range("(0, 180]")] = 10.0
    rest_speed: Positive = 0.03
    rest_turn_speed: Positive = 0.15
    hold_s: Positive = 0.5
    stuck_path_m: NotNegative = 0.1
    stuck_time_s: Positive = 10.0
    sensing: SensingConfig = field(default_factory=SensingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tolerance_m >= self.min_distance_m:
            raise ConfigError(
                f"task.tolerance_m is {self.tolerance_m} and task.min_distance_m {self.min_distance_m}: the robot "
                "could be there before it starts. Choose a tolerance below the distance."
            )
        if self.hold_s >= self.duration_s:
            raise ConfigError(
                f"task.hold_s is {self.hold_s}, and an episode is over after {self.duration_s} s (task.duration_s). "
                "Choose a shorter hold."
            )


class NavigateTask(BaseTask):
    """The navigate task for n simulations.

    Success: within the tolerances of the goal pose and at rest, for `hold_s` without a break. Failures: `collision`,
    `stuck` and `timeout`. Score: success weighted by path length (P. Anderson et al., "On evaluation of embodied
    navigation agents", 2018): for a success the shortest way as a share of the path driven, at most 1; else 0.

    The reward of a frame is by how much the way left got shorter, as a share of twice the way left at the start. The
    way left is the length of the shortest way to the goal; near the goal what a wheel moves for the turn to its
    heading is added; more than twice the way at the start counts as that. The frame of the success adds what is missing
    to 1. The frame of a collision gives -0.5 instead. So an episode's rewards sum to 1 for a success, and lie between
    -0.5 and 0.5 without one, or between -1 and 0 with a collision.

    A shortest way keeps the robot's radius and `CLEARANCE` from all obstacles and goes in sixteen directions on a grid
    of 0.05 m, so it may be up to 2.8 % longer than the shortest one that there is.
    """

    name = "navigate"
    never = (Event.WRONG_OBJECT, Event.DROPPED)
    judged_by: frozenset[str] | None = frozenset({"base_pose_in_world"})
    environment_names: tuple[str, ...] = ENVIRONMENT

    def __init__(self, config: NavigateConfig, n: int, fps: int, body: Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self._hold, self._window = self.in_frames(config.hold_s), self.in_frames(config.stuck_time_s)
        # Lengths of ways, a grid for each simulation; the grids grow with the largest arena seen.
        self._ways: NDArray[np.float64] = np.zeros((n, 2, 2))
        self._origin = np.zeros((n, 2))
        self._goal: NDArray[np.float64] = np.zeros((n, 3))
        self._pose: NDArray[np.float64] = np.zeros((n, 3))
        self._shortest, self._first = np.zeros(n), np.ones(n)
        self._left: NDArray[np.float64] = np.ones(n)
        self._path, self._sum = PathLengths(n, self._window), np.zeros(n)
        self._within = np.zeros(n, np.int64)
        self._sensing = Sensing(config.sensing, n, fps, slice(2))
        if config.arena != "random":  # better now than in the middle of a run
            self.sample(0)

    def sample(self, seed: int) -> Arena:
        """Return the arena and the goal of the episode with this seed.

        There is a way to the goal by construction: the robot's centre can get there with room to spare.
        """
        config = self.config
        rng = np.random.default_rng(np.random.SeedSequence([0x60A1, int(seed)]))
        fixed = config.arena != "random" and not config.random_start
        farthest = 0.0
        for attempt in range(1 if fixed else _ARENA_TRIES):
            # The first try is the arena that the avoid task has for this seed.
            again = int(rng.integers(2**62)) if attempt else seed
            arena = self.arena(config.arena, again, config.random_start)
            points, free = arena.reachable
            away = np.hypot(*(points - arena.start[:2]).transpose(2, 0, 1))
            free = free & (arena.clearance(points) >= config.goal_clearance_m)
            farthest = max(farthest, float(away[free].max(initial=0.0)))
            places = points[free & (away >= config.min_distance_m)]
            if len(places):
                x, y = places[rng.integers(len(places))]
                goal = float(x), float(y), float(rng.uniform(-math.pi, math.pi))
                scene = replace(arena, goal=goal, report_seed=config.sensing.draw_seed(rng))
                vars(scene)["reachable"] = arena.reachable  # it does not depend on the goal, and takes a while
                return scene
        raise ConfigError(
            f"No goal in the arena {config.arena!r} is at least {config.min_distance_m} m (task.min_distance_m) from "
            f"the start and {config.goal_clearance_m} m (task.goal_clearance_m) from every obstacle. "
            + (
                f"With this clearance the farthest is {farthest:.2f} m away; choose a smaller distance."
                if farthest > 0
                else "No place has this clearance; choose a smaller one."
            )
        )

    def instruction(self, scene: Arena) -> str:
        """Return what a person would ask for."""
        return "Drive to the goal pose without touching anything."

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[Arena]) -> None:
        """Start episodes: the robot stands at each arena's start."""
        super().begin(ids, scenes)
        for sim, arena in zip(ids, scenes, strict=True):
            goal = arena.goal
            if goal is None or not np.isfinite(goal).all():
                raise ConfigError(
                    f"The goal of the arena {arena.name!r} is {goal}; the task navigate needs x, y and yaw."
                )
            ways = WayField(arena, goal[:2])
            start = np.array([arena.start[:2]])
            if not interpolate(ways.is_way[None].astype(np.float64), ways.origin[None], start)[0] > 0:
                raise ConfigError(
                    f"No way leads from the start {_place(arena.start)} of the arena {arena.name!r} to the goal "
                    f"{_place(goal)}; choose a goal that the robot can get to."
                )
            self._keep(int(sim), ways)
            self._sensing.begin(int(sim), arena.report_seed)
            self._goal[sim], self._pose[sim] = goal, arena.start
        self._path.begin(ids)
        self._sum[ids] = 0.0
        self._within[ids] = 0
        self._shortest[ids] = interpolate(self._ways, self._origin, self._pose[:, :2])[ids]
        self._first[ids] = self._left[ids] = np.maximum(self._way_left(), self.config.tolerance_m)[ids]

    def environment_state(self, truth: BaseTruth) -> NDArray[np.float64]:
        """Return the goals in the robots' frames, shape (n, 4).

        x and y [m], and cosine and sine of the angle from the robot's heading to the goal's. `config.sensing` says what
        is wrong with it.
        """
        goals = goal_in_robot(self._goal, truth.base_pose_in_world)
        return self._sensing.sense(goals[:, None], self.frame)[:, 0]

    def judge(self, truth: BaseTruth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        config = self.config
        pose = np.where(running[:, None], truth.base_pose_in_world, self._pose)
        step, turn = np.hypot(*(pose - self._pose)[:, :2].T), np.abs(_wrap(pose[:, 2] - self._pose[:, 2]))
        self._pose = pose
        recent = self._path.add(step, self.frame)
        event = self.count_frame(running)
        distance, angle = self._errors()
        there = (distance <= config.tolerance_m) & (angle <= math.radians(config.tolerance_deg))
        there &= (step * self.fps <= config.rest_speed) & (turn * self.fps <= config.rest_turn_speed)
        self._within[running] = np.where(there, self._within + 1, 0)[running]
        hit = running & truth.touched
        clean = running & ~truth.touched
        is_over = event == Event.TIMEOUT
        event[clean & ~is_over & (self.frame >= self._window) & (recent < config.stuck_path_m)] = Event.STUCK
        event[clean & (self._within >= self._hold)] = Event.SUCCESS
        event[hit] = Event.COLLISION
        left = np.minimum(self._way_left(), _FARTHEST * self._first)
        reward = np.where(clean, _PROGRESS * (self._left - left) / self._first, 0.0)
        self._left = np.where(running, left, self._left)
        reward[hit] = -_PROGRESS
        success = event == Event.SUCCESS
        reward[success] = 1.0 - self._sum[success]
        self._sum += reward
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        success = event == Event.SUCCESS
        distance, angle = self._errors()
        shortest, path = float(self._shortest[sim]), float(self._path.total[sim])
        return Outcome(
            success=success,
            event=event,
            score=shortest / max(shortest, path, 1e-9) if success else 0.0,
            details={
                "path_m": path,
                "shortest_m": shortest,
                "time_s": float(self.frame[sim]) / self.fps,
                "error_m": float(distance[sim]),
                "error_rad": float(angle[sim]),
            },
        )

    def _keep(self, sim: int, field: WayField) -> None:
        """Store the ways to the goal of a simulation."""
        grow = [max(0, one - have) for one, have in zip(field.lengths.shape, self._ways.shape[1:], strict=True)]
        if any(grow):
            self._ways = np.pad(self._ways, ((0, 0), (0, grow[0]), (0, grow[1])), mode="edge")
        rows, columns = self._ways.shape[1:]
        # Beyond its arena as at the border.
        row = np.minimum(np.arange(rows), field.lengths.shape[0] - 1)
        column = np.minimum(np.arange(columns), field.lengths.shape[1] - 1)
        self._ways[sim] = field.lengths[np.ix_(row, column)]
        self._origin[sim] = field.origin

    def _errors(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distance [m] and angle [rad] from the goals, each of shape (n,)."""
        apart = self._pose - self._goal
        return np.hypot(apart[:, 0], apart[:, 1]), np.abs(_wrap(apart[:, 2]))

    def _way_left(self) -> NDArray[np.float64]:
        """Return the way left, with the turn to the goal's heading [m], shape (n,)."""
        distance, angle = self._errors()
        near = np.maximum(1 - distance / _TURN_WITHIN_M, 0.0)
        return interpolate(self._ways, self._origin, self._pose[:, :2]) + _TURN_M_PER_RAD * angle * near


def goal_in_robot(goal: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return goals as their robots see them.

    Args:
        goal: x [m], y [m], yaw [rad] in the world frame, shape (n, 3).
        pose: of the robots, likewise.

    Returns:
        x [m], y [m], and cosine and sine of the goal's heading, in the robot's frame, shape (n, 4)
    """
    dx, dy, turn = (goal - pose).T
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, np.cos(turn), np.sin(turn)], axis=1)


def _wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _place(pose: tuple[float, float, float]) -> str:
    return f"({pose[0]:.2f}, {pose[1]:.2f})"
