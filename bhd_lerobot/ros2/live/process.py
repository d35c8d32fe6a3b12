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
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from bhd_lerobot.errors import BhdError, DatasetError, as_text
from bhd_lerobot.ros2.live.channel import PROBLEM_BYTES, Channel, Word
from bhd_lerobot.ros2.live.clock_offset import ClockOffset
from bhd_lerobot.ros2.live.graph import Endpoint
from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.live.node import Node, Publisher, Received
from bhd_lerobot.ros2.live.spec import NodeSpec, silence_text
from bhd_lerobot.ros2.messages.images import decode_image
from bhd_lerobot.ros2.messages.parts import head_stamps
from bhd_lerobot.ros2.messages.scan import ScanReader, static_frames, static_of, static_topics
from bhd_lerobot.ros2.messages.views import TF

_WAIT_S = 0.05  # the longest without a sign of life
_AGAIN_S = 0.02  # between two stops at the end
_FIRST_S = 1.0  # so long without a first message a topic is silent
_CHECK_NS = 500_000_000  # between two looks at who else is there
_MIXED_NS = 2_000_000_000  # so long two publishers of a topic are a problem after they were heard in turn
_FRAMES_NS = 5_000_000_000  # so long what states how scanners are mounted is waited for
_STOP_S = 1.0  # so long the stop is sent
_SILENT_S = 0.3  # so long without a sign of life the node counts as stopped
_SLACK_NS = 100_000_000  # by so much more than time passed may a clock that was set go on with the next message
_TOMORROW_NS = 1_000_000_000  # a stamp further from the one before is of a clock that was set


class Stopper:
    """Sends the stop of all outputs."""

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
    """Sends commands as they come, at most so often; those that stay again and again, and the stop when they cease."""

    def __init__(self, spec: NodeSpec, channel: Channel, publishers: list[Publisher], wake: int) -> None:
        super().__init__(name="bhd-ros2-sender", daemon=True)
        self._spec, self._channel, self._publishers, self._wake = spec, channel, publishers, wake
        self._stopper = Stopper(spec, publishers)
        self._parent = os.getppid()

    def run(self) -> None:
        """Send until the process is to end."""
        period = 1 / self._spec.command_hz
        # Between two that are new, what stays is never due: it would be sent just before what is new, and delay it.
        again = min(2 * period, max(period, _WAIT_S))
        words, sent, changed = self._channel.words, 0.0, 0.0
        while not words[Word.END] and os.getppid() == self._parent:
            longest = again if words[Word.DRIVEN] else max(period, _WAIT_S)
            is_new, _, _ = select.select([self._wake], [], [], max(0.0, sent + longest - time.monotonic()))
            if is_new:
                time.sleep(max(0.0, changed + period - time.monotonic()))
                os.eventfd_read(self._wake)
                changed = time.monotonic()
            sent = time.monotonic()
            self.step()
        words[Word.END] = 1
        if words[Word.DRIVEN]:
            for _ in range(5):
                self._stopper.send()
                time.sleep(_AGAIN_S)
            words[Word.DRIVEN] = 0

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
        # Several inputs may be of one topic, whose messages have the numbers of some of them each.
        self._inputs: dict[tuple[str, str, Qos], list[int]] = {}
        for index, one in enumerate(spec.inputs):
            self._inputs.setdefault((one.topic, one.msgtype, one.qos), []).append(index)
        self._subscriptions = [
            [node.subscription(topic, msgtype, each) for each in _either(qos)] for topic, msgtype, qos in self._inputs
        ]
        self._cameras = [node.subscription(one.topic, one.msgtype, one.qos) for one in spec.cameras]
        self._clocks = [
            ClockOffset(is_synchronised=spec.network.is_local or spec.is_synchronised)
            for _ in (*spec.inputs, *spec.cameras)
        ]
        self._is_rate_known = False  # whether it was printed that a clock is slow
        self._dropped: dict[int, tuple[int, int]] = {}  # stamp and arrival of the message that was dropped last [ns]
        self._stamps = [0] * len(spec.inputs)  # newest of each [ns]
        self._old_stamps = [0] * len(spec.inputs)  # newest before the sender's clock was set [ns]
        self._record = np.zeros((), channel.state_dtype)
        self._record["values"] = np.nan
        self._wrong: dict[
            int, str
        ] = {}  # number of the input, or beyond them of the camera -> what is wrong with its newest message
        self._topics: list[Any] = [*spec.inputs, *spec.cameras]
        self._heard: list[list[int]] = [[] for _ in self._topics]  # publishers, the one that was heard last at the end
        self._mixed_ns = [0] * len(self._topics)  # when a publisher was heard again after another one
        self._scanners = {one.topic: one.reader for one in spec.inputs if isinstance(one.reader, ScanReader)}
        frames = sorted({name for scan in self._scanners for name in static_topics(scan)})
        self._frames = [node.subscription(name, TF, Qos(100, transient_local=True)) for name in frames]
        self._static: dict[str, dict[str, Any]] = {name: {} for name in frames}
        self._frame_senders: set[int] = set()
        self._images_ns = [0] * len(self._cameras)
        self._others: set[str] = set()
        self._missed: set[str] = set()  # topics of commands that nobody received
        self._intruders: set[str] = set()
        self._checked_ns = 0
        self._start_ns = time.monotonic_ns()
        self._network_problem = self._unreceived_problem = ""
        channel.states.publish(self._record)

    def step(self) -> None:
        """Take what has arrived, and publish it."""
        news = False
        for subscription in self._frames:
            for received in subscription.take():
                self._frame_senders.add(received.sender)
                self._static[subscription.topic] |= static_frames([received.data])[0]
                for topic, scanner in self._scanners.items():
                    scanner.static = static_of(topic, self._static)
        for subscriptions, indices in zip(self._subscriptions, self._inputs.values(), strict=True):
            arrived = [received for subscription in subscriptions for received in subscription.take()]
            for received in sorted(arrived, key=lambda one: one.sent_ns) if len(subscriptions) > 1 else arrived:
                news = self._take_all(indices, received) or news
        for index, subscription in enumerate(self._cameras):
            for received in subscription.take()[-1:]:
                self._take_image(index, received)
        now = time.monotonic_ns()
        if now - self._checked_ns > _CHECK_NS:
            self._checked_ns = now
            self._network_problem = self._intrusion() or self._twins(now)
            self._unreceived_problem = self._unreceived()
        text = self._network_problem or self._silence(now) or self._unreceived_problem
        problem = text.encode()[:PROBLEM_BYTES]
        if news or problem != self._record["problem"]:
            self._record["problem"] = problem
            self._channel.states.publish(self._record)

    def _take_all(self, indices: list[int], received: Received) -> bool:
        """Take a message for all inputs of its topic; return whether any has read it."""
        try:
            message = received.message()
        except DatasetError as error:
            self._wrong |= dict.fromkeys(indices, str(error))
            return False
        taken = [self._take(index, received, message) for index in indices]
        return any(taken)

    def _take(self, index: int, received: Received, message: Any) -> bool:
        one, record = self._spec.inputs[index], self._record
        try:
            if one.topic in self._scanners and (lacking := self._lacking_frames(received.arrived_ns)):
                raise DatasetError(lacking)
            values = one.reader.read(message)
        except DatasetError as error:
            self._wrong[index] = str(error)
            return False
        if not one.qos.transient_local:
            self._hear(index, received)
        header = getattr(message, "header", None)
        stamp = 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
        if stamp:
            newest = self._stamps[index]
            if any(stamp <= other < stamp + _TOMORROW_NS for other in (newest, self._old_stamps[index])):
                before, self._dropped[index] = self._dropped.get(index), (stamp, received.arrived_ns)
                goes_on = before and 0 <= stamp - before[0] <= received.arrived_ns - before[1] + _SLACK_NS
                if not goes_on:
                    record["dropped"][index] += 1
                    return False  # out of order; a stamp that is far behind, or the next, is of a clock that was set
            self._dropped.pop(index, None)
            if abs(stamp - newest) > _TOMORROW_NS:
                self._old_stamps[index] = newest
            self._stamps[index] = stamp
        self._wrong.pop(index, None)
        record["count"][index] += 1
        self._count_interval(index, received.arrived_ns - int(record["arrived_ns"][index]), record["count"][index])
        record["arrived_ns"][index] = received.arrived_ns
        record["measured_ns"][index] = self._measured_ns(index, stamp, received)
        record["values"][self._columns[index]] = values
        return True

    def _measured_ns(self, index: int, stamp_ns: int, received: Received) -> int:
        """Return when a message was measured, monotonic [ns]; print once that a topic's clock is slow or fast."""
        clock, arrived = self._clocks[index], received.arrived_ns
        wall = arrived + time.time_ns() - time.monotonic_ns()
        measured = clock.measured_ns(stamp_ns, arrived, received.sent_ns, wall)
        if clock.rate != 1.0 and not self._is_rate_known:
            self._is_rate_known = True
            print(
                f"warning: the clock of the stamps of {self._topics[index].topic} goes at {clock.rate:.2f} of real "
                "time: a simulation whose real time factor is not 1? The robot and its sensors are slower, or faster, "
                "than the commands that they get.",
                file=sys.stderr,
            )
        return measured

    def _count_interval(self, index: int, interval_ns: int, count: int) -> None:
        periods = self._record["period_ns"]
        if count > 1:
            periods[index] += (interval_ns - periods[index]) // 8 if periods[index] else interval_ns

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
        silent = [each.topic for each in self._frames if not self._frame_senders.issuperset(each.sender_ids)]
        return f"{' and '.join(silent)} may state how the scanner is mounted, and has not been received" * bool(silent)

    def _take_image(self, index: int, received: Received) -> None:
        camera, number = self._spec.cameras[index], len(self._spec.inputs) + index
        ring = self._channel.images[index]
        try:
            image = decode_image(camera.topic, camera.msgtype, received.data)
        except DatasetError as error:
            self._wrong[number] = str(error)
            return
        if image.shape != (camera.height, camera.width, 3):
            height, width, _ = image.shape
            self._wrong[number] = f"it is {width} x {height} px, not {camera.width} x {camera.height}"
            return
        self._wrong.pop(number, None)
        record = np.zeros((), self._channel.image_dtypes[index])
        [stamp] = head_stamps([received.data]).tolist()
        record["measured_ns"] = self._measured_ns(len(self._spec.inputs) + index, stamp, received)
        record["pixels"] = image
        ring.publish(record)
        interval, known = received.arrived_ns - self._images_ns[index], 1 + bool(self._images_ns[index])
        self._count_interval(len(self._spec.inputs) + index, interval, known)
        self._images_ns[index] = received.arrived_ns
        self._hear(len(self._spec.inputs) + index, received)

    # --- problems ----------------------------------------------------------------------------------------------------

    def _silence(self, now_ns: int) -> str:
        """Return which topic is silent, and why, as text; empty if none is."""
        listened: list[tuple[Any, Any]] = [
            *zip(self._spec.inputs, self._record["arrived_ns"], strict=True),
            *zip(self._spec.cameras, self._images_ns, strict=True),
        ]
        for number, (one, arrived) in enumerate(listened):
            silent = (now_ns - max(int(arrived), self._start_ns)) / 1e9
            # What has never come is named soon, for the one who waits for it.
            if silent > (one.silence_s if arrived or math.isinf(one.silence_s) else min(one.silence_s, _FIRST_S)):
                return self._why(number, one, silent, heard=bool(arrived))
        return ""

    def _why(self, number: int, one: Any, silent_s: float, *, heard: bool) -> str:
        if wrong := self._wrong.get(number):
            return f"The newest message of {one.topic} cannot be used: {wrong}"
        mismatches = self._node.graph.mismatches(one.topic, one.msgtype, _either(one.qos)[-1], is_publisher=False)
        if mismatches:
            return " ".join(mismatches)
        endpoints = [other for other in self._node.graph.endpoints() if other.is_publisher and not self._is_ours(other)]
        if any(other.topic == one.topic for other in endpoints):
            so_long = silence_text(one.topic, silent_s) if heard else f"{one.topic} has sent no message yet"
            return f"{so_long}, though it has a publisher."
        network = self._spec.network
        where = f"in ROS domain {network.domain_number} on {network.interface!r}"
        any_more = " any more" if heard else ""
        return f"Nobody publishes {one.topic} ({one.msgtype}) {where}{any_more}. {_offers(one, endpoints)}"

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

    def _unreceived(self) -> str:
        """Return which commands no node receives, and why, as text; empty if all are received."""
        found: dict[str, str] = {}
        subscriptions = [end for end in self._node.graph.endpoints() if not (end.is_publisher or end.is_own)]
        for one in self._spec.outputs if self._spec.is_alone else ():
            ends = [end for end in subscriptions if end.topic == one.topic]
            if any(end.msgtype == one.msgtype and one.qos.serves(end.qos) for end in ends):
                continue
            if wrong := self._node.graph.mismatches(one.topic, one.msgtype, one.qos, is_publisher=True):
                found[one.topic] = f"{' '.join(wrong)} {one.remedy}".rstrip()
            elif one.is_required:
                found[one.topic] = (
                    f"No node receives {one.topic} ({one.msgtype}), so the robot cannot be commanded. Check that its "
                    f"driver or controller runs, and robot.ros2.namespace. {_offers(one, subscriptions, 'receives')}"
                )
        before, self._missed = self._missed, set(found)  # one that has just appeared may not be known yet
        lasting = before & self._missed
        self._channel.words[Word.UNRECEIVED] = len(self._missed)
        return " ".join(text for topic, text in found.items() if topic in lasting)

    def _twins(self, now_ns: int) -> str:
        """Return which topic two publishers send to at a time, as text; empty if none. A robot may have restarted."""
        for one, mixed_ns in zip(self._topics, self._mixed_ns, strict=True):
            if mixed_ns and now_ns - mixed_ns < _MIXED_NS:
                ends = self._node.graph.endpoints()
                nodes = sorted({end.node or "?" for end in ends if end.is_publisher and end.topic == one.topic})
                return (
                    f"Several nodes send {one.topic} at a time: {', '.join(nodes)}. Are there two robots of one name?"
                )
        return ""

    def _is_ours(self, endpoint: Endpoint) -> bool:
        return endpoint.is_own or endpoint.node == f"/{self._spec.name}_guard"


def _either(qos: Qos) -> tuple[Qos, ...]:
    """Return how a topic is received: what is transient local here is volatile in older drivers, or later ones."""
    return (qos, replace(qos, transient_local=False)) if qos.transient_local else (qos,)


def _offers(one: Any, endpoints: list[Endpoint], does: str = "publishes") -> str:
    fitting = sorted({other.topic for other in endpoints if other.msgtype == one.msgtype})
    if fitting:
        return f"Of this type there are: {', '.join(fitting)}."
    there = sorted({other.topic for other in endpoints})
    return (
        f"There are: {', '.join(there)}."
        if there
        else f"No node {does} anything there; options of the network are robot.ros2.domain and robot.ros2.interface."
    )


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
    # Ctrl-C is for the process that uses this one; at a shutdown all are asked to end, and the robot has to be stopped.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
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
