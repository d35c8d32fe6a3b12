"""What is refused and why, and what a plan keeps to."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics, IkResult
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan, PlanFailure
from bhd_lerobot.control.motion.trajectory import MotionLimits, State
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.sim.chain import chain_from_mjcf
from tests.cases import each_case
from tests.control.geometry.arm_models import serial
from tests.control.goal_rig import ARM, HOME, HZ, KINEMATICS, LIMITS, STOP_LIMITS, ZEROS, Array, joints, moved

PLANNER = GoalPlanner(ARM, HZ)
NAN, INF = float("nan"), float("inf")
DOWN = (0.0, 0.7071067811865476, 0.7071067811865476, 0.0)


def plan(start: State | None = None, opening: float | None = None, **fields: Any) -> Plan | PlanFailure:
    state = State.at_rest(HOME) if start is None else start
    command = BrainCommand("a", **fields)
    return PLANNER.plan(command, state.position, state.velocity, state.acceleration, opening=opening)


def made(start: State | None = None, opening: float | None = None, **fields: Any) -> Plan:
    answer = plan(start, opening, **fields)
    assert isinstance(answer, Plan), answer
    return answer


def moving_start(tick: int = 150, **fields: Any) -> State:
    trajectory = made(joint_target=joints(1.5, -0.2, 0.1), gripper=0.0, **fields).trajectory
    return State(trajectory.position[tick], trajectory.velocity[tick], trajectory.acceleration[tick])


REFUSALS: list[tuple[dict[str, Any], ResultCode, str]] = [
    ({}, ResultCode.BAD_TARGET, "no target"),
    ({"target_pose": moved(), "joint_target": joints()}, ResultCode.BAD_TARGET, "Both"),
    ({"joint_target": joints(), "motion": "line"}, ResultCode.BAD_TARGET, "line"),
    ({"target_pose": np.eye(4)}, ResultCode.BAD_TARGET, "quaternion"),
    ({"joint_target": joints(NAN)}, ResultCode.NON_FINITE, "nan"),
    ({"target_pose": Pose((0.4, INF, 0.3), DOWN)}, ResultCode.NON_FINITE, "inf"),
    ({"target_pose": Pose((0.4, 0.1, 0.3), (NAN, 0, 0, 1))}, ResultCode.NON_FINITE, "nan"),
    ({"gripper": NAN}, ResultCode.NON_FINITE, "nan"),
    ({"target_pose": Pose((0.4, 0.1, 0.3), (0.0, 0.71, 0.71, 0.0))}, ResultCode.NOT_NORMALISED, "1.00409"),
    ({"target_pose": Pose((0.4, 0.1, 0.3), (0.0, 0.0, 0.0, 0.0))}, ResultCode.NOT_NORMALISED, "norm"),
    ({"joint_target": joints(4.0)}, ResultCode.JOINT_LIMIT, "shoulder_pan"),
    ({"gripper": 0.09}, ResultCode.JOINT_LIMIT, "0.09"),
    ({"gripper": -0.001}, ResultCode.JOINT_LIMIT, "-0.001"),
    ({"joint_target": joints(), "max_velocity": 0.0}, ResultCode.BAD_VELOCITY, "0.0"),
    ({"joint_target": joints(), "max_velocity": 3.2}, ResultCode.BAD_VELOCITY, "3.14159 rad/s"),
    ({"joint_target": joints(), "max_velocity": NAN}, ResultCode.BAD_VELOCITY, "nan"),
    ({"target_pose": moved(0.1), "motion": "line", "max_velocity": 1.1}, ResultCode.BAD_VELOCITY, "1 m/s"),
    ({"joint_target": joints(), "max_acceleration": -1.0}, ResultCode.BAD_ACCELERATION, "-1.0"),
    ({"joint_target": joints(), "max_acceleration": 16.0}, ResultCode.BAD_ACCELERATION, "15 rad/s^2"),
    ({"target_pose": moved(0.1), "motion": "line", "max_acceleration": 6.0}, ResultCode.BAD_ACCELERATION, "5 m/s^2"),
    ({"joint_target": joints(), "timeout_s": 0.0}, ResultCode.BAD_TIMEOUT, "0.0"),
    ({"joint_target": joints(), "timeout_s": INF}, ResultCode.BAD_TIMEOUT, "inf"),
    ({"joint_target": joints(), "timeout_s": 1e17}, ResultCode.BAD_TIMEOUT, "1e+17"),
    ({"joint_target": joints(), "timeout_s": NAN}, ResultCode.BAD_TIMEOUT, "nan"),
]


@pytest.mark.law
@each_case(("fields", "code", "words"), REFUSALS)
def test_invalid_goals_are_refused_with_a_reason(fields: dict[str, Any], code: ResultCode, words: str) -> None:
    failure = PLANNER.check(BrainCommand("a", **fields))
    assert failure is not None
    assert (failure.code, plan(**fields)) == (code, failure)
    assert words in failure.message


@each_case(
    "fields",
    [
        {"joint_target": joints(), "max_velocity": 3.1415, "max_acceleration": 15.0},
        {"joint_target": [0, 0, 0, 0, 0, 1]},
        {"joint_target": np.zeros(6)},
        {"target_pose": Pose((0.4, 0.1, 0.3), (0.0, 0.7075, 0.7075, 0.0))},
        {"target_pose": moved(0.1), "motion": "line", "max_velocity": 1.0, "max_acceleration": 5.0},
        {"gripper": 0, "motion": "line"},
        {"gripper": np.float32(0.05)},
    ],
)
def test_goals_within_the_ranges_are_accepted(fields: dict[str, Any]) -> None:
    assert PLANNER.check(BrainCommand("a", **fields)) is None


def test_a_plan_goes_where_the_goal_says() -> None:
    assert made(joint_target=joints(0.5)).target.tolist() == [*joints(0.5), HOME[6]]
    trajectory = made(joint_target=joints(2.0, -0.1), max_velocity=0.5, max_acceleration=1.5).trajectory
    assert np.abs(trajectory.velocity).max() == pytest.approx(0.5)  # the fastest joint is as fast as it may be
    assert (np.abs(trajectory.acceleration[:, :6]) <= LIMITS.acceleration[:6] / 10 + 1e-9).all()
    start = moving_start()
    brake = PLANNER.brake(start, hard=False)
    assert np.allclose(made(start, gripper=0.05).target[:6], brake.target[:6])  # the arm comes to rest
    for motion in ("joint", "line"):
        planned = made(target_pose=moved(0.1, 0.1, -0.05, 0.3), motion=motion, gripper=0.02)
        tool = KINEMATICS.tool(planned.target[:6])
        assert np.abs(tool - moved(0.1, 0.1, -0.05, 0.3).matrix()).max() < 1e-9
        assert planned.target[6] == 0.02


@pytest.mark.parametrize("fields", [{"joint_target": joints(0.5)}, {"target_pose": moved(0.1), "motion": "line"}])
def test_the_gripper_takes_its_own_time_and_keeps_its_target(fields: dict[str, Any]) -> None:
    start = moving_start(50)
    assert start.velocity[6] < 0
    assert made(start, 0.0, **fields).target[6] == 0.0
    stopped = made(start, None, **fields)
    assert 0.0 < stopped.target[6] < start.position[6]
    alone = made(gripper=0.0).trajectory
    both = made(gripper=0.0, joint_target=joints(2.0), max_velocity=0.3).trajectory
    assert both.ticks > alone.ticks
    assert np.array_equal(both.position[: alone.ticks, 6], alone.position[:, 6])
    assert (alone.position[:, :6] == HOME[:6]).all()


def test_a_line_from_a_moving_start_begins_where_the_arm_stops() -> None:
    start = moving_start()
    planned = made(start, target_pose=moved(0.05, 0.0, 0.1), motion="line")
    stop = made(start, gripper=0.05)
    tools = KINEMATICS.tool(planned.trajectory.position[:, :6])[:, :3, 3]
    begin, end = KINEMATICS.tool(stop.target[:6])[:3, 3], tools[-1]
    brake = int(np.argmin(np.linalg.norm(tools - begin, axis=1)))
    way = (end - begin) / np.linalg.norm(end - begin)
    after = tools[brake:] - begin
    assert np.linalg.norm(after - np.outer(after @ way, way), axis=1).max() < 5e-5
    steps = np.diff(np.concatenate((start.position[None], planned.trajectory.position)), axis=0)
    assert (np.abs(steps) * HZ <= LIMITS.velocity + 1e-6).all()


def test_a_gentle_goal_does_not_carry_a_fast_arm_past_its_range() -> None:
    fast = made(joint_target=(*joints()[:5], 2 * np.pi)).trajectory
    tick = int(0.8 * fast.ticks)
    start = State(fast.position[tick], fast.velocity[tick], fast.acceleration[tick])
    assert start.velocity[5] > 1.0
    gentle = made(start, joint_target=joints(), max_acceleration=0.5).trajectory
    assert np.abs(gentle.position).max() <= 2 * np.pi + 1e-9


@pytest.mark.law
@pytest.mark.parametrize(
    "fields", [{"joint_target": joints(), "gripper": 0.0}, {"gripper": 0.03}, {"joint_target": joints()}]
)
def test_a_goal_that_comes_where_only_a_stop_s_brake_ends_in_time_leaves_no_range(fields: dict[str, Any]) -> None:
    """A setpoint's reference may be there, of few ticks a second; the guard would stop an arm that went on."""

    def ways(limits: MotionLimits) -> Array:
        return speed * speed / (2 * limits.acceleration) + speed * limits.acceleration / (2 * limits.jerk)

    ends, speed = [5, 6], 0.9 * LIMITS.velocity
    position, velocity = HOME.copy(), ZEROS.copy()
    position[ends] = (LIMITS.upper - (ways(LIMITS) + ways(STOP_LIMITS)) / 2)[ends]
    velocity[ends] = speed[ends]
    planned = made(State(position, velocity, ZEROS), **fields).trajectory
    assert (planned.position <= LIMITS.upper + 1e-9).all()
    change = np.diff(np.concatenate((velocity[None], planned.velocity)), axis=0) * HZ
    assert (np.abs(change) <= STOP_LIMITS.acceleration * 1.001).all()


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"target_pose": moved(2.0)}, ResultCode.UNREACHABLE),
        ({"target_pose": moved(2.0), "motion": "line"}, ResultCode.UNREACHABLE),
        ({"joint_target": joints(0.0, 1.2)}, ResultCode.TABLE_COLLISION),
        ({"target_pose": moved(dz=-0.3)}, ResultCode.TABLE_COLLISION),
        ({"joint_target": joints(0.0, 0.0, 1.5)}, ResultCode.SELF_COLLISION),
        # Motions that would take hours.
        ({"target_pose": moved(0.1), "max_velocity": 1e-7}, ResultCode.PLANNING_FAILED),
        ({"target_pose": moved(0.1), "max_velocity": 1e-3}, ResultCode.PLANNING_FAILED),
        ({"target_pose": moved(0.1), "max_acceleration": 1e-6}, ResultCode.PLANNING_FAILED),
        ({"target_pose": moved(0.1), "max_velocity": 1e-4, "motion": "line"}, ResultCode.PLANNING_FAILED),
    ],
)
def test_blocked_paths_are_refused(fields: dict[str, Any], code: ResultCode) -> None:
    failure = plan(**fields)
    assert isinstance(failure, PlanFailure)
    assert failure.code == code
    assert len(failure.message) > 20


def test_the_whole_path_is_checked() -> None:
    # A full turn of the shoulder ends in the posture that it starts in, and goes through the table.
    failure = plan(joint_target=joints(0.0, 2 * np.pi))
    assert isinstance(failure, PlanFailure)
    assert failure.code in (ResultCode.TABLE_COLLISION, ResultCode.SELF_COLLISION)
    assert KINEMATICS.check(np.array([joints(0.0, 2 * np.pi)])).tolist() == [ResultCode.SUCCEEDED]


def test_an_arm_that_starts_too_close_may_only_move_straight_away() -> None:
    close = HOME.copy()
    for lift in np.arange(0.0, 1.2, 0.005):
        close[:6] = joints(0.0, lift)
        if KINEMATICS.collision.distances(close[:6])[1] < 0.002:
            break
    start = State.at_rest(close)
    assert isinstance(plan(start, joint_target=joints(0.0, 0.0)), Plan)
    down = plan(start, joint_target=joints(0.0, lift + 0.01))
    beside = plan(start, joint_target=joints(0.5, lift))
    for failure in (down, beside):
        assert isinstance(failure, PlanFailure)
        assert failure.code == ResultCode.TABLE_COLLISION
        assert "starts" in failure.message


class Choosy(ArmKinematics):
    """Offers given postures, whatever the pose."""

    offered: np.ndarray = np.empty((0, 6))

    def solve(self, pose: np.ndarray, posture: np.ndarray) -> IkResult:
        return IkResult(ResultCode.SUCCEEDED, self.offered)


def test_the_first_posture_with_an_admissible_way_wins_and_at_most_eight_are_tried() -> None:
    kinematics = Choosy(ARM.arm.chain, ARM.limits)
    planner = GoalPlanner(ARM, HZ)
    planner.kinematics = kinematics
    command = BrainCommand("a", target_pose=moved())
    into_itself, into_the_table = joints(0.0, 0.0, 1.5), joints(0.0, 1.2)
    kinematics.offered = np.array([into_itself, into_the_table, joints(0.3), joints(0.6)])
    answer = planner.plan(command, HOME, ZEROS, ZEROS)
    assert isinstance(answer, Plan)
    assert tuple(answer.target[:6]) == joints(0.3)
    kinematics.offered = np.array([into_itself, *(into_the_table,) * 7, joints(0.3)])
    answer = planner.plan(command, HOME, ZEROS, ZEROS)
    assert isinstance(answer, PlanFailure)
    assert answer.code == ResultCode.SELF_COLLISION  # what the closest one fails by


def test_a_singular_posture_ends_neither_a_pose_nor_lies_on_a_line_but_joints_may_pass_it() -> None:
    chain = dataclasses.replace(ARM.arm.chain, min_manipulability=1.0)
    strict = GoalPlanner(dataclasses.replace(ARM, arm=dataclasses.replace(ARM.arm, chain=chain)), HZ)
    for motion in ("joint", "line"):
        answer = strict.plan(BrainCommand("a", target_pose=moved(0.05), motion=motion), HOME, ZEROS, ZEROS)
        assert isinstance(answer, PlanFailure)
        assert answer.code == ResultCode.SINGULAR
    assert isinstance(strict.plan(BrainCommand("a", joint_target=joints(0.5)), HOME, ZEROS, ZEROS), Plan)
    through = [
        KINEMATICS.manipulability(row) for row in made(joint_target=joints(0, 0, 0, 0, 2.5)).trajectory.position[:, :6]
    ]
    assert min(through) < ARM.arm.chain.min_manipulability


def test_an_unbrakeable_state_stops_at_once() -> None:
    brake = PLANNER.brake(State(HOME, np.full(7, NAN), ZEROS), hard=True)
    assert brake.ticks == 1
    assert np.array_equal(brake.target, HOME)
    assert not brake.velocity.any()


def test_what_the_motors_cannot_carry_is_refused_with_the_load() -> None:
    limits = dataclasses.replace(ARM.limits, effort=(10.0,) * 6 + (60.0,))
    weak = dataclasses.replace(ARM, arm=dataclasses.replace(ARM.arm, load=5.0, limits=limits))
    target = HOME[:6] + 0.3
    failure = GoalPlanner(weak, HZ).plan(BrainCommand("x", joint_target=tuple(target)), HOME, np.zeros(7), np.zeros(7))
    assert not isinstance(failure, Plan)
    assert failure.code == ResultCode.OVERLOAD
    assert "load of 5 kg" in failure.message


def test_a_goal_that_is_planned_anew_on_its_way_is_neither_refused_nor_later() -> None:
    arm = dataclasses.replace(ARM, arm=dataclasses.replace(ARM.arm, load=4.0))
    planner, random = GoalPlanner(arm, HZ), np.random.default_rng(0)
    checked = 0
    for _ in range(40):
        goal, start = HOME[:6] + random.uniform(-0.8, 0.8, 6), HOME.copy()
        start[:6] += random.uniform(-0.8, 0.8, 6)
        command = BrainCommand("a", joint_target=tuple(goal))
        whole = planner.plan(command, start, ZEROS, ZEROS)
        if isinstance(whole, PlanFailure):
            continue
        rows = whole.trajectory
        for row in random.integers(0, rows.ticks - 1, 5):
            again = planner.plan(command, rows.position[row], rows.velocity[row], rows.acceleration[row])
            assert isinstance(again, Plan), again
            assert row + 1 + again.trajectory.ticks <= rows.ticks + 1
            checked += 1
    assert checked > 100


def arm_of(joints: int) -> Body:
    """The UR5's gripper at the end of another chain."""
    body = ARM.arm
    chain = dataclasses.replace(chain_from_mjcf(serial(joints, joints), "tool"), min_manipulability=0.0)

    def each(values: tuple[float, ...]) -> tuple[float, ...]:
        return (*(values[0],) * joints, values[-1])

    names = ("velocity", "acceleration", "jerk", "stop_deceleration", "stop_jerk", "effort", "setpoint_jerk")
    numbers = {name: each(getattr(ARM.limits, name)) for name in names}
    limits = dataclasses.replace(
        ARM.limits,
        names=(*(f"{joint}.pos" for joint in chain.joints), "gripper.pos"),
        lower=(*(-2.0,) * joints, 0.0),
        upper=(*(2.0,) * joints, ARM.limits.upper[-1]),
        **numbers,
    )
    return dataclasses.replace(ARM, arm=dataclasses.replace(body, chain=chain, limits=limits), mjcf="")


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 5, 7])
def test_goals_of_any_arm_are_planned(joints: int) -> None:
    """To the tool's position, its orientation too with six joints or more, straight on a line, within the limits."""
    body = arm_of(joints)
    planner = GoalPlanner(body, HZ)
    kinematics, start = planner.kinematics, np.append(np.full(joints, 0.3), 0.05)
    assert kinematics.check(start[None, :joints])[0] == ResultCode.SUCCEEDED
    for motion, far in (("joint", 0.3), ("line", 0.02)):
        vector = pose_vectors(kinematics.tool(start[:joints] + far * np.linspace(1.0, -1.0, joints)))
        pose = Pose(tuple(vector[:3].tolist()), tuple(vector[3:].tolist()))
        still = np.zeros(joints + 1)
        found = planner.plan(BrainCommand("a", target_pose=pose, motion=motion), start, still, still)
        assert isinstance(found, Plan), found
        path = found.trajectory
        assert (np.abs(path.velocity) <= np.array(body.limits.velocity) + 1e-9).all()
        assert (np.abs(path.acceleration) <= np.array(body.limits.acceleration) + 1e-9).all()
        assert np.abs(np.diff(path.position, axis=0, prepend=start[None])).max() < 0.1
        tool = kinematics.tool(path.position[:, :joints])
        np.testing.assert_allclose(tool[-1, :3, 3], vector[:3], atol=2e-4)
        np.testing.assert_allclose(tool[-1], pose.matrix(), atol=2e-4)  # which some posture reaches
        if motion == "line":
            first = kinematics.tool(start[:joints])[:3, 3]
            way = vector[:3] - first
            off = tool[:, :3, 3] - first
            beside = off - np.outer(off @ way, way) / (way @ way)
            assert np.linalg.norm(beside, axis=1).max() < 1e-4


def test_a_line_whose_faster_law_would_stand_still_follows_the_even_one() -> None:
    """Found with an SO-101: at one node the linear program's speed was 0, and the way took years."""
    start = (-0.1297636396302487, 0.5497728776842761, -0.43384947770747767, 1.4548729267920004, -1.370359933373184)
    turn, place = (
        (-0.9459775055687898, -0.32423226082216233),
        (0.28863530547293637, 0.01975498451291824, 0.143239839614),
    )
    pose = np.eye(4)
    pose[:2, :2], pose[2, 2], pose[:3, 3] = [turn, (turn[1], -turn[0])], -1.0, place
    x, y, z, *quaternion = pose_vectors(pose).tolist()
    command = BrainCommand("a", target_pose=Pose((x, y, z), tuple(quaternion)), motion="line", max_velocity=0.25)
    command = dataclasses.replace(command, max_acceleration=1.0)
    rest = np.zeros(6)
    answer = GoalPlanner(SO101Config().body(), HZ).plan(command, np.array([*start, 0.05]), rest, rest)
    assert isinstance(answer, Plan), answer
    assert answer.trajectory.ticks < 10 * HZ
