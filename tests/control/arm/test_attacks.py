"""Attacks on arms with position servos: what interrupts a tick, lies, garbage, and whatever else must not matter."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import HELD, OBSTACLE, Capsule
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.clearance import fill_geometry, new_geometries
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.messages import Mode, Request, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from tests.control.arm_rig import ARM, FRAME, HZ, LIMITS, SWEEP, PerfectArm, Rig, posture

ONE = np.ones(1, np.bool_)


class FeelingArm(PerfectArm):
    """Measures the torques that its motion needs, and those of what presses on it."""

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self._dynamics, self._acceleration = ArmDynamics(ARM), np.zeros((n, 7))
        self.pressed: Any = 0.0  # [N m] more
        self.read_instead: float | None = None

    def read(self, out: PlantReading) -> None:
        super().read(out)
        out.has_effort = True
        motion = (array[:, :6] for array in (self.position, self.velocity, self._acceleration))
        out.effort[:, :6] = self._dynamics.torque(*motion) + self.pressed
        if self.read_instead is not None:
            out.effort[:, :6] = self.read_instead

    def write(self, ctrl: np.ndarray) -> None:
        before = self.velocity
        super().write(ctrl)
        self._acceleration = (self.velocity - before) * HZ


class FeelingRig(Rig):
    def __init__(self) -> None:
        self.start(ARM, FeelingArm(1), ArmController(ARM, 1, HZ, FRAME, max_force=150.0), active=True)


class Interruption(KeyboardInterrupt):
    pass


@contextmanager
def interrupted_at(line: int) -> Iterator[list[int]]:
    """Interrupt the core's Python at its so-manyth line from here; never if negative. Yields the number of lines."""
    count = [0]

    def in_core(frame: Any, event: str, argument: Any) -> Any:
        count[0] += event == "line"
        if count[0] == line:
            raise Interruption
        return in_core

    sys.settrace(lambda frame, *_: in_core if "/bhd_lerobot/control/" in frame.f_code.co_filename else None)
    try:
        yield count
    except Interruption:
        pass
    finally:
        sys.settrace(None)


def stopping(cause: str) -> Rig:
    """Return a moving arm whose next tick stops it."""
    rig = Rig()
    rig.go(**SWEEP)
    rig.tick(60)
    if cause == "estop":
        rig.cerebellum.estop.press()
    elif cause == "fault":
        rig.plant.fault[:] = True
    else:
        rig.controller.rows[int(rig.controller.arms["row"][0])] += 0.5  # what the guard refuses
    return rig


@pytest.mark.parametrize("cause", ["estop", "fault", "guard"])
def test_whatever_interrupts_a_tick_that_stops_an_arm_the_next_one_stops_it(cause: str) -> None:
    rig = stopping(cause)
    with interrupted_at(-1) as lines:
        rig.cerebellum.tick(rig.now)
    for line in range(1, lines[0] + 1, lines[0] // 25):
        rig = stopping(cause)
        with interrupted_at(line):
            rig.cerebellum.tick(rig.now)
        begun = rig.cerebellum.written.copy()
        rig.tick()
        rig.plant.fault[:] = False
        rig.tick(130)
        assert np.abs(rig.cerebellum.written - begun).max() < 0.15, line  # the sweep would go on by 0.7 rad
        assert rig.request(Request.RESET).accepted.all(), line
        assert rig.request(Request.ACTIVATE).accepted.all(), line


def test_a_stop_that_lets_go_needs_no_guard_while_the_gripper_moves() -> None:
    for ticks in range(10, 100, 15):
        rig = FeelingRig()
        rig.go(joint_target=posture(j0=0.8), gripper=0.0)
        rig.tick(ticks)
        rig.plant.pressed = np.array([0.0, 90.0, 60.0, 0.0, 0.0, 0.0])
        rig.until(Mode.FAULT, 50)
        rig.tick(100)
        assert rig.cerebellum.take_flags()[1] == Watchdog.FORCE


@pytest.mark.parametrize("value", [1e12, 1e300, 1e308])
def test_efforts_that_nothing_has_are_none_and_do_not_blind_the_force_limit(value: float) -> None:
    rig = FeelingRig()
    rig.plant.read_instead = value
    rig.tick(30)
    assert rig.mode == Mode.FAULT
    rig.plant.read_instead = None
    rig.tick(100)
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    rig.plant.pressed = np.array([0.0, 90.0, 60.0, 0.0, 0.0, 0.0])
    rig.until(Mode.FAULT, 50)


def test_a_guard_that_trips_out_of_the_range_lets_the_arm_go_on_after_a_reset() -> None:
    rig = Rig()
    beyond = LIMITS.upper[6] + 0.00069  # a lead may be there
    for array in (rig.controller.command, rig.controller.actuators, rig.cerebellum.written, rig.plant.position):
        array[0, 6] = beyond
    rig.tick(5)
    assert rig.mode == Mode.HOLD
    rig.controller.command[0, 0] += 1.0
    rig.tick(100)
    assert rig.cerebellum.take_flags()[1] == Watchdog.GUARD
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    rig.tick(100)
    assert (rig.mode, int(rig.cerebellum.take_flags()[1][0])) == (Mode.HOLD, 0)


def test_whatever_surrounds_an_arm_leaves_room_for_what_it_holds() -> None:
    for count in range(30, 64, 3):
        obstacles = [
            Capsule(f"{OBSTACLE}{k}", 0, (-2.0, 0.0, 1.0 + k), (-2.0, 0.1, 1.0 + k), 0.01) for k in range(count)
        ]
        chain = ur5(obstacles=obstacles).arm.chain
        try:
            geometries = new_geometries(chain, 1)
        except ConfigError:
            continue
        fill_geometry(geometries[1], chain.holding(Capsule(HELD, 6, chain.tool.position, (0.0, 0.0, 0.2), 0.02)))
