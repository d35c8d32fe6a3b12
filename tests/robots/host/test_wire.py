"""Processes that write what they must not, or nothing: what an arm on the wall clock then gets and does."""

import json
import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.control.arm.wrench import tool_wrench
from bhd_lerobot.control.commands import BrainCommand, GoalPhase, Pose
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.planning_link import PlanningLink
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5 import UR5
from tests.forks import Fork
from tests.robots.host.support import States, mode, relaxed, unique, watchdog_count
from tests.waiting import until

NAME = unique("wire")
HZ = 500
AWAY_S = 0.3
DOWN = (0.0, 0.7071067811865476, 0.7071067811865476, 0.0)


@pytest.fixture(scope="module")
def connected() -> Iterator[tuple[UR5, States]]:
    with UR5(UR5Config(id=NAME, clock="realtime", realtime=relaxed())) as robot:
        states = States(NAME)
        yield robot, states
        states.block.close()


@pytest.fixture
def arm(connected: tuple[UR5, States]) -> tuple[UR5, States]:
    robot, states = connected
    if mode(robot) in (Mode.FAULT, Mode.ESTOP):
        lead_out(robot)
    until(lambda: mode(robot) == Mode.HOLD, "the arm holds")
    robot.host.bridge.take_results()
    states.read().all.clear()
    return robot, states


def lead_out(robot: UR5) -> None:
    def active() -> bool:
        reset = robot.host.bridge.reset()
        return bool(reset.accepted.all()) and bool(robot.host.bridge.activate().accepted.all())

    until(active, "it is active")


def turn(robot: UR5, name: str, by: float) -> None:
    bridge = robot.host.bridge
    target = np.asarray(bridge.state().command)[0, :6] + np.array([by, 0, 0, 0, 0, 0])
    assert bridge.submit(BrainCommand(name, joint_target=tuple(target.tolist()), timeout_s=60.0)) is None
    until(lambda: (one := bridge.feedback()) is not None and one.phase == GoalPhase.EXECUTING, "it is followed")


def expect_no_jump(states: States, robot: UR5) -> None:
    """The joints moved no further than their limits allow, with a tenth for the servos' overshoot."""
    ticks = np.diff([int(state["tick"]) for state in states.read().all])
    positions = np.array([state["joint_positions"][0] for state in states.all])
    assert np.isfinite(positions).all()
    limits = robot.host.body.limits  # type: ignore[union-attr]
    most = 1.1 * np.array(limits.velocity[:6]) / HZ * ticks[:, None]
    assert (np.abs(np.diff(positions[:, :6], axis=0)) <= most).all()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("what", ["not a number", "a jump"])
def test_garbage_over_the_rows_of_a_trajectory_stops_the_arm(arm: tuple[UR5, States], what: str) -> None:
    robot, states = arm
    turn(robot, f"garbage {what}", 1.0 if what == "a jump" else -1.0)
    link = PlanningLink(states.block.section("plan"), 6, HZ)
    rows = link._memory.rows
    rows[...] = np.nan if what == "not a number" else rows + 1.0
    until(lambda: states.has(Mode.FAULT), "it is a fault")
    until(lambda: watchdog_count(states.read().all[-1], Watchdog.GUARD), "the guard is named")
    until(lambda: not robot.host.bridge.state().is_moving.any(), "the arm rests")
    expect_no_jump(states, robot)


def test_a_cerebellum_that_was_away_does_not_catch_up_at_the_wire(arm: tuple[UR5, States]) -> None:
    robot, states = arm
    turn(robot, "away", 0.8)
    pid = robot.host.link.pids["cerebellum"]
    os.kill(pid, signal.SIGSTOP)
    time.sleep(AWAY_S)
    os.kill(pid, signal.SIGCONT)
    until(robot.host.bridge.take_results, "the goal ends")
    commands = np.array([state["command"][0] for state in states.read().all])
    skipped = np.diff([int(state["skipped"]) for state in states.all])
    assert skipped.max() > AWAY_S * HZ / 2  # it was away
    limits = robot.host.body.limits  # type: ignore[union-attr]
    assert (np.abs(np.diff(commands, axis=0)) <= 1.001 * np.array(limits.velocity) / HZ).all()


def test_what_a_silent_brain_left_in_the_queue_moves_nothing_later(arm: tuple[UR5, States]) -> None:
    robot, states = arm
    action = robot.get_observation()
    robot.send_action({name: action[name] for name in robot.action_features})
    until(lambda: states.has(Mode.TRACKING), "it is commanded")
    where = np.asarray(robot.host.bridge.state().command).copy()
    late = robot.host.bridge.now_ns + round(0.5e9)
    assert states.block.fifo.push(10**6, late, where + 0.3, np.ones(1, np.bool_))
    until(lambda: states.read().all[-1]["mode"][0] == Mode.HOLD, "it holds")
    until(lambda: robot.host.bridge.now_ns > late + 10**8, "it would have been due")
    assert np.abs(robot.host.bridge.state().command - where).max() < 1e-3
    assert mode(robot) == Mode.HOLD


def press_often(name: str, times: int) -> None:
    """Press an arm's emergency stop at random moments, and say when."""
    block, rng = LiveBlock.attach(name), random.Random(0)
    pressed = []
    for _ in range(times):
        time.sleep(rng.uniform(0.0, 0.01))
        before = time.monotonic_ns()
        block.estop.press()
        pressed.append((before, time.monotonic_ns()))
    print(json.dumps(pressed), flush=True)
    block.close()


def test_no_press_around_a_reset_is_lost(arm: tuple[UR5, States], tmp_path: Path) -> None:
    robot, states = arm
    child = Fork(press_often, NAME, 100, output=tmp_path / "presses")
    resets = 0
    while child.poll() is None:
        resets += bool(robot.host.bridge.reset().accepted.all())
    assert resets > 3
    presses = json.loads((tmp_path / "presses").read_text())
    until(lambda: states.read().all[-1]["start_ns"] > presses[-1][1], "a tick after the last press")
    starts = np.array([int(state["start_ns"]) for state in states.all])
    stopped = [bool(state["emergency_stop"][0]) for state in states.all]
    for _, pressed_ns in presses:
        # The first tick that began after it found it: it is stopped at the end of that tick, or was before it, and has
        # been reset meanwhile.
        tick = int(np.searchsorted(starts, pressed_ns, "right"))
        assert stopped[tick] or stopped[tick - 1]


@pytest.fixture
def pressing() -> Iterator[tuple[UR5, Callable[[], float]]]:
    """An arm that presses from above on a box, and what it presses with [N], from the torques of an arm at rest."""
    name = unique("press")
    config = UR5Config(
        id=name, clock="realtime", scene="pick", seed=3, max_force=float("inf"), realtime=relaxed(plant_timeout_s=20.0)
    )
    robot = UR5(config)
    robot.connect()
    states = States(name)
    body = robot.host.body
    dynamics, forward = ArmDynamics(body), ForwardKinematics(body.chain)  # type: ignore[arg-type, attr-defined]

    def force() -> float:
        state = states.read().all[-1]
        position, still = state["joint_positions"][:, :6], np.zeros((1, 6))
        torque = state["joint_efforts"][:, :6] - dynamics.torque(position, still, still)
        wrench = tool_wrench(forward.jacobian(position), torque)
        return float(np.linalg.norm(wrench[0, :3]))

    def go(height: float, number: int) -> None:
        pose = Pose((x, y, height), DOWN)
        goal = BrainCommand(f"go {number}", target_pose=pose, gripper=0.0, max_velocity=0.5, timeout_s=600.0)
        assert robot.host.bridge.submit(goal) is None
        until(robot.take_results, "the goal has ended")

    names, values = robot.environment
    scene = dict(zip(names, values.tolist(), strict=True))
    x, y, top = scene["object_0_x"], scene["object_0_y"], 2 * scene["object_0_z"]
    height = top + 0.05
    go(height, 0)
    number = 0
    while force() < 60.0:
        number += 1
        height -= 0.01 if height > top + 0.025 else 0.001
        go(height, number)
    yield robot, force
    states.block.close()
    robot.disconnect()


@pytest.mark.thorough
def test_after_an_emergency_stop_an_arm_presses_no_more_nor_after_a_reset(
    pressing: tuple[UR5, Callable[[], float]],
) -> None:
    robot, force = pressing
    robot.estop()
    until(lambda: mode(robot) == Mode.ESTOP, "the emergency stop is latched")
    until(lambda: force() < 20.0, "it has given way")
    lead_out(robot)
    assert mode(robot) == Mode.HOLD
    assert force() < 20.0
