"""An arm on the wall clock: goals from another process, cancelled, stopped, and LeRobot's contract."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose, ResultCode
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.conformance import check_robot
from bhd_lerobot.robots.ur5 import UR5
from tests.robots.host.support import is_gone, mode, relaxed, unique
from tests.waiting import until

NAME = unique("arm")
TARGETS = ((0.3, 0.2, 0.4), (0.4, -0.1, 0.35))


def ur5(name: str) -> UR5:
    return UR5(UR5Config(id=name, clock="realtime", realtime=relaxed()))


@pytest.fixture(scope="module")
def arm() -> Iterator[UR5]:
    with ur5(NAME) as robot:
        yield robot
    assert is_gone(NAME)


def goal(name: str, target: int, speed: float = 1.0) -> BrainCommand:
    pose = Pose(TARGETS[target], (0.0, 1.0, 0.0, 0.0))
    return BrainCommand(name, target_pose=pose, max_velocity=speed, timeout_s=60.0)


def result(arm: UR5) -> CommandResult:
    """Wait for the next result, and return it: there is exactly one."""
    found: list[CommandResult] = []

    def take() -> bool:
        found.extend(arm.host.bridge.take_results())
        return bool(found)

    until(take, "the goal ends")
    assert len(found) == 1
    return found[0]


def start(arm: UR5, command: BrainCommand) -> Any:
    """Send a goal and wait until it is followed; return the first feedback."""
    bridge = arm.host.bridge
    assert bridge.submit(command) is None
    return until(
        lambda: (one := bridge.feedback()) is not None and one.task_id == command.task_id and one, "it is followed"
    )


def test_a_goal_is_accepted_gives_feedback_and_succeeds(arm):
    command = goal("there", 0)
    feedback = [start(arm, command)]
    bridge = arm.host.bridge
    found: list[CommandResult] = []

    def follow() -> bool:
        one = bridge.feedback()
        if one is not None and one.task_id == command.task_id:
            feedback.append(one)
        found.extend(bridge.take_results())
        return bool(found)

    until(follow, "the goal ends")
    assert [one.code for one in found] == [ResultCode.SUCCEEDED]
    assert found[0].task_id == "there"
    progress = [one.progress for one in feedback]
    assert progress == sorted(progress)
    assert 0 <= progress[0] < progress[-1] <= 1
    position = arm.host.mirror.kinematics.tool(bridge.state().joint_positions[0, :-1])[:3, 3]
    assert np.linalg.norm(position - TARGETS[0]) < 0.01
    until(lambda: mode(arm) == Mode.HOLD, "it holds")


def test_a_goal_is_refused_with_a_reason(arm):
    refusal = arm.host.bridge.submit(BrainCommand("far", target_pose=Pose((2.0, 0.0, 0.3), (0.0, 1.0, 0.0, 0.0))))
    # It is planned in another process; where that finds out, the refusal comes as the result.
    ended = refusal or result(arm)
    arm.host.bridge.take_results()
    assert (ended.task_id, ended.success, ended.code) == ("far", False, ResultCode.UNREACHABLE)


def test_a_cancelled_goal_ends_as_such_and_the_arm_holds(arm):
    start(arm, goal("cancelled", 1, speed=0.2))
    assert arm.host.bridge.cancel("cancelled") == ResultCode.SUCCEEDED
    assert result(arm).code == ResultCode.CANCELLED
    until(lambda: mode(arm) == Mode.HOLD, "it holds")
    assert arm.host.bridge.cancel("cancelled") == ResultCode.UNKNOWN_ID


def test_an_emergency_stop_ends_the_goal_and_refuses_the_next(arm):
    start(arm, goal("stopped", 1, speed=0.2))
    arm.estop()
    assert result(arm).code == ResultCode.ESTOP
    assert mode(arm) == Mode.ESTOP
    bridge = arm.host.bridge
    refusal = bridge.submit(goal("next", 1))
    assert refusal is not None
    assert refusal.code == ResultCode.ESTOP
    bridge.take_results()
    until(lambda: bridge.reset().accepted[0], "the arm is at rest")
    refusal = bridge.submit(goal("inactive", 1))
    assert refusal is not None
    assert refusal.code == ResultCode.NOT_ACTIVE
    bridge.take_results()
    arm.activate()
    start(arm, goal("after", 1))
    assert result(arm).code == ResultCode.SUCCEEDED


def test_an_action_replaces_a_goal(arm):
    start(arm, goal("replaced", 0, speed=0.2))
    observation = arm.get_observation()
    arm.send_action({name: observation[name] for name in arm.action_names})
    assert result(arm).code == ResultCode.REPLACED_BY_SETPOINT


def test_it_keeps_lerobots_contract():
    assert check_robot(lambda: ur5(unique("arm-contract")), adversarial=True) == ()
    assert is_gone(unique("arm-contract"))
