from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bhd_lerobot.control.commands import MOTIONS, BrainCommand, CommandResult, Feedback, GoalPhase, Pose, ResultCode
from bhd_lerobot.control.motion.command_check import check
from bhd_lerobot.control.motion.goal_codec import (
    FEEDBACK_DTYPE,
    MESSAGE_BYTES,
    NAME_BYTES,
    RESULT_DTYPE,
    check_encodable,
    decode_feedback,
    decode_goal,
    decode_name,
    decode_result,
    encode_goal,
    encode_name,
    encode_result,
    goal_dtype,
    write_feedback,
)
from bhd_lerobot.errors import ActionError
from tests.cases import each_case
from tests.control.goal_rig import ARM, joints

DOF = 6
numbers = st.floats()
texts = st.text(st.characters(), max_size=20)  # lone surrogates and zeros, too
names = texts.filter(lambda text: 0 < len(text.encode("utf-8", "surrogatepass")) <= NAME_BYTES)
poses = st.builds(Pose, st.tuples(*[numbers] * 3), st.tuples(*[numbers] * 4))
commands = st.builds(
    BrainCommand,
    task_id=names,
    target_pose=st.none() | poses,
    joint_target=st.none() | st.tuples(*[numbers] * DOF),
    gripper=st.none() | numbers,
    motion=st.sampled_from(MOTIONS),
    max_velocity=st.none() | numbers,
    max_acceleration=st.none() | numbers,
    timeout_s=numbers,
    preempt=st.booleans(),
)


def in_memory(record: Any, dtype: np.dtype) -> Any:
    """Return the record as another process finds it."""
    block = bytearray(dtype.itemsize)
    np.frombuffer(block, dtype)[0] = record
    return np.frombuffer(bytes(block), dtype)[0]


@given(commands)
def test_a_goal_comes_out_as_it_went_in(command: BrainCommand) -> None:
    decoded = decode_goal(in_memory(encode_goal(command, DOF), goal_dtype(DOF)))
    assert repr(decoded) == repr(command)  # NaN is not equal to itself
    assert decode_name(encode_name(command.task_id, DOF)) == command.task_id
    assert check_encodable(command, DOF) is None


@given(names, st.booleans(), st.sampled_from(ResultCode), st.text(max_size=100))
def test_a_result_comes_out_as_it_went_in(name: str, success: bool, code: ResultCode, message: str) -> None:
    result = CommandResult(name, success, code, message)
    assert decode_result(in_memory(encode_result(result), RESULT_DTYPE)) == result


@given(st.text(st.sampled_from("aé€😀\0"), min_size=120, max_size=700))
@example("a" * MESSAGE_BYTES)
@example("a" * (MESSAGE_BYTES + 1))
@example("😀" * 200)
def test_a_long_message_is_cut_between_two_characters(message: str) -> None:
    decoded = decode_result(encode_result(CommandResult("a", False, ResultCode.FAULT, message))).message
    if len(message.encode()) <= MESSAGE_BYTES:
        assert decoded == message
    else:
        assert decoded[-1] == "…"
        assert message.startswith(decoded[:-1])
        assert MESSAGE_BYTES - 3 <= len(decoded.encode()) <= MESSAGE_BYTES


@given(names, st.sampled_from(GoalPhase), st.floats(0, 1), st.floats(0, 1e3), st.floats(0, 1))
def test_feedback_comes_out_as_it_went_in(
    name: str, phase: GoalPhase, progress: float, left: float, off: float
) -> None:
    feedback = Feedback(name, phase, progress, left, off)
    block = np.zeros(3, FEEDBACK_DTYPE)
    write_feedback(block[1], feedback)
    assert decode_feedback(in_memory(block[1], FEEDBACK_DTYPE)) == feedback
    assert [decode_feedback(record) for record in block] == [None, feedback, None]
    write_feedback(block[1], None)
    assert decode_feedback(block[1]) is None


FULL: dict[str, Any] = {"task_id": "a", "joint_target": joints(0.1)}


@each_case(
    ("fields", "code", "words"),
    [
        ({"task_id": "x" * 65}, ResultCode.BAD_TARGET, "65 bytes"),
        ({"task_id": "é" * 33}, ResultCode.BAD_TARGET, "66 bytes"),
        ({"task_id": ""}, ResultCode.BAD_TARGET, "not empty"),
        ({"task_id": 7}, ResultCode.BAD_TARGET, "task_id is 7"),
        ({"motion": "lin"}, ResultCode.BAD_TARGET, "Did you mean 'line'"),
        ({"preempt": 1}, ResultCode.BAD_TARGET, "preempt is 1"),
        ({"joint_target": (1.0, 2.0)}, ResultCode.BAD_TARGET, "6 numbers"),
        ({"joint_target": ("a",) * 6}, ResultCode.BAD_TARGET, "6 numbers"),
        ({"joint_target": ((1.0,), 2.0)}, ResultCode.BAD_TARGET, "6 numbers"),
        ({"joint_target": (10**400, *(0.0,) * 5)}, ResultCode.BAD_TARGET, "6 numbers"),
        ({"target_pose": (1, 2, 3)}, ResultCode.BAD_TARGET, "quaternion of 4"),
        ({"target_pose": Pose((1, 2), (1, 0, 0, 0))}, ResultCode.BAD_TARGET, "quaternion of 4"),  # type: ignore[arg-type]
        ({"gripper": "open"}, ResultCode.BAD_TARGET, "gripper is 'open'"),
        ({"max_velocity": "fast"}, ResultCode.BAD_VELOCITY, "max_velocity is 'fast'"),
        ({"max_acceleration": True}, ResultCode.BAD_ACCELERATION, "max_acceleration is True"),
        ({"timeout_s": None}, ResultCode.BAD_TIMEOUT, "timeout_s is None"),
    ],
)
def test_goals_that_do_not_fit_a_record_are_refused(fields: dict[str, Any], code: ResultCode, words: str) -> None:
    command = BrainCommand(**{**FULL, **fields})
    failure = check_encodable(command, DOF)
    assert failure is not None
    assert failure.code == code
    assert words in failure.message
    if isinstance(command.task_id, str) and len(command.task_id) > 30:
        assert check(command, ARM.arm) is None  # the length of a name matters between processes only
    else:
        refusal = check(command, ARM.arm)
        assert refusal is not None
        assert refusal.code == code


def test_whole_numbers_become_floats_and_a_long_name_of_a_result_is_refused() -> None:
    command = BrainCommand("a", joint_target=(1, 0, 0, 0, 0, 0), timeout_s=5)
    assert decode_goal(encode_goal(command, DOF)) == command
    with pytest.raises(ActionError, match="65 bytes"):
        encode_result(CommandResult("x" * 65, False, ResultCode.FAULT, ""))
    with pytest.raises(ActionError, match="65 bytes"):
        encode_name("x" * 65, DOF)
