"""The contract checker, on our robots and on robots that are broken in each way that it claims to find."""

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.conformance import ConformanceError, check_robot
from bhd_lerobot.robots.turtlebot3 import TurtleBot3


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

    def get_observation(self):
        return {**super().get_observation(), "eye": self._image}


class SharedDict(GoodRobot):
    breach = "shares memory|same dict"

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
    breach = "robot's own state|finite"

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


class DisconnectsOnce(GoodRobot):
    breach = "must be idempotent"

    def disconnect(self):
        if not self._on:
            raise DeviceNotConnectedError
        self._on = False


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
    check_robot(lambda: GoodRobot(config))


@pytest.mark.parametrize("robot", BROKEN, ids=lambda cls: cls.__name__)
def test_a_broken_robot_is_found(robot, config):
    with pytest.raises(ConformanceError, match=robot.breach):
        check_robot(lambda: robot(config))


@pytest.mark.parametrize(
    "options",
    [{}, {"beams": 36}, {"odometry": True, "imu": True}, {"beams": 1, "lidar_noise_std": 0.0}, {"fps": 50}],
    ids=str,
)
def test_turtlebot3_keeps_the_contract(options, tmp_path):
    check_robot(
        lambda: TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, **options)), {"x.vel": 0.1, "theta.vel": 0.3}
    )
