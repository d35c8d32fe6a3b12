"""The small interface below the cerebellum: what a simulated and a real base have in common."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class PlantReading:
    """One reading of the joints; the plant writes into it.

    Args:
        n: number of simulations.
        joints: number of joints.

    Attributes:
        position: joint angles [rad], shape (n, joints).
        velocity: joint speeds [rad/s], shape (n, joints).
        effort: torques that the motors give, also to carry the robot's weight [N m], a gripper's force [N], shape
            (n, joints); all 0 if the plant does not measure them.
        has_effort: whether it does.
        stamp_ns: when the hardware measured this, on the plant's own clock [ns], shape (n,); None for a plant whose
            readings are never old, such as a simulation in lockstep.
        fault: whether the hardware reports a fault, shape (n,).
    """

    def __init__(self, n: int, joints: int) -> None:
        # One block, so that a single sum checks that every number in it is finite.
        self.values = np.zeros((3, n, joints))
        self.position: NDArray[np.float64] = self.values[0]
        self.velocity: NDArray[np.float64] = self.values[1]
        self.effort: NDArray[np.float64] = self.values[2]
        self.has_effort = False
        self.stamp_ns: NDArray[np.int64] | None = None
        self.fault = np.zeros(n, np.bool_)


class Plant(Protocol):
    """What the cerebellum reads from and writes to. Neither call may block."""

    n: int

    def read(self, out: PlantReading) -> None:
        """Write the newest joint readings into `out`."""

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the actuator commands: wheel speeds [rad/s], shape (n, actuators)."""
