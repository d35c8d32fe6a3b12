"""The state machine of goals, edge by edge, and every way in which a goal can end."""

from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import GoalPhase, ResultCode
from tests.cases import each_case
from tests.control.goal_rig import ARM, HOME, HZ, Rig, joints, moved

FAR = joints(2.0)
NEAR = joints(0.2)


def started(n: int = 1, ticks: int = 100, **fields: Any) -> Rig:
    """Return a rig in the middle of the motion of a goal "a"."""
    rig = Rig(n)
    for sim in range(n):
        assert rig.go("a", sim, **(fields or {"joint_target": FAR})) is None
    rig.tick(ticks)
    return rig


def at_rest(rig: Rig) -> bool:
    return not rig.velocity.any() and not rig.acceleration.any()


@each_case(
    "fields",
    [
        {"joint_target": NEAR, "gripper": 0.03},
        {"target_pose": moved(0.1, 0.1, 0.1)},
        {"target_pose": moved(0.1, 0.1, 0.1), "motion": "line"},
        {"gripper": 0.0},
    ],
)
def test_a_goal_from_idle_to_idle(fields: dict[str, Any]) -> None:
    rig = Rig()
    assert rig.phase == GoalPhase.IDLE
    assert rig.manager.feedback(0) is None
    assert rig.go("a", **fields) is None
    assert rig.phase == GoalPhase.CONVERTING
    assert rig.manager.busy.all()
    assert not rig.manager.following.any()
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING  # in lockstep, conversion takes no time
    assert rig.manager.following.all()
    feedback = []
    while (now := rig.manager.feedback(0)) is not None:
        assert now.phase == GoalPhase.EXECUTING
        feedback.append((now.progress, -now.remaining_s))
        rig.tick()
    assert feedback == sorted(feedback)
    assert feedback[-1] == (1.0, 0.0)
    rig.run()
    assert rig.phase == GoalPhase.IDLE
    assert rig.results() == [("a", ResultCode.SUCCEEDED)]
    assert rig.results() == []
    assert not rig.manager.following.any()


def test_a_goal_that_is_cancelled_ends_when_the_arm_has_come_to_rest() -> None:
    rig = started()
    assert rig.manager.cancel(0, "a") == ResultCode.SUCCEEDED
    assert rig.manager.cancel(0, "a") == ResultCode.SUCCEEDED
    rig.tick()
    assert rig.results() == []
    assert rig.phase == GoalPhase.EXECUTING
    rig.run()
    assert at_rest(rig)
    assert rig.results() == [("a", ResultCode.CANCELLED)]
    assert rig.phase == GoalPhase.IDLE
    assert HOME[0] < rig.position[0, 0] < FAR[0]
    assert rig.manager.cancel(0, "a") == ResultCode.UNKNOWN_ID


def test_a_goal_that_waits_is_cancelled_at_once() -> None:
    rig = started()
    rig.go("b", joint_target=NEAR)
    assert rig.manager.cancel(0, "b") == ResultCode.SUCCEEDED
    assert rig.results() == [("b", ResultCode.CANCELLED)]
    rig.run()
    assert rig.results() == [("a", ResultCode.SUCCEEDED)]
    assert rig.manager.cancel(0, "never") == ResultCode.UNKNOWN_ID
    rig.go("c", joint_target=FAR)
    rig.manager.cancel(0, "c")
    assert rig.phase == GoalPhase.IDLE
    assert not rig.manager.busy.any()


@pytest.mark.parametrize("fields", [{"joint_target": NEAR}, {"target_pose": moved(0.1, 0.1)}, {"gripper": 0.04}])
def test_a_goal_that_preempts_ends_all_others_and_starts_in_motion(fields: dict[str, Any]) -> None:
    rig = started()
    rig.go("b", joint_target=joints())
    speed = rig.velocity[0, 0]
    rig.go("c", **fields, preempt=True)
    assert rig.results() == [("a", ResultCode.PREEMPTED), ("b", ResultCode.PREEMPTED)]
    rig.tick()
    assert abs(rig.velocity[0, 0] - speed) <= ARM.limits.acceleration[0] / HZ + 1e-9
    rig.run()
    assert rig.results() == [("c", ResultCode.SUCCEEDED)]


def test_a_goal_that_preempts_a_brake_takes_over_but_never_a_hard_one() -> None:
    rig = started()
    rig.manager.cancel(0, "a")
    rig.tick(2)
    rig.go("b", joint_target=NEAR, preempt=True)
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING
    assert rig.velocity[0, 0] > 0
    rig.run()
    rig = started()
    rig.stop(ResultCode.ESTOP, hard=True)
    rig.go("b", joint_target=NEAR, preempt=True)
    while not at_rest(rig):
        assert rig.phase == GoalPhase.CONVERTING
        rig.tick()
    rig.run()
    assert rig.results() == [("a", ResultCode.ESTOP), ("b", ResultCode.SUCCEEDED)]


def test_a_gripper_goes_on_to_its_target_under_a_goal_for_the_arm_and_stays_where_it_was_stopped() -> None:
    rig = started(ticks=50, gripper=0.01)
    assert rig.velocity[0, 6] < 0
    rig.go("b", joint_target=NEAR, preempt=True)
    rig.run()
    assert rig.position[0, 6] == 0.01
    rig = started(ticks=50, gripper=0.01)
    rig.manager.cancel(0, "a")
    rig.run()
    stopped = rig.position[0, 6]
    assert 0.02 < stopped < 0.08
    rig.go("b", joint_target=NEAR)
    rig.run()
    assert rig.position[0, 6] == stopped


def test_a_goal_that_is_refused_preempts_nothing() -> None:
    rig = started()
    refusal = rig.go("b", joint_target=joints(9.0), preempt=True)
    assert refusal is not None
    assert refusal.code == ResultCode.JOINT_LIMIT
    rig.run()
    assert rig.results() == [("b", ResultCode.JOINT_LIMIT), ("a", ResultCode.SUCCEEDED)]


def test_a_name_can_be_used_again_once_its_goal_has_ended() -> None:
    rig = started()
    rig.go("b", joint_target=NEAR)
    for name in "ab":
        live = rig.go(name, joint_target=NEAR)
        assert live is not None
        assert live.code == ResultCode.DUPLICATE_ID
    assert rig.results() == []  # they still get their own
    rig.run()
    assert len(rig.results()) == 2
    assert rig.go("a", joint_target=joints(9.0)) is not None  # refused, so that it has ended, too
    assert rig.go("a", joint_target=FAR) is None
    rig.run()
    assert rig.results() == [("a", ResultCode.JOINT_LIMIT), ("a", ResultCode.SUCCEEDED)]


def test_the_queue_is_finite() -> None:
    rig = Rig()
    assert [rig.go(name, joint_target=NEAR) is None for name in "abcdefghi"] == [True] * 8 + [False]
    assert rig.results() == [("i", ResultCode.QUEUE_FULL)]
    rig.tick()
    assert rig.go("j", joint_target=NEAR) is None  # "a" is followed and waits no longer
    assert rig.go("k", joint_target=NEAR, preempt=True) is None
    rig.run()
    assert len(rig.results()) == 10


def test_a_goal_that_cannot_be_planned_fails_and_the_next_one_is_taken() -> None:
    rig = Rig()
    rig.go("a", target_pose=moved(2.0))
    rig.go("b", joint_target=NEAR)
    rig.tick()
    assert rig.phase == GoalPhase.ERROR
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING
    rig.run()
    rig.go("c", target_pose=moved(2.0))
    rig.run()
    assert rig.phase == GoalPhase.ERROR
    assert rig.go("d", joint_target=joints()) is None
    assert rig.phase == GoalPhase.CONVERTING
    rig.run()
    assert rig.phase == GoalPhase.IDLE
    codes = [code for _, code in rig.results()]
    assert codes == [ResultCode.UNREACHABLE, ResultCode.SUCCEEDED] * 2


class Lagging:
    """An arm that follows its reference with a first-order lag, and joints that are blocked."""

    def __init__(self, rig: Rig, time_constant_s: float) -> None:
        self.position = rig.position.copy()
        self.share = 1.0 / (time_constant_s * HZ)
        self.lowest_opening = 0.0
        self.blocked: int | None = None

    def __call__(self, rig: Rig) -> None:
        new = self.position + self.share * (rig.position - self.position)
        new[:, 6] = np.maximum(new[:, 6], self.lowest_opening)
        if self.blocked is not None:
            new[:, self.blocked] = self.position[:, self.blocked]
        rig.measured_velocity[:] = (new - self.position) * HZ
        rig.measured_position[:] = self.position = new


def lagging(time_constant_s: float) -> tuple[Rig, Lagging]:
    rig = Rig()
    rig.disturb = arm = Lagging(rig, time_constant_s)
    return rig, arm


def test_a_goal_is_reached_when_the_joints_are_and_not_when_the_reference_is() -> None:
    rig, arm = lagging(0.02)
    rig.go("a", joint_target=FAR)
    rig.run()
    assert rig.results() == [("a", ResultCode.SUCCEEDED)]
    assert np.abs(arm.position[0, :6] - FAR).max() <= 0.002
    assert np.abs(arm.position[0, :6] - FAR).max() > 0


def test_a_joint_that_is_held_back_on_the_way_ends_the_goal() -> None:
    rig, arm = lagging(0.02)
    rig.go("a", joint_target=FAR)
    rig.tick(50)
    arm.blocked = 0
    while rig.phase != GoalPhase.ERROR:
        assert np.abs(rig.measured_position - rig.position)[0, :6].max() <= 0.1 + np.pi / HZ
        rig.tick()
    assert rig.manager.busy.all()  # it brakes
    result = rig.manager.take_results(0)[0]
    assert result.code == ResultCode.PATH_TOLERANCE
    assert "shoulder_pan" in result.message
    rig.run()
    assert at_rest(rig)


@each_case(
    ("position", "velocity", "goal", "seconds", "words"),
    [
        ({2: 0.003}, {}, {"joint_target": NEAR}, 0.5, ("elbow", "0.0030 rad")),
        ({}, {4: 0.02}, {"joint_target": NEAR}, 0.5, ()),
        ({6: 0.05}, {6: -0.003}, {"gripper": 0.0}, 1.5, ()),
    ],
)
def test_what_has_not_arrived_has_a_while_and_then_fails(
    position: dict, velocity: dict, goal: dict[str, Any], seconds: float, words: tuple[str, ...]
) -> None:
    def off(rig: Rig) -> None:
        for joint, by in position.items():
            rig.measured_position[0, joint] = by + (rig.position[0, joint] if joint < 6 else 0.0)
        for joint, speed in velocity.items():
            rig.measured_velocity[0, joint] = speed

    rig = Rig()
    rig.disturb = off
    rig.go("a", **goal)
    rig.tick()
    moving = round(rig.manager.feedback(0).remaining_s * HZ)  # type: ignore[union-attr]
    assert rig.run() == pytest.approx(moving + seconds * HZ, abs=3)
    result = rig.manager.take_results(0)[0]
    assert result.code == ResultCode.GOAL_TOLERANCE
    assert [word for word in words if word not in result.message] == []


@pytest.mark.parametrize("fields", [{}, {"joint_target": FAR}])
def test_a_stalled_gripper_succeeds(fields: dict[str, Any]) -> None:
    rig, arm = lagging(0.02)
    arm.lowest_opening = 0.03
    rig.go("a", gripper=0.0, **fields)
    rig.run()
    result = rig.manager.take_results(0)[0]
    assert result.success
    assert "stalled" in result.message
    assert "0.0300 m" in result.message
    assert rig.position[0, 6] == 0.0  # it keeps on gripping
    rig.go("b", joint_target=NEAR)
    rig.run()
    assert rig.position[0, 6] == 0.0


def test_a_goal_that_takes_too_long_is_braked_and_its_time_starts_with_its_motion() -> None:
    alone = Rig()
    alone.go("a", joint_target=FAR)
    needed = alone.run() / HZ
    rig = Rig()
    for name, target in (("a", FAR), ("b", joints()), ("c", FAR)):
        rig.go(name, joint_target=target, timeout_s=1.1 * needed)
    rig.run()
    assert rig.results() == [(name, ResultCode.SUCCEEDED) for name in "abc"]
    rig = Rig()
    rig.go("a", joint_target=FAR, timeout_s=0.4)
    rig.tick(round(0.4 * HZ) + 1)
    assert rig.results() == [("a", ResultCode.TIMEOUT)]
    assert rig.phase == GoalPhase.ERROR
    assert not at_rest(rig)
    rig.run()
    assert at_rest(rig)


@pytest.mark.law
@pytest.mark.parametrize(
    ("code", "hard", "phase"),
    [
        (ResultCode.ESTOP, True, GoalPhase.ERROR),
        (ResultCode.FAULT, True, GoalPhase.ERROR),
        (ResultCode.CANCELLED, False, GoalPhase.IDLE),
    ],
)
def test_a_stop_ends_all_goals_at_once_and_brakes(code: ResultCode, hard: bool, phase: GoalPhase) -> None:
    rig = started(2)
    rig.go("b", joint_target=NEAR)
    rig.stop(code, hard, np.array([True, False]))
    assert rig.results() == [("a", code), ("b", code)]
    assert rig.phase == phase
    assert rig.manager.feedback(0) is None
    assert rig.manager.busy.tolist() == [True, True]
    assert rig.results(1) == []
    rig.run()
    assert rig.results(1) == [("a", ResultCode.SUCCEEDED)]
    assert rig.position[0, 0] < FAR[0]


def test_a_hard_stop_is_shorter_and_stays_hard() -> None:
    ticks = []
    for hard in (False, True):
        rig = started()
        rig.stop(ResultCode.CANCELLED, hard)
        ticks.append(rig.run())
    assert ticks[1] < 0.75 * ticks[0]
    rig = started()
    rig.stop(ResultCode.ESTOP, hard=True)
    rig.tick(3)
    rig.stop(ResultCode.CANCELLED, hard=False)
    rig.hard[:] = True
    assert rig.run() == ticks[1] - 3
    rig = started()
    rig.stop(ResultCode.CANCELLED, hard=False)
    rig.tick(3)
    rig.stop(ResultCode.ESTOP, hard=True)
    assert 3 + rig.run() < ticks[0]


def test_a_stop_and_a_goal_that_cannot_be_planned_brake_a_reference_that_others_moved() -> None:
    for failing in (False, True):
        rig = Rig()
        rig.velocity[0, 2] = 1.0
        if failing:
            rig.go("a", target_pose=moved(2.0))
            rig.tick()
        else:
            rig.stop(ResultCode.ESTOP, hard=True)
        assert rig.manager.following.all()
        while rig.manager.busy.any():
            rig.tick()
        assert at_rest(rig)
    rig.stop(ResultCode.ESTOP, hard=True)
    assert not rig.manager.busy.any()  # nothing to brake
