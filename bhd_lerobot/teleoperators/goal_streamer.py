"""Goals as a stream of setpoints, one a frame, for robots that take nothing else."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Rates
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.commands import BrainCommand, CommandResult
from bhd_lerobot.control.plant import PlantReading


class GoalStreamer:
    """Plans goals as the cerebellum does, and hands out where the reference is at the end of every frame.

    LeRobot's `Robot` takes setpoints only; a brain that gives goals drives it through this.

    Args:
        arm: the arm.
        rates: the rates.
        start: where the arm's reference is now, joint angles [rad] and the gripper's opening [m], shape (7,).
    """

    def __init__(self, arm: Arm, rates: Rates, start: NDArray[np.float64]) -> None:
        self._rates = rates
        self._controller = ArmController(arm, 1, rates.control_hz, rates.ticks_per_frame)
        self._reading = PlantReading(1, self._controller.joints)
        self._reading.position[0] = start
        self._controller.configure(np.zeros(1, np.intp), self._reading)

    def frame(
        self, commands: Sequence[BrainCommand], measured: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], list[CommandResult]]:
        """Plan one frame.

        Args:
            commands: new goals.
            measured: where the joints are now, shape (7,).

        Returns:
            The reference at the end of the frame, shape (7,), and the goals that ended or were refused.
        """
        controller, reading = self._controller, self._reading
        refused = [refusal for command in commands if (refusal := controller.submit(0, command)) is not None]
        # Within the frame nothing is measured: the arm is taken to follow the reference from where it is.
        behind = measured - controller.command[0]
        for _ in range(self._rates.ticks_per_frame):
            reading.velocity[0] = controller.velocity[0]
            reading.position[0] = controller.command[0] + behind
            controller.run(reading)
        # A refusal is among the results, too, unless another goal has its name.
        ended = controller.take_results(0)
        return controller.command[0].copy(), [one for one in refused if one not in ended] + ended
