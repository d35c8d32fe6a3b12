"""After a stop an arm with position servos does not press on what it touches: forces of the physics, in newtons."""

from typing import Any

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.messages import Mode, Request
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation

BOUND_N, BOUND_S = 20.0, 0.5


class Pressed:
    """A UR5 whose joints are commanded to where the tool would be in the table."""

    def __init__(self) -> None:
        self.arm = arm = UR5Simulation(UR5Config(), 1, threads=1)
        arm.reset(np.zeros(1, int), [TableScene("empty", (), arm.body.home)], [0])
        arm.cerebellum.controller.setpoints.clearance = None  # type: ignore[union-attr]
        action = arm.cerebellum.command.copy()
        pose = arm.kinematics.tool(action[0, :6])
        self.model = arm.world.copy_model(0)
        self.data = mujoco.MjData(self.model)
        self.frames = 0
        while self.force() < 60.0:
            pose[2, 3] -= 0.001
            found = arm.kinematics.solutions(pose, action[0, 5])
            action[0, :6] = found[np.nanargmin(np.abs(found - action[0, :6]).max(axis=1))]
            assert arm.step(action).sent.accepted.all()
            self.frames += 1
            assert self.frames < 400

    def force(self) -> float:
        """Return the sum of the normal forces between the arm and what it touches now [N]."""
        self.arm.world.copy_into(0, self.model, self.data)
        self.data.ctrl[:] = self.arm.world.ctrl[0]
        mujoco.mj_forward(self.model, self.data)
        wrench = np.zeros(6)
        total = 0.0
        for contact in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, contact, wrench)
            total += abs(wrench[0])
        return total

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * self.arm.rates.fps)):
            self.arm.step(None)


@pytest.mark.parametrize("cause", ["fault", "emergency stop"])
def test_a_stopped_arm_lets_go_of_the_table_and_stays_so_after_reset_and_activate(cause: str) -> None:
    pressed = Pressed()
    cerebellum: Any = pressed.arm.cerebellum
    if cause == "fault":
        read, faults = cerebellum.plant.read, [True]

        def broken(out: Any) -> None:
            read(out)
            out.safety[:] = bool(faults) and faults.pop()

        cerebellum.plant.read = broken
    else:
        cerebellum.estop.press()
    pressed.arm.step(None)
    assert cerebellum.mode[0] == (Mode.FAULT if cause == "fault" else Mode.ESTOP)
    pressed.wait(BOUND_S)
    assert pressed.force() < BOUND_N
    where = cerebellum.reading.position.copy()
    for request in (Request.RESET, Request.ACTIVATE):
        assert cerebellum.request(request).accepted.all()
    pressed.wait(2.0)
    assert pressed.force() < BOUND_N
    assert np.abs(cerebellum.reading.position - where)[0, :6].max() < 0.01  # it has not moved on, nor sunk
