"""The articles' test client: accepted, feedback, succeeded; and the emergency stop."""

import importlib.util
from pathlib import Path

import pytest

_FILE = Path(__file__).resolve().parents[2] / "examples" / "send_goal.py"
_SPEC = importlib.util.spec_from_file_location("send_goal", _FILE)
send_goal = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(send_goal)


def test_a_goal_is_accepted_gives_feedback_and_succeeds(capsys):
    assert send_goal.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "accepted"
    feedback = [line for line in lines if "feedback" in line]
    shares = [int(line.split("%")[0].split()[-1]) for line in feedback]
    assert len(shares) > 5
    assert shares == sorted(shares)
    assert "succeeded" in lines[-1]
    assert sum("succeeded" in line or "failed" in line for line in lines) == 1


def test_the_emergency_stop_ends_the_goal_and_refuses_the_next(capsys):
    assert send_goal.main(["--estop-after=1"]) == 0
    text = capsys.readouterr().out
    stop, end, refusal = (text.index(part) for part in ("emergency stop\n", "failed  ESTOP", "refused  ESTOP"))
    assert stop < end < refusal


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--position", "2", "0", "0"], "UNREACHABLE"),
        (["--position", "nan", "0", "0.3"], "NON_FINITE"),
        (["--position", "0.3", "0.2", "-0.1"], "TABLE_COLLISION"),
        (["--quaternion", "1", "1", "0", "0"], "NOT_NORMALISED"),
        (["--max-velocity", "0"], "BAD_VELOCITY"),
        (["--max-acceleration", "0"], "BAD_ACCELERATION"),
        (["--timeout", "0"], "BAD_TIMEOUT"),
    ],
)
def test_bad_goals_are_refused_with_a_code_and_a_non_zero_exit(capsys, arguments, message):
    assert send_goal.main(arguments) == 1
    assert message in capsys.readouterr().out
