"""Plans from another process: what is asked for is what is planned, and what is played is never overwritten."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import HELD, Capsule
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.control.motion.trajectory import PlanFailure, State
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.planning_link import PlanningLink, PlanServer
from tests.cases import each_case
from tests.control.goal_rig import ARM, HOME, HZ, joints, moved
from tests.control.support import shared_block
from tests.forks import Fork
from tests.realtime.mail_support import DURATION_S, RampPlanner, serve_plans

PLANNER = GoalPlanner(ARM, HZ)
STATE = State.of(*np.arange(21.0).reshape(3, 7))


def ramp(ticks: int, step: float = 1.0, **fields: Any) -> BrainCommand:
    return BrainCommand("x" * 200, gripper=step, timeout_s=float(ticks), **fields)  # a planner needs no name


def linked(planner: Any = None) -> tuple[PlanningLink, PlanServer, Any, bytearray]:
    planner = planner or RampPlanner()
    block = bytearray(PlanningLink.nbytes(planner.dof, planner.width, planner.hz, DURATION_S))
    link = PlanningLink(block, planner.dof, planner.width, planner.hz, duration_s=DURATION_S)
    return link, PlanServer(block, planner, duration_s=DURATION_S), planner, block


def answer(link: PlanningLink) -> Plan:
    plan = link.poll(0)
    assert isinstance(plan, Plan)
    return plan


@pytest.mark.parametrize(
    "command",
    [
        BrainCommand("a", joint_target=joints(0.3)),
        BrainCommand("b", target_pose=moved(0.05), motion="line", gripper=0.02),
        BrainCommand("c", gripper=0.0),
    ],
)
def test_a_plan_is_the_planners_bit_for_bit_and_lies_in_the_shared_memory(command: BrainCommand) -> None:
    block = bytearray(PlanningLink.nbytes(6, 7, HZ))
    link, server = PlanningLink(block, 6, 7, HZ), PlanServer(block, PLANNER)
    state = State.at_rest(HOME)
    assert not server.serve_once()
    link.request(0, command, state, 0.05, 17)
    assert link.poll(0) is None
    assert server.serve_once()
    plan = answer(link)
    assert plan.rows is not None
    assert np.shares_memory(plan.rows, np.frombuffer(block, np.uint8))
    expected = PLANNER.plan(command, *np.array((state.position, state.velocity, state.acceleration)), opening=0.05)
    assert isinstance(expected, Plan)
    for name in ("position", "velocity", "acceleration"):
        assert np.array_equal(getattr(plan.trajectory, name), getattr(expected.trajectory, name))
        assert np.shares_memory(getattr(plan.trajectory, name), plan.rows)
    assert np.array_equal(plan.target, expected.target)
    assert server.newest is not None
    assert np.array_equal(server.newest.position, expected.trajectory.position)
    assert not np.shares_memory(server.newest.position, plan.rows)  # it stays as it is when the rows do not
    assert not server.serve_once()
    assert link.poll(0) is None  # once


def test_what_the_gripper_holds_arrives() -> None:
    """A line that is free for the arm, and not for what hangs in the gripper."""
    link, server, _, _ = linked(PLANNER)
    state = State.of(*np.stack((HOME, 0 * HOME, 0 * HOME)))
    command = BrainCommand("down", target_pose=moved(dz=-0.1), motion="line")
    for held in (None, Capsule(HELD, 6, ARM.arm.chain.tool.position, (0.0, 0.01, 0.32), 0.01), None):
        expected = PLANNER.plan(command, *np.array((state.position, state.velocity, state.acceleration)), held=held)
        link.request(0, command, state, None, 0, held)
        server.serve_once()
        plan = link.poll(0)
        assert isinstance(plan, PlanFailure) == isinstance(expected, PlanFailure) == (held is not None)
        if held is not None:
            assert plan == expected
            assert plan.message.startswith("On the way what the gripper holds comes within")


def test_a_planner_that_fails_or_raises_fails_one_goal_and_plans_the_next(caplog: pytest.LogCaptureFixture) -> None:
    link, server, _, _ = linked()
    link.request(0, ramp(3, max_velocity=0.25), STATE, None, 0)
    server.serve_once()
    failure = link.poll(0)
    assert isinstance(failure, PlanFailure)
    assert failure.code == ResultCode.UNREACHABLE
    assert re.match(r"0.25 is what was asked for\. é+…$", failure.message)
    link.request(0, ramp(3, max_acceleration=1.0), STATE, None, 0)
    assert server.serve_once()
    failure = link.poll(0)
    assert isinstance(failure, PlanFailure)
    assert failure.code == ResultCode.PLANNING_FAILED
    assert "ZeroDivisionError: no planner plans this" in failure.message
    assert "Traceback" in caplog.text
    link.request(0, ramp(3), STATE, None, 0)
    assert server.serve_once()
    assert answer(link).trajectory.ticks == 3


def test_a_trajectory_that_is_too_long_for_the_memory_is_a_failure() -> None:
    link, server, _, _ = linked()
    room = round((DURATION_S + 5) * 100)
    for ticks, fits in ((room, True), (room + 1, False), (3, True)):
        link.request(0, ramp(ticks), STATE, None, 0)
        server.serve_once()
        plan = link.poll(0)
        assert isinstance(plan, Plan) == fits
        if isinstance(plan, PlanFailure):
            assert plan.code == ResultCode.PLANNING_FAILED
            assert "there is room for 6 s" in plan.message


def test_what_is_dropped_or_replaced_is_not_planned() -> None:
    link, server, planner, _ = linked()
    link.request(0, ramp(3), STATE, None, 0)
    link.drop(0)
    assert server.serve_once()
    assert planner.planned == []
    assert link.poll(0) is None
    for ticks in (3, 5):
        link.request(0, ramp(ticks), STATE, None, 0)
    assert server.serve_once()
    assert answer(link).trajectory.ticks == 5
    assert len(planner.planned) == 1


def test_an_answer_to_an_older_request_is_ignored() -> None:
    link, server, planner, _ = linked()
    plan = planner.plan

    def interrupted(command: BrainCommand, *state: Any, **options: Any) -> Any:
        planner.plan = plan
        link.drop(0)
        link.request(0, ramp(7), STATE, None, 0)
        return plan(command, *state, **options)

    planner.plan = interrupted
    link.request(0, ramp(3), STATE, None, 0)
    assert server.serve_once()
    assert link.poll(0) is None
    assert server.serve_once()
    assert answer(link).trajectory.ticks == 7
    assert len(planner.planned) == 2


@each_case("number", [2**62, 2**63 - 1, -(2**63)])
@each_case("field", ["request", "dropped", "answered"])
def test_numbers_that_another_process_wrote_cost_one_request_at_the_most(field: str, number: int) -> None:
    link, server, _, _ = linked()
    link.request(0, ramp(3), STATE, None, 0)
    header = server._memory.header[0]
    if field == "request":
        header["request"]["number"] = number
    else:
        header[field] = number
    server.serve_once()
    link.poll(0)
    for ticks in (4, 5):
        link.request(0, ramp(ticks), STATE, None, 0)
        assert server.serve_once()
        assert answer(link).trajectory.ticks == ticks


@given(st.lists(st.sampled_from(["ask", "serve", "poll", "begin", "drop"]), max_size=60))
def test_the_rows_that_are_played_are_never_written_to(steps: list[str]) -> None:
    link, server, _, _ = linked()
    playing: tuple[np.ndarray, np.ndarray] | None = None
    polled: Plan | None = None
    asked = 0
    for step in steps:
        if step == "ask":
            asked, polled = asked + 1, None
            link.request(0, ramp(3, float(asked)), STATE, None, 0)
        elif step == "serve":
            server.serve_once()
        elif step == "poll" and (plan := link.poll(0)) is not None:
            polled = plan
            assert isinstance(plan, Plan)
            assert plan.trajectory.position[0, 0] == asked
        elif step == "begin" and polled is not None:
            link.begin(0)
            assert polled.rows is not None
            playing, polled = (polled.rows, polled.rows.copy()), None
        elif step == "drop":
            link.drop(0)
            polled = None
        if playing is not None:
            assert np.array_equal(*playing)
        if polled is not None:
            assert polled.trajectory.position[0, 0] == asked


def test_a_half_written_request_is_not_read() -> None:
    link, server, planner, block = linked()
    link.request(0, ramp(3), STATE, None, 0)
    guard = np.frombuffer(block, np.int64, 1)
    guard += 1
    assert not server.serve_once()
    # After a writer that was killed while writing, the next one can write again.
    again = PlanningLink(block, 6, 7, 100, duration_s=DURATION_S)
    assert guard[0] % 2 == 0
    again.request(0, ramp(4), STATE, None, 0)
    assert server.serve_once()
    assert answer(again).trajectory.ticks == 4
    assert len(planner.planned) == 1


def test_a_request_that_changes_while_it_is_read_is_read_again() -> None:
    link, server, _, _ = linked()
    link.request(0, ramp(3), STATE, None, 0)
    header = server._header

    class Interrupted:
        def __getitem__(self, name: str) -> Any:
            value = header[name].copy()
            link.request(0, ramp(5), STATE, None, 0)
            return value

    server._header = Interrupted()
    assert not server.serve_once()
    server._header = header
    assert server.serve_once()
    assert answer(link).trajectory.ticks == 5


def test_a_restarted_planner_answers_only_open_requests() -> None:
    link, server, planner, block = linked()
    link.request(0, ramp(3), STATE, None, 0)
    assert server.serve_once()
    assert not PlanServer(block, planner, duration_s=DURATION_S).serve_once()
    link.request(0, ramp(5), STATE, None, 0)
    assert PlanServer(block, planner, duration_s=DURATION_S).serve_once()
    assert answer(link).trajectory.ticks == 5


def test_another_process_plans(tmp_path: Path) -> None:
    path, count = tmp_path / "block", 200
    block = shared_block(path, PlanningLink.nbytes(6, 7, 100, DURATION_S))
    link = PlanningLink(block, 6, 7, 100, duration_s=DURATION_S)
    process = Fork(serve_plans, path, count)
    playing_rows: tuple[np.ndarray, np.ndarray] | None = None
    for number in range(1, count + 1):
        link.request(0, ramp(1 + number % 500, float(number)), STATE, 0.01 * number, 0)
        while (plan := link.poll(0)) is None:
            assert process.poll() is None or number == count
        assert isinstance(plan, Plan)
        assert plan.rows is not None
        steps = number * np.arange(1, 2 + number % 500)
        assert np.array_equal(plan.rows[:, 1, 2], STATE.velocity[2] + steps)
        assert plan.target.tolist() == [0.01 * number] * 7
        assert playing_rows is None or np.array_equal(*playing_rows)
        if number % 3:
            link.begin(0)
            playing_rows = plan.rows, plan.rows.copy()
    assert process.wait() == 0


def test_what_cannot_be_is_refused() -> None:
    link, _, _, _ = linked()
    with pytest.raises(ConfigError, match="arm 1"):
        link.request(1, ramp(3), STATE, None, 0)
    with pytest.raises(ValueError, match="buffer"):
        PlanningLink(bytearray(PlanningLink.nbytes(6, 7, 100, 2.0) - 1), 6, 7, 100, duration_s=2.0)
    for timeout_s in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="time-out is"):
            PlanningLink(bytearray(PlanningLink.nbytes(6, 7, 100)), 6, 7, 100, timeout_s=timeout_s)


def test_garbage_over_a_request_ends_no_planner() -> None:
    rng = np.random.default_rng(0)
    _, server, planner, block = linked()
    for number in range(300):
        block[:400] = rng.bytes(400)
        np.frombuffer(block, np.int64)[:2] = 2 * number + 2, number + 1  # a request that is whole, and new
        server.serve_once()
    _, server, planner, block = linked()
    link = PlanningLink(block, planner.dof, planner.width, planner.hz, duration_s=DURATION_S)
    link.request(0, ramp(3), STATE, None, 0)
    assert server.serve_once()
    assert len(answer(link).rows) == 3
