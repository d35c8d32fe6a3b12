"""Plays trajectories back, one tick at a time, for n simulations at once."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.motion.trajectory import State, Trajectory


class TrajectoryPlayer:
    """One trajectory for each simulation, or none.

    The rows of all trajectories lie in one block, so that a tick is one gather however many are played.

    Attributes:
        active: which simulations a trajectory is played for, shape (n,).
    """

    def __init__(self, n: int, dof: int) -> None:
        self.active: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self._rows: NDArray[np.float64] = np.zeros((4096, 3, dof))
        self._source = self._rows  # what the only trajectory is played from: the block, or borrowed rows
        self._used = 0
        # The row that is next is the number of ticks so far and this.
        self._offset, self._end = np.zeros(n, np.intp), np.zeros(n, np.intp)
        self._ticks = 0
        self._ids = np.flatnonzero(self.active)
        self._only: tuple[int, int] | None = None  # the simulation and its offset, if there is one only
        self._soonest = 0  # ticks until the first of the trajectories ends

    def start(self, sim: int, trajectory: Trajectory) -> None:
        """Play a trajectory from the next tick on; it takes the place of the one that is being played."""
        self.active[sim] = False
        if self._used + trajectory.ticks > len(self._rows):
            self._make_room(trajectory.ticks)
        begin, end = self._used, self._used + trajectory.ticks
        rows = self._rows[begin:end]
        rows[:, 0], rows[:, 1], rows[:, 2] = trajectory.position, trajectory.velocity, trajectory.acceleration
        self._offset[sim], self._end[sim], self._used = begin - self._ticks, end, end
        self._source = self._rows
        self.active[sim] = True
        self._changed()

    def borrow(self, rows: NDArray[np.float64]) -> None:
        """Play rows of another owner from the next tick on, without copying them; for one simulation.

        Args:
            rows: position, velocity and acceleration at each tick, shape (T, 3, dof). They must stay as they are until
                something else is played.
        """
        if len(self.active) != 1:
            raise ValueError(f"Rows of {len(self.active)} simulations lie in one block; only a single one may borrow.")
        self._offset[0], self._end[0] = -self._ticks, len(rows)
        self._source = rows
        self.active[0] = True
        self._changed()

    def stop(self, sim: int) -> None:
        """Play nothing for a simulation: its reference stays as it is."""
        self.active[sim] = False
        self._changed()

    def remaining(self, sim: int) -> int:
        """Return how many ticks are left."""
        return int(self._end[sim] - self._offset[sim]) - self._ticks if self.active[sim] else 0

    def ahead(self, sim: int, ticks: int) -> State | None:
        """Return the state after so many more ticks, at least one, or at the end; None if nothing is played."""
        if not self.active[sim]:
            return None
        rows = self._source if len(self.active) == 1 else self._rows
        last = min(int(self._offset[sim]) + self._ticks + ticks, int(self._end[sim])) - 1
        return State.of(*rows[last])

    def tick(
        self, position: NDArray[np.float64], velocity: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> None:
        """Write the next row of each trajectory; who plays none keeps what is there. The arrays have shape (n, dof)."""
        if not self._soonest:
            return
        if self._only is not None:
            sim, offset = self._only
            position[sim], velocity[sim], acceleration[sim] = self._source[offset + self._ticks]
        else:
            ids = self._ids
            rows = self._rows[self._offset[ids] + self._ticks]
            position[ids], velocity[ids], acceleration[ids] = rows[:, 0], rows[:, 1], rows[:, 2]
        self._ticks += 1
        self._soonest -= 1
        if not self._soonest:
            ids = self._ids
            self.active[ids] = self._offset[ids] + self._ticks < self._end[ids]
            self._changed()

    def _changed(self) -> None:
        self._ids = ids = np.flatnonzero(self.active)
        self._soonest = int((self._end[ids] - self._offset[ids]).min()) - self._ticks if len(ids) else 0
        self._only = (int(ids[0]), int(self._offset[ids[0]])) if len(ids) == 1 else None
        if not len(ids):
            self._used = 0

    def _make_room(self, ticks: int) -> None:
        """Move the rows that are still to be played to the front of a block that holds `ticks` more."""
        ids = np.flatnonzero(self.active)
        lengths = self._end[ids] - self._offset[ids] - self._ticks
        needed = int(lengths.sum()) + ticks
        # Half of the block stays free, so that rows are moved seldom.
        rows = np.zeros((max(len(self._rows), 2 * needed), *self._rows.shape[1:]))
        used = 0
        for sim, length in zip(ids, lengths, strict=True):
            rows[used : used + length] = self._rows[self._end[sim] - length : self._end[sim]]
            self._offset[sim], self._end[sim] = used - self._ticks, used + length
            used += length
        self._rows, self._used = rows, used
