"""Roam without touching anything."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import ARENAS, Arena
from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, OneOf, Positive
from bhd_lerobot.tasks.sensing import Sensing, SensingConfig
from bhd_lerobot.tasks.task import BaseTask, Event, Outcome, PathLengths, TaskConfig

_BEARINGS_DEG = np.arange(0.0, 360.0, 22.5)
_DISTANCES_M = np.arange(1, 9) * 0.25

TRAIL = tuple(f"trail_{bearing:g}deg_{distance:g}m" for bearing in _BEARINGS_DEG for distance in _DISTANCES_M)
"""Places around the robot, bearing counter-clockwise from its front [deg] and distance [m]: 1 in a cell that it has
visited in this episode, 0 in any other."""

_TINY = 1e-9
_REPORT_STREAM = 0x7EA1
_TRAIL_XY = np.stack([f(np.radians(_BEARINGS_DEG))[:, None] * _DISTANCES_M for f in (np.cos, np.sin)]).reshape(2, -1)


@TaskConfig.register_subclass("avoid")
@dataclass
class AvoidConfig(TaskConfig):
    """What the avoid task asks for.

    Attributes:
        arena: the layout.
        random_start: start at a random free pose in the fixed layouts too.
        duration_s: length of an episode [s].
        min_path_m: length of the path that a success needs [m].
        cell_m: edge length of the cells that the score counts [m].
        stuck_path_m: a path shorter than this in `stuck_time_s` means stuck [m].
        stuck_time_s: see `stuck_path_m` [s].
        trail: report which ground around the robot it has visited: `TRAIL`, the task's memory for brains that have none
            of their own.
        sensing: what is wrong with the robot's pose that the trail is drawn around.
    """

    arena: Annotated[str, OneOf(ARENAS)] = "random"
    random_start: bool = False
    duration_s: Positive = 60.0
    min_path_m: NotNegative = 3.0
    cell_m: Positive = 0.25
    stuck_path_m: NotNegative = 0.1
    stuck_time_s: Positive = 10.0
    trail: bool = False
    sensing: SensingConfig = field(default_factory=SensingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.trail or self.sensing.is_exact):
            raise ConfigError(
                "task.sensing states what is wrong with the pose that the trail is drawn around, and task.trail is "
                "false: there is no trail. Set --task.trail=true, or leave task.sensing out."
            )


class AvoidTask(BaseTask):
    """The avoid task for n simulations.

    Success: the whole time without a contact, and a path of at least `min_path_m`. Score: the number of distinct cells
    that the robot's centre visited before the first contact or the end, as a share of the free cells, those that it
    could have got into. The reward of a frame is what the frame adds to the score. Failures: `collision`, `stuck`, and
    `timeout` when the time is over and the path too short.
    """

    name = "avoid"
    never = (Event.WRONG_OBJECT, Event.DROPPED, Event.UNREACHABLE)
    judged_by: frozenset[str] | None = frozenset({"base_pose_in_world"})
    lasts = True

    def __init__(self, config: AvoidConfig, n: int, fps: int, body: Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self.environment_names = TRAIL if config.trail else ()
        if body and body.drive and (longest := body.drive.limits.velocity[0] * config.duration_s) < config.min_path_m:
            self.notes = (
                f"warning: no episode can succeed: in task.duration_s = {config.duration_s:g} s the robot drives "
                f"{longest:.2g} m at the most, and task.min_path_m is {config.min_path_m:g}. Set a longer duration or "
                "a shorter path.",
            )
        self._sensing = Sensing(config.sensing, n, fps, slice(2))
        self._window = self.in_frames(config.stuck_time_s)
        # Cells by number, a row for each simulation; the rows grow with the largest arena seen.
        self._free: NDArray[np.bool_] = np.zeros((n, 0), np.bool_)
        self._visited: NDArray[np.bool_] = np.zeros((n, 0), np.bool_)
        self._origin, self._end = np.zeros((n, 2)), np.zeros((n, 2))
        self._columns = np.ones(n, np.int64)
        self._pose = np.zeros((n, 2))
        self._path = PathLengths(n, self._window)

    def sample(self, seed: int) -> Arena:
        """Return the arena of the episode with this seed."""
        arena, sensing = self.arena(self.config.arena, seed, self.config.random_start), self.config.sensing
        if sensing.is_exact:
            return arena
        rng = np.random.default_rng(np.random.SeedSequence([_REPORT_STREAM, int(seed)]))
        return replace(arena, report_seed=sensing.draw_seed(rng))

    def instruction(self, scene: Arena) -> str:
        """Return what a person would ask for."""
        return "Roam without touching anything."

    def environment_state(self, truth: BaseTruth) -> NDArray[np.float64]:
        """Return `TRAIL` if the configuration asks for it, shape (n, 128); else nothing, shape (n, 0).

        `config.sensing` states what is wrong with the pose that it is drawn around; which cells were visited is true.
        """
        if not self.config.trail:
            return np.zeros((len(truth.touched), 0))
        pose = self._sensing.sense(truth.base_pose_in_world[:, None], self.frame)[:, 0]
        x, y, yaw = pose.T[:, :, None]
        cos, sin, (ahead, left) = np.cos(yaw), np.sin(yaw), _TRAIL_XY
        points = np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left], axis=-1)
        cell, inside = self._cells(points)
        return (self._visited[self._sims[:, None], cell] & inside).astype(np.float64)

    def privileged_state(self) -> NDArray[np.float64]:
        """Return how far a robot is from being stuck, the score so far, and the path that success needs, shape (n, 3).

        The first and the last are paths as a share of what they must be, up to 2 and 1.
        """
        config, visited = self.config, self._visited.sum(axis=1)
        paths = [
            np.clip(path / max(least, _TINY), 0.0, most)
            for path, least, most in (
                (self._path.recent, config.stuck_path_m, 2.0),
                (self._path.total, config.min_path_m, 1.0),
            )
        ]
        return np.stack([*paths, visited / np.maximum(self._free.sum(axis=1), 1)], axis=1)

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[Arena]) -> None:
        """Start episodes: the robot stands at each arena's start."""
        super().begin(ids, scenes)
        for sim, arena in zip(ids, scenes, strict=True):
            cells = arena.free_cells(self.config.cell_m)
            columns, rows = arena.cells(self.config.cell_m)
            if columns * rows > self._free.shape[1]:
                grow = ((0, 0), (0, columns * rows - self._free.shape[1]))
                self._free, self._visited = np.pad(self._free, grow), np.pad(self._visited, grow)
            self._free[sim] = self._visited[sim] = False
            self._sensing.begin(sim, arena.report_seed)
            self._free[sim, cells] = True
            self._origin[sim], self._end[sim] = arena.extent[0::2], arena.extent[1::2]
            self._columns[sim] = columns
            self._pose[sim] = arena.start[:2]
        started = np.zeros(len(self._sims), np.bool_)
        started[ids] = True
        self._count_cells(started)
        self._path.begin(ids)

    def judge(self, truth: BaseTruth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        position = truth.base_pose_in_world[:, :2]
        recent = self._path.add(np.where(running, np.hypot(*(position - self._pose).T), 0.0), self.frame)
        self._pose[running] = position[running]
        event = self.count_frame(running)
        clean = running & ~truth.touched
        reward = self._count_cells(clean)
        is_over = event == Event.TIMEOUT
        event[is_over & (self._path.total >= self.config.min_path_m)] = Event.SUCCESS
        event[clean & ~is_over & (self.frame >= self._window) & (recent < self.config.stuck_path_m)] = Event.STUCK
        event[running & truth.touched] = Event.COLLISION
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        free, visited = max(1, int(self._free[sim].sum())), int(self._visited[sim].sum())
        return Outcome(
            success=event == Event.SUCCESS,
            event=event,
            score=visited / free,
            details={
                "path_m": float(self._path.total[sim]),
                "cells_visited": float(visited),
                "cells_free": float(free),
            },
        )

    def _count_cells(self, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Count the cells that robots are in, and return what they add to the scores, shape (n,)."""
        cell, inside = (one[:, 0] for one in self._cells(self._pose[:, None]))
        new = mask & inside & self._free[self._sims, cell] & ~self._visited[self._sims, cell]
        self._visited[self._sims[new], cell[new]] = True
        return np.where(new, 1.0 / np.maximum(self._free.sum(axis=1), 1), 0.0)

    def _cells(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the cells of points [m], shape (n, k, 2), and which points lie in the arena, both of shape (n, k)."""
        column, row = np.moveaxis(
            np.floor((points - self._origin[:, None]) / self.config.cell_m).astype(np.int64), -1, 0
        )
        cell = np.clip(row * self._columns[:, None] + column, 0, self._free.shape[1] - 1)
        # Outside the arena is no free cell, also where the last row of cells sticks out of it.
        is_inside = (points >= self._origin[:, None]) & (points < self._end[:, None])
        return cell, np.asarray(is_inside.all(axis=-1))
