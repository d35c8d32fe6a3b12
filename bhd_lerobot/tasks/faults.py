"""What it means for an episode that a robot stopped by itself, or was stopped."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Mode
from bhd_lerobot.tasks.task import Event


def add_faults(event: NDArray[np.int64], mode: NDArray[np.integer], running: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the events of a frame, with those of robots that take no action any more.

    What the task says of the frame says more than a latched fault, but an emergency stop comes before all else.

    Args:
        event: what the task says, shape (n,).
        mode: of the robots at the end of the frame, shape (n,).
        running: which of them are in an episode, shape (n,).
    """
    if not np.count_nonzero(mode >= Mode.ESTOP):
        return event
    faulty = running & (mode == Mode.FAULT) & (event == Event.NOTHING)
    return np.where(running & (mode == Mode.ESTOP), Event.ESTOP, np.where(faulty, Event.FAULT, event))
