"""How a plant that gets no commands any more brings its robot to rest, by itself and with its own sensors only."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]

_SLOW = 0.2  # [rad/s] a joint slower than this is held where it is


class WheelStop:
    """Wheels that are commanded to stand."""

    def __init__(self, joints: int) -> None:
        self._actuators = np.zeros((1, joints))

    def begin(self, actuators: Array) -> None:
        """Start a stop."""

    def command(self, reading: PlantReading) -> Array:
        """Return a speed of 0 for each wheel."""
        return self._actuators


class ServoStop:
    """Position servos that hold each joint where it is.

    While a joint is fast its servo is commanded to wherever the joint is: it brakes with what its damping gives, up to
    its largest torque, and does not pull the joint back to where the stop began. Once slow, it holds the joint there.
    That is no farther from where the stop found it than a joint needs to brake from its largest speed: a reading that
    is wrong is followed no farther. The gripper keeps its last command: what it grips is not let go of.

    Attributes:
        hold: where the joints are held [rad], the opening last [m], shape (1, joints).
    """

    def __init__(self, arm: Arm) -> None:
        self.hold = np.asarray(arm.home)[None].copy()
        self._held = np.zeros(self.hold.shape, np.bool_)
        speed = np.asarray(arm.limits.velocity)
        self._room = speed**2 / np.asarray(arm.limits.stop_deceleration)  # twice the way that the hardest brake takes
        self._first, self._begun = self.hold.copy(), False

    def begin(self, actuators: Array) -> None:
        """Start a stop."""
        self._held[:] = False
        self._held[:, -1] = True
        self.hold[:, -1] = actuators[:, -1]
        self._begun = False

    def command(self, reading: PlantReading) -> Array:
        """Return where the joints are to be."""
        if not self._begun:
            self._first, self._begun = reading.position.copy(), True
        near = np.minimum(np.maximum(reading.position, self._first - self._room), self._first + self._room)
        np.copyto(self.hold, near, where=~self._held)
        self._held |= np.abs(reading.velocity) < _SLOW
        return self.hold


class TorqueStop:
    """Torque motors that carry the arm's weight; its brakes stop it."""

    def __init__(self, body: Body) -> None:
        arm = body.need(Arm)
        self._dynamics = ArmDynamics(body)
        self._effort = np.asarray(arm.limits.effort[:-1])
        self._actuators = np.asarray(arm.home)[None].copy()

    def begin(self, actuators: Array) -> None:
        """Start a stop."""
        self._actuators[:] = actuators

    def command(self, reading: PlantReading) -> Array:
        """Return torques, and the opening."""
        position = reading.position[:, : self._dynamics.dof]
        still = np.zeros_like(position)
        weight = self._dynamics.torque(position, still, still)
        self._actuators[:, :-1] = np.minimum(np.maximum(weight, -self._effort), self._effort)
        return self._actuators


PlantStop = WheelStop | ServoStop | TorqueStop
"""What the actuators get, from the last commands on, shape (1, joints), and for each tick's reading."""


def make_stop(body: Body, joints: int) -> PlantStop:
    """Return how a robot is stopped."""
    if body.arm is None:
        return WheelStop(joints)
    return TorqueStop(body) if body.arm.actuation == "torque" else ServoStop(body.arm)
