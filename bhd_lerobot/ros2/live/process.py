"""A node's process, and its guard: ``python -m bhd_lerobot.ros2.live.process ROLE PIPE MEMORY WAKE``.

The node receives, decodes and sends; no other process of ours talks to the network. A robot without a time-out of its
own would continue with its last command when the node is killed or stopped: then the guard, a second process with
publishers alone, sends the stop.
"""

import contextlib
import math
import os
import select
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from bhd_lerobot.errors import BhdError, DatasetError, as_text
from bhd_lerobot.ros2.live.channel import PROBLEM_BYTES, Channel, Word
from bhd_lerobot.ros2.live.clock_offset import ClockOffset
from bhd_lerobot.ros2.live.graph import Endpoint
from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.live.node import Node, Publisher, Received
from bhd_lerobot.ros2.live.spec import NodeSpec
from bhd_lerobot.ros2.messages.images import decode_image
from bhd_lerobot.ros2.messages.scan import ScanReader, static_frames, static_topics
from bhd_lerobot.ros2.messages.views import TF

_WAIT_S = 0.05  # the longest without a sign of life
_AGAIN_S = 0.02  # between two stops at the end
_FIRST_S = 1.0  # so long without a first message a topic is silent
_CHECK_NS = 500_000_000  # between two looks at who else is there
_MIXED_NS = 2_000_000_000  # so long two publishers of a topic are a problem after they were heard in turn
_FRAMES_NS = 5_000_000_000  # so long what states how scanners are mounted is waited for
_STOP_S = 1.0  # so long the stop is sent
_SILENT_S = 0.3  # so long without a sign of life the node counts as stopped
_TOMORROW_NS = 1_000_000_000  # a stamp further from the one before is of a clock that was set


class Stopper:
    """Sends the stop of all outputs.

    Args:
        publishers: of the outputs, in their order.
    """

    def __init__(self, spec: NodeSpec, publishers: list[Publisher]) -> None:
        self._pairs = [
            (publisher, one) for publisher, one in zip(publishers, spec.outputs, strict=True) if one.stop is not None
        ]
        self.since_ns = 0  # when the present stop began, monotonic [ns]; 0: there is none

    @property
    def is_over(self) -> bool:
        """Whether it was sent for long enough; the topic is left to others then."""
        return self.since_ns > 0 and time.monotonic_ns() - self.since_ns > _STOP_S * 1e9

    def send(self) -> None:
        """Send it once, unless it was sent for long enough."""
        self.since_ns = self.since_ns or time.monotonic_ns()
        if not self.is_over:
            for publisher, one in self._pairs:
                publisher.send(one.writer.encode(np.array(one.stop, np.float64), time.time_ns()))


class Sender(threading.Thread):
    """Sends commands as they come, at most so often; the stop when they cease."""

    def __init__(self, spec: NodeSpec, channel: Channel, publishers: list[Publisher], wake: int) -> None:
        super().__init__(name="bhd-ros2-sender", daemon=True)
        self._spec, self._channel, self._publishers, self._wake = spec, channel, publishers, wake
        self._stopper = Stopper(spec, publishers)
        self._parent = os.getppid()

    def run(self) -> None:
        """Send until the process is to end."""
        period = 1 / self._spec.command_hz
        sent = 0.0
        while not self._channel.words[Word.END] and os.getppid() == self._parent:
            longest = period if self._channel.words[Word.DRIVEN] else max(period, _WAIT_S)
            select.select([self._wake], [], [], max(0.0, sent + longest - time.monotonic()))
            if (left := sent + period - time.monotonic()) > 0:
                time.sleep(left)
            with contextlib.suppress(BlockingIOError):
                os.read(self._wake, 8)
            sent = time.monotonic()
            self.step()
        self._channel.words[Word.END] = 1
        if self._channel.words[Word.DRIVEN]:
            for _ in range(5):
                self._stopper.send()
                time.sleep(_AGAIN_S)
            self._channel.words[Word.DRIVEN] = 0

    def step(self) -> None:
        """Send the newest command, or the stop if it is too old."""
        command = self._channel.commands.latest()
        if command is None:
            return
        if time.monotonic_ns() - int(command["stamp_ns"]) > self._spec.timeout_s * 1e9:
            self._stopper.send()
            return
        self._stopper.since_ns = 0
        self._channel.words[Word.DRIVEN] = 1
        for publisher, one, part in zip(self._publishers, self._spec.outputs, self._spec.command_columns, strict=True):
            publisher.send(one.writer.encode(command["values"][part], time.time_ns()))


class Receiver:
    """Decodes what arrives, and says what is wrong."""

    def __init__(self, spec: NodeSpec, channel: Channel, node: Node) -> None:
        self._spec, self._channel, self._node = spec, channel, node
        self._columns = spec.columns
        self._inputs = [node.subscription(one.topic, one.msgtype, one.qos) for one in spec.inputs]
        self._cameras = [node.subscription(one.topic, one.msgtype, one.qos) for one in spec.cameras]
        self._clocks = [ClockOffset() for _ in (*self._inputs, *self._cameras)]
        self._stamps = [0] * len(self._inputs)  # newest of each [ns]
        self._old_stamps = [0] * len(self._inputs)  # newest before the sender's clock was set [ns]
        self._record = np.zeros((), channel.state_dtype)
        self._record["values"] = np.nan
        self._wrong: dict[str, str] = {}  # topic -> what is wrong with its newest message
        topics = [one.topic for one in (*spec.inputs, *spec.cameras)]
        self._heard: list[list[int]] = [[] for _ in topics]  # publishers, the one that was heard last at the end
        self._mixed_ns = [0] * len(topics)  # when a publisher was heard again after another one
        self._scanners = {one.topic: one.reader for one in spec.inputs if isinstance(one.reader, ScanReader)}
        frames = sorted({name for scan in self._scanners for name in static_topics(scan)})
        self._frames = [node.subscription(name, TF, Qos(100, transient_local=True)) for name in frames]
        self._frame_senders: set[int] = set()
        self._images_ns = [0] * len(self._cameras)
        self._others: set[str] = set()
        self._intruders: set[str] = set()
        self._checked_ns = 0
        self._start_ns = time.monotonic_ns()
        self._network_problem = ""
        channel.states.publish(self._record)

    def step(self) -> None:
        """Take what has arrived, and publish it."""
        news = False
        for subscription in self._frames:
            for received in subscription.take():
                self._frame_senders.add(received.sender)
                for scanner in self._scanners.values():
                    scanner.static |= static_frames([received.data])[0]
        for index, subscription in enumerate(self._inputs):
            for received in subscription.take():
                news = self._take(index, received) or news
        for index, subscription in enumerate(self._cameras):
            for received in subscription.take()[-1:]:
                self._take_image(index, received)
        now = time.monotonic_ns()
        if now - self._checked_ns > _CHECK_NS:
            self._checked_ns = now
            self._network_problem = self._intrusion() or self._twins(now)
        problem = (self._network_problem or self._silence(now)).encode()[:PROBLEM_BYTES]
        if news or problem != self._record["problem"]:
            self._record["problem"] = problem
            self._channel.states.publish(self._record)

    def _take(self, index: int, received: Received) -> bool:
        one, record = self._spec.inputs[index], self._record
        try:
            message = received.message()
            if one.topic in self._scanners and (lacking := self._lacking_frames(received.arrived_ns)):
                raise DatasetError(lacking)
            values = one.reader.read(message)
        except DatasetError as error:
            self._wrong[one.topic] = str(error)
            return False
        self._hear(index, received)
        header = getattr(message, "header", None)
        stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        if stamp:
            newest = self._stamps[index]
            if any(stamp <= other < stamp + _TOMORROW_NS for other in (newest, self._old_stamps[index])):
                record["dropped"][index] += 1
                return False  # out of order; a stamp that is far behind is of a clock that was set
            if abs(stamp - newest) > _TOMORROW_NS:
                self._old_stamps[index] = newest
            self._stamps[index] = stamp
        self._wrong.pop(one.topic, None)
        record["count"][index] += 1
        record["arrived_ns"][index] = received.arrived_ns
        record["measured_ns"][index] = self._clocks[index].measured_ns(stamp, received.arrived_ns)
        record["values"][self._columns[index]] = values
        return True

    def _hear(self, index: int, received: Received) -> None:
        heard = self._heard[index]
        if received.sender in heard:
            if heard[-1] != received.sender:
                self._mixed_ns[index] = received.arrived_ns
            heard.remove(received.sender)
        heard.append(received.sender)

    def _lacking_frames(self, now_ns: int) -> str:
        """Return as text which topic has not stated yet how scanners are mounted; empty if none is waited for."""
        if now_ns - self._start_ns > _FRAMES_NS:
            return ""
        silent = [one.topic for one in self._frames if not self._frame_senders.issuperset(one.sender_ids)]
        return f"{' and '.join(silent)} may state how the scanner is mounted, and has not been received" * bool(silent)

    def _take_image(self, index: int, received: Received) -> None:
        camera = self._spec.cameras[index]
        ring = self._channel.images[index]
        try:
            image = decode_image(camera.topic, camera.msgtype, received.data)
        except DatasetError as error:
            self._wrong[camera.topic] = str(error)
            return
        if image.shape != (camera.height, camera.width, 3):
            height, width, _ = image.shape
            self._wrong[camera.topic] = f"it is {width} x {height} px, not {camera.width} x {camera.height}"
            return
        self._wrong.pop(camera.topic, None)
        record = np.zeros((), self._channel.image_dtypes[index])
        clock = self._clocks[len(self._inputs) + index]
        record["measured_ns"] = clock.measured_ns(_header_stamp(received.data), received.arrived_ns)
        record["pixels"] = image
        ring.publish(record)
        self._images_ns[index] = received.arrived_ns
        self._hear(len(self._inputs) + index, received)

    # --- problems ----------------------------------------------------------------------------------------------------

    def _silence(self, now_ns: int) -> str:
        """Return which topic is silent, and why, as text; empty if none is."""
        listened: list[tuple[Any, Any]] = [
            *zip(self._spec.inputs, self._record["arrived_ns"], strict=True),
            *zip(self._spec.cameras, self._images_ns, strict=True),
        ]
        for one, arrived in listened:
            silent = (now_ns - max(int(arrived), self._start_ns)) / 1e9
            # What has never come is named soon, for the one who waits for it.
            if silent > (one.silence_s if arrived or math.isinf(one.silence_s) else min(one.silence_s, _FIRST_S)):
                return self._why(one, silent, heard=bool(arrived))
        return ""

    def _why(self, one: Any, silent_s: float, *, heard: bool) -> str:
        if wrong := self._wrong.get(one.topic):
            return f"The newest message of {one.topic} cannot be used: {wrong}"
        mismatches = self._node.graph.mismatches(one.topic, one.msgtype, one.qos, is_publisher=False)
        if mismatches:
            return " ".join(mismatches)
        endpoints = [other for other in self._node.graph.endpoints() if other.is_publisher and not self._is_ours(other)]
        if any(other.topic == one.topic for other in endpoints):
            so_long = f"for {silent_s:.1f} s" if heard else "yet"
            return f"{one.topic} has a publisher and no message {so_long}."
        return f"Nobody publishes {one.topic} ({one.msgtype}){' any more' if heard else ''}. {_offers(one, endpoints)}"

    def _intrusion(self) -> str:
        """Return which other nodes publish on the topics of commands, as text; empty if none does."""
        if not self._spec.is_alone:
            return ""
        topics = {one.topic for one in self._spec.outputs}
        now = {
            f"{other.topic} by {other.node or 'an unnamed node'}"
            for other in self._node.graph.endpoints()
            if other.is_publisher and other.topic in topics and not self._is_ours(other)
        }
        # One that has just appeared may not have told its name yet, and may be the guard.
        self._intruders, self._others = now & self._others, now
        self._channel.words[Word.OTHERS] = len(self._intruders)
        self._channel.words[Word.CHECKS] += 1
        if not self._intruders:
            return ""
        return (
            f"Another node commands the robot: {', '.join(sorted(self._intruders))}. Stop it; one that was killed "
            "counts for up to 20 s more."
        )

    def _twins(self, now_ns: int) -> str:
        """Return which topic two publishers send to at a time, as text; empty if none. A robot may have restarted."""
        everyone: tuple[Any, ...] = (*self._spec.inputs, *self._spec.cameras)
        for one, mixed_ns in zip(everyone, self._mixed_ns, strict=True):
            if mixed_ns and now_ns - mixed_ns < _MIXED_NS:
                ends = self._node.graph.endpoints()
                nodes = sorted({end.node or "?" for end in ends if end.is_publisher and end.topic == one.topic})
                return (
                    f"Several nodes send {one.topic} at a time: {', '.join(nodes)}. Are there two robots of one name?"
                )
        return ""

    def _is_ours(self, endpoint: Endpoint) -> bool:
        return endpoint.is_own or endpoint.node == f"/{self._spec.name}_guard"


def _header_stamp(data: bytes) -> int:
    """Return the stamp [ns] of a serialised message that begins with a header."""
    order: Any = "little" if data[1] & 1 else "big"
    seconds, nanoseconds = (int.from_bytes(data[k : k + 4], order) for k in (4, 8))
    return seconds * 1_000_000_000 + nanoseconds


def _offers(one: Any, endpoints: list[Endpoint]) -> str:
    fitting = sorted({other.topic for other in endpoints if other.msgtype == one.msgtype})
    if fitting:
        return f"Of this type there are: {', '.join(fitting)}."
    there = sorted({other.topic for other in endpoints})
    return f"There are: {', '.join(there)}." if there else "No node publishes anything on this network."


def _run_node(spec: NodeSpec, channel: Channel, connection: Connection, wake: int) -> None:
    with Node(spec.name, spec.network) as node:
        receiver = Receiver(spec, channel, node)
        sender = Sender(spec, channel, [node.publisher(one.topic, one.msgtype, one.qos) for one in spec.outputs], wake)
        channel.show_life(Word.ALIVE)
        connection.send("ready")
        sender.start()
        while sender.is_alive():
            node.wait(_WAIT_S)
            receiver.step()
            channel.show_life(Word.ALIVE)


def _run_guard(spec: NodeSpec, channel: Channel, connection: Connection) -> None:
    parent = os.getppid()
    with Node(f"{spec.name}_guard", spec.network) as node:
        publishers = [node.publisher(one.topic, one.msgtype, one.qos) for one in spec.outputs]
        stopper = Stopper(spec, publishers)
        channel.show_life(Word.GUARD_ALIVE)
        connection.send("ready")
        while True:
            channel.show_life(Word.GUARD_ALIVE)
            is_silent = channel.silence_s(Word.ALIVE) > _SILENT_S
            is_driven = bool(channel.words[Word.DRIVEN])  # not after the node itself has sent the stop
            if is_silent and is_driven:
                stopper.send()
            else:
                stopper.since_ns = 0
            is_over = channel.words[Word.END] or os.getppid() != parent
            if is_over and is_silent and (not is_driven or stopper.is_over):
                return
            time.sleep(_WAIT_S)


def main() -> int:
    """Run the process; return its exit status."""
    role, pipe, memory, wake = sys.argv[1], *(int(text) for text in sys.argv[2:5])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = Connection(pipe)
    try:
        spec: NodeSpec = connection.recv()
        channel = Channel(spec, memory)
        if role == "guard":
            _run_guard(spec, channel, connection)
        else:
            _run_node(spec, channel, connection, wake)
    except EOFError:
        return 1
    except BhdError as error:
        with contextlib.suppress(OSError):
            connection.send(f"failed: {error}")
        return 2
    except Exception as error:
        with contextlib.suppress(OSError):
            connection.send(f"failed: {as_text(error)}")
        raise
    return 0


if __name__ == "__main__":
    sys.exit(main())
