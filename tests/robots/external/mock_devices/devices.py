"""A LeRobot robot with two cameras and its leader, without hardware, and what can go wrong with them.

Registered as `mock_arm` and `mock_leader` when it is imported: `--robot.discover_packages_path` names this module.
"""

import math
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig, ColorMode
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")


def _ask(fault: str) -> None:
    """Ask a person, as LeRobot's devices do that are not calibrated."""
    if fault == "asks":
        print(f"answered {input('which calibration? ')!r}", flush=True)


@CameraConfig.register_subclass("mock_camera")
@dataclass
class MockCameraConfig(CameraConfig):
    """A camera whose images say their number; `freeze_after` and `fail_after` are numbers of images."""

    fps: int | None = 30
    width: int | None = 64
    height: int | None = 48
    freeze_after: int = 0
    fail_after: int = 0


class MockCamera(Camera):
    """Captures on a thread of its own, as LeRobot's OpenCV camera does."""

    def __init__(self, config: MockCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self.color_mode = ColorMode.RGB
        self.latest_timestamp: float | None = None
        self._image: Any = None
        self._count = 0
        rows, columns = np.mgrid[0 : config.height, 0 : config.width]
        self._scene = np.stack([rows % 256, columns % 256, (rows + columns) % 256], axis=2).astype(np.uint8)
        self._ended, self._new = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._new.wait(5)

    def _run(self) -> None:
        period, due = 1 / (self.config.fps or 30), time.perf_counter()
        while not self._ended.is_set():
            config = self.config
            if not (config.freeze_after and self._count >= config.freeze_after):
                image = self._scene.copy()
                image[:8, :8] = self._count % 256
                self._image, self.latest_timestamp = image, time.perf_counter()
                self._count += 1
                self._new.set()
            due += period
            time.sleep(max(0.0, due - time.perf_counter()))

    def read(self, color_mode: ColorMode | None = None) -> Any:
        return self.read_latest()

    def async_read(self, timeout_ms: float = 200) -> Any:
        return self.read_latest()

    def read_latest(self, max_age_ms: int = 500) -> Any:
        if self.config.fail_after and self._count >= self.config.fail_after:
            raise RuntimeError("the camera was unplugged")
        return self._image

    def disconnect(self) -> None:
        self._ended.set()
        self._thread = None


@RobotConfig.register_subclass("mock_arm")
@dataclass
class MockArmConfig(RobotConfig):
    """Options of the mock arm; a fault happens at a number of calls of `get_observation`, or of `send_action`.

    `log` is a file for the actions that it was sent, `times` one for when it was observed, monotonic [ns].
    """

    port: str = ""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    fault: str = ""
    fault_at: int = 10
    read_s: float = 0.002
    log: str = ""
    times: str = ""
    use_degrees: bool = True


class MockArm(Robot):
    """Follows its actions with a delay of a frame; writes what it was sent into a file."""

    config_class = MockArmConfig
    name = "mock_arm"

    def __init__(self, config: MockArmConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = {name: MockCamera(camera) for name, camera in config.cameras.items()}  # type: ignore[arg-type]
        self._position = dict.fromkeys(JOINTS, 0.0)
        self._is_connected = False
        self.observed = self.sent = 0
        self.is_blocked, self.unblocked = False, threading.Event()
        self._times: list[int] = []

    @property
    def observation_features(self) -> dict[str, Any]:
        shapes = {name: (camera.height, camera.width, 3) for name, camera in self.config.cameras.items()}
        return {**dict.fromkeys(JOINTS, float), **shapes}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        if self._is_connected:
            raise DeviceAlreadyConnectedError("The mock arm is connected.")
        if self.config.fault == "no connection":
            raise ConnectionError("there is no such port")
        _ask(self.config.fault)
        for camera in self.cameras.values():
            camera.connect()
        self._is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def _check(self) -> None:
        if not self._is_connected:
            raise DeviceNotConnectedError("The mock arm is not connected.")

    def get_observation(self) -> dict[str, Any]:
        self._check()
        self.observed += 1
        self._times.append(time.monotonic_ns())
        time.sleep(self.config.read_s)
        seen: dict[str, Any] = dict(self._position)
        seen |= {name: camera.read_latest() for name, camera in self.cameras.items()}
        if self.observed == self.config.fault_at:
            seen = self._faulty(seen)
        return seen

    def _faulty(self, seen: dict[str, Any]) -> dict[str, Any]:
        match self.config.fault:
            case "disconnect":
                raise ConnectionError("the bus does not answer")
            case "nan":
                seen["elbow.pos"] = math.nan
            case "missing key":
                seen["wrist.pos"] = seen.pop("elbow.pos")
            case "image size":
                name = next(iter(self.cameras))
                seen[name] = seen[name][:-1]
            case "block":
                self._block()
            case "slow":
                time.sleep(0.15)
        return seen

    def _block(self) -> None:
        self.is_blocked = True
        self.unblocked.wait(60)
        self.is_blocked = False

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._check()
        self.sent += 1
        if self.sent == self.config.fault_at:
            if self.config.fault == "send raises":
                raise ConnectionError("the bus does not answer")
            if self.config.fault == "send blocks":
                self._block()
        if self.config.log:
            with open(self.config.log, "a", encoding="utf-8") as file:
                file.write(" ".join(f"{action[name]!r}" for name in JOINTS) + "\n")
        self._position = {name: float(np.clip(action[name], -90.0, 90.0)) for name in JOINTS}
        applied = dict(self._position)
        if self.config.fault == "sends nan" and self.sent == self.config.fault_at:
            applied["elbow.pos"] = math.nan
        return applied

    def disconnect(self) -> None:
        if not self._is_connected:
            raise DeviceNotConnectedError("The mock arm is not connected.")
        for camera in self.cameras.values():
            camera.disconnect()
        self._is_connected = False
        if self.config.times:
            with open(self.config.times, "w", encoding="utf-8") as file:
                file.write("\n".join(map(str, self._times)))


@TeleoperatorConfig.register_subclass("mock_leader")
@dataclass
class MockLeaderConfig(TeleoperatorConfig):
    """A leader that is moved in a sine; a fault happens at a number of calls."""

    amplitude: float = 20.0
    period_s: float = 2.0
    fault: str = ""
    fault_at: int = 10
    use_degrees: bool = True


class MockLeader(Teleoperator):
    """Moves as a person would."""

    config_class = MockLeaderConfig
    name = "mock_leader"

    def __init__(self, config: MockLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self._is_connected = False
        self._started = 0.0
        self.asked = 0

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        _ask(self.config.fault)
        self._is_connected, self._started = True, time.monotonic()

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        self.asked += 1
        value = self.config.amplitude * math.sin(
            (time.monotonic() - self._started) * 2 * math.pi / self.config.period_s
        )
        action: dict[str, Any] = dict.fromkeys(JOINTS, value)
        if self.asked >= self.config.fault_at:
            match self.config.fault:
                case "silent":
                    time.sleep(30)
                case "raises":
                    raise ConnectionError("the leader was unplugged")
                case "nan":
                    action["elbow.pos"] = math.nan
                case "missing key":
                    del action["elbow.pos"]
        return action

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self._is_connected = False
