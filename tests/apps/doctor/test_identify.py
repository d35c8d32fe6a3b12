"""The servos of simulated arms whose servos are not those of their body."""

from itertools import islice
from typing import Any

import numpy as np
import pytest
import yaml

from bhd_lerobot.apps.doctor.identify import ServoModel, excite, for_identification, identify, servo_option
from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.cli.doctor import main
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.arm import SO101
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.config_ur import UR5Config
from tests.cases import each_case
from tests.robots.device.support import Bus
from tests.robots.device.support import bus as bus  # noqa: PLC0414
from tests.waiting import until

STIFFNESS, DAMPING, FRICTION = (14.0, 22.0), (0.8, 0.45), (0.03, 0.06)


def test_a_double_with_other_servos_is_found_within_ten_percent() -> None:
    robot = SO101(for_identification(SO101Config()))
    robot.connect()
    host: Any = robot.host
    gain, bias, friction = (
        host.world.model_field(name) for name in ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss")
    )
    gain[:, :2, 0], bias[:, :2, 1], bias[:, :2, 2] = STIFFNESS, np.negative(STIFFNESS), np.negative(DAMPING)
    friction[:, :2] = FRICTION
    host.plant.set_latency(np.arange(1), [10])  # 0.02 s
    found = [identify(robot.body, track) for track in islice(excite(host), 2)]
    robot.disconnect()
    for one, *wanted in zip(found, STIFFNESS, DAMPING, FRICTION, strict=True):
        assert [one.stiffness, one.damping, one.friction] == pytest.approx(wanted, rel=0.1)
        assert one.latency_s == pytest.approx(0.02, abs=0.004)
        assert one.error_rad < 0.001


@pytest.mark.thorough
def test_an_arm_on_its_bus_is_found_within_ten_percent(bus: Bus) -> None:
    bus.change(servo={"stiffness": 14.0, "damping": 0.75, "friction": 0.035})
    robot = SO101(for_identification(bus.config(id="identified")))

    def found() -> ServoModel | None:
        one = identify(robot.body, next(excite(robot.host)))
        return one if one.error_rad < 0.001 else None  # a machine that stalls delays commands, and fits badly

    with robot:
        one = until(found, "it is measured on a machine that keeps up")
    assert [one.stiffness, one.damping, one.friction] == pytest.approx([14.0, 0.75, 0.035], rel=0.1)


def test_what_is_printed_is_the_option_of_the_same_arm() -> None:
    found = {k: ServoModel(10.0 + k, 0.5, 0.02, 0.0, 0.0) for k in range(5)}
    name, _, text = servo_option(SO101Config().body(), found).partition("=")
    assert name == "--robot.servos"
    arm = SO101Config(servos=yaml.safe_load(text.strip("'"))).body().need(Arm)
    assert arm.servo_stiffness[:5] == (10.0, 11.0, 12.0, 13.0, 14.0)
    assert arm.servo_damping[:5] == (0.5,) * 5


@each_case(
    ("servos", "text"),
    [
        ({"hip": [1.0, 1.0, 0.0]}, r"joint of robot\.servos"),
        ({"elbow_flex": [1.0, 1.0]}, "needs stiffness, which is positive"),
        ({"elbow_flex": [0.0, 1.0, 0.0]}, "needs stiffness, which is positive"),
        ({"elbow_flex": [1.0, -1.0, 0.0]}, "not negative"),
    ],
)
def test_servos_that_cannot_be_are_refused(servos: dict[str, list[float]], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        SO101Config(servos=servos)


def test_the_servos_of_a_ur5_are_known() -> None:
    with pytest.raises(ConfigError, match="those of ur5 are known"):
        UR5Config(servos={"elbow": [1.0, 1.0, 0.0]})


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (["--robot.type=turtlebot3"], "bhd-doctor describes arms"),
        (["--robot.type=ur5"], "whose servos are known"),
        (["--robot.type=turtlebot3_manipulation"], "whose servos are known"),
        ([], "robot"),
    ],
)
def test_where_there_are_no_servos_to_identify_that_is_said(
    robot: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--identify", *robot]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "Unknown option" not in said
