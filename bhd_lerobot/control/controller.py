"""What stands between a command and the actuators; the modes are the cerebellum's."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import LIMITS, ArmRecords, SpringRecords, new_states


class Controller(ABC):
    """Turns commands into actuator commands that respect every limit, for n robots.

    What a tick does of it is compiled, see `bhd_lerobot.control.tick`. The arrays are the controller's own and live;
    others only read them.

    Args:
        n: number of robots.
        other: a controller of another part of the same robots, which has their records.

    Attributes:
        states: the records of the robots, shape (n,).
        numbers: the record of their limits, shape (1,).
        arms: the records of arms with position servos, shape (n,); None of other robots.
        springs: the records of the impedances of arms with torque motors, shape (n,); None of other robots.
        arm_limits: the record of the arms' limits, shape (1,); None of robots without.
        geometries: what the arms are kept clear with, see `bhd_lerobot.control.arm.clearance`.
        monitors: of bases, the records of their collision monitors, shape (n,); a single one without beams if there
            are none; None of arms alone.
        width: number of values in a command.
        joints: number of joints and of actuators.
        command: what is applied now, after all limits, shape (n, width).
        actuators: what goes to the plant, shape (n, joints).
        busy: whether it follows one, or brakes after one, shape (n,): it moves without setpoints, and their age says
            nothing about it.
        protective_stop: the `Watchdog` flag of each robot that has just begun a stop of its own, shape (n,); 0 for the
            others.
        contact_wrench: what the surroundings put on the tools, estimated from the motors' efforts, in the base frame:
            forces [N], and moments about the tool centre points [N m], shape (n, 6); 0 where it is not estimated.
        limits: the `Limit` flags raised since they were last taken, shape (n,).
    """

    width: int
    joints: int
    command: NDArray[np.float64]
    actuators: NDArray[np.float64]
    busy: NDArray[np.bool_]
    protective_stop: NDArray[np.int64]
    limits: NDArray[np.int64]
    monitors: Any = None
    geometries: Any = None

    def __init__(self, n: int, other: "Controller | None" = None) -> None:
        if other is None:
            self.states, self.numbers = new_states(n), np.zeros(1, LIMITS)
            self.numbers["gyro"] = -1
        else:
            self.states, self.numbers = other.states, other.numbers
        self.contact_wrench: NDArray[np.float64] = self.states["wrench"]
        self.arms: Any = None
        self.springs: Any = None
        self.arm_limits: Any = None

    def serve(self, sim: int) -> None:
        """Do what the tick of one robot waits for, see `tick`."""
        return

    def tell(self, sim: int) -> None:
        """Take the modes that one robot has entered outside of a tick."""
        return

    @property
    def rows(self) -> Any:
        """The trajectories that arms play, shape (T, 3, width); None of other robots."""
        return None

    @property
    def groups(self) -> tuple[Any, ArmRecords | None, SpringRecords | None]:
        """The records of its drives' monitors, of its arms and of its impedances, as ticks take them."""
        arms = None if self.arms is None else ArmRecords(self.arms, self.arm_limits, self.geometries, self.rows)
        return self.monitors, arms, None if self.springs is None else SpringRecords(self.springs, self.arm_limits)

    @abstractmethod
    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each robot is commanded to be at rest, shape (n,)."""

    @abstractmethod
    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Take the joints as they are for the start."""

    def resume(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Continue at rest from where the joints are: someone else has stopped the robots there."""
        return

    @abstractmethod
    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about robots that were put somewhere else."""

    @property
    def cause(self) -> str:
        """Why the last stop of its own was, as text."""
        return ""

    def take_limits(self) -> NDArray[np.int64]:
        """Return the `Limit` flags raised since the last call, shape (n,), and clear them."""
        limits = self.limits.copy()
        self.limits[:] = 0
        return limits

    def odometry(self) -> NDArray[np.float64]:
        """Return x [m], y [m] and yaw [rad] since the start, shape (n, 3); shape (n, 0) for what does not drive."""
        return np.zeros((len(self.busy), 0))

    # --- goals: robots that take none refuse them --------------------------------------------------------------------

    def submit(self, sim: int, command: BrainCommand, blocked: ResultCode | None = None) -> CommandResult | None:
        """Take a goal.

        Args:
            sim: the robot.
            command: the goal.
            blocked: why the robot takes no goals now, or None.

        Returns:
            None if it was accepted, otherwise the refusal.
        """
        return CommandResult(command.task_id, False, ResultCode.BAD_TARGET, "This robot takes setpoints, not goals.")

    def cancel(self, sim: int, task_id: str) -> ResultCode:
        """Cancel a goal; return `SUCCEEDED`, or `UNKNOWN_ID` if there is none of this name."""
        return ResultCode.UNKNOWN_ID

    def take_results(self, sim: int) -> list[CommandResult]:
        """Return the results of one robot that were not taken yet."""
        return []

    def feedback(self, sim: int) -> Feedback | None:
        """Return how far the goal is that one robot follows, or None."""
        return None
