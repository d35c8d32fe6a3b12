"""Plays trajectories back, one tick at a time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.motion.trajectory import State, Trajectory

Array = NDArray[np.float64]


class TrajectoryPlayer:
    """One trajectory for each arm, or none: rows of one block, from the next to the end, in the arms' records.

    Attributes:
        rows: position, velocity and acceleration at each tick, shape (T, 3, dof).

    Args:
        arms: the records of the arms.
        dof: numbers of a position.
    """

    def __init__(self, arms: NDArray[Any], dof: int) -> None:
        self._next, self._end = arms["row"], arms["end"]
        self._block: Array = np.zeros((4096, 3, dof))
        self.rows, self._used = self._block, 0

    def start(self, sim: int, trajectory: Trajectory) -> None:
        """Play a trajectory from the next tick on; it takes the place of the one that is being played."""
        self.stop(sim)
        if self._used + trajectory.ticks > len(self._block):
            self._make_room(trajectory.ticks)
        begin, end = self._used, self._used + trajectory.ticks
        rows = self._block[begin:end]
        rows[:, 0], rows[:, 1], rows[:, 2] = trajectory.position, trajectory.velocity, trajectory.acceleration
        self._next[sim], self._end[sim], self._used, self.rows = begin, end, end, self._block

    def borrow(self, rows: Array) -> None:
        """Play rows of another owner from the next tick on, without copying them; for one arm.

        Args:
            rows: as the attribute. They must stay as they are until something else is played.
        """
        if len(self._next) != 1:
            raise ValueError(f"Rows of {len(self._next)} arms lie in one block; only a single one may borrow.")
        self._next[0], self._end[0], self.rows = 0, len(rows), rows

    def stop(self, sim: int) -> None:
        """Play nothing for an arm: its reference stays as it is."""
        self._next[sim] = self._end[sim] = 0
        if not (self._next < self._end).any():
            self._used = 0

    def is_playing(self, sim: int) -> bool:
        """Return whether anything is left to be played for an arm."""
        return bool(self._next[sim] < self._end[sim])

    def remaining(self, sim: int) -> int:
        """Return how many ticks are left."""
        return max(int(self._end[sim] - self._next[sim]), 0)

    def ahead(self, sim: int, ticks: int) -> State | None:
        """Return the state after so many more ticks, at least one, or at the end; None if nothing is played."""
        if not self.is_playing(sim):
            return None
        return State.of(*self.rows[min(int(self._next[sim]) + ticks, int(self._end[sim])) - 1])

    def _make_room(self, ticks: int) -> None:
        """Move the rows that are still to be played to the front of a block that holds `ticks` more."""
        ids = np.flatnonzero(self._next < self._end)
        lengths = self._end[ids] - self._next[ids]
        needed = int(lengths.sum()) + ticks
        # Half of the block stays free, so that rows are moved seldom.
        block = np.zeros((max(len(self._block), 2 * needed), *self._block.shape[1:]))
        used = 0
        for sim, length in zip(ids, lengths, strict=True):
            block[used : used + length] = self._block[self._end[sim] - length : self._end[sim]]
            self._next[sim], self._end[sim] = used, used + length
            used += length
        self._block, self._used = block, used


@kernel()
def play(state: Any, arm: Any, limits: Any, rows: Array) -> None:
    """Write the next row of an arm's trajectory to its reference; it stays as it is if none is left."""
    if arm.row >= min(arm.end, len(rows)):
        return
    for k in range(limits.width):
        state.command[k], arm.speed[k], arm.change[k] = rows[arm.row, 0, k], rows[arm.row, 1, k], rows[arm.row, 2, k]
    arm.row += 1
