"""A base driven from a terminal, alone and under LeRobot's command."""

import json
import os
import pty
import sys
import termios
import time
from collections.abc import Iterator

import pytest
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.bodies.turtlebot3 import MAX_ANGULAR, MAX_LINEAR
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.estop import KEYS as ESTOP_KEYS
from bhd_lerobot.rollout.marks import TELEOP_KEYS
from bhd_lerobot.teleoperators.bhd_keyboard_base import BhdKeyboardBase
from bhd_lerobot.teleoperators.config_bhd_keyboard_base import BhdKeyboardBaseConfig
from tests.cases import each_case
from tests.forks import Fork
from tests.teleoperators.keyboard_support import Clock, Person, clock, person  # noqa: F401  fixtures
from tests.waiting import until

# x and theta, in signs, of every key that moves.
MOVES = {
    **{"u": (1, 1), "i": (1, 0), "o": (1, -1), "j": (0, 1), "l": (0, -1)},
    **{"m": (-1, -1), ",": (-1, 0), ".": (-1, 1)},
}
SPEEDS = "qzwxrv"


@pytest.fixture
def teleop(tmp_path, clock: Clock, person: Person) -> Iterator[BhdKeyboardBase]:  # noqa: F811
    config = BhdKeyboardBaseConfig(calibration_dir=tmp_path, linear_speed=0.1, angular_speed=0.5)
    with BhdKeyboardBase(config, clock) as teleop:
        yield teleop


def velocity(teleop: BhdKeyboardBase) -> tuple[float, float]:
    action = teleop.get_action()
    assert action.keys() == teleop.action_features.keys()
    return action["x.vel"], action["theta.vel"]


def test_each_key_has_its_velocity_and_every_other_key_stops(teleop: BhdKeyboardBase, person: Person) -> None:  # noqa: F811
    for number in range(1, 128):
        key = chr(number)
        if key in SPEEDS or number in (3, 13, 17, 19, 22, 26, 28):  # Ctrl-C and others are the terminal's
            continue
        person.press(f"i{key}", teleop)
        x, theta = MOVES.get(key, (0, 0))
        assert velocity(teleop) == (0.1 * x, 0.5 * theta), repr(key)


def test_keys_of_the_emergency_stop_and_of_the_recorder_only_stop() -> None:
    others = {chr(key) for sent in (ESTOP_KEYS, *(one.sent for one in TELEOP_KEYS)) for key in sent}
    assert not others & {*MOVES, *SPEEDS}


def test_a_key_is_followed_while_it_is_repeated_and_for_hold_s_at_the_most(
    teleop: BhdKeyboardBase, clock: Clock, person: Person  # noqa: F811
) -> None:  # fmt: skip
    for pause in (0.0, 0.5, 0.03, 0.03, 0.03, 0.59):
        clock.now += pause
        assert velocity(teleop) == ((0.1, 0.0) if pause else (0.0, 0.0))  # between two repeats it goes on
        person.press("i", teleop)
        assert velocity(teleop) == (0.1, 0.0)
    clock.now += 0.59
    assert velocity(teleop) == (0.1, 0.0)
    clock.now += 0.02
    assert velocity(teleop) == (0.0, 0.0)
    person.press("i", teleop)
    clock.now += 10.0  # nothing asked for an action meanwhile
    assert velocity(teleop) == (0.0, 0.0)


def test_speeds_change_by_a_tenth_without_a_break_in_the_motion(
    teleop: BhdKeyboardBase, clock: Clock, person: Person, capsys: pytest.CaptureFixture[str]  # noqa: F811
) -> None:  # fmt: skip
    linear, angular = 0.1, 0.5
    for key, x, theta in [
        *(("q", 1.1, 1.1), ("z", 0.9, 0.9), ("w", 1.1, 1.0), ("x", 0.9, 1.0), ("r", 1.0, 1.1), ("v", 1.0, 0.9))
    ]:
        linear, angular = linear * x, angular * theta
        person.press(f"u{key}", teleop)
        assert velocity(teleop) == pytest.approx((linear, angular))
    assert "Now 0.098 m/s, 0.490 rad/s." in capsys.readouterr().err
    person.press("q" * 100 + "u", teleop)
    assert velocity(teleop) == (MAX_LINEAR, MAX_ANGULAR)


def test_its_lifecycle(tmp_path, clock: Clock, person: Person, capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    before = termios.tcgetattr(person.device)
    teleop = BhdKeyboardBase(BhdKeyboardBaseConfig(calibration_dir=tmp_path), clock)
    with pytest.raises(DeviceNotConnectedError):
        teleop.get_action()
    teleop.connect()
    assert "any other key stops" in capsys.readouterr().err
    assert termios.tcgetattr(person.device) != before
    with pytest.raises(DeviceAlreadyConnectedError):
        teleop.connect()
    teleop.disconnect()
    teleop.disconnect()
    assert not teleop.is_connected
    assert termios.tcgetattr(person.device) == before


@each_case(
    ("options", "message"),
    [
        ({"linear_speed": 0.3}, r"teleop.linear_speed is 0.3, and teleop.max_linear_speed is 0.22"),
        ({"angular_speed": 3.0}, r"teleop.max_angular_speed is 2.84"),
    ],
)
def test_speeds_that_cannot_be_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        BhdKeyboardBaseConfig(**options)


def teleoperate(*arguments: str) -> None:
    """Run LeRobot's command, and print what is sent to the robot whenever that changes."""
    from lerobot.scripts import lerobot_teleoperate

    from bhd_lerobot.robots.robot import BhdRobot

    send = BhdRobot.send_action
    sent: list[object] = []

    def printing(robot: BhdRobot, action: dict[str, float]) -> dict[str, float]:
        if sent[-1:] != [action]:
            sent.append(action)
            print("SENT", json.dumps(action), flush=True)
        return send(robot, action)

    BhdRobot.send_action = printing  # type: ignore[method-assign]
    sys.argv = ["lerobot-teleoperate", *arguments]
    lerobot_teleoperate.main()
    print("ENDED", flush=True)


@pytest.mark.thorough
def test_stock_teleoperate_drives_a_base_until_ctrl_c(tmp_path) -> None:
    person, device = pty.openpty()  # noqa: F811
    before = termios.tcgetattr(device)
    log = tmp_path / "log"
    process = Fork(
        teleoperate, "--robot.type=turtlebot3", "--robot.arena=empty", "--teleop.type=bhd_keyboard_base", "--fps=10",
        output=log, terminal=device,
    )  # fmt: skip

    until(lambda: process.poll() is not None or "SENT" in log.read_text())
    assert "any other key stops" in log.read_text(), log.read_text()
    for key, action in ((b"i", '{"x.vel": 0.22, "theta.vel": 0.0}'), (b"j", '{"x.vel": 0.0, "theta.vel": 1.0}')):
        while f"SENT {action}" not in log.read_text():
            assert process.poll() is None, log.read_text()
            os.write(person, key)
            time.sleep(0.05)
    os.write(person, b"\x03")
    assert process.wait() == 0, log.read_text()
    assert log.read_text().splitlines()[-1] == "ENDED"
    assert termios.tcgetattr(device) == before
    os.close(person)
    os.close(device)


def test_without_a_terminal_stock_teleoperate_ends_with_a_message(tmp_path) -> None:
    log = tmp_path / "log"
    process = Fork(teleoperate, "--robot.type=turtlebot3", "--teleop.type=bhd_keyboard_base", output=log)
    assert process.wait() != 0
    last = log.read_text().splitlines()[-1]
    assert last.startswith("bhd_keyboard_base reads keys, and standard input is no terminal")
    assert "ssh -t" in last
    assert "Traceback" not in log.read_text()
