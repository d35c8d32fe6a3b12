"""Plays trajectories back, one tick at a time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.motion.trajectory import State, Trajectory

Array = NDArray[np.float64]


class TrajectoryPlayer:
    """One trajectory for each arm, or none: rows of one block, from the next to the end, in the arms' records.

    Each arm has rows of its own, which no other arm's trajectory moves: others may be played meanwhile.

    Attributes:
        rows: position, velocity and acceleration at each tick, shape (T, 3, dof).

    Args:
        arms: the records of the arms.
        dof: numbers of a position.
    """

    def __init__(self, arms: NDArray[Any], dof: int) -> None:
        self._next, self._end = arms["row"], arms["end"]
        self.rows: Array = np.zeros((4096, 3, dof))
        self._block, self._used = self.rows, 0
        self._first, self._room = np.zeros((2, len(arms)), np.int64)

    def start(self, sim: int, trajectory: Trajectory) -> None:
        """Play a trajectory from the next tick on; it takes the place of the one that is being played."""
        if trajectory.ticks > self._room[sim]:
            self._make_room(sim, 1 << (trajectory.ticks - 1).bit_length())
        begin, end = int(self._first[sim]), int(self._first[sim]) + trajectory.ticks
        rows = self._block[begin:end]
        rows[:, 0], rows[:, 1], rows[:, 2] = trajectory.position, trajectory.velocity, trajectory.acceleration
        self._next[sim], self._end[sim], self.rows = begin, end, self._block

    def borrow(self, rows: Array) -> None:
        """Play rows of another owner from the next tick on, without copying them; for one arm.

        Args:
            rows: as the attribute. They must stay as they are until something else is played.
        """
        if len(self._next) != 1:
            raise ValueError(f"Rows of {len(self._next)} arms lie in one block; only a single one may borrow.")
        # Machine code counts on their type; what is so already is not copied.
        self._next[0], self._end[0], self.rows = 0, len(rows), np.ascontiguousarray(rows, np.float64)

    def stop(self, sim: int) -> None:
        """Play nothing for an arm: its reference stays as it is."""
        self._next[sim] = self._end[sim] = 0

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

    def _make_room(self, sim: int, ticks: int) -> None:
        """Give an arm more rows, at the end of the block."""
        first, self._used = self._used, self._used + ticks
        self._first[sim], self._room[sim] = first, ticks
        if self._used > len(self._block):
            block = np.zeros((2 * self._used, *self._block.shape[1:]))
            block[:first] = self._block[:first]
            self._block = block


@kernel()
def play(state: Any, arm: Any, limits: Any, rows: Array) -> None:
    """Write the next row of an arm's trajectory to its reference; it stays as it is if none is left."""
    if arm.row >= min(arm.end, len(rows)):
        return
    for k in range(limits.width):
        state.command[k], arm.speed[k], arm.change[k] = rows[arm.row, 0, k], rows[arm.row, 1, k], rows[arm.row, 2, k]
    arm.row += 1
