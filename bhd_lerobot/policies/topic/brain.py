"""The brain `topic`: another node's messages are the setpoints."""

import os
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command
from bhd_lerobot.errors import BrainStoppedError, ConfigError, RealtimeError, unknown_name
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.topic.config import TopicConfig
from bhd_lerobot.ros2.live.link import NodeLink
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.spec import InputSpec, NodeSpec
from bhd_lerobot.ros2.messages.mapping import FieldConfig, MappingConfig, topics_of
from bhd_lerobot.ros2.messages.presets import entries
from bhd_lerobot.ros2.messages.table import STAMPED_TWIST, TWIST_TYPE

BASE_TOPIC, TOPIC = "/brain/cmd_vel", "/brain/commands"
_DISCOVERY_S = 5.0  # that it may take until a node of Fast DDS sends to one that has just come
_FLOATS = "std_msgs/msg/Float64MultiArray"


class TopicBrain(Brain):
    """Drives one robot with what another node sends."""

    name = "topic"
    uses_privileged_state = False
    config: TopicConfig

    def __init__(self, config: TopicConfig) -> None:
        super().__init__(config)
        self._link: NodeLink | None = None
        self._columns: list[list[int]] = []
        self._heard_ns = 0

    def bind(self, robot: RobotFeatures) -> None:
        """Join the network.

        Raises:
            ConfigError: Cyclone DDS is not installed, or the mapping lacks an action of the robot.
            RealtimeError: the network cannot be used.
        """
        self.close()
        mapping = MappingConfig.load(self.config.mapping) if self.config.mapping else self._default(robot)
        if unknown := [name for name in mapping.action if name not in robot.action_names]:
            raise ConfigError(f"{self.config.mapping}: {unknown_name('action', unknown[0], robot.action_names)}")
        if missing := [name for name in robot.action_names if name not in mapping.action]:
            raise ConfigError(f"The mapping {self.config.mapping} has no action {', '.join(missing)}.")
        topics = topics_of(mapping.action, mapping.types)
        names = list(mapping.action)
        self._columns = [[robot.action_names.index(names[column]) for column in topic.columns] for topic in topics]
        inputs = tuple(InputSpec.of(topic, SENSOR_DATA, self.config.timeout_s / 2) for topic in topics)
        self._link = NodeLink(NodeSpec(f"bhd_brain_{os.getpid()}", self.config.network, inputs))
        self._link.open(patience_s=None)

    def _default(self, robot: RobotFeatures) -> MappingConfig:
        speeds = robot.body.drive.limits.names if robot.body and robot.body.drive else ()
        msgtype = TWIST_TYPE if self.config.network.distro == "humble" else STAMPED_TWIST
        driven = [name for name in robot.action_names if name in speeds]
        numbered = enumerate(name for name in robot.action_names if name not in speeds)
        others = {name: FieldConfig(TOPIC, _FLOATS, f"data[{k}]") for k, name in numbered}
        return MappingConfig(action=entries(BASE_TOPIC, msgtype, driven) | others)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start an episode: another node, which may just have found this one, is given time to send a setpoint.

        Raises:
            ConfigError: there are several robots.
        """
        if n != 1:
            raise ConfigError(f"n_envs is {n}; a node drives one robot: use --n_envs=1.")
        start = time.monotonic()
        while self._newest_ns() == 0 and time.monotonic() - start < _DISCOVERY_S:
            time.sleep(0.02)
        self._heard_ns = time.monotonic_ns()

    def _newest_ns(self) -> int:
        """Return when the oldest of the newest messages arrived, monotonic [ns]; 0 if one has not come yet."""
        state = None if self._link is None else self._link.state
        return 0 if state is None or not state["count"].all() else int(state["arrived_ns"].min())

    def act(self, observation: Observation) -> Command:
        """Return the newest setpoint; None if there is none, or it is too old.

        Raises:
            BrainStoppedError: no setpoint has come for `timeout_s`, or the node's process has ended; says why.
        """
        if self._link is None:
            raise AssertionError("The brain was not bound.")
        try:
            self._link.check()
        except RealtimeError as error:
            raise BrainStoppedError(str(error).removesuffix(".")) from error
        oldest, now = self._newest_ns(), time.monotonic_ns()
        self._heard_ns = max(self._heard_ns, oldest)
        if now - self._heard_ns > self.config.timeout_s * 1e9:
            why = self._link.problem.removesuffix(".") or "a topic sends nothing"
            raise BrainStoppedError(f"no setpoint for {(now - self._heard_ns) / 1e9:.1f} s: {why}")
        if now - oldest > self.config.command_timeout_s * 1e9:
            return None
        state = self._link.state
        values = np.empty((1, sum(map(len, self._columns))))
        for columns, part in zip(self._columns, self._link.spec.columns, strict=True):
            values[0, columns] = state["values"][part]
        if not np.isfinite(values).all():
            raise BrainStoppedError(f"the setpoint {values[0].tolist()} has a value that is not finite")
        return values

    def close(self) -> None:
        """Leave the network. May be called twice."""
        if self._link is not None:
            self._link.close()
            self._link = None
