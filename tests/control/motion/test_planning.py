"""Goals whose plans come later than they are asked for: no jump, and still exactly one result for every goal."""

import itertools
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import Capsule
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.commands import BrainCommand, GoalPhase, ResultCode
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.control.motion.planning import MIN_LEAD, MOST_LEADS, lead_ticks
from bhd_lerobot.control.motion.trajectory import PlanFailure, State
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case
from tests.control.goal_rig import ARM, HOME, HZ, Rig, broken_limit, joints, moved
from tests.control.motion.test_goal_properties import actions, end, follow

LEAD = 12
TIMEOUT = 300
NEVER = 10**9
PLANNER = GoalPlanner(ARM, HZ)
FAR, NEAR, BACK = joints(2.0), joints(0.2), joints(-1.0)


class LatePlanning:
    """A planner that answers at the k-th poll after a request, in the block that it is free to write to."""

    def __init__(self, latencies: Iterable[int], lead: int = LEAD, timeout: int = TIMEOUT) -> None:
        self.lead, self.timeout = lead, timeout
        self.latencies = itertools.chain(latencies, itertools.repeat(1))
        self.out: dict[int, list] = {}  # what is asked for: polls to come, and the answer
        self.states: list[State] = []
        self.starts: list[int] = []
        self.dropped = self.begun = 0

    def request(  # noqa: PLR0917
        self,
        sim: int,
        command: BrainCommand,
        state: State,
        opening: float | None,
        start_tick: int,
        held: Capsule | None = None,
    ) -> None:
        self.states.append(state)
        self.starts.append(start_tick)
        plan = PLANNER.plan(command, state.position, state.velocity, state.acceleration, opening=opening, held=held)
        self.out[sim] = [max(1, next(self.latencies)), plan]

    def poll(self, sim: int) -> Plan | PlanFailure | None:
        self.out[sim][0] -= 1
        return None if self.out[sim][0] else self.out.pop(sim)[1]

    def begin(self, sim: int) -> None:
        self.begun += 1

    def drop(self, sim: int) -> None:
        self.dropped += 1
        self.out.pop(sim, None)


def rig_of(*latencies: int, ticks: int = 0) -> tuple[Rig, LatePlanning]:
    """Return a rig; if ticks are given, so many of the motion of a goal "a" have passed, and latencies are what
    follows."""
    planning = LatePlanning(latencies if not ticks else (1, *latencies))
    rig = Rig(planning=planning)
    if ticks:
        rig.go("a", joint_target=FAR)
        rig.tick(LEAD + ticks)
        assert rig.velocity.any()
    return rig, planning


@pytest.mark.parametrize("latency", [1, 2, LEAD, LEAD + 1, TIMEOUT])
def test_a_plan_for_an_arm_at_rest_starts_exactly_at_its_tick_or_when_it_comes(latency: int) -> None:
    rig, planning = rig_of(latency)
    rig.go("a", joint_target=FAR)
    rig.tick(max(LEAD, latency - 1))
    assert rig.phase == GoalPhase.CONVERTING
    assert rig.manager.busy.all()
    assert not rig.manager.following.any()
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING
    assert rig.position[0, 0] != HOME[0]
    rig.run()
    assert rig.results() == [("a", ResultCode.SUCCEEDED)]
    assert rig.position[0, :6].tolist() == list(FAR)
    assert (len(planning.states), planning.begun, planning.dropped) == (1, 1, 0)


@pytest.mark.parametrize("latency", [1, LEAD + 1])
def test_a_preempting_goal_starts_from_the_predicted_state(latency: int) -> None:
    rig, planning = rig_of(latency, ticks=100)
    undisturbed = Rig(planning=LatePlanning([]))
    undisturbed.go("a", joint_target=FAR)
    undisturbed.tick(LEAD + 100 + LEAD)
    rig.go("b", joint_target=BACK, preempt=True)
    assert rig.results() == [("a", ResultCode.PREEMPTED)]
    rig.tick(LEAD)
    # Until the switch the old motion goes on, and the new one was planned from where it leads.
    assert np.array_equal(rig.history, undisturbed.history)
    state = planning.states[-1]
    assert np.array_equal((state.position, state.velocity, state.acceleration), rig.history[-1, :, 0])
    assert rig.phase == GoalPhase.CONVERTING
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING
    expected = PLANNER.plan(BrainCommand("b", joint_target=BACK), *rig.history[-2, :, 0], opening=HOME[6])
    assert isinstance(expected, Plan)
    assert rig.position[0].tolist() == expected.trajectory.position[0].tolist()
    rig.run()
    assert rig.results() == [("b", ResultCode.SUCCEEDED)]
    assert len(planning.states) == 2


def test_a_plan_that_is_late_for_an_arm_that_moves_is_asked_for_again_from_further_ahead() -> None:
    rig, planning = rig_of(LEAD + 2, 2 * LEAD + 2, 1, ticks=50)
    rig.go("b", joint_target=BACK, preempt=True)
    rig.tick(LEAD + 2 + 2 * LEAD + 2 + 4 * LEAD - 1)
    assert rig.phase == GoalPhase.CONVERTING
    rig.tick()
    assert rig.phase == GoalPhase.EXECUTING
    assert len(planning.states) == 4
    asked = np.subtract(planning.starts[1:], (LEAD, 2 * LEAD, 4 * LEAD))  # the ticks of the requests
    assert np.diff(asked).tolist() == [LEAD + 1, 2 * LEAD + 2]
    rig.run()
    assert rig.results() == [("a", ResultCode.PREEMPTED), ("b", ResultCode.SUCCEEDED)]


def test_a_planner_that_is_always_too_late_is_named_and_the_arm_brakes() -> None:
    lead = MIN_LEAD
    planning = LatePlanning([1, *(lead * 2**k + 2 for k in range(9))], lead)
    rig = Rig(planning=planning)
    rig.go("a", joint_target=joints(3.0), max_velocity=0.3)  # 10 s
    rig.tick(500)
    rig.go("b", joint_target=BACK, preempt=True)
    while not (results := rig.manager.take_results(0)) or results[0].task_id != "b":
        rig.tick()
    assert results[0].code == ResultCode.PLANNING_FAILED
    assert "the arm moves" in results[0].message
    assert np.diff(planning.starts)[-1] > 0
    assert len(planning.states) == 2 + int(np.log2(MOST_LEADS))
    assert rig.phase == GoalPhase.ERROR
    assert rig.velocity.any()
    assert rig.run() < HZ  # it brakes
    assert not rig.velocity.any()
    assert rig.go("c", joint_target=NEAR) is None
    rig.run()
    assert rig.results() == [("c", ResultCode.SUCCEEDED)]


@pytest.mark.parametrize("ticks", [0, 50], ids=["at rest", "moving"])
def test_a_planner_that_never_answers_is_named(ticks: int) -> None:
    rig, planning = rig_of(NEVER, ticks=ticks)
    rig.go("b", joint_target=BACK, preempt=True)
    rig.tick(TIMEOUT + 1)
    assert rig.phase == GoalPhase.CONVERTING
    rig.tick()
    assert rig.phase == GoalPhase.ERROR
    result = rig.manager.take_results(0)[-1]
    assert (result.task_id, result.code) == ("b", ResultCode.PLANNING_FAILED)
    assert "did not answer within 0.602 s" in result.message
    assert planning.dropped == 1
    rig.run()
    rig.go("c", joint_target=NEAR)
    rig.run()
    assert rig.results() == [("c", ResultCode.SUCCEEDED)]


def test_a_plan_that_fails_ends_the_goal_at_once_and_brakes() -> None:
    rig, planning = rig_of(3, ticks=50)
    rig.go("b", target_pose=moved(2.0), preempt=True)
    rig.tick(3)
    assert rig.results() == [("a", ResultCode.PREEMPTED), ("b", ResultCode.UNREACHABLE)]
    assert rig.velocity.any()
    assert rig.run() < HZ
    assert planning.begun == 1


@pytest.mark.parametrize("ticks", [0, 50], ids=["at rest", "moving"])
@pytest.mark.parametrize("way", ["cancel", "stop", "estop", "setpoint", "restart", "preempt"])
def test_ending_a_goal_during_planning_drops_the_request(way: str, ticks: int) -> None:
    rig, planning = rig_of(NEVER, ticks=ticks)
    rig.go("b", joint_target=BACK, preempt=True)
    rig.tick(3)
    rig.results()
    due = [("b", ResultCode.CANCELLED)]
    if way == "cancel":
        assert rig.manager.cancel(0, "b") == ResultCode.SUCCEEDED
    elif way == "stop":
        rig.stop(ResultCode.CANCELLED, hard=False)
    elif way == "estop":
        rig.stop(ResultCode.ESTOP, hard=True)
        due = [("b", ResultCode.ESTOP)]
    elif way == "setpoint":
        rig.manager.end_all(0, ResultCode.REPLACED_BY_SETPOINT, "a setpoint")
        due = [("b", ResultCode.REPLACED_BY_SETPOINT)]
        assert not rig.manager.following.any()
        rig.bring_to_rest()  # as what follows setpoints does
    elif way == "restart":
        rig.manager.restart(np.array([0]))
        due = []
        rig.bring_to_rest()
    elif way == "preempt":
        rig.go("c", joint_target=NEAR, preempt=True)
        due = [("b", ResultCode.PREEMPTED)]
    assert (planning.dropped, planning.out) == (1, {})
    rig.run()
    assert rig.results() == (due if way != "preempt" else [*due, ("c", ResultCode.SUCCEEDED)])
    assert rig.go("after", joint_target=NEAR) is None
    rig.run()
    assert rig.results() == [("after", ResultCode.SUCCEEDED)]


@pytest.mark.parametrize("preempt", [False, True])
def test_a_goal_in_a_brake_waits_for_its_end_or_preempts_it(preempt: bool) -> None:
    rig, planning = rig_of(1, ticks=100)
    rig.manager.cancel(0, "a")
    rig.tick()
    rig.go("b", joint_target=NEAR, preempt=preempt)
    rig.tick(LEAD + 1)
    assert rig.velocity.any()  # the brake is longer
    assert (rig.phase == GoalPhase.EXECUTING and len(planning.states) == 2) == preempt
    rig.run()
    code = ResultCode.PREEMPTED if preempt else ResultCode.CANCELLED
    assert rig.results() == [("a", code), ("b", ResultCode.SUCCEEDED)]


latencies = st.lists(st.integers(1, 30) | st.integers(1, 2 * TIMEOUT) | st.just(NEVER), max_size=12)


@settings(max_examples=25)
@given(st.lists(actions, min_size=1, max_size=6), latencies, st.integers(MIN_LEAD, 40))
def test_limits_hold_and_every_goal_has_one_result_with_a_late_planner(
    script: list, latencies: list[int], lead: int
) -> None:
    planning = LatePlanning(latencies, lead)
    rig = Rig(planning=planning)
    end(rig, follow(rig, 0, script))
    assert planning.out == {}


@each_case("preempt", [False, True])
@each_case("latency", [1, LEAD + 2, 200])
def test_a_goal_that_comes_while_setpoints_are_followed_begins_with_a_brake(latency: int, preempt: bool) -> None:
    controller = ArmController(ARM, 1, HZ, 20, planning=LatePlanning([latency, latency]))
    reading = PlantReading(1, 7, states=controller.states)
    rows = []

    def tick(ticks: int) -> None:
        for _ in range(ticks):
            reading.position[:], reading.velocity[:] = controller.command, controller.velocity
            controller.advance()
            rows.append(np.stack((controller.command, controller.velocity, controller.acceleration)))

    reading.position[:] = HOME
    controller.configure(np.array([0]), reading)
    for _ in range(5):
        controller.states["requested"][:, :7], controller.states["has_setpoint"] = controller.command + 0.02, True
        controller.tell(0)
        tick(20)
    assert controller.velocity.any()
    assert controller.submit(0, BrainCommand("b", joint_target=NEAR, preempt=preempt)) is None
    tick(3)
    rows.clear()  # a setpoint's acceleration falls as fast as it rose
    tick(LEAD - 2)
    assert controller.velocity.any()
    if latency == 1:
        assert controller.goals.phase[0] == GoalPhase.EXECUTING  # it does not wait for the end of the brake
    for _ in range(3000):
        tick(1)
        if not controller.busy.any():
            break
    assert [result.code for result in controller.take_results(0)] == [ResultCode.SUCCEEDED]
    assert broken_limit(np.array(rows), np.zeros((len(rows) - 1, 1), np.bool_)) == ""


def test_a_lead_is_a_positive_whole_number_of_ticks() -> None:
    assert [lead_ticks(*one) for one in ((1000, 0.025), (500, 0.025), (100, 0.025), (500, 1))] == [25, 13, 5, 500]
    for lead_s in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="lead is"):
            lead_ticks(500, lead_s)
