"""The small interface below the cerebellum: what a simulated and a real robot have in common."""

from abc import abstractmethod
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.record import new_states


class SafetyStatus(IntEnum):
    """What a robot's own safety functions say of it."""

    NORMAL = 0
    """It follows commands."""
    STOPPED = 1
    """It has stopped by itself and follows none: a protective stop, or commands did not come for too long."""
    EMERGENCY_STOP = 2
    """Its emergency stop is pressed."""
    FAULT = 3
    """It is broken, or cannot be reached."""


class PlantReading:
    """One reading of the robot; the plant writes into it.

    Args:
        n: number of robots.
        joints: number of joints.
        sensors: number of further values that the plant measures, such as the ranges of a scan.
        states: records whose fields it fills, shape (n,); new ones if None.

    Attributes:
        position: joint angles [rad], a gripper's opening [m], shape (n, joints).
        velocity: joint speeds [rad/s], a gripper's [m/s], shape (n, joints).
        effort: torques that the motors gave on average since the reading of the tick before, also to carry the robot's
            weight [N m], a gripper's force [N], shape (n, joints); all 0 if the plant does not measure them.
        has_effort: whether it does.
        stamp_ns: when the hardware measured this, on the monotonic clock of this machine [ns], shape (n,); None for a
            plant whose readings are never old, such as a simulation in lockstep.
        safety: a `SafetyStatus` of each robot, shape (n,); all but `NORMAL` is a fault or an emergency stop.
        sensors: the newest further values, shape (n, sensors): what they are, and in which order, says the host; see
            `bhd_lerobot.robots.parts.drive.DrivePart`.
        sensors_ns: when the oldest of these was measured, as `stamp_ns` [ns], shape (n,).
    """

    def __init__(self, n: int, joints: int, sensors: int = 0, states: NDArray | None = None) -> None:
        states = new_states(n) if states is None else states
        self.position: NDArray[np.float64] = states["position"][:, :joints]
        self.velocity: NDArray[np.float64] = states["velocity"][:, :joints]
        self.effort: NDArray[np.float64] = states["effort"][:, :joints]
        self.has_effort = False
        self.stamp_ns: NDArray[np.int64] | None = None
        self.safety: NDArray[np.int8] = states["safety"]
        self.sensors = np.zeros((n, sensors))
        self.sensors_ns = np.zeros(n, np.int64)

    def of_joints(self, first: int, joints: int) -> "PlantReading":
        """Return the reading of some neighbouring joints, live, without sensors."""
        part = PlantReading.__new__(PlantReading)
        for name in ("position", "velocity", "effort"):
            setattr(part, name, getattr(self, name)[:, first : first + joints])
        part.has_effort, part.stamp_ns, part.safety = self.has_effort, self.stamp_ns, self.safety
        return part

    def __setattr__(self, name: str, value: Any) -> None:
        """Set `has_effort` or `stamp_ns`; others hold these arrays, too, and a plant writes into them."""
        if name not in ("has_effort", "stamp_ns") and vars(self).get(name, value) is not value:
            raise TypeError(f"PlantReading.{name} is not to be replaced: write into it, out.{name}[:] = values.")
        super().__setattr__(name, value)


class Plant(Protocol):
    """What the cerebellum reads from and writes to; a subclass needs no more than `n`, `read` and `write`.

    `open`, `enable` and `close` may take their time: the control loop stands meanwhile. The other calls come from
    inside of it, once a tick, and must neither wait nor raise: what goes wrong is told by `PlantReading.safety`.

    Attributes:
        n: number of robots.
        takes: what `write` gets: ``"actuators"``, or of a base ``"twist"``.
        latency_s: time from a command until the readings show it [s]; a robot that follows so late is not blocked.
        hint: where commands go and what else to check if the robot does not follow, as text.
    """

    n: int
    takes: str = "actuators"
    latency_s: float = 0.0
    hint: str = ""

    def open(self) -> None:
        """Connect to the robot. Raises whatever reports why that is impossible."""
        return

    def enable(self) -> None:
        """Make the robot follow commands from now on: release brakes, switch motors on. It stays where it is."""
        return

    @abstractmethod
    def read(self, out: PlantReading) -> None:
        """Write the newest readings into `out`."""

    @abstractmethod
    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take commands.

        Args:
            ctrl: joint positions [rad], or torques [N m], and the opening [m]; then of a base wheel speeds [rad/s],
                or where `takes` is ``"twist"`` the forward speed [m/s] and the yaw rate [rad/s]; shape (n, joints).

        The first follows an `enable` and is where the robot was read to be; wheels stand. A robot that gets none for
        too long has to stop by itself.
        """

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the new `Mode` of each robot, shape (n,), before the first command that is given in it.

        In a mode without motion, such as `SAFE_OFF`, the robot may switch its motors off; an arm that takes torques has
        to brake then, without the help of what it reads: nothing else stops it.
        """
        return

    def recover(self) -> bool:
        """Begin to leave a stop of the robot's own, because a person or a new episode resets it.

        Before an episode it is called again each second for as long as the robot is stopped.

        Returns:
            Whether the robot may have moved by itself: its reference then starts from where it is.
        """
        return False

    def close(self) -> None:
        """Disconnect; the robot is to stay safe without commands. May be called twice."""
        return
