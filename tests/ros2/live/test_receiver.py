"""Which messages a node's process takes, whatever the stamps in them are."""

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.ros2.live.channel import Channel
from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Received
from bhd_lerobot.ros2.live.process import Receiver
from bhd_lerobot.ros2.live.spec import InputSpec, NodeSpec
from bhd_lerobot.ros2.messages.mapping import fields_of
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode

BATTERY = "sensor_msgs/msg/BatteryState"


def taken(stamps: list[float]) -> list[float]:
    """Return the numbers of the messages that are taken, of messages with stamps [s] that are numbered from 0 on."""
    now = time.monotonic_ns()
    arrived = [
        Received(
            BATTERY, encode(BATTERY, {"header": header(np.array([round(stamp * 1e9)])), "voltage": n}, 1)[0], 0, now
        )
        for n, stamp in enumerate(stamps)
    ]
    topic: Any = SimpleNamespace(take=lambda: [arrived.pop(0)] if arrived else [])
    node: Any = SimpleNamespace(subscription=lambda *_: topic, graph=SimpleNamespace(endpoints=list))
    spec = NodeSpec("test", NetworkConfig(), (InputSpec.of(fields_of("/battery", BATTERY, ["voltage"])),))
    channel = Channel(spec)
    receiver = Receiver(spec, channel, node)
    found = []
    while arrived:
        receiver.step()
        state = channel.states.latest()
        if state is not None and state["count"][0] == len(found) + 1:
            found.append(float(state["values"][0]))
    channel.close()
    return found


@pytest.mark.law
@pytest.mark.parametrize(
    ("stamps", "wanted"),
    [
        ([10.0, 10.1, 10.2], [0, 1, 2]),
        ([10.0, 10.2, 10.1, 10.3], [0, 1, 3]),
        ([0.0, 0.0, 0.0], [0, 1, 2]),  # no stamps
        ([10.0, 3610.0, 3610.1, 10.3, 10.4], [0, 1, 2, 3, 4]),  # the clock is set, and set back
        ([10.0, 10.1, 9.6, 9.7, 9.8], [0, 1, 3, 4]),  # set back by less than a second
        ([10.0, 10.2, 3610.3, 10.1, 3610.4, 10.2, 3610.3, 3610.5], [0, 1, 2, 4, 7]),  # one is late from before
    ],
)
def test_a_message_is_taken_unless_it_comes_after_a_later_one_of_the_same_clock(stamps, wanted):
    assert taken(stamps) == wanted
