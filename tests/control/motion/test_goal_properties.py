"""Whatever is asked for and whenever: the reference keeps every limit, and every goal ends in exactly one result."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.commands import ResultCode
from tests.control.goal_rig import HOME, HZ, LIMITS, Rig, broken_limit, joints, moved

share = st.floats(-1, 1)
targets = st.one_of(
    st.builds(
        lambda a, b, c, last: {"joint_target": (*np.add(HOME[:5], (1.2 * a, 0.3 * b, -0.3 * b, a / 5, c / 2)), last)},
        share, share, share, st.sampled_from((-2 * np.pi, 2 * np.pi, 0.0, 0.5)),
    ),
    st.builds(lambda a, b, c, d: {"target_pose": moved(0.2 * a, 0.3 * b, 0.15 * c, 2 * d)}, share, share, share, share),
    st.builds(
        lambda a, b, c, d: {"target_pose": moved(0.2 * a, 0.3 * b, 0.15 * c, d), "motion": "line"},
        share, share, share, share,
    ),
    st.just({"target_pose": moved(2.0)}),
    st.just({}),
)  # fmt: skip
grippers = st.just({}) | st.floats(0, 0.085).map(lambda opening: {"gripper": opening})
goals = st.builds(
    lambda target, gripper, most, change, preempt: (
        "goal", {**target, **gripper, "preempt": preempt, "max_velocity": most, "max_acceleration": change}
    ),
    targets, grippers, st.none() | st.floats(0.6, 1.0), st.none() | st.floats(0.5, 5.0), st.booleans(),
)  # fmt: skip
others = st.one_of(
    st.tuples(st.just("cancel"), st.integers(0, 12)),
    st.tuples(st.just("again"), st.integers(0, 12)),
    st.tuples(st.just("stop"), st.booleans()),
)
actions = st.tuples(st.one_of(goals, goals, goals, others), st.integers(0, 5) | st.integers(0, 400))


def follow(rig: Rig, sim: int, script: list) -> Counter:
    """Do what the script says; return how many results are due for each name."""
    due: Counter = Counter()
    for number, ((kind, value), ticks) in enumerate(script):
        name = str(number)
        if kind == "goal":
            rig.go(name, sim, **value)
            due[name] += 1
        elif kind == "cancel":
            rig.manager.cancel(sim, str(value))
        elif kind == "again" and due[str(value)]:
            before = rig.manager.feedback(sim)
            answer = rig.go(str(value), sim, gripper=0.01)
            if answer is not None and answer.code == ResultCode.DUPLICATE_ID:  # it has not ended, and gets its own
                assert rig.manager.feedback(sim) == before
            else:
                due[str(value)] += 1
        elif kind == "stop":
            mask = np.zeros(rig.n, np.bool_)
            mask[sim] = True
            rig.stop(ResultCode.ESTOP if value else ResultCode.CANCELLED, value, mask)
        rig.tick(ticks)
    return due


def end(rig: Rig, due: Counter) -> None:
    """Let everything end, all limits kept: every goal has had its results, and the arm rests."""
    rig.run()
    results = rig.manager.take_results(0)
    assert Counter(result.task_id for result in results) == +due
    assert all(result.success == (result.code == ResultCode.SUCCEEDED) for result in results)
    assert all(result.message for result in results)
    assert not rig.velocity.any()
    assert not rig.acceleration.any()
    assert rig.manager.feedback(0) is None


@settings(max_examples=50)
@given(st.lists(actions, min_size=1, max_size=6))
@example([(("goal", {"joint_target": tuple(HOME[:6] + 0.3), "preempt": False}), 3), (("goal", {"gripper": 0.0}), 0)])
def test_limits_hold_and_every_goal_has_one_result(script: list) -> None:
    rig = Rig()
    end(rig, follow(rig, 0, script))


@pytest.mark.parametrize("kind", range(3), ids=("position", "velocity", "acceleration"))
def test_the_check_of_the_limits_catches_a_step_of_each_kind(kind: int) -> None:
    rig = Rig()
    rig.go("a", joint_target=joints(1.0))
    rig.run()
    rows, never = rig.history, np.zeros((len(rig.history) - 1, 1), np.bool_)
    assert broken_limit(rows, never) == ""
    # A tenth more than what one tick may change; in the middle of the motion the fourth joint stands still.
    rows[len(rows) // 2, kind, 0, 3] += (
        1.1 * (LIMITS.velocity / HZ, LIMITS.acceleration / HZ, LIMITS.jerk / HZ)[kind][3]
    )
    assert broken_limit(rows, never) != ""
