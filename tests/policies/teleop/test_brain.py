"""The brain `teleop`, at what a teleoperator and a processor of another package may return."""

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.errors import BrainStoppedError, ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.ros2.robots.config_robot import Ros2RobotConfig
from bhd_lerobot.teleoperators.bhd_keyboard_base import BhdKeyboardBase
from bhd_lerobot.teleoperators.config_bhd_keyboard_base import BhdKeyboardBaseConfig
from tests.robots.external.mock_devices.devices import JOINTS, MockLeaderConfig

ONLY = np.zeros(1, np.intp)
SEEN = Observation(JOINTS, np.zeros((1, 3)))


@pytest.fixture
def brain() -> Iterator[TeleopBrain]:
    with closing(TeleopBrain(TeleopConfig(MockLeaderConfig()))) as brain:
        brain.bind(RobotFeatures(JOINTS, JOINTS, 50, robot_type="mock_arm"))
        brain.reset(ONLY, [0], 1)
        yield brain


def test_a_leader_in_other_units_than_the_robot_is_refused_unless_they_are_translated() -> None:
    def bind(robot: dict[str, Any], **options: Any) -> None:
        with closing(TeleopBrain(TeleopConfig(MockLeaderConfig(use_degrees=False), **options))) as brain:
            brain.bind(RobotFeatures(JOINTS, JOINTS, 50, robot_type="mock_arm", robot={"type": "mock_arm", **robot}))

    with pytest.raises(ConfigError, match=r"robot.use_degrees is true, and teleop.use_degrees is false"):
        bind({"use_degrees": True})
    bind({"use_degrees": False})
    bind({})
    bind({"use_degrees": True}, map={name: {"from": name, "scale": 1.8} for name in JOINTS})


@pytest.mark.parametrize("raises", [False, True])
def test_what_a_teleoperator_answers_too_late_is_not_of_the_next_episode(brain, monkeypatch, raises):
    calls = []

    def get_action() -> dict[str, float]:
        calls.append(0)
        if len(calls) == 1:
            time.sleep(0.2)
            if raises:
                raise ConnectionError("the bus does not answer")
        return dict.fromkeys(JOINTS, float(len(calls)))

    monkeypatch.setattr(brain.teleop, "get_action", get_action)
    assert brain.act(SEEN) is None
    time.sleep(0.3)
    brain.reset(ONLY, [0], 1)
    assert brain.act(SEEN).tolist() == [[2.0] * 3]  # type: ignore[union-attr]


def test_what_a_teleoperator_answers_late_within_an_episode_counts(brain, monkeypatch):
    def get_action() -> dict[str, float]:
        time.sleep(0.05)
        return dict.fromkeys(JOINTS, 1.0)

    monkeypatch.setattr(brain.teleop, "get_action", get_action)
    actions: list[Any] = [brain.act(SEEN) for _ in range(10)]
    assert any(action is not None for action in actions)


@pytest.mark.parametrize("value", [None, "fast", [1.0, 2.0]])
def test_a_processor_that_returns_no_number_ends_the_episode(brain: TeleopBrain, value: object) -> None:
    brain._process = lambda action, observation: dict.fromkeys(JOINTS, value)
    brain._map = dict
    with pytest.raises(BrainStoppedError, match=r"the processor .* for .shoulder.pos., which is not a number"):
        brain.act(SEEN)


@pytest.mark.parametrize("part", ["arm", "base"])
def test_of_an_arm_on_a_base_the_part_that_a_teleoperator_does_not_give_is_held(part: str) -> None:
    body = turtlebot3_manipulation()
    names, speeds = body.limits.names, body.need(Drive).limits.names
    driven = speeds if part == "base" else names[: -len(speeds)]
    seen = Observation(names, np.arange(1.0, 1.0 + len(names))[None])
    asked = {name: {"from": JOINTS[0], "scale": 0.0, "offset": 9.0} for name in driven}
    with closing(TeleopBrain(TeleopConfig(MockLeaderConfig(), map=asked))) as brain:
        brain.bind(RobotFeatures(names, names, 25, body=body, robot_type=body.name))
        brain.reset(ONLY, [0], 1)
        actions = [brain.act(replace(seen, state=seen.state + late)) for late in (0.0, 1.0)]
        brain.reset(ONLY, [0], 1)
        brain.hold(seen.state)  # who takes over from a policy: a grip does not open to where it is measured
        actions.append(brain.act(replace(seen, state=seen.state + 1.0)))
    held = {name: 0.0 if name in speeds else value for name, value in zip(names, seen.state[0], strict=True)}
    for action in actions:
        assert action.tolist() == [[9.0 if name in driven else held[name] for name in names]]  # type: ignore[union-attr]


@pytest.mark.law
def test_the_numbers_of_a_ros_2_robot_are_in_si_units_as_those_of_our_teleoperators_and_no_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ros2 = Ros2RobotConfig.get_choice_name(Ros2RobotConfig)
    monkeypatch.setattr(BhdKeyboardBase, "connect", lambda self: None)  # which needs a terminal
    with closing(TeleopBrain(TeleopConfig(BhdKeyboardBaseConfig()))) as brain:
        names = ("x.vel", "theta.vel")
        brain.bind(RobotFeatures(names, names, 10, robot_type=ros2))
        assert brain._map({"x.vel": 0.1, "theta.vel": 0.2}) == {"x.vel": 0.1, "theta.vel": 0.2}
    with (
        closing(TeleopBrain(TeleopConfig(MockLeaderConfig()))) as brain,
        pytest.raises(ConfigError, match=r"both have 'shoulder\.pos'.*degrees and radians"),
    ):
        brain.bind(RobotFeatures(JOINTS, JOINTS, 50, robot_type=ros2))
