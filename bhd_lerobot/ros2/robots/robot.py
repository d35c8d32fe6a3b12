"""Any ROS 2 robot as a LeRobot `Robot`: a mapping says which fields of which topics are its features."""

import os
import sys
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from bhd_lerobot.errors import ActionError, ConfigError, RealtimeError, unknown_name
from bhd_lerobot.ros2.live.link import NodeLink
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.spec import CameraSpec, InputSpec, NodeSpec, OutputSpec
from bhd_lerobot.ros2.messages.mapping import (
    FieldsReader,
    MappingConfig,
    TopicFields,
    features_of,
    sendable_topics,
    topics_of,
)
from bhd_lerobot.ros2.messages.table import SCAN
from bhd_lerobot.ros2.robots.config_robot import Ros2RobotConfig
from bhd_lerobot.ros2.robots.plant import scan_reader

_COMMAND_HZ = 50.0
_STANDS_NS = 3_000_000_000  # so long a robot may stand that is commanded to move
_MOVES = 0.05  # of the way that is commanded; less is noise


class Ros2Robot(Robot):
    """A robot on a ROS 2 network.

    Observation and action are the features of its mapping, the images those of its cameras. An observation is the
    newest message of each topic.

    Attributes:
        reading_timestamps: when each topic's numbers in the last observation were measured, on `time.perf_counter`
            [s]; none of messages that are on their way for an unknown time.
    """

    config_class = Ros2RobotConfig
    name = "ros2"

    def __init__(self, config: Ros2RobotConfig) -> None:
        super().__init__(config)
        self.config = config
        mapping = self._mapping = MappingConfig.load(config.mapping)
        if sizeless := [name for name, one in mapping.images.items() if not (one.width and one.height)]:
            raise ConfigError(
                f"{config.mapping}: images.{sizeless[0]} has no width and height [px]; a live camera needs both."
            )
        if unknown := [name for name in config.stop if name not in mapping.action]:
            raise ConfigError(unknown_name("action in robot.stop", unknown[0], mapping.action))
        if config.ros2.scan_yaw is not None and not any(one.beams for one in mapping.observation.values()):
            raise ConfigError(
                f"robot.ros2.scan_yaw is {config.ros2.scan_yaw}; {config.mapping} has no scan with beams."
            )
        self._names, self._actions = features_of(mapping.observation), tuple(mapping.action)
        inputs, self._places = self._inputs(mapping)
        self._acted = sendable_topics(mapping.action, mapping.types)
        named, remedy = config.ros2.in_namespace, f"Correct the type in {config.mapping}."
        self.spec = NodeSpec(
            f"bhd_{os.getpid()}",
            config.ros2,
            inputs,
            tuple(
                OutputSpec(named(one.topic), one.msgtype, one, remedy=remedy, stop=self._stop_of(one))
                for one in self._acted
            ),
            tuple(
                CameraSpec(name, named(one.topic), one.type, one.width, one.height, silence_s=config.topic_timeout_s)
                for name, one in mapping.images.items()
            ),
            command_hz=config.ros2.command_hz or _COMMAND_HZ,
            timeout_s=config.ros2.timeout_s,
            is_synchronised=config.ros2.synchronised,
        )
        self._link = NodeLink(self.spec)
        self.cameras = {name: Ros2Camera(self._link, index) for index, name in enumerate(mapping.images)}
        self.reading_timestamps: dict[str, float] = {}
        self._is_connected = False
        self._whole_turns: NDArray[np.float64] | None = None
        self._both = [name for name in self._actions if name in self._names]  # observed and commanded
        self._values = np.full(len(self._names), np.nan)
        self._first: NDArray[np.float64] | None = None  # what was observed when commands began
        self._since_ns = 0

    def _inputs(self, mapping: MappingConfig) -> tuple[tuple[InputSpec, ...], list[list[int]]]:
        """Return what is received, and where its numbers are in the observation."""
        found, places, named = [], [], self.config.ros2.in_namespace
        yaws: list[tuple[int, float]] = []
        numbers = {name: one for name, one in mapping.observation.items() if not one.beams}
        for topic in [part for whole in topics_of(numbers, mapping.types) for part in whole.parts()]:
            features = [list(numbers)[column] for column in topic.columns]
            reader = FieldsReader(topic, features)
            found.append(InputSpec(named(topic.topic), topic.msgtype, reader, SENSOR_DATA, self.config.topic_timeout_s))
            places.append([self._names.index(feature) for feature in features])
            yaws += [(places[-1][place], turn) for place, turn in topic.turns.items()]
        for name, one in mapping.observation.items():
            if one.beams:
                scans = scan_reader(self.config.ros2, one.topic, one.lidar, one.beams)
                found.append(InputSpec(named(one.topic), SCAN, scans, SENSOR_DATA, self.config.topic_timeout_s))
                places.append([self._names.index(feature) for feature in one.names(name)])
        self._yaws, self._turns = [place for place, _ in yaws], np.array([turn for _, turn in yaws])
        return tuple(found), places

    def _stop_of(self, topic: TopicFields) -> tuple[float, ...] | None:
        names = [self._actions[column] for column in topic.columns]
        if not any(name in self.config.stop for name in names) and not all(name.endswith(".vel") for name in names):
            return None
        if missing := [name for name in names if name not in self.config.stop and not name.endswith(".vel")]:
            raise ConfigError(
                f"robot.stop has no {' and no '.join(missing)}, which is no speed and goes to {topic.topic} in the "
                f"same message: it would be sent as 0. Set --robot.stop.{missing[0]}, too."
            )
        return tuple(self.config.stop.get(name, 0.0) for name in names)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """LeRobot's description of an observation: floats first, then images."""
        images = {name: (one.height, one.width, 3) for name, one in self._mapping.images.items()}
        return {**dict.fromkeys(self._names, float), **images}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """LeRobot's description of an action."""
        return dict.fromkeys(self._actions, float)

    @property
    def is_connected(self) -> bool:
        """Whether it is on the network."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Join the network, and wait for the robot's topics.

        Raises:
            RealtimeError: a topic sends nothing; names it, and why.
        """
        if self._is_connected:
            raise DeviceAlreadyConnectedError("The ROS 2 robot is already connected.")
        self._link.open()
        self._is_connected = True

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure beyond the configuration."""

    @property
    def reading_names(self) -> tuple[str, ...]:
        """The topics whose numbers it observes."""
        return tuple(dict.fromkeys(one.topic for one in self.spec.inputs))

    @property
    def reading_period_s(self) -> float:
        """Time between two messages of the slowest topic, and a quarter more for its jitter [s]."""
        periods = self._link.state["period_ns"] if self._is_connected else np.zeros(0)
        return 1.25e-9 * float(max(periods, default=0))

    def begin_episode(self) -> None:
        """Let yaws begin within half a turn of 0 with the next observation, as the import of a bag does."""
        self._whole_turns = None

    def get_observation(self) -> dict[str, Any]:
        """Return the newest values of all features: floats, and images of shape (height, width, 3), uint8 RGB.

        Raises:
            RealtimeError: a topic is silent, or another node commands the robot.
        """
        state = self._state()
        values = np.empty(len(self._names))
        for place, part in zip(self._places, self._link.spec.columns, strict=True):
            values[place] = state["values"][part]
        if self._whole_turns is None:
            self._whole_turns = self._turns * np.round(values[self._yaws] / self._turns)
        values[self._yaws] -= self._whole_turns
        self._values = values
        self.reading_timestamps = {}
        for one, measured in zip(self.spec.inputs, (state["measured_ns"] / 1e9).tolist(), strict=True):
            self.reading_timestamps[one.topic] = min(measured, self.reading_timestamps.get(one.topic, measured))
        observation: dict[str, Any] = dict(zip(self._names, values.tolist(), strict=True))
        return observation | {name: camera.read_latest() for name, camera in self.cameras.items()}

    def _state(self) -> Any:
        if not self._is_connected:
            raise DeviceNotConnectedError("The ROS 2 robot is not connected. Call connect() first.")
        self._link.check()
        if problem := self._link.problem:
            raise RealtimeError(problem)
        return self._link.state

    def send_action(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Send an action; return it.

        Raises:
            ActionError: an action is missing, or is not a finite number; nothing is sent.
        """
        self._state()
        missing = [name for name in self._actions if name not in action]
        if missing:
            raise ActionError(f"The action lacks {', '.join(missing)}. It needs {', '.join(self._actions)}.")
        values = np.array([float(action[name]) for name in self._actions])
        if not np.isfinite(values).all():
            raise ActionError(f"The action {dict(action)} has a value that is not finite.")
        sent = np.concatenate([values[list(topic.columns)] for topic in self._acted]) if self._acted else values
        self._link.write(sent)
        self._watch(action)
        return dict(zip(self._actions, values.tolist(), strict=True))

    def _watch(self, action: Mapping[str, Any]) -> None:
        """Print once that the robot stands although it is commanded to move, as with an inactive controller."""
        if not self._both or self._since_ns < 0:
            return
        now, seen = time.monotonic_ns(), self._values[[self._names.index(name) for name in self._both]]
        if self._first is None:
            speeds = np.array([name.endswith(".vel") for name in self._both])
            self._first, self._since_ns = np.where(speeds, 0.0, seen), now  # one that stands has no speed
        wanted = np.abs(np.array([float(action[name]) for name in self._both]) - self._first).max()
        if np.isnan(seen).any() or not wanted:
            self._first = None
        elif np.abs(seen - self._first).max() >= _MOVES * wanted:
            self._since_ns = -1
        elif now - self._since_ns > _STANDS_NS:
            topics = ", ".join(one.topic for one in self.spec.outputs)
            print(
                f"warning: the robot has not moved for {_STANDS_NS / 1e9:g} s, though it is commanded to, on {topics}. "
                "Are its motors on, and its controller active (ros2 control list_controllers)?",
                file=sys.stderr,
            )
            self._since_ns = -1

    def disconnect(self) -> None:
        """Stop the robot if it has a stop, and leave the network. May be called twice."""
        self._is_connected = False
        self._link.close()


class Ros2Camera:
    """The images of a topic.

    Attributes:
        latest_timestamp: when the last image was taken, on `time.perf_counter` [s]; None before the first.
    """

    def __init__(self, link: NodeLink, index: int) -> None:
        self._link, self._index = link, index
        self.latest_timestamp: float | None = None

    def read_latest(self) -> NDArray[np.uint8]:
        """Return the newest image, shape (height, width, 3)."""
        record = self._link.channel.images[self._index].latest()
        if record is None:
            raise RealtimeError("The camera has sent no image.")
        self.latest_timestamp = int(record["measured_ns"]) / 1e9
        image: NDArray[np.uint8] = record["pixels"]
        return image
