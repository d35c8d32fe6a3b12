"""The display of `bhd-monitor`: everything fits, nothing jumps, and what matters is shown."""

import io
from typing import Any

import pytest
from rich.cells import cell_len
from rich.console import Console

from bhd_lerobot.apps.monitor import state as monitor_state
from bhd_lerobot.apps.monitor.state import Count, Dimension, MonitorState, Spread
from bhd_lerobot.apps.monitor.view import KEYS, render, unit
from bhd_lerobot.control.messages import Limit, Mode, Reason, Watchdog
from bhd_lerobot.robots.host.state import LIMITS, WATCHDOGS
from tests.cases import each_case

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")


def state(**overrides: Any) -> MonitorState:
    values: dict[str, Any] = {
        "id": "wally",
        "robot": "ur5",
        "clock": "realtime",
        "uptime": 3723.4,
        "phase": "RUNNING",
        "episode": 4,
        "episode_time": 12.34,
        "mode": "TRACKING",
        "estop": False,
        "estop_latched": False,
        "control_rate": 499.97,
        "control_hz": 500,
        "frame_rate": 25.01,
        "fps": 25,
        "command_rate": 24.9,
        "executed": 6170,
        "skipped": 0,
        "overruns": 2,
        "catch_up_lost": 0,
        "recorder_drops": 0,
        "lateness": Spread(45e-6, 120e-6, 2.3e-3),
        "duration": Spread(45e-6, 120e-6, 2.3e-3),
        "fifo_fill": 3,
        "fifo_capacity": 256,
        "command_age": 0.0123,
        "observation_age": 0.0019,
        "dimensions": tuple(Dimension(f"{name}.pos", 0.5, 0.25, 0.2499) for name in JOINTS),
        "limits": {name: Count(0, 0.0) for name in monitor_state.LIMITS},
        "watchdogs": {name: Count(0, 0.0) for name in monitor_state.WATCHDOGS},
        "refusals": {},
        "alive": {"brain": 0.004, "cerebellum": 0.0005},
        "goal": None,
        "pose": {},
    }
    return MonitorState(**values | overrides)


EXTREME = state(
    id="a-robot-with-a-name-that-is-much-longer-than-anybody-would-ever-call-a-robot-of-theirs",
    uptime=360000.0,
    mode="UNCONFIGURED",
    episode=99999,
    episode_time=86399.9,
    control_rate=10000.0,
    control_hz=10000,
    frame_rate=1000.0,
    fps=1000,
    command_rate=1000.0,
    executed=864_000_000,
    skipped=99_999_999,
    overruns=9_999_999,
    catch_up_lost=99_999_999,
    recorder_drops=9_999_999,
    lateness=Spread(1.234, 99.9, 999.0),
    fifo_fill=256,
    command_age=0.9994,
    observation_age=99.96,
    dimensions=tuple(Dimension(f"{name}_with_a_long_name.pos", -3.14159, -100.0, None or -99.99999) for name in JOINTS),
    limits={name: Count(999_999, 499.9) for name in monitor_state.LIMITS},
    watchdogs={name: Count(999_999, 499.9) for name in monitor_state.WATCHDOGS},
    refusals=dict.fromkeys(monitor_state.REASONS[1:], 999_999),
    alive=dict.fromkeys(("brain", "cerebellum"), 123.4),
    goal={"task_id": "g" * 64, "phase": "CONVERTING", "progress": 1.7, "remaining_s": 123.4, "position_error": 0.1},
    estop=True,
)
EMPTY = state(
    **dict.fromkeys(("mode", "episode_time", "control_rate", "frame_rate", "command_rate", "lateness", "duration")),
    phase="STARTING",
    command_age=None,
    observation_age=None,
    dimensions=(),
    limits={},
    watchdogs={},
    alive={},
)


def lines(shown: MonitorState, width: int = 80, height: int | None = None, **options: Any) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height or 100)
    console.print(render(shown, height=height, **options))
    return console.file.getvalue().splitlines()


@pytest.mark.law
@each_case("shown", [state(), EXTREME, EMPTY])
@each_case(("width", "height"), [(80, 24), (120, 40), (80, 10), (200, 60)])
def test_it_fits_and_the_keys_are_always_there(shown: MonitorState, width: int, height: int) -> None:
    printed = lines(shown, width, height)
    assert len(printed) <= height
    assert max(cell_len(line) for line in printed) <= 80
    assert printed[-1].strip() == KEYS


def test_an_arm_is_shown_completely_in_24_lines() -> None:
    printed = lines(
        state(goal={"task_id": "2-down", "phase": "EXECUTING", "progress": 0.5, "remaining_s": 1.0}), 80, 24
    )
    assert not any("…" in line for line in printed)
    for word in ("wally", "TRACKING", "control", "p99", "queue", "brain", "wrist_3.pos", "gripper.pos", "2-down"):
        assert any(word in line for line in printed), word
    assert [line.split()[0] for line in printed[-4:-1]] == ["limits", "watchdogs", "refused"]
    assert "executed 6170   overruns 2" in "\n".join(printed)


def text(shown: MonitorState, **options: Any) -> str:
    return "\n".join(lines(shown, 80, 24, **options))


def test_what_happened_is_shown_with_its_rate_the_most_frequent_first() -> None:
    shown = text(
        state(
            limits={"VELOCITY": Count(3, 0.0), "ACCELERATION": Count(120, 2.5), "EFFORT": Count(0, 0.0)},
            watchdogs={"COMMAND_AGE": Count(2, None)},
            refusals={"STALE": 7, "NON_FINITE": 1},
        )
    )
    assert "acceleration 120 (2.5/s)   velocity 3 (0.0/s)" in shown
    assert "effort" not in shown
    assert "command age 2" in shown
    assert "stale 7   non finite 1" in shown


def test_requested_against_applied_with_units_and_without_a_request_under_a_goal() -> None:
    moved = (Dimension("x.vel", 0.2, 0.15, -0.00001), Dimension("theta.vel", None, -1.0, -0.98))
    shown = text(state(dimensions=moved, pose={"x": 1.5, "y": -2.25, "yaw": 3.125}))
    rows = {row.split()[0]: row.split()[1:] for row in shown.splitlines() if row.strip()}
    assert rows["x.vel"] == ["0.2000", "0.1500", "0.0000", "m/s"]
    assert rows["theta.vel"] == ["–", "-1.0000", "-0.9800", "rad/s"]
    assert "x 1.500 m   y -2.250 m   yaw 3.125 rad" in shown
    assert unit("gripper.pos") == "m"
    assert unit("elbow.pos") == "rad"


@each_case(
    ("changes", "message"),
    [
        ({"estop": True}, "e-stop not latched yet"),
        ({"estop": True, "estop_latched": True, "mode": "ESTOP"}, "emergency stop latched"),
        ({"alive": {"cerebellum": 3.25}}, "cerebellum silent 3 s"),
    ],
)
def test_what_matters_most_stands_beside_the_mode(changes: dict[str, Any], message: str) -> None:
    assert message in lines(state(**changes), 80, 24)[1]
    assert message not in text(state())


def test_a_latched_mode_is_written_in_white_on_red_and_no_other_is() -> None:
    def styles(mode: str) -> set[str]:
        console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, color_system="standard")
        segments = console.render(render(state(mode=mode), height=24))
        return {str(segment.style) for segment in segments if mode in segment.text and segment.style is not None}

    red = {mode.name for mode in Mode if styles(mode.name) == {"bold white on red"}}
    assert red == {"ESTOP", "FAULT"}


def test_the_names_are_those_of_what_the_states_count() -> None:
    assert tuple(limit.name for limit in LIMITS) == monitor_state.LIMITS
    assert tuple(watchdog.name for watchdog in WATCHDOGS) == monitor_state.WATCHDOGS
    assert len(monitor_state.REASONS) == len(Reason)
    assert set(monitor_state.LIMITS) == {one.name for one in Limit} - {"NONE"}
    assert set(monitor_state.WATCHDOGS) == {one.name for one in Watchdog} - {"NONE"}
