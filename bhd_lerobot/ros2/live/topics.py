"""What is on a network, for people: its topics, the rate of one, and messages as plain values."""

import math
import time
from collections import deque
from dataclasses import fields, is_dataclass
from itertools import groupby
from typing import Any

import numpy as np

from bhd_lerobot.errors import ConfigError, RealtimeError, unknown_name
from bhd_lerobot.ros2.live.graph import Endpoint
from bhd_lerobot.ros2.live.network import NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node, Subscription
from bhd_lerobot.ros2.messages.definitions import find_type

_SHOWN = 8  # elements of a longer array
_POLL_S = 0.02
_NAMES_S = 3.0  # Fast DDS sends the names of a process's nodes to one that has come later with its next heartbeat


def found_topics(node: Node, wait_s: float) -> list[Endpoint]:
    """Return all publishers and subscriptions of others, after the time in which they are found [s].

    Names of nodes come after their topics: for those that are missing it waits a little longer.

    Raises:
        RealtimeError: nobody else is there.
    """
    time.sleep(wait_s)
    end = time.monotonic() + _NAMES_S
    while "" in {one.node for one in _of_others(node)} and time.monotonic() < end:
        time.sleep(_POLL_S)
    found = _of_others(node)
    if not found and len(node.graph.nodes()) <= 1:
        raise RealtimeError(_nobody(node.network, wait_s))
    return found


def _of_others(node: Node) -> list[Endpoint]:
    return [one for one in node.graph.endpoints() if not one.is_own]


def _nobody(network: NetworkConfig, wait_s: float) -> str:
    domain = network.domain_number
    remedy = (
        "Nodes on other machines are found with --interface=auto, or with the name of a network interface."
        if network.is_local
        else f"Without multicast, as in many wireless networks, --peers names the other machines. A firewall must let "
        f"the UDP ports {7400 + 250 * domain} to {7649 + 250 * domain} pass."
    )
    return (
        f"Nobody is in ROS domain {domain} on {network.interface!r}, after {wait_s:g} s. Check that a node runs, and "
        f"that the ROS_DOMAIN_ID of its shell is {domain}, or set --domain. {remedy}"
    )


def described(endpoints: list[Endpoint]) -> list[str]:
    """Return lines about topics: types, publishers, subscriptions, and what does not fit together."""
    lines = []
    for topic, group in groupby(endpoints, lambda one: one.topic):
        ends = list(group)
        lines.append(f"{topic}  {', '.join(sorted({one.msgtype for one in ends}))}")
        for one in ends:
            kind = "publisher" if one.is_publisher else "subscription"
            lines.append(f"  {kind:<12}  {one.node or '(unnamed node)'}  {one.qos}")
        lines += [f"  mismatch: {text}" for text in _mismatches(ends)]
    return lines


def _mismatches(ends: list[Endpoint]) -> list[str]:
    """Return why publishers and subscriptions of a topic exchange nothing, in sentences."""
    found = []
    for publisher in (one for one in ends if one.is_publisher):
        for one in (one for one in ends if not one.is_publisher):
            names = publisher.node or "an unnamed node", one.node or "an unnamed node"
            if publisher.msgtype != one.msgtype:
                found.append(f"{names[0]} publishes {publisher.msgtype}, {names[1]} subscribes to {one.msgtype}.")
            elif not publisher.qos.serves(one.qos):
                found.append(f"{names[0]} publishes {publisher.qos}, {names[1]} wants {one.qos}; no message passes.")
    return list(dict.fromkeys(found))


def subscribed(node: Node, topic: str, wait_s: float) -> Subscription:
    """Subscribe to a topic, with the type of its publishers and a quality of service that fits all of them.

    Raises:
        ConfigError: there are several types, or the type's definition is not known.
        RealtimeError: there is no publisher of it.
    """
    topic, end = "/" + topic.lstrip("/"), time.monotonic() + wait_s
    while not (publishers := [one for one in _of_others(node) if one.topic == topic and one.is_publisher]):
        if time.monotonic() > end:
            raise RealtimeError(_absent(node, topic, wait_s))
        time.sleep(_POLL_S)
    types = sorted({one.msgtype for one in publishers})
    if len(types) > 1:
        who = ", ".join(f"{one.node or 'an unnamed node'} publishes {one.msgtype}" for one in publishers)
        raise ConfigError(f"{topic} has several types: {who}.")
    find_type(types[0], node.network.distro)
    # A reliable subscription would have what Fast DDS sends first late or never, see `clients`.
    keeps = all(one.qos.transient_local for one in publishers)
    return node.subscription(topic, types[0], Qos(1000, reliable=keeps, transient_local=keeps))


def _absent(node: Node, topic: str, wait_s: float) -> str:
    there = _of_others(node)
    if not there:
        return _nobody(node.network, wait_s)
    if any(one.topic == topic for one in there):
        return f"Nobody publishes {topic}, after {wait_s:g} s; there are subscriptions to it."
    names = {one.topic for one in there if one.is_publisher and not is_hidden(one.topic)}
    return f"{unknown_name('topic', topic, names)} These have publishers, after {wait_s:g} s."


def is_hidden(topic: str) -> bool:
    """Return whether a topic is a part of an action or for ROS 2's own use."""
    return "/_" in topic


class Intervals:
    """Times between messages, of the last seconds and of all."""

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self.count, self.mean, self._squares, self.least, self.most = 0, 0.0, 0.0, math.inf, 0.0
        self._times: deque[float] = deque()
        self._last: float | None = None

    def add(self, now_s: float) -> None:
        """Add a message, which arrived at a time [s]."""
        if self._last is not None:
            interval = now_s - self._last
            self.count += 1
            change = interval - self.mean
            self.mean += change / self.count
            self._squares += change * (interval - self.mean)
            self.least, self.most = min(self.least, interval), max(self.most, interval)
        self._last = now_s
        self._times.append(now_s)

    def of_window(self, now_s: float) -> str:
        """Return a line about the last seconds."""
        while self._times and self._times[0] < now_s - self.window_s:
            self._times.popleft()
        if len(self._times) < 2:
            ago = "yet" if self._last is None else f"for {now_s - self._last:.1f} s"
            return f"no message {ago}" if not self._times else "one message"
        intervals = np.diff(np.array(self._times))
        return _line(len(intervals), intervals.mean(), intervals.min(), intervals.max(), intervals.std())

    def of_all(self) -> str:
        """Return a line about all messages."""
        if not self.count:
            return "no message" if self._last is None else "one message"
        return _line(self.count, self.mean, self.least, self.most, math.sqrt(self._squares / self.count))


def _line(count: int, mean: float, least: float, most: float, deviation: float) -> str:
    rate = f"{1 / mean:.4g} Hz" if mean else "inf Hz"
    return (
        f"{rate}; interval: mean {1e3 * mean:.3f} ms, min {1e3 * least:.3f}, max {1e3 * most:.3f}, "
        f"standard deviation {1e3 * deviation:.3f}; {count + 1} messages"
    )


def plain(value: Any) -> Any:
    """Return a message, or a part of one, as dictionaries, lists and Python's own values; long arrays are shortened."""
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value) if not one.name.startswith("_")}
    if isinstance(value, np.ndarray | list):
        shown = [plain(one) for one in value[:_SHOWN]]
        return shown if len(value) <= _SHOWN else [*shown, f"{len(value) - _SHOWN} more"]
    if isinstance(value, np.floating):
        return float(str(value))  # a float32 with its own digits
    return value.item() if isinstance(value, np.generic) else value


def at_path(message: Any, path: str) -> Any:
    """Return a field of a message: names and numbers of elements, separated by dots, as in ``transforms.0.header``.

    Raises:
        ConfigError: it has no such field.
    """
    for name in filter(None, path.split(".")):
        if is_dataclass(message):
            names = [one.name for one in fields(message) if not one.name.startswith("_")]
            if name not in names:
                raise ConfigError(f"{path}: {unknown_name('field', name, names)}")
            message = getattr(message, name)
        elif isinstance(message, list | np.ndarray) and name.isdecimal() and int(name) < len(message):
            message = message[int(name)]
        else:
            size = f"{len(message)} elements" if isinstance(message, list | np.ndarray) else "no fields"
            raise ConfigError(f"{path}: there is no {name!r} in what has {size}.")
    return message
