"""Trajectories: limits, ends, agreement with Ruckig's own evaluation, straightness of lines, and playing them back."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.motion import line as line_module
from bhd_lerobot.control.motion.line import Line, ToolLimits, along_line
from bhd_lerobot.control.motion.player import TrajectoryPlayer
from bhd_lerobot.control.motion.player import play as play_row
from bhd_lerobot.control.motion.trajectory import (
    MotionLimits,
    PlanFailure,
    State,
    Trajectory,
    at_once,
    sample,
    to_rest,
    to_target,
)
from bhd_lerobot.control.record import ARM_LIMITS, new_arms, new_states
from tests.control.goal_rig import HOME, HZ, KINEMATICS, LIMITS, STOP_LIMITS, TOOL, moved

Array = NDArray[np.float64]
ARM = LIMITS[:6]
TOOL_LIMITS = ToolLimits(1.0, 5.0)


def planned(answer: Trajectory | PlanFailure) -> Trajectory:
    assert isinstance(answer, Trajectory), answer
    return answer


def excess(start: State, trajectory: Trajectory, limits: MotionLimits) -> float:
    """Return by how much a trajectory breaks a limit, as a share of it."""
    before = np.concatenate((start.acceleration[None], trajectory.acceleration[:-1]))
    return float(
        max(
            (np.abs(trajectory.velocity) / limits.velocity).max(),
            (np.abs(trajectory.acceleration) / limits.acceleration).max(),
            (np.abs(trajectory.acceleration - before) * HZ / limits.jerk).max(),
        )
        - 1.0
    )


def viable(shares: list[list[float]], limits: MotionLimits) -> State:
    """Return a state out of which the limits can still be kept: the acceleration ends before the speed is too high."""
    position, velocity, acceleration = np.array(shares)
    change = acceleration * limits.acceleration
    room = np.maximum(limits.velocity - change**2 / 2 / limits.jerk, 0.0)
    return State(position * 4.0, velocity * room, change)


states = st.lists(st.lists(st.floats(-1, 1), min_size=6, max_size=6), min_size=3, max_size=3).map(
    lambda shares: viable(shares, ARM)
)
postures = st.lists(st.floats(-4, 4), min_size=6, max_size=6).map(np.array)


@pytest.mark.law
@given(states, postures)
def test_a_trajectory_keeps_the_limits_and_ends_at_rest_on_its_target(start: State, target: Array) -> None:
    trajectory = planned(to_target(start, target, ARM, HZ))
    assert excess(start, trajectory, ARM) < 1e-6
    assert np.array_equal(trajectory.target, target)
    assert not trajectory.velocity[-1].any()
    assert not trajectory.acceleration[-1].any()
    assert np.abs(trajectory.position).max() <= 2 * np.pi + 1e-9
    path = np.concatenate((start.position[None], trajectory.position))
    assert (np.abs(np.diff(path, axis=0)) <= ARM.velocity / HZ + 1e-9).all()


@given(states, st.booleans())
def test_braking_keeps_the_limits_and_is_as_short_as_they_allow(start: State, hard: bool) -> None:
    limits = (STOP_LIMITS if hard else LIMITS)[:6]
    trajectory = planned(to_rest(start, limits, HZ))
    assert excess(start, trajectory, limits) < 1e-6
    assert not trajectory.velocity[-1].any()
    # No longer than undoing the acceleration, and then a ramp up to the largest deceleration and down from it.
    ramp = np.abs(start.acceleration) / limits.jerk
    speed = np.abs(start.velocity) + start.acceleration**2 / limits.jerk
    bound = ramp + speed / limits.acceleration + 2 * np.sqrt(speed / limits.jerk) + limits.acceleration / limits.jerk
    assert trajectory.ticks <= np.ceil(bound.max() * HZ) + 1


@settings(max_examples=25)
@given(states, postures, st.sampled_from((0.2, 0.5, 1.0)))
def test_samples_agree_with_ruckig(start: State, target: Array, share: float) -> None:
    request = ruckig.InputParameter(6)
    request.current_position, request.current_velocity = start.position, start.velocity
    request.current_acceleration, request.target_position = start.acceleration, target
    # With lower limits than the start's speed and acceleration there are segments that bring it within them.
    request.max_velocity, request.max_acceleration = ARM.velocity * share, ARM.acceleration * share
    request.max_jerk = ARM.jerk
    answer = ruckig.Trajectory(6)
    assert ruckig.Ruckig(6).calculate(request, answer) == ruckig.Result.Working
    samples = sample(answer, HZ)
    assert samples.ticks == 1 or samples.ticks - 1 < answer.duration * HZ <= samples.ticks + 1e-6
    for row in range(0, samples.ticks, 5):
        own = np.array(answer.at_time((row + 1) / HZ))
        mine = np.array([samples.position[row], samples.velocity[row], samples.acceleration[row]])
        assert np.abs(own - mine).max() < 1e-9


def test_all_joints_arrive_together_and_an_arm_that_is_there_already_needs_one_tick() -> None:
    trajectory = planned(to_target(State.at_rest(np.zeros(6)), [1.0, 0.5, -0.3, 0.1, 2.0, 0.01], ARM, HZ))
    assert (trajectory.velocity[-2] != 0).all()
    trajectory = planned(to_target(State.at_rest(HOME[:6]), HOME[:6], ARM, HZ))
    assert trajectory.ticks == 1
    assert np.array_equal(trajectory.position, HOME[None, :6])


def test_a_joint_that_comes_fast_towards_its_end_does_not_leave_its_range() -> None:
    limits = MotionLimits(*(np.array([value]) for value in (3.0, 10.0, 100.0, -1.0, 1.0)))
    run_up = planned(to_target(State.at_rest([-1.0]), [1.0], limits, HZ))
    for tick in range(0, run_up.ticks, 10):
        start = State(run_up.position[tick], run_up.velocity[tick], run_up.acceleration[tick])
        for target in (-1.0, 0.0, 1.0, float(run_up.position[tick, 0])):
            assert np.abs(planned(to_target(start, [target], limits, HZ)).position).max() <= 1.0 + 1e-9
        assert np.abs(planned(to_rest(start, limits, HZ)).position).max() <= 1.0 + 1e-9


def test_a_joint_that_cannot_stop_before_its_end_comes_to_rest_on_it() -> None:
    limits = MotionLimits(*(np.array([value]) for value in (3.0, 10.0, 100.0, -1.0, 1.0)))
    start = State.of([0.9], [3.0], [0.0])
    brake = planned(to_rest(start, limits, HZ))
    assert brake.target == 1.0
    assert not brake.velocity[-1].any()
    # The shortest way to stop from 3 m/s: 0.4 s on average at half the speed.
    assert brake.position.max() <= 0.9 + 3.0 * 0.4 / 2 + 1e-3


def random_limits(random: np.random.Generator, dof: int) -> MotionLimits:
    rates = np.cumprod(random.uniform((0.2, 2.0, 4.0), (4.0, 10.0, 20.0), (dof, 3)), axis=1).T
    return MotionLimits(*rates, np.full(dof, -10.0), np.full(dof, 10.0))


def test_a_trajectory_planned_anew_from_its_own_state_is_not_later() -> None:
    """Whatever is planned again on the way, a goal or a brake, at the most a tick is lost to sampling."""
    random = np.random.default_rng(0)
    checked = 0

    def check(plan: Callable[[State], Trajectory | PlanFailure], start: State, ticks: int | None = None) -> None:
        nonlocal checked
        whole = planned(plan(start))
        for row in range(whole.ticks - 1) if ticks is None else random.integers(0, max(1, whole.ticks - 1), ticks):
            state = State(whole.position[row], whole.velocity[row], whole.acceleration[row])
            late = row + 1 + planned(plan(state)).ticks - whole.ticks
            assert late <= 1, f"{late} ticks late from tick {row + 1} of {whole.ticks}: {start}, {state}"
            checked += 1

    # The smallest case: its acceleration falls to zero at the limit of the speed.
    limits = MotionLimits(*(np.array([value]) for value in (1.0, 8.0, 80.0, -10.0, 10.0)))
    check(lambda state: to_target(state, [2.0], limits, HZ), State.at_rest([0.0]))
    for number in range(50):
        dof = (1, 6)[number % 2]
        limits = random_limits(random, dof) if number % 3 else ARM[:dof].scaled(*random.uniform(0.1, 1.0, 2))
        goal = random.uniform(-3, 3, dof)
        begins = State.at_rest(random.uniform(-3, 3, dof)), viable(random.uniform(-1, 1, (3, dof)).tolist(), limits)
        for start in begins:
            check(lambda state: to_target(state, goal, limits, HZ), start, 8)  # noqa: B023  used at once
        check(lambda state: to_rest(state, limits, HZ), begins[1], 4)  # noqa: B023
    assert checked > 1000


def test_what_was_straight_is_straight_when_planned_anew() -> None:
    random = np.random.default_rng(1)
    straight = 0
    for _ in range(20):
        start, goal = random.uniform(-2, 2, (2, 6))
        way = (goal - start) / np.abs(goal - start).max()
        lead = int(np.abs(way).argmax())
        whole = planned(to_target(State.at_rest(start), goal, ARM, HZ))

        def off(trajectory: Trajectory) -> float:
            along = (trajectory.position[:, lead] - start[lead]) / way[lead]  # noqa: B023
            return float(np.abs(trajectory.position - start - np.outer(along, way)).max())  # noqa: B023

        if off(whole) > 1e-9:
            continue  # a straight line would have taken longer
        straight += 1
        for row in random.integers(0, whole.ticks - 1, 10):
            state = State(whole.position[row], whole.velocity[row], whole.acceleration[row])
            again = planned(to_target(state, goal, ARM, HZ))
            assert off(again) < 1e-6
            assert excess(state, again, ARM) < 1e-6
            assert np.array_equal(again.target, goal)
    assert straight > 5


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_numbers_return_a_failure(bad: float) -> None:
    start = State.of([bad], [0.0], [0.0])
    limits = MotionLimits(*(np.array([value]) for value in (3.0, 10.0, 100.0, -1.0, 1.0)))
    for answer in (to_target(start, [0.0], limits, HZ), to_rest(start, limits, HZ)):
        assert isinstance(answer, PlanFailure)
        assert answer.code == ResultCode.PLANNING_FAILED
        assert answer.message


def test_a_line_keeps_the_jerk_of_joints_that_must_move_gently() -> None:
    gentle = dataclasses.replace(ARM, jerk=ARM.jerk / 5)
    random = np.random.default_rng(0)
    made = 0
    for _ in range(12):
        goal = KINEMATICS.tool(HOME[:6] + random.uniform(-1, 1, 6) * (2.0, 0.3, 0.6, 0.8, 1.2, 1.0))
        answer = along_line(HOME[:6], goal, KINEMATICS, (gentle, TOOL_LIMITS), HZ)
        if isinstance(answer, Trajectory):
            made += 1
            assert excess(State.at_rest(HOME[:6]), answer, gentle) < 1e-9
    assert made > 6


def test_a_line_takes_as_many_poses_as_it_needs_to_be_straight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_module, "_STEP", 1.0)
    monkeypatch.setattr(line_module, "_TURN", 10.0)
    line = Line(TOOL, moved(0.05, 0.25, 0.1, 1.0).matrix())
    tools = KINEMATICS.tool(planned(along_line(HOME[:6], line.goal, KINEMATICS, (ARM, TOOL_LIMITS), HZ)).position)
    way = (line.goal - line.start)[:3, 3] / line.length
    beside = tools[:, :3, 3] - TOOL[:3, 3]
    assert np.linalg.norm(beside - np.outer(beside @ way, way), axis=1).max() < 5e-5
    # Where no number of poses suffices, the line is refused.
    monkeypatch.setattr(line_module, "_DEVIATION", 0.0)
    answer = along_line(HOME[:6], line.goal, KINEMATICS, (ARM, TOOL_LIMITS), HZ)
    assert isinstance(answer, PlanFailure)
    assert answer.code == ResultCode.SINGULAR


def test_a_slow_line_keeps_the_speed_of_the_tool() -> None:
    goal = moved(0.0, 0.2, 0.0).matrix()
    trajectory = planned(along_line(HOME[:6], goal, KINEMATICS, (ARM, ToolLimits(0.05, 0.2)), HZ))
    steps = np.linalg.norm(np.diff(KINEMATICS.tool(trajectory.position)[:, :3, 3], axis=0), axis=1) * HZ
    assert steps.max() == pytest.approx(0.05, rel=1e-3)
    assert trajectory.ticks / HZ == pytest.approx(0.2 / 0.05 + 0.05 / 0.2, rel=0.05)


def test_a_line_can_turn_the_tool_on_the_spot_or_do_nothing() -> None:
    turning = planned(along_line(HOME[:6], moved(turn=1.0).matrix(), KINEMATICS, (ARM, TOOL_LIMITS), HZ))
    tools = KINEMATICS.tool(turning.position)
    assert np.linalg.norm(tools[:, :3, 3] - TOOL[:3, 3], axis=1).max() < 5e-5
    assert planned(along_line(HOME[:6], TOOL, KINEMATICS, (ARM, TOOL_LIMITS), HZ)).ticks == 1


def numbered(ticks: int, first: float) -> Trajectory:
    rows = first + np.arange(ticks, dtype=np.float64)[:, None] + np.array([0.0, 0.25])
    return Trajectory(rows, rows + 1000, rows + 2000)


class Played(TrajectoryPlayer):
    """A player with arms of two dimensions, for which it is ticked."""

    def __init__(self, n: int) -> None:
        arms, states, limits = new_arms(n), new_states(n), np.zeros(1, ARM_LIMITS)
        limits["width"] = 2
        super().__init__(arms, 2)
        self._fields = states["command"][:, :2], arms["speed"][:, :2], arms["change"][:, :2]
        self._records, [self._limits] = list(zip(*map(as_objects, (states, arms)), strict=True)), as_objects(limits)

    def tick(self) -> np.ndarray:
        """Play a row; return positions, speeds and accelerations, shape (3, n, 2): no numbers if there was none."""
        before = [self.is_playing(sim) for sim in range(len(self._records))]
        for state, arm in self._records:
            play_row(state, arm, self._limits, self.rows)
        return np.where(np.array(before)[:, None], np.stack(self._fields), np.nan)


@settings(max_examples=10)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 3000), st.integers(0, 2000)), max_size=12))
def test_every_row_is_played_once_and_in_order(script: list[tuple[int, int, int]]) -> None:
    player = Played(4)
    expected: list[list[np.ndarray]] = [[] for _ in range(4)]
    for number, (sim, ticks, wait) in enumerate(script):
        trajectory = numbered(ticks, 10_000.0 * number)
        player.start(sim, trajectory)
        assert player.remaining(sim) == ticks
        expected[sim] = list(trajectory.position)
        for _ in range(min(wait, 50) if number % 2 else wait):
            rows = player.tick()
            for one in range(4):
                if expected[one]:
                    row = expected[one].pop(0)
                    assert np.array_equal(rows[:, one], [row, row + 1000, row + 2000])
                else:
                    assert np.isnan(rows[:, one]).all()
                assert player.remaining(one) == len(expected[one])
                assert player.is_playing(one) == bool(expected[one])


def test_joined_trajectories_wait_for_each_other() -> None:
    joined = numbered(3, 1.0).beside(numbered(2, 5.0))
    assert joined.position[:, [0, 2]].tolist() == [[1, 5], [2, 6], [3, 6]]
    assert numbered(2, 1.0).then(numbered(1, 3.0)).position[:, 0].tolist() == [1, 2, 3]
    assert at_once([4.0, 5.0]).ticks == 1


def rows_of(ticks: int, seed: int = 0, dof: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(ticks, 3, dof))


def test_borrowed_rows_are_played_where_they_lie() -> None:
    player, rows = Played(1), rows_of(6)
    player.borrow(rows)
    state = player.ahead(0, 2)
    assert state is not None
    assert np.array_equal((state.position, state.velocity, state.acceleration), rows[1])
    state.position[:] = 9.0  # of a copy
    assert (rows != 9.0).all()
    assert player.remaining(0) == 6
    assert np.array_equal(player.tick()[:, 0], rows[0])
    rows[1] = 7.0  # forbidden to the owner; that it shows proves that nothing was copied
    assert (player.tick() == 7.0).all()
    player.stop(0)
    assert np.isnan(player.tick()).all()
    assert player.remaining(0) == 0
    with pytest.raises(ValueError, match="3 arms"):
        Played(3).borrow(rows_of(2))
