"""Roam without touching anything."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import ARENAS, Arena, make_arena
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.tasks.task import Event, Outcome, Truth


@dataclass
class AvoidConfig:
    """What the avoid task asks for.

    Attributes:
        arena: ``"random"``, ``"turtlebot3_world"`` or ``"empty"``.
        duration_s: length of an episode [s].
        min_path_m: length of the path that a success needs [m].
        cell_m: edge length of the cells that the score counts [m].
        stuck_path_m: a path shorter than this in `stuck_time_s` means stuck [m].
        stuck_time_s: see `stuck_path_m` [s].
    """

    arena: str = "random"
    duration_s: float = 60.0
    min_path_m: float = 3.0
    cell_m: float = 0.25
    stuck_path_m: float = 0.1
    stuck_time_s: float = 10.0

    def __post_init__(self) -> None:
        if self.arena not in ARENAS:
            raise ConfigError(unknown_name("arena", self.arena, ARENAS))
        for name in ("duration_s", "cell_m", "stuck_time_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"task.{name} is {getattr(self, name)}; it must be positive and finite.")
        for name in ("min_path_m", "stuck_path_m"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"task.{name} is {getattr(self, name)}; it must be 0 or positive, and finite.")


class AvoidTask:
    """The avoid task for n simulations.

    Success: the whole time without a contact, and a path of at least `min_path_m`. Score: the number of distinct cells
    that the robot's centre visited before the first contact or the end, as a share of the free cells, those that it
    could have got into. The reward of a frame is what the frame adds to the score. Failures: `collision`, `stuck`, and
    `timeout` when the time is over and the path too short.

    Args:
        config: what is asked for.
        n: number of simulations.
        fps: frames a second [Hz].
    """

    name = "avoid"
    instruction = "Roam without touching anything."

    def __init__(self, config: AvoidConfig, n: int, fps: int) -> None:
        self.config = config
        self.duration_s = config.duration_s
        self.frames = max(1, round(config.duration_s * fps))
        self._window = max(1, round(config.stuck_time_s * fps))
        self._arenas: list[Arena | None] = [None] * n
        self._free: list[NDArray[np.int64]] = [np.zeros(0, np.int64)] * n
        self._visited: list[set[int]] = [set() for _ in range(n)]
        self._pose = np.zeros((n, 2))
        self._path = np.zeros(n)
        self._history = np.zeros((self._window, n))  # path lengths of the last frames, a ring
        self._frame = np.zeros(n, np.int64)

    def sample(self, seed: int) -> Arena:
        """Return the arena of the episode with this seed."""
        return make_arena(self.config.arena, seed)

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[Arena]) -> None:
        """Start episodes: the robot stands at each arena's start."""
        for sim, arena in zip(ids, scenes, strict=True):
            self._arenas[sim] = arena
            self._free[sim] = arena.free_cells(self.config.cell_m)
            self._visited[sim] = set()
            self._pose[sim] = arena.start[:2]
            self._count_cell(sim)
        self._path[ids] = 0.0
        self._history[:, ids] = 0.0
        self._frame[ids] = 0

    def judge(self, truth: Truth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        n = len(running)
        reward, event = np.zeros(n), np.full(n, int(Event.NOTHING))
        position = truth.base_pose_in_world[:, :2]
        self._path += np.where(running, np.hypot(*(position - self._pose).T), 0.0)
        self._pose[running] = position[running]
        slot = self._frame % self._window
        sims = np.arange(n)
        recent = self._path - self._history[slot, sims]  # the ring's oldest entry is the path one window ago
        self._history[slot, sims] = self._path
        self._frame[running] += 1
        clean = running & ~truth.touched
        for sim in np.flatnonzero(clean):
            reward[sim] = self._count_cell(sim)
        over = clean & (self._frame >= self.frames)
        far = self._path >= self.config.min_path_m
        event[over & far] = Event.SUCCESS
        event[over & ~far] = Event.TIMEOUT
        stuck = clean & ~over & (self._frame >= self._window) & (recent < self.config.stuck_path_m)
        event[stuck] = Event.STUCK
        event[running & truth.touched] = Event.COLLISION
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        free = max(1, len(self._free[sim]))
        return Outcome(
            success=event == Event.SUCCESS,
            event=event,
            score=len(self._visited[sim]) / free,
            details={
                "path_m": float(self._path[sim]),
                "cells_visited": float(len(self._visited[sim])),
                "cells_free": float(free),
            },
        )

    def parameters(self) -> dict[str, Any]:
        """Return everything that defines the task."""
        return {"type": self.name, **asdict(self.config)}

    def _count_cell(self, sim: int) -> float:
        """Count the cell that the robot is in, and return what it adds to the score."""
        arena, visited = self._arenas[sim], self._visited[sim]
        if arena is None:
            return 0.0
        cell = int(arena.cell_of(self._pose[sim], self.config.cell_m))
        if cell in visited:
            return 0.0
        free = self._free[sim]
        index = int(np.searchsorted(free, cell))
        if index == len(free) or free[index] != cell:
            return 0.0
        visited.add(cell)
        return 1.0 / len(free)
