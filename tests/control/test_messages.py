import numpy as np

from bhd_lerobot.control.messages import Limit, Mode, Reason, SendResult, Watchdog
from tests.cases import each_case


@each_case("reason", list(Reason))
def test_every_reason_has_an_explanation_of_its_own(reason: Reason) -> None:
    assert len(reason.explanation) > 5
    assert [other for other in Reason if other.explanation == reason.explanation] == [reason]


def test_a_latch_is_explained_with_the_way_out_of_it() -> None:
    for reason in (Reason.ESTOP, Reason.FAULT, Reason.NOT_ACTIVE):
        assert "reset()" in reason.explanation
        assert "activate()" in reason.explanation


def test_numbers_that_are_recorded_stay_what_they_are() -> None:
    """Datasets hold these numbers: a change breaks what was recorded before."""
    assert [mode.name for mode in Mode] == [
        "UNCONFIGURED", "INACTIVE", "HOLD", "TRACKING", "STOPPING", "SAFE_OFF", "ESTOP", "FAULT",
    ]  # fmt: skip
    assert [int(mode) for mode in Mode] == list(range(8))
    assert {flag.name: int(flag) for flag in Limit} == {
        "NON_FINITE": 1, "VELOCITY": 2, "ACCELERATION": 4, "EFFORT": 8, "POSITION": 16,
    }  # fmt: skip
    assert {flag.name: int(flag) for flag in Watchdog} == {
        "COMMAND_AGE": 1, "BLOCKED": 2, "BRAIN": 4, "RECORDER": 8, "PLANT": 16, "MISSES": 32,
    }  # fmt: skip


def test_a_result_tells_who_took_the_command() -> None:
    result = SendResult(np.array([Reason.ACCEPTED, Reason.ESTOP], np.int8))
    assert result.accepted.tolist() == [True, False]
