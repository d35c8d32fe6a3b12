"""An arm on the wall clock: goals from another process, and processes that write what they must not, or nothing."""

import json
import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand, CommandResult, GoalPhase, Pose, ResultCode
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.planning_link import PlanningLink
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.ur import UR5
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


TARGETS = ((0.3, 0.2, 0.4), (0.4, -0.1, 0.35))


def goal(name: str, target: int, speed: float = 1.0) -> BrainCommand:
    pose = Pose(TARGETS[target], (0.0, 1.0, 0.0, 0.0))
    return BrainCommand(name, target_pose=pose, max_velocity=speed, timeout_s=60.0)


def result(robot: UR5) -> CommandResult:
    """Wait for the next result, and return it: there is exactly one."""
    found: list[CommandResult] = []

    def take() -> bool:
        found.extend(robot.host.bridge.take_results())
        return bool(found)

    until(take, "the goal ends")
    assert len(found) == 1
    return found[0]


def start(robot: UR5, command: BrainCommand) -> Any:
    """Send a goal and wait until it is followed; return the first feedback."""
    bridge = robot.host.bridge
    assert bridge.submit(command) is None
    return until(
        lambda: (one := bridge.feedback()) is not None and one.task_id == command.task_id and one, "it is followed"
    )


def test_a_goal_is_accepted_gives_feedback_and_succeeds(arm: tuple[UR5, States]) -> None:
    robot, _ = arm
    bridge = robot.host.bridge
    progress = [start(robot, goal("there", 0)).progress]

    def follow() -> bool:
        one = bridge.feedback()
        if one is not None:
            progress.append(one.progress)
        return one is None

    until(follow, "the goal ends")
    ended = result(robot)
    assert (ended.task_id, ended.code) == ("there", ResultCode.SUCCEEDED)
    assert progress == sorted(progress)
    assert 0 <= progress[0] < progress[-1] <= 1
    position = robot.host.kinematics.tool(bridge.state().joint_positions[0, :-1])[:3, 3]
    assert np.linalg.norm(position - TARGETS[0]) < 0.01
    until(lambda: mode(robot) == Mode.HOLD, "it holds")


def test_a_goal_is_refused_with_a_reason(arm: tuple[UR5, States]) -> None:
    robot, _ = arm
    refusal = robot.host.bridge.submit(BrainCommand("far", target_pose=Pose((2.0, 0.0, 0.3), (0.0, 1.0, 0.0, 0.0))))
    # It is planned in another process; where that finds out, the refusal comes as the result.
    ended = refusal or result(robot)
    robot.host.bridge.take_results()
    assert (ended.task_id, ended.success, ended.code) == ("far", False, ResultCode.UNREACHABLE)


def test_an_emergency_stop_ends_the_goal_and_refuses_the_next(arm: tuple[UR5, States]) -> None:
    robot, _ = arm
    start(robot, goal("stopped", 1, speed=0.2))
    robot.estop()
    assert result(robot).code == ResultCode.ESTOP
    assert mode(robot) == Mode.ESTOP
    bridge = robot.host.bridge
    refusal = bridge.submit(goal("next", 1))
    assert refusal is not None
    assert refusal.code == ResultCode.ESTOP
    bridge.take_results()
    until(lambda: bridge.reset().accepted[0], "the arm is at rest")
    refusal = bridge.submit(goal("inactive", 1))
    assert refusal is not None
    assert refusal.code == ResultCode.NOT_ACTIVE
    bridge.take_results()
    robot.activate()
    start(robot, goal("after", 1))
    assert result(robot).code == ResultCode.SUCCEEDED


def turn(robot: UR5, name: str, by: float) -> None:
    bridge = robot.host.bridge
    target = np.asarray(bridge.state().command)[0, :6] + np.array([by, 0, 0, 0, 0, 0])
    assert bridge.submit(BrainCommand(name, joint_target=tuple(target.tolist()), timeout_s=60.0)) is None
    until(lambda: (one := bridge.feedback()) is not None and one.phase == GoalPhase.EXECUTING, "it is followed")


def expect_no_jump(states: States, robot: UR5) -> None:
    """The joints moved no further than their limits allow, with a tenth for the servos' overshoot."""
    ticks = np.diff([int(state["tick"]) for state in states.read().all])
    positions = np.array([state["state"]["position"][:7] for state in states.all])
    assert np.isfinite(positions).all()
    limits = robot.host.body.limits  # type: ignore[union-attr]
    most = 1.1 * np.array(limits.velocity[:6]) / HZ * ticks[:, None]
    assert (np.abs(np.diff(positions[:, :6], axis=0)) <= most).all()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("what", ["not a number", "a jump"])
def test_garbage_over_the_rows_of_a_trajectory_stops_the_arm(arm: tuple[UR5, States], what: str) -> None:
    robot, states = arm
    turn(robot, f"garbage {what}", 1.0 if what == "a jump" else -1.0)
    link = PlanningLink(states.block.section("plan"), 6, 7, HZ)
    rows = link._memory.rows
    rows[...] = np.nan if what == "not a number" else rows + 1.0
    until(lambda: states.has(Mode.FAULT), "it is a fault")
    until(lambda: watchdog_count(states.read().all[-1], Watchdog.GUARD), "the guard is named")
    until(lambda: not robot.host.bridge.state().is_moving.any(), "the arm rests")
    expect_no_jump(states, robot)


def test_a_cerebellum_that_was_away_does_not_catch_up_at_the_wire(arm: tuple[UR5, States]) -> None:
    robot, states = arm
    turn(robot, "away", 0.8)
    pid = robot.host.link.pid
    os.kill(pid, signal.SIGSTOP)
    time.sleep(AWAY_S)
    os.kill(pid, signal.SIGCONT)
    until(robot.host.bridge.take_results, "the goal ends")
    commands = np.array([state["state"]["command"][:7] for state in states.read().all])
    skipped = np.diff([int(state["skipped"]) for state in states.all])
    assert skipped.max() > AWAY_S * HZ / 2  # it was away
    limits = robot.host.body.limits  # type: ignore[union-attr]
    assert (np.abs(np.diff(commands, axis=0)) <= 1.001 * np.array(limits.velocity) / HZ).all()


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
    stopped = [state["state"]["mode"] == Mode.ESTOP for state in states.all]
    for _, pressed_ns in presses:
        # The first tick that began after it found it: it is stopped at the end of that tick, or was before it, and has
        # been reset meanwhile.
        tick = int(np.searchsorted(starts, pressed_ns, "right"))
        assert stopped[tick] or stopped[tick - 1]
