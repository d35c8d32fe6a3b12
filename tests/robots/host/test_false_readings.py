"""Sensors that lie, on the wall clock and with real processes: what is written after the stop."""

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.messages import Mode
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.ur import UR5
from tests.robots.host import lying_arm
from tests.robots.host.support import mode, relaxed, unique
from tests.waiting import until

BRAKES, BLOCKED = 0.03, 0.2  # [rad] from 0.4 rad/s; by which a joint is away that is found to be blocked
WORDS = {
    "step": "shoulder_lift reads a change of 0.300 rad",
    "wrapped": "its angles are wrapped",
    "from the future": "a stamp is 10.000 s ahead of now: of another clock",
    "frozen": "The arm stayed more than 0.1 rad from its reference",
}


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[UR5, Any]]:
    path = str(tmp_path_factory.mktemp("lying") / "shared")
    shared = lying_arm.shared(path, new=True)
    os.environ[lying_arm.LOG] = path
    try:
        plant = f"{lying_arm.__name__}:LyingArm"
        realtime = relaxed(plant_timeout_s=5.0)
        config = UR5Config(id=unique("lying"), clock="realtime", plant=plant, control_hz=125, realtime=realtime)
        with UR5(config) as robot:
            yield robot, shared
    finally:
        del os.environ[lying_arm.LOG]


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("lie", lying_arm.LIES[1:])
def test_a_false_reading_is_a_fault_that_moves_nothing(arm: tuple[UR5, Any], lie: str) -> None:
    robot, shared = arm
    action = {name: robot.get_observation()[name] for name in robot.action_features}
    start = int(shared["count"])

    def turn() -> Mode:
        action["shoulder_pan.pos"] -= 0.4 / 25
        robot.host.send(np.array([list(action.values())]))
        robot.host.step(None)
        return mode(robot)

    for _ in range(25):
        turn()
    until(lambda: turn() == Mode.TRACKING, "it is on its way")
    shared["lie"] = lying_arm.LIES.index(lie)
    until(lambda: turn() == Mode.FAULT, "it is a fault")
    stopped = int(shared["count"])
    until(lambda: int(shared["count"]) > stopped + 125, "it has held for a second")
    robot.host.link.pause()
    end = int(shared["count"])
    modes, written = shared["mode"][start:end], shared["written"][start:end]
    first = int((modes == Mode.FAULT).argmax())
    assert np.abs(written[first:, :6] - written[first, :6]).max() < (BLOCKED if lie == "frozen" else BRAKES)
    assert np.abs(np.diff(written[:, :6], axis=0)).max() < np.pi / 125 * 1.5
    assert WORDS[lie] in robot.host.problem
    shared["lie"] = 0
    robot.host.reset(np.zeros(1, np.intp), [None], [0])
    robot.host.begin()
