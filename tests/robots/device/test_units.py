"""What readings of LeRobot's robots mean, and the options that say it."""

import math
from dataclasses import dataclass
from typing import Any

import draccus
import numpy as np
import pytest
from lerobot.robots.config import RobotConfig
from lerobot.robots.so_follower import SO101FollowerConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.device.process import Speed
from bhd_lerobot.robots.device.units import Motor, unit_of
from tests.cases import each_case


@dataclass
class Stock:
    robot: RobotConfig


FEATURES = ("elbow.pos", "joint_3.pos", "gripper.pos")
DEGREES, SHARE, CLOSING = Motor("DEGREES", 1.5), Motor("RANGE_M100_100", 1.5), Motor("RANGE_0_100", 0.9)
DEVICE = SO101FollowerConfig(port="/dev/none")


@pytest.mark.law
@each_case(
    ("row", "motor", "reading", "position"),
    [
        (None, DEGREES, 90.0, math.pi / 2),
        (None, SHARE, -50.0, -0.75),
        ("deg", DEGREES, -180.0, -math.pi),
        ("deg", Motor(), 45.0, math.pi / 4),
        ("rad", Motor(), 0.3, 0.3),
        ([[-100, 1.0], [100, -1.0]], SHARE, 50.0, -0.5),  # another sign
        ([[0, 0.0], [53.4, 0.073]], CLOSING, 26.7, 0.0365),
        ({"from": "joint_3.pos"}, DEGREES, 10.0, math.radians(10.0)),
        ({"from": "joint_3.pos", "is": [[0.0, 0.5], [90.0, 0.5 + math.pi / 2]]}, Motor(), 180.0, 0.5 + math.pi),
    ],
)
def test_a_reading_means_a_position(row: Any, motor: Motor, reading: float, position: float) -> None:
    unit = unit_of("elbow", row, dict.fromkeys(FEATURES, motor), FEATURES, "mine")
    assert unit.scale * reading + unit.offset == pytest.approx(position)
    assert unit.feature == ("joint_3.pos" if isinstance(row, dict) else "elbow.pos")
    end = {"DEGREES": math.degrees(1.5), "RANGE_M100_100": 100.0, "RANGE_0_100": 100.0}.get(motor.mode, math.inf)
    assert unit.range[0] < unit.range[1]
    assert any(one == pytest.approx(unit.scale * end + unit.offset) for one in unit.range)


@each_case(
    ("row", "motor", "text"),
    [
        (None, Motor(), "robot.units.elbow is not set, and mine reads numbers of an unknown unit there: .*'rad'"),
        (None, CLOSING, "reads 0 to 100 there"),
        ("deg", SHARE, "'deg', and mine reads -100 to 100 there"),
        ("turns", Motor(), "robot.units.elbow is 'turns'; it must be 'deg', 'rad'"),
        ([[0, 1]], Motor(), "must be 'deg', 'rad', or two readings"),
        ([[0, 1], [0, 2]], Motor(), "must be finite, and differ"),
        ([[0, 1], [math.nan, 2]], Motor(), "must be finite, and differ"),
        ({"from": "hip.pos"}, Motor(), "has no 'hip.pos' among what it observes and takes: elbow.pos, joint_3.pos"),
        ({"form": "hip.pos"}, Motor(), "form"),
    ],
)
def test_what_means_nothing_is_refused(row: Any, motor: Motor, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        unit_of("elbow", row, dict.fromkeys(FEATURES, motor), FEATURES, "mine")


@each_case(
    ("make", "text"),
    [
        (lambda: SO101Config(plant="lerobot"), "robot.device is not set: .*--robot.device.type=so101_follower"),
        (lambda: SO101Config(device=DEVICE), "robot.device is of plant=lerobot; add --robot.plant=lerobot"),
        (lambda: SO101Config(units={"gripper": "deg"}), "robot.units is of plant=lerobot"),
        (lambda: SO101Config(plant="lerobot", device=SO101Config()), "'so101', a robot of this package"),
        (lambda: SO101Config(plant="lerobot", device={"type": "so102"}), r"robot\.device\.type.*so101_follower"),
        (lambda: SO101Config(plant="lerobot", device={"type": "so101_follower"}), r"robot\.device\.port is required"),
        (
            lambda: TurtleBot3Config(plant="lerobot"),
            "name a class as package.module:Class; or ros2",
        ),
        (
            lambda: UR5Config(plant="lerobot", device=DEVICE, control="impedance", action_space="tool"),
            "robot.device takes positions: use --robot.control=servo",
        ),
        (lambda: TurtleBot3ManipulationConfig(plant="lerobot", device=DEVICE), "turtlebot3_manipulation has wheels"),
    ],
)
def test_options_that_fit_nothing_are_refused(make: Any, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        make()


def test_lerobots_own_commands_take_a_device() -> None:
    line = "{type: so101_follower, port: /dev/none, id: arm}"
    config = draccus.parse(Stock, args=["--robot.type=so101", "--robot.plant=lerobot", f"--robot.device={line}"]).robot
    assert config.device_config == SO101FollowerConfig(port="/dev/none", id="arm")
    assert config.clock == "realtime"


def test_speeds_are_slopes_of_the_last_readings() -> None:
    speed, times = Speed(), np.arange(30) * 7_000_000
    for stamp in times:
        found = speed.add(int(stamp), np.array([0.5 - 2.0 * stamp / 1e9, 1.0]))
    np.testing.assert_allclose(found, [-2.0, 0.0], atol=1e-6)
    # An encoder at rest between two of its steps.
    rng = np.random.default_rng(0)
    for stamp in times[-1] + np.arange(1, 200) * 10_000_000:
        found = speed.add(int(stamp), rng.integers(0, 2, 2) / 652)
    assert np.abs(found).max() < 0.05
    assert Speed().add(0, np.ones(2)).tolist() == [0.0, 0.0]
