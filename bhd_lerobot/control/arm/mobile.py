"""The controller of arms on bases with two driven wheels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.step import Stage
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.drive import BaseController, tell_drive
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]


class MobileArmController(Controller):
    """Arms and the bases that carry them, each by its own controller; they stop, and are at rest, as one.

    A command is the arm's, then the drive's. While a goal of the arm is followed, the base comes to rest.

    Attributes:
        goals: the goals of the arms.

    Args:
        arm: the arms' controller.
        drive: the bases', on the records of the arms'.
    """

    def __init__(self, arm: ArmController, drive: BaseController) -> None:
        super().__init__(len(arm.states), arm)
        self.arm, self.drive, self.goals, states = arm, drive, arm.goals, arm.states
        self.arms, self.arm_limits, self.geometries = arm.arms, arm.arm_limits, arm.geometries
        self.monitors = drive.monitors
        self.width, self.joints = arm.width + drive.width, arm.joints + drive.joints
        self.command, self.actuators = (states[name][:, : self.width] for name in ("command", "actuators"))
        self.busy, self.protective_stop, self.limits = (states[k] for k in ("busy", "protective_stop", "limits"))
        self._state_of, [self._numbers] = as_objects(states), as_objects(self.numbers)

    def _parts(self, reading: PlantReading) -> tuple[PlantReading, PlantReading]:
        """Return the readings of arm and wheels."""
        return reading.of_joints(0, self.arm.joints), reading.of_joints(self.arm.joints, self.drive.joints)

    @property
    def rows(self) -> Any:
        """The trajectories that arms play."""
        return self.arm.rows

    def serve(self, sim: int) -> None:
        """Do what the tick of one robot waits for."""
        if self.arms["stage"][sim] in (Stage.BEGUN, Stage.ENDED):
            self.tell(sim)
        else:
            self.arm.serve(sim)

    def tell(self, sim: int) -> None:
        """Take the modes that a robot has entered, and its setpoint."""
        tell_drive(self._state_of[sim], self._numbers)
        self.arm.tell(sim)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each robot is commanded to be at rest, shape (n,)."""
        return self.arm.at_rest() & self.drive.at_rest()

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from the posture that the arms are in, and odometry here."""
        arm, wheels = self._parts(reading)
        self.arm.configure(ids, arm)
        self.drive.configure(ids, wheels)

    def resume(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Continue from the posture that the arms are in; the bases stand."""
        arm, wheels = self._parts(reading)
        self.arm.resume(ids, arm)
        self.drive.resume(ids, wheels)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about robots that were put somewhere else."""
        self.arm.restart(ids)
        self.drive.restart(ids)

    @property
    def cause(self) -> str:
        """Why the last stop of its own was, as text."""
        return self.drive.cause or self.arm.cause

    def odometry(self) -> Array:
        """Return x [m], y [m] and yaw [rad] since the start, shape (n, 3)."""
        return self.drive.odometry()

    def submit(self, sim: int, command: BrainCommand, blocked: ResultCode | None = None) -> CommandResult | None:
        """Take a goal of the arm; None if it was accepted, otherwise the refusal."""
        return self.arm.submit(sim, command, blocked)

    def cancel(self, sim: int, task_id: str) -> ResultCode:
        """Cancel a goal: decelerate, then hold."""
        return self.arm.cancel(sim, task_id)

    def take_results(self, sim: int) -> list[CommandResult]:
        """Return the results of one robot that were not taken yet."""
        return self.arm.take_results(sim)

    def feedback(self, sim: int) -> Feedback | None:
        """Return how far the goal is that one arm follows, or None."""
        return self.arm.feedback(sim)
