from bhd_lerobot.control.messages import Limit, Mode, Watchdog


def test_recorded_enum_values_are_stable() -> None:
    """Datasets hold these numbers: a change breaks what was recorded before."""
    assert [mode.name for mode in Mode] == [
        "UNCONFIGURED", "INACTIVE", "HOLD", "TRACKING", "STOPPING", "SAFE_OFF", "ESTOP", "FAULT",
    ]  # fmt: skip
    assert [int(mode) for mode in Mode] == list(range(8))
    assert {flag.name: int(flag) for flag in Limit} == {
        "NON_FINITE": 1, "VELOCITY": 2, "ACCELERATION": 4, "EFFORT": 8, "POSITION": 16, "POSTURE": 32,
        "CLEARANCE": 64,
    }  # fmt: skip
    assert {flag.name: int(flag) for flag in Watchdog} == {
        "COMMAND_AGE": 1, "BLOCKED": 2, "BRAIN": 4, "RECORDER": 8, "PLANT": 16, "MISSES": 32, "GUARD": 64,
        "FORCE": 128, "SPEED": 256,
    }  # fmt: skip
