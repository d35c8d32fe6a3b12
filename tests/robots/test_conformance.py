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


def observed(robot: GoodRobot) -> dict[str, Any]:
    return GoodRobot.get_observation(robot)


def sent(robot: GoodRobot, action: dict[str, float]) -> dict[str, float]:
    return GoodRobot.send_action(robot, action)


def check_connected(robot: GoodRobot, error: Exception | None = None) -> None:
    if not robot._on:
        raise error or DeviceNotConnectedError


def observes(**changes: Any) -> dict[str, Any]:
    return {"get_observation": lambda self: {**observed(self), **changes}}


def shared_dict(robot: Any) -> dict[str, Any]:
    seen = observed(robot)
    robot.__dict__.setdefault("shared", {}).update(seen)
    return robot.shared


def live_image(robot: GoodRobot) -> dict[str, Any]:
    view = robot._image.view()
    view.flags.writeable = False
    return {**observed(robot), "eye": view}


def change_image(robot: GoodRobot, action: dict[str, float]) -> dict[str, float]:
    robot._image += 1
    return sent(robot, action)


def own_action(robot: Any, action: dict[str, float]) -> dict[str, float]:
    robot.__dict__.setdefault("own", {}).update(sent(robot, action))
    return robot.own


def change_action(robot: GoodRobot, action: dict[str, float]) -> dict[str, float]:
    applied = sent(robot, action)
    action["a.vel"] = 5.0
    return applied


def remember_action(robot: Any, action: dict[str, float]) -> dict[str, float]:
    sent(robot, action)
    robot.remembered = action
    return action


def remembered(robot: Any) -> dict[str, Any]:
    seen = observed(robot)
    return {**seen, "b.vel": robot.remembered["b.vel"]} if hasattr(robot, "remembered") else seen


def take_nan(robot: GoodRobot, action: dict[str, float]) -> dict[str, float]:
    check_connected(robot)
    return dict(action)


def observe_nan(robot: GoodRobot, action: dict[str, float]) -> dict[str, float]:
    check_connected(robot)
    robot._state["a.pos"] = action["a.vel"]
    return dict.fromkeys(action, 0.0)


def observe_with_key_error(robot: GoodRobot) -> dict[str, Any]:
    check_connected(robot, KeyError("x"))
    return observed(robot)


def disconnect_with_key_error(robot: GoodRobot) -> None:
    check_connected(robot, KeyError("bus"))
    robot._on = False


def swallow(robot: GoodRobot, *error: object) -> bool:
    robot.disconnect()
    return True


def without_cameras(robot: GoodRobot, config: RobotConfig) -> None:
    GoodRobot.__init__(robot, config)
    del robot.cameras


def late_features(robot: GoodRobot) -> dict[str, Any]:
    return {**GoodRobot.observation_features, **({"late.pos": float} if robot._on else {})}


BROKEN: dict[str, tuple[str, dict[str, Any]]] = {  # what is broken -> the message, and what differs from a good robot
    "missing observation": (
        "missing",
        {"get_observation": lambda self: {k: v for k, v in observed(self).items() if k != "b.vel"}},
    ),
    "extra observation": ("extra", observes(**{"c.pos": 1.0})),
    "shuffled observation": ("order", {"get_observation": lambda self: dict(reversed(observed(self).items()))}),
    "integer observation": ("not a finite float", observes(**{"a.pos": 1})),
    "NaN observation": ("not a finite float", observes(**{"a.pos": math.nan})),
    "image of a wrong shape": ("must be uint8", observes(eye=np.zeros((3, 2, 3), np.uint8))),
    "float image": ("must be uint8", observes(eye=np.zeros((2, 3, 3)))),
    "list observation": ("not a dict", {"get_observation": lambda self: list(observed(self).items())}),
    "shared dict": ("same dict", {"get_observation": shared_dict}),
    "live image": ("not a copy", {"get_observation": live_image, "send_action": change_image}),
    "shared action": ("same dict every time: the robot's own state", {"send_action": own_action}),
    "changed action": ("changed the dict", {"send_action": change_action}),
    "no applied action": ("what was applied", {"send_action": lambda self, action: sent(self, action) and None}),
    "other applied keys": (
        "what was applied",
        {"send_action": lambda self, action: {"a.vel": sent(self, action)["a.vel"]}},
    ),
    "observes unconnected": (
        r"get_observation\(\) without a connection did not raise",
        {"get_observation": lambda self: {**self._state, "eye": self._image.copy()}},
    ),
    "acts unconnected": (
        r"send_action\(\) without a connection did not raise",
        {"send_action": lambda self, action: dict(action)},
    ),
    "wrong error unconnected": (
        "raised KeyError, not DeviceNotConnectedError",
        {"get_observation": observe_with_key_error},
    ),
    "connects twice": (
        r"connect\(\) on a connected robot did not raise",
        {"connect": lambda self, calibrate=True: setattr(self, "_on", True)},
    ),
    "never connects": ("is_connected is False after connect", {"connect": lambda self, calibrate=True: None}),
    "never disconnects": ("is_connected is True after disconnect", {"disconnect": lambda self: None}),
    "wrong error of disconnect": (
        r"disconnect\(\) a second time raised KeyError",
        {"disconnect": disconnect_with_key_error},
    ),
    "swallows exceptions": ("swallowed", {"__exit__": swallow}),
    "connected after an exception": ("left the robot connected", {"__exit__": lambda self, *error: None}),
    "features change": ("observation_features changed", {"observation_features": property(late_features)}),
    "array feature": ("LeRobot knows float", {"observation_features": {"scan.pos": (360,)}}),
    "no cameras": ("no attribute 'cameras'", {"__init__": without_cameras}),
}
SHARED_IMAGE = {"get_observation": lambda self: {**observed(self), "eye": self._image}}
ADVERSARIAL: dict[str, tuple[str, dict[str, Any]]] = {
    "shared image": ("shares memory", SHARED_IMAGE),
    "remembers what it returned": (
        "came back in an observation",
        {"send_action": remember_action, "get_observation": remembered},
    ),
    "takes NaN": ("what is not finite must be refused", {"send_action": take_nan}),
    "observes NaN after NaN": ("'a.vel' was nan: it reached the robot", {"send_action": observe_nan}),
}


def broken(config: RobotConfig, changes: dict[str, Any]) -> GoodRobot:
    return type("Broken", (GoodRobot,), changes)(config)


@pytest.fixture
def config(tmp_path: Path) -> RobotConfig:
    return TurtleBot3Config(calibration_dir=tmp_path)


def test_a_good_robot_passes_and_shared_images_are_a_finding(config):
    assert check_robot(lambda: GoodRobot(config), adversarial=True) == ()
    assert "shared the memory of 'eye'" in check_robot(lambda: broken(config, SHARED_IMAGE))[0]


def test_names_that_lerobot_rollout_drops_are_a_finding(config):
    """The Unitree G1 of LeRobot has names that end in `.q`."""
    renamed = {
        "observation_features": {**GoodRobot.observation_features, "arm.q": float},
        "action_features": {"a.vel": float, "gripper.value": float},
        "get_observation": lambda self: {**observed(self), "arm.q": 0.5},
    }
    action = {"a.vel": 0.0, "gripper.value": 0.0}
    [finding] = check_robot(lambda: broken(config, renamed), action, adversarial=True)
    assert "lerobot-rollout drops 'arm.q', 'gripper.value'" in finding
    assert "'a.vel'" not in finding


@each_case("name", [*BROKEN, *ADVERSARIAL])
def test_a_broken_robot_is_found(name, config):
    message, changes = (BROKEN | ADVERSARIAL)[name]
    with pytest.raises(ConformanceError, match=message):
        check_robot(lambda: broken(config, changes), adversarial=name in ADVERSARIAL)


@pytest.mark.parametrize("options", [{"use_degrees": False}, {"max_relative_target": 5.0}], ids=str)
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


def test_invalid_trial_actions_are_refused_before_connecting(config):
    arrived: list[dict[str, float]] = []

    class Noting(GoodRobot):
        def send_action(self, action: dict[str, float]) -> dict[str, float]:
            arrived.append(action)
            return super().send_action(action)

    class Blind(Noting):
        action_features: ClassVar[dict[str, Any]] = {"c.pos": float, "b.vel": float}

    for bad in (math.nan, math.inf):
        with pytest.raises(ConfigError, match=f"'b.vel': {bad}"):
            check_robot(lambda: Noting(config), {"a.vel": 1.0, "b.vel": bad})
    blind = Blind(config)
    with pytest.raises(ConfigError, match=r"does not observe 'c.pos'"):
        check_robot(lambda: blind)
    assert not arrived
    assert not blind.is_connected


def test_after_an_error_the_robot_is_disconnected_and_the_error_stays(config):
    class Stuck(GoodRobot):
        def get_observation(self):
            return {**super().get_observation(), "a.pos": math.nan}

        def disconnect(self):
            raise OSError("no such device")

    with pytest.raises(ConformanceError, match="not a finite float") as caught:
        check_robot(lambda: Stuck(config))
    assert "no such device" in caught.value.__notes__[0]


@each_case("options", [{"odometry": True, "imu": True}, {"beams": 1, "lidar_noise_std": 0.0, "fps": 50}])
def test_turtlebot3_keeps_the_contract(options, tmp_path):
    findings = check_robot(
        lambda: TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, **options)),
        {"x.vel": 0.1, "theta.vel": 0.3},
        adversarial=True,
    )
    assert findings == ()
