"""What plants of ROS 2 robots have in common: a node in a process of its own below the cerebellum."""

import os
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.ros2.live.link import NodeLink
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.live.spec import InputSpec, NodeSpec, OutputSpec, silence_text
from bhd_lerobot.ros2.messages.scan import ScanReader

_NEARLY = 0.9  # of `moves`: a robot that is to move just so fast reads a little less


def scan_reader(network: Ros2Config, topic: str, lidar: LidarSpec, beams: int) -> ScanReader:
    """Return what reads the scans of a robot, mounted as its options or ``/tf_static`` state."""
    return ScanReader(network.in_namespace(topic), lidar, beams, network.scan_frame, network.scan_yaw, "--robot.ros2.")


class Ros2Plant(Plant):
    """A robot on a ROS 2 network.

    Attributes:
        moves: a command that is so far from rest moves the robot, see `commanded` and `moved`.
        followed_s: how long after its first such command the robot had moved as far [s]; None before.
    """

    n = 1
    command_hz: float
    usual_latency_s: float
    moves: float

    def __init__(self, name: str, config: Any, inputs: tuple[InputSpec, ...], outputs: tuple[OutputSpec, ...]) -> None:
        network = config.ros2
        spec = NodeSpec(
            f"bhd_{name}_{os.getpid()}",
            network,
            tuple(replace(one, topic=network.in_namespace(one.topic)) for one in inputs),
            tuple(replace(one, topic=network.in_namespace(one.topic)) for one in outputs),
            command_hz=network.command_hz or self.command_hz,
            timeout_s=network.timeout_s,
            is_synchronised=network.synchronised,
        )
        self.link = NodeLink(spec)
        self._parts = spec.columns
        self._silence_s = network.silent_s
        self.latency_s = self.usual_latency_s if network.latency_s is None else network.latency_s
        sent = ", ".join(one.topic for one in spec.outputs if one.is_required)
        self.hint = f"Commands go to {sent}. A robot that follows later needs a larger robot.ros2.latency_s."
        self._enabled = False
        self._commanded_ns = 0
        self.followed_s: float | None = None

    def open(self) -> None:
        """Join the network, and wait for the robot's topics.

        Raises:
            RealtimeError: a topic sends nothing, or another node commands the robot.
        """
        self.link.open()

    def enable(self) -> None:
        """Let commands through from now on."""
        self._enabled = True

    def state(self) -> Any:
        """Return the newest state of the node.

        Raises:
            RealtimeError: something is wrong with the topics, or the node's process has ended.
        """
        state = self.link.state
        silent_s = (time.monotonic_ns() - int(state["arrived_ns"][0])) / 1e9
        is_old = silent_s > self._silence_s
        # Of old readings the node is the cause only if it did not live for half of that time after the last of them.
        self.link.check(silent_s - self._silence_s / 2 if is_old else self._silence_s)
        if problem := bytes(state["problem"]).decode(errors="ignore"):
            raise RealtimeError(problem)
        if is_old:
            raise RealtimeError(f"{silence_text(self.link.spec.inputs[0].topic, silent_s)}.")
        return state

    def read(self, out: PlantReading) -> None:
        """Write the newest readings into `out`."""
        self.read_parts(self.state(), out)
        if self.followed_s is None and self._commanded_ns and self.moved(out) >= _NEARLY * self.moves:
            self.followed_s = (time.monotonic_ns() - self._commanded_ns) / 1e9

    def commanded(self, ctrl: np.ndarray) -> float:
        """Return how far from rest a command is, shape (n, joints)."""
        raise NotImplementedError

    def moved(self, out: PlantReading) -> float:
        """Return how far from rest the robot is, in the same unit."""
        raise NotImplementedError

    def read_parts(self, state: Any, out: PlantReading) -> None:
        """Write what the robot's topics say into `out`."""
        raise NotImplementedError

    def numbers(self, state: Any, index: int) -> Any:
        """Return the numbers of an input, shape (width,)."""
        return state["values"][self._parts[index]]

    def write(self, ctrl: np.ndarray) -> None:
        """Send commands."""
        if self._enabled:
            self.link.write(ctrl[0])
            if not self._commanded_ns and self.commanded(ctrl) >= self.moves:
                self._commanded_ns = time.monotonic_ns()

    def close(self) -> None:
        """Stop the robot, and leave the network."""
        self._enabled = False
        self.link.close()
        if self.followed_s is not None:
            advice = (
                "" if self.followed_s < self.latency_s else f" Set --robot.ros2.latency_s={1.25 * self.followed_s:.2f}"
            )
            print(
                f"The robot followed its first command after {self.followed_s:.2f} s (robot.ros2.latency_s "
                f"{self.latency_s:g}).{advice}",
                file=sys.stderr,
            )
            self.followed_s = None
