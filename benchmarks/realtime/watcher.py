"""Reads what a running robot publishes, from another process than its own."""

import numpy as np

from benchmarks.realtime.cases import CaseError
from benchmarks.realtime.stamps import Array, records_of
from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.block import LiveBlock


class Watcher:
    """Reads every published state of a robot, from another process.

    Args:
        name: the robot's name.

    Raises:
        CaseError: there is no such robot.
    """

    def __init__(self, name: str) -> None:
        try:
            self.block = LiveBlock.attach(name)
        except BhdError as error:
            raise CaseError(str(error)) from error
        self.words = self.block.words
        self.period_ns = NANOSECONDS // int(self.block.about["control_hz"])
        self.begin()

    def begin(self) -> None:
        """Forget what was read; what is published from now on is kept."""
        self._reader = RingReader(self.block.ring)
        self._batches: list[Array] = []

    @property
    def drops(self) -> int:
        """States that were overwritten before they could be read."""
        return self._reader.drops

    def drain(self) -> Array:
        """Read what was published since the last call, and return it."""
        states = []
        while (state := self._reader.read()) is not None:
            states.append(state)
        batch = records_of(np.array(states, self.block.state_dtype))
        if len(batch):
            self._batches.append(batch)
        return batch

    def records(self) -> Array:
        """Return all that was read since `begin`, in order."""
        return np.concatenate(self._batches) if self._batches else records_of(np.zeros(0, self.block.state_dtype))

    def close(self) -> None:
        """Leave the robot's memory."""
        self.block.close()
