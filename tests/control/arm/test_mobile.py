"""An arm on a base: what is written is safe, a stop of one part stops the other, and goals and setpoints take turns."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.arm.step import Stage
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.messages import Limit, Mode, Request, Setpoint, Watchdog
from tests.control import arm_rig
from tests.control.arm_rig import FRAME, HZ, TICK_NS
from tests.control.mobile_rig import (
    ARM,
    DRIVE,
    HOME,
    SWEEP,
    TIMEOUT_TICKS,
    WHEELS,
    Rig,
    off,
)

STOP = np.array(DRIVE.limits.stop_deceleration) / HZ
MOVING = off(0.2, 0.6, j0=0.5)


def moving(frames: int = 16, **options: Any) -> Rig:
    """Return a robot whose arm and base follow setpoints."""
    rig = Rig(**options)
    rig.stream(MOVING, frames)
    assert rig.mode == Mode.TRACKING
    assert min(map(abs, rig.twist)) > 0.1
    return rig


def lie(joint: int, value: float) -> Callable[[Rig], None]:
    return lambda rig: rig.plant.lie.update({0: {joint: value}})


def queued(*rows: Any) -> Callable[[Rig], None]:
    """Have commands due in the same tick that no sender of ours sends."""

    def push(rig: Rig) -> None:
        for row in rows:
            rig.push(row)

    return push


NAN = np.full(7, np.nan)
NAN_IN_ARM, NAN_IN_DRIVE = HOME.copy(), MOVING.copy()
NAN_IN_ARM[2], NAN_IN_DRIVE[5] = np.nan, np.inf
HARD: dict[str, tuple[Callable[[Rig], Any], Mode, Watchdog]] = {
    "e-stop": (lambda rig: rig.cerebellum.estop.press(), Mode.ESTOP, Watchdog.NONE),
    "plant fault": (lambda rig: rig.plant.fault.fill(True), Mode.FAULT, Watchdog.PLANT),
    "a joint is no number": (lie(1, np.nan), Mode.FAULT, Watchdog.PLANT),
    "a wheel is no number": (lie(5, np.nan), Mode.FAULT, Watchdog.PLANT),
    "a joint jumps": (lie(0, 2.0), Mode.FAULT, Watchdog.PLANT),
    "a wheel jumps": (lie(6, 99.0), Mode.FAULT, Watchdog.PLANT),
    "command not finite": (queued(NAN), Mode.FAULT, Watchdog.GUARD),
    "arm's command not finite": (queued(NAN_IN_ARM), Mode.FAULT, Watchdog.GUARD),
    "command, then one not finite": (queued(off(0.26, -1.0, j0=-0.5), NAN), Mode.FAULT, Watchdog.GUARD),
    "arm's reference": (lambda rig: rig.controller.arm.command.__iadd__(0.1), Mode.FAULT, Watchdog.GUARD),
    "drive's reference": (lambda rig: rig.controller.drive.command.__iadd__(0.1), Mode.FAULT, Watchdog.GUARD),
    "drive's reference, no number": (lambda rig: rig.controller.drive.command.fill(np.nan), Mode.FAULT, Watchdog.GUARD),
    "interrupted by a watchdog": (
        lambda rig: rig.cerebellum.interrupt(Watchdog.MISSES, Mode.FAULT),
        Mode.FAULT,
        Watchdog.MISSES,
    ),
}


@pytest.mark.parametrize("cause", HARD)
def test_whatever_stops_a_part_hard_stops_the_other_and_neither_moves_before_it_is_reset(cause: str) -> None:
    act, mode, watchdog = HARD[cause]
    rig = moving()
    rig.cerebellum.take_flags()
    act(rig)
    rig.tick(2)
    assert rig.mode == mode
    limits, watchdogs = rig.cerebellum.take_flags()
    assert int(watchdogs[0]) == watchdog
    assert "not finite" not in cause or limits[0] & Limit.NON_FINITE
    seen = [rig.twist]
    while any(seen[-1]):
        rig.tick()
        seen.append(rig.twist)
    falls = [np.abs(before) - np.abs(after) for before, after in pairwise(seen)]
    np.testing.assert_allclose(
        falls[:-1], np.minimum(np.abs(seen[:-2]), STOP), rtol=1e-6, atol=1e-9
    )  # as hard as it may
    rig.tick(HZ)
    rest = rig.cerebellum.written.copy()
    assert not rig.send(MOVING).accepted.any()
    rig.push(MOVING)
    assert rig.go(**SWEEP) is not None
    rig.tick(HZ)
    np.testing.assert_array_equal(rig.cerebellum.written, rest)
    rig.plant.fault[:] = False
    rig.plant.lie.clear()
    rig.tick()
    for request in (Request.RESET, Request.ACTIVATE):
        assert rig.request(request).accepted.all()
    rig.tick(50)
    np.testing.assert_array_equal(rig.cerebellum.written, rest)
    rig.stream(MOVING, 3)
    assert rig.mode == Mode.TRACKING


def test_a_reset_waits_for_arm_and_base() -> None:
    rig = moving()
    rig.cerebellum.estop.press()
    rig.tick()
    ticks = abs(rig.twist[0]) / STOP[0]
    at_rest: list[tuple[bool, bool]] = []
    while not rig.request(Request.RESET).accepted.all():
        at_rest.append((bool(rig.controller.arm.at_rest()[0]), bool(rig.controller.drive.at_rest()[0])))
        rig.tick()
    assert (True, True) not in at_rest
    assert len(at_rest) >= int(ticks)  # the base takes longer


def test_a_drive_brakes_for_what_is_not_finite() -> None:
    rig = moving()
    rig.push(NAN_IN_DRIVE)
    rig.tick(FRAME)
    assert rig.mode == Mode.TRACKING
    assert int(rig.cerebellum.take_flags()[0][0]) & Limit.NON_FINITE
    for _ in range(30):
        rig.push(NAN_IN_DRIVE)
        rig.tick(FRAME)
    assert rig.twist == [0.0, 0.0]


@pytest.mark.parametrize("how", ["silence", "deactivate"])
def test_a_silent_brain_and_a_deactivation_stop_both_and_the_mode_waits_for_both(how: str) -> None:
    rig = moving()
    if how == "deactivate":
        rig.request(Request.DEACTIVATE)
    else:
        rig.tick(TIMEOUT_TICKS)
    rig.tick(FRAME)
    assert rig.mode == Mode.STOPPING
    while rig.mode == Mode.STOPPING:
        before = rig.controller.at_rest().all()
        rig.tick()
    assert before
    assert rig.mode == (Mode.SAFE_OFF if how == "deactivate" else Mode.HOLD)
    assert rig.twist == [0.0, 0.0]
    assert not rig.controller.arm.velocity.any()
    rest = rig.cerebellum.written.copy()
    rig.tick(HZ)
    np.testing.assert_array_equal(rig.cerebellum.written, rest)


@pytest.mark.parametrize("goal", [SWEEP, {"gripper": 0.054}, {"joint_target": (9.0, 0.0, 0.0, 0.0)}])
def test_while_a_goal_is_followed_the_base_comes_to_rest_and_holds_only_once_it_has(goal: dict[str, Any]) -> None:
    rig = moving()
    refused = rig.go(**goal) is not None
    speeds = []
    for _ in range(2000):
        rig.tick()
        speeds.append(np.abs(rig.twist))
        assert rig.mode != Mode.HOLD or not speeds[-1].any()
        if refused and rig.mode == Mode.STOPPING:
            return  # a refused goal changes nothing: setpoints were followed until they grew old
        if rig.mode == Mode.HOLD:
            break
    assert not refused
    assert rig.mode == Mode.HOLD
    assert rig.results() == [("1", ResultCode.SUCCEEDED)]
    slower = np.diff(speeds[60:], axis=0)  # an acceleration has ended by then
    assert (slower <= 0).all()


def block_wheels(rig: Rig) -> None:
    rig.plant.stuck[:, WHEELS] = True


def freeze_encoder(rig: Rig) -> None:
    rig.plant.lie[0] = {6: float(rig.plant.position[0, 6])}


def block_arm(rig: Rig) -> None:
    rig.plant.stuck[:, 0] = True


@pytest.mark.parametrize(
    ("act", "watchdog", "cause"),
    [
        (block_wheels, Watchdog.BLOCKED, "wheels"),
        (freeze_encoder, Watchdog.BLOCKED, "wheels"),
        (block_arm, Watchdog.BLOCKED, "arm"),
    ],
)
def test_whatever_blocks_a_part_is_one_protective_stop_of_both_whose_cause_is_named(
    act: Callable[[Rig], None], watchdog: Watchdog, cause: str
) -> None:
    rig = moving()
    for again in range(2):  # the second time after a reset
        act(rig)
        for frame in range(100):
            if rig.mode == Mode.FAULT:
                break
            rig.send(off(0.2, 0.6, j0=0.5 if frame % 20 < 10 else -0.5))
            rig.tick(FRAME)
        assert rig.mode == Mode.FAULT
        assert int(rig.cerebellum.take_flags()[1][0]) == watchdog
        assert cause in rig.controller.cause
        rig.plant.stuck[:] = False
        rig.tick(2 * HZ)
        assert rig.twist == [0.0, 0.0]
        assert int(rig.cerebellum.take_flags()[1][0]) == Watchdog.NONE  # and nothing more is found while it stands
        if act is freeze_encoder:
            return
        for request in (Request.RESET, Request.ACTIVATE):
            assert rig.request(request).accepted.all(), again
        act = block_arm if act is block_wheels else block_wheels
        cause = "arm" if act is block_arm else "wheels"
        rig.stream(MOVING, 16)


def test_a_gyroscope_that_contradicts_the_wheels_stops_both() -> None:
    rig = Rig(gyro=0)
    for _ in range(60):
        rig.send(MOVING)
        rig.tick(FRAME)
    assert rig.mode == Mode.FAULT
    assert int(rig.cerebellum.take_flags()[1][0]) == Watchdog.PLANT
    assert "gyroscope" in rig.controller.cause
    rig.tick(HZ)
    assert rig.twist == [0.0, 0.0]
    assert not rig.controller.arm.velocity.any()


@pytest.mark.parametrize("stage", [Stage.BEGUN, Stage.GOALS, Stage.STOPPED, Stage.ENDED])
@pytest.mark.parametrize("is_raised", [False, True], ids=["e-stop", "exception"])
def test_a_stop_in_the_middle_of_a_tick_that_waits_is_the_next_ticks(stage: Stage, is_raised: bool) -> None:
    rig = moving()
    serve, done = rig.controller.serve, []

    def meanwhile(sim: int) -> None:
        if rig.controller.arms["stage"][sim] == stage and not done:
            done.append(stage)
            rig.cerebellum.estop.press()
            if is_raised:
                raise KeyboardInterrupt
        serve(sim)

    rig.controller.serve = meanwhile  # type: ignore[method-assign]
    if stage == Stage.STOPPED:
        rig.plant.fault[:] = True
    rig.go(**SWEEP)
    for _ in range(600):
        rig.send(MOVING) if stage == Stage.BEGUN else None
        try:
            rig.tick()
        except KeyboardInterrupt:
            rig.now += TICK_NS
        if done:
            break
    assert done
    rig.tick()
    assert rig.mode == Mode.ESTOP
    rig.plant.fault[:] = False
    before = np.abs(rig.twist)
    rig.tick(5)
    np.testing.assert_allclose(np.abs(rig.twist), np.maximum(before - 5 * STOP, 0.0), atol=1e-9)
    rig.tick(2 * HZ)
    rest = rig.cerebellum.written.copy()
    rig.tick(HZ)
    np.testing.assert_array_equal(rig.cerebellum.written, rest)
    assert not rest[0, WHEELS].any()


def test_a_restart_and_a_recovery_leave_wheels_that_stand_and_an_arm_where_it_is() -> None:
    rig = moving(n=2)
    other = rig.cerebellum.written[1].copy()
    rig.cerebellum.restart(np.array([0]))
    rig.plant.anew[0] = True
    np.testing.assert_array_equal(rig.cerebellum.written[1], other)
    assert not rig.cerebellum.written[0, WHEELS].any()
    np.testing.assert_array_equal(rig.cerebellum.written[0, ARM], rig.cerebellum.command[0, ARM])
    rig.tick(50)
    assert not rig.cerebellum.written[0, WHEELS].any()
    rig.cerebellum.estop.press()
    rig.tick(2 * HZ)
    assert rig.mode == Mode.ESTOP
    moved = rig.plant.position.copy()
    moved[:, :2] += 0.1  # it has stopped by itself elsewhere, and somebody has pushed it
    moved[:, WHEELS] += 7.0
    rig.plant.position, rig.plant.recover = moved, lambda: True
    rig.plant.anew[:] = True
    assert rig.request(Request.RESET).accepted.all()
    np.testing.assert_allclose(rig.cerebellum.written[1, :4], moved[1, :4])
    assert not rig.cerebellum.written[:, WHEELS].any()
    for request in (Request.CONFIGURE, Request.ACTIVATE):
        rig.request(request)
    rig.tick(50)
    assert (rig.cerebellum.mode == Mode.HOLD).all()
    assert rig.cerebellum.state(rig.now).odometry[0].tolist() == [0, 0, 0]


ROBOTS: dict[bool, tuple[Any, Any, int, tuple[float, ...]]] = {
    False: (arm_rig.Rig, arm_rig.HOME, 6, (1, 1, 1, 1, 1, 1, 0.05)),
    True: (Rig, HOME, 4, (1, 1, 1, 1, 0.05, 1, 4)),
}
"""Of an arm, and of one on a base: the rig, where it is at home, its joints, and how far its commands are spread."""


def follow(on_base: bool, n: int, robot: int) -> np.ndarray:
    """Return what is written to a robot whose number among n says nothing of what it does."""
    make, home, dof, spread = ROBOTS[on_base]
    rig, rngs, rows = make(n), [np.random.default_rng(sim if n > 1 else robot) for sim in range(n)], []
    for _ in range(50):
        for sim, own in enumerate(rngs):
            draw, values, one = own.random(), home + own.normal(0, 0.2, 7) * spread, np.array([sim])
            if draw < 0.45:
                rig.sequence += 1
                setpoint = Setpoint(rig.sequence, rig.now, np.broadcast_to(values, (n, 7)))
                rig.cerebellum.offer(setpoint, np.arange(n) == sim)
            elif draw < 0.55:
                rig.go(sim, joint_target=tuple(values[:dof].tolist()), gripper=0.02, preempt=draw < 0.5)
            elif draw < 0.58:
                rig.cerebellum.estop.press(one)
            elif draw < 0.61:
                rig.plant.lie[sim] = {int(own.integers(7)): np.nan}
            elif draw < 0.72:
                rig.plant.lie.pop(sim, None)
            elif draw < 0.75 and not on_base:
                rig.cerebellum.restart(one)
                rig.request(Request.CONFIGURE, one)
            elif draw < 0.92:
                for request in (Request.RESET, Request.ACTIVATE):
                    rig.request(request, one)
        rig.tick(FRAME)
        rows.append(rig.cerebellum.written[robot if n > 1 else 0].copy())
    return np.array(rows)


@pytest.mark.parametrize("robot", range(3))
@pytest.mark.parametrize("on_base", ROBOTS)
def test_a_robot_among_others_is_bit_for_bit_the_robot_alone(on_base: bool, robot: int) -> None:
    np.testing.assert_array_equal(follow(on_base, 3, robot), follow(on_base, 1, robot))
