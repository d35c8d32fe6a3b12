"""Setpoints that are streamed to a robot: twists to a base, joint positions to an arm."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bhd_lerobot.control.messages import Reason
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.messages.table import STAMPED_TWIST, TWIST_TYPE
from bhd_lerobot.ros2.serve.server import Counts, Input, Topics


class Setpoints(Topics):
    """The topic by which a brain streams setpoints: twists of a base, joint positions and the opening of an arm."""

    def __init__(self, host: LiveHost, node: Node, counts: Counts, taken: Callable[[], None], topic: str) -> None:
        self._host, self._counts, self._taken, self._topic = host, counts, taken, topic
        is_arm = host.body.arm is not None
        # Twists of Jazzy, and those of Humble and of most tutorials.
        types = (ur.FLOATS,) if is_arm else (STAMPED_TWIST, TWIST_TYPE)
        take = self._move if is_arm else self._drive
        self.inputs = [Input(node.subscription(topic, msgtype), take) for msgtype in types]

    def _drive(self, message: Any) -> bool:
        twist = getattr(message, "twist", message)
        return self._send([twist.linear.x, twist.angular.z])

    def _move(self, message: Any) -> bool:
        names = self._host.action_names
        if len(message.data) != len(names):
            self._counts.add(f"{self._topic}: {len(message.data)} values; there are {len(names)}: {', '.join(names)}")
            return False
        return self._send(message.data)

    def _send(self, values: Any) -> bool:
        sent = self._host.bridge.send(np.array([values], np.float64))
        self._counts.add_result(self._topic, sent)
        if Reason(int(sent.reasons[0])) != Reason.ACCEPTED:
            return False
        self._taken()
        return True
