"""The contract checker, on our robots and on robots that are broken in each way that it claims to find."""

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.conformance import ConformanceError, check_robot
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from tests.cases import each_case
from tests.robots.fake_feetech import START, so101


class GoodRobot(Robot):
    """A minimal robot that keeps the contract; the broken ones below each change one thing."""

    config_class = RobotConfig
    name = "good"
    observation_features: ClassVar[dict[str, Any]] = {"a.pos": float, "b.vel": float, "eye": (2, 3, 3)}
    action_features: ClassVar[dict[str, Any]] = {"a.vel": float, "b.vel": float}

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {"eye": None}
        self._on = False
        self._state = {"a.pos": 0.5, "b.vel": -1.0}
        self._image = np.full((2, 3, 3), 7, np.uint8)
        self._applied = {"a.vel": 0.0, "b.vel": 0.0}

    is_connected = property(lambda self: self._on)
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        if self._on:
            raise DeviceAlreadyConnectedError
        self._on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        if not self._on:
            raise DeviceNotConnectedError
        return {**self._state, "eye": self._image.copy()}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        if not self._on:
            raise DeviceNotConnectedError
        if not all(map(math.isfinite, action.values())):
            raise ValueError(action)
        self._applied = {name: float(action[name]) for name in self.action_features}
        return dict(self._applied)

    def disconnect(self) -> None:
        self._on = False


class MissingObservation(GoodRobot):
    breach = "missing"

    def get_observation(self):
        return {k: v for k, v in super().get_observation().items() if k != "b.vel"}


class ExtraObservation(GoodRobot):
    breach = "extra"

    def get_observation(self):
        return {**super().get_observation(), "c.pos": 1.0}


class ShuffledObservation(GoodRobot):
    breach = "order"

    def get_observation(self):
        return dict(reversed(super().get_observation().items()))


class IntegerObservation(GoodRobot):
    breach = "not a finite float"

    def get_observation(self):
        return {**super().get_observation(), "a.pos": 1}


class NanObservation(GoodRobot):
    breach = "not a finite float"

    def get_observation(self):
        return {**super().get_observation(), "a.pos": math.nan}


class WrongImage(GoodRobot):
    breach = "must be uint8"

    def get_observation(self):
        return {**super().get_observation(), "eye": np.zeros((3, 2, 3), np.uint8)}


class FloatImage(GoodRobot):
    breach = "must be uint8"

    def get_observation(self):
        return {**super().get_observation(), "eye": np.zeros((2, 3, 3))}


class ListObservation(GoodRobot):
    breach = "not a dict"

    def get_observation(self):
        return list(super().get_observation().items())


class SharedImage(GoodRobot):
    breach = "shares memory"
    adversarial = True

    def get_observation(self):
        return {**super().get_observation(), "eye": self._image}


class SharedDict(GoodRobot):
    breach = "same dict"

    def __init__(self, config):
        super().__init__(config)
        self._shared = {"a.pos": 0.5, "b.vel": -1.0, "eye": self._image}

    def get_observation(self):
        super().get_observation()
        return self._shared


class LiveImage(GoodRobot):
    breach = "not a copy"

    def get_observation(self):
        view = self._image.view()
        view.flags.writeable = False
        return {**super().get_observation(), "eye": view}

    def send_action(self, action):
        self._image += 1
        return super().send_action(action)


class SharedAction(GoodRobot):
    breach = "same dict every time: the robot's own state"

    def __init__(self, config):
        super().__init__(config)
        self._kept = {"a.vel": 0.0, "b.vel": 0.0}

    def send_action(self, action):
        super().send_action(action)
        return self._kept


class MutatesAction(GoodRobot):
    breach = "changed the dict"

    def send_action(self, action):
        result = super().send_action(action)
        action["a.vel"] = 5.0
        return result


class ReturnsNothing(GoodRobot):
    breach = "what was applied"

    def send_action(self, action):
        super().send_action(action)


class ReturnsOtherKeys(GoodRobot):
    breach = "what was applied"

    def send_action(self, action):
        return {"a.vel": super().send_action(action)["a.vel"]}


class ObservesUnconnected(GoodRobot):
    breach = "get_observation\\(\\) without a connection did not raise"

    def get_observation(self):
        return {**self._state, "eye": self._image.copy()}


class ActsUnconnected(GoodRobot):
    breach = "send_action\\(\\) without a connection did not raise"

    def send_action(self, action):
        return dict(action)


class WrongErrorUnconnected(GoodRobot):
    breach = "raised KeyError, not DeviceNotConnectedError"

    def get_observation(self):
        if not self._on:
            raise KeyError("x")
        return super().get_observation()


class ConnectsTwice(GoodRobot):
    breach = "connect\\(\\) on a connected robot did not raise"

    def connect(self, calibrate=True):
        self._on = True


class NeverConnects(GoodRobot):
    breach = "is_connected is False after connect"

    def connect(self, calibrate=True): ...


class NeverDisconnects(GoodRobot):
    breach = "is_connected is True after disconnect"

    def disconnect(self): ...


class DisconnectsOnceWithAnotherError(GoodRobot):
    breach = "disconnect\\(\\) a second time raised KeyError"

    def disconnect(self):
        if not self._on:
            raise KeyError("bus")
        self._on = False


class KeepsWhatItReturned(GoodRobot):
    breach = "came back in an observation"
    adversarial = True

    def send_action(self, action):
        super().send_action(action)
        self._kept = action
        return action

    def get_observation(self):
        seen = super().get_observation()
        return {**seen, "b.vel": self._kept["b.vel"]} if hasattr(self, "_kept") else seen


class TakesNan(GoodRobot):
    breach = "what is not finite must be refused"
    adversarial = True

    def send_action(self, action):
        if not self._on:
            raise DeviceNotConnectedError
        return dict(action)


class ObservesNanAfterNan(GoodRobot):
    breach = "'a.vel' was nan: it reached the robot"
    adversarial = True

    def send_action(self, action):
        if not self._on:
            raise DeviceNotConnectedError
        self._state["a.pos"] = action["a.vel"]
        return dict.fromkeys(action, 0.0)


class SwallowsExceptions(GoodRobot):
    breach = "swallowed"

    def __exit__(self, *error):
        self.disconnect()
        return True


class StaysConnectedOnError(GoodRobot):
    breach = "left the robot connected"

    def __exit__(self, *error): ...


class FeaturesChange(GoodRobot):
    breach = "observation_features changed"

    @property
    def observation_features(self):
        features = {"a.pos": float, "b.vel": float, "eye": (2, 3, 3)}
        return {**features, "late.pos": float} if self._on else features


class ArrayFeature(GoodRobot):
    breach = "LeRobot knows float"
    observation_features: ClassVar = {"scan.pos": (360,)}


class UnusableName(GoodRobot):
    breach = "lerobot-rollout drops"
    observation_features: ClassVar = {"scan_000": float}


class NoCameras(GoodRobot):
    breach = "no attribute 'cameras'"

    def __init__(self, config):
        super().__init__(config)
        del self.cameras


BROKEN = list(GoodRobot.__subclasses__())


@pytest.fixture
def config(tmp_path: Path) -> RobotConfig:
    return TurtleBot3Config(calibration_dir=tmp_path)


def test_a_good_robot_passes(config):
    assert check_robot(lambda: GoodRobot(config), adversarial=True) == ()


@each_case("robot", BROKEN)
def test_a_broken_robot_is_found(robot, config):
    with pytest.raises(ConformanceError, match=robot.breach):
        check_robot(lambda: robot(config), adversarial=getattr(robot, "adversarial", False))


class MockRobot(Robot):
    """What LeRobot's `tests.mocks.mock_robot.MockRobot` does, which is not part of its distribution.

    It returns the dict that it was given, and refuses a second `disconnect`.
    """

    config_class = RobotConfig
    name = "mock_robot"
    observation_features: ClassVar[dict[str, Any]] = {f"motor_{i}.pos": float for i in range(3)}
    action_features: ClassVar[dict[str, Any]] = {f"motor_{i}.pos": float for i in range(3)}

    def __init__(self, config: RobotConfig, position: float = 40.0) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {}
        self.is_on, self.position = False, position
        self.arrived: list[dict[str, float]] = []

    is_connected = property(lambda self: self.is_on)
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        if self.is_on:
            raise DeviceAlreadyConnectedError
        self.is_on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        if not self.is_on:
            raise DeviceNotConnectedError
        return dict.fromkeys(self.observation_features, self.position)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.arrived.append(dict(action))
        if not self.is_on:
            raise DeviceNotConnectedError
        return action

    def disconnect(self) -> None:
        if not self.is_on:
            raise DeviceNotConnectedError
        self.is_on = False


def test_lerobots_mock_robot_gets_findings_and_only_what_leaves_it_where_it_is(config):
    made: list[MockRobot] = []

    def make() -> MockRobot:
        made.append(MockRobot(config))
        return made[-1]

    findings = check_robot(make)
    assert len(findings) == 1
    assert "disconnect() a second time raises DeviceNotConnectedError" in findings[0]
    assert len(made[0].arrived) == 3 + 2 + 1  # the last one without a connection
    for robot in made:
        assert all(set(action.values()) == {40.0} for action in robot.arrived)
        assert not robot.is_connected
    given = {"motor_0.pos": 1.0, "motor_1.pos": 2.0, "motor_2.pos": 3.0}
    check_robot(make, given)
    assert all(action == given for robot in made[2:] for action in robot.arrived)
    assert given == {"motor_0.pos": 1.0, "motor_1.pos": 2.0, "motor_2.pos": 3.0}
    with pytest.raises(ConformanceError, match=r"took nan for 'motor_0.pos'"):
        check_robot(make, adversarial=True)
    assert not made[-1].is_connected


@pytest.mark.parametrize("options", [{}, {"use_degrees": False}, {"max_relative_target": 5.0}], ids=str)
def test_lerobots_so101_stays_where_it_is(options, tmp_path, monkeypatch):
    make, buses = so101(tmp_path, monkeypatch, **options)
    findings = check_robot(make)
    assert len(findings) == 1
    assert "disconnect() a second time" in findings[0]
    assert len(buses[0].goals) == 3 + 2
    for bus in buses:
        assert all(map(math.isfinite, bus.asked))
        assert not bus.is_connected
        for goal in bus.goals:  # LeRobot rounds steps towards zero
            assert all(abs(goal[motor] - START[motor]) <= 1 for motor in START), goal
    # Asked for, NaN is tried. LeRobot's bus refuses it.
    assert check_robot(make, adversarial=True) == findings
    assert not all(map(math.isfinite, buses[-2].asked))


def test_what_may_not_be_sent_is_refused_before_anything_is(config):
    made: list[MockRobot] = []

    def make() -> MockRobot:
        made.append(MockRobot(config))
        return made[-1]

    for bad in (math.nan, math.inf):
        with pytest.raises(ConfigError, match=f"'motor_1.pos': {bad}"):
            check_robot(make, {"motor_0.pos": 1.0, "motor_1.pos": bad, "motor_2.pos": 3.0})
    assert not any(robot.arrived for robot in made)

    class Blind(MockRobot):
        observation_features: ClassVar[dict[str, Any]] = {"motor_0.pos": float}

    blind = Blind(config)
    with pytest.raises(ConfigError, match=r"does not observe 'motor_1.pos', 'motor_2.pos'"):
        check_robot(lambda: blind)
    assert not blind.arrived
    assert not blind.is_connected


def test_after_an_error_the_robot_is_disconnected_and_the_error_stays(config):
    class Stuck(MockRobot):
        def get_observation(self):
            return {**super().get_observation(), "motor_0.pos": math.nan}

        def disconnect(self):
            raise OSError("no such device")

    with pytest.raises(ConformanceError, match="not a finite float") as caught:
        check_robot(lambda: Stuck(config))
    assert "no such device" in caught.value.__notes__[0]


def test_shared_images_are_a_finding(config):
    assert "shared the memory of 'eye'" in check_robot(lambda: SharedImage(config))[0]


@pytest.mark.parametrize(
    "options",
    [{}, {"beams": 36}, {"odometry": True, "imu": True}, {"beams": 1, "lidar_noise_std": 0.0}, {"fps": 50}],
    ids=str,
)
def test_turtlebot3_keeps_the_contract(options, tmp_path):
    findings = check_robot(
        lambda: TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, **options)),
        {"x.vel": 0.1, "theta.vel": 0.3},
        adversarial=True,
    )
    assert findings == ()
