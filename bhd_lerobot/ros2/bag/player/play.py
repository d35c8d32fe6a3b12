"""Publishing a bag into a network, at the times at which it was recorded."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Options, Positive
from bhd_lerobot.ros2.bag.player.offer import described, offers_of
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.live.node import Node, Publisher

_POLL_S = 0.02
_SETTLE_S = 1.0  # a subscription may find a publisher later than it is found; an estimate
_LONGEST_S = 0.1  # between two looks for a request to stop
_LAST_S = 2.0  # for receivers to have the last messages
_PAUSE_S = 0.5  # by what is later, what follows is later, too: it does not come all at once
_MOST_KEPT = 100  # of what a latched topic sent before the start
_SHORTEST_S = 0.1  # of a round: the bag may have but one message


@dataclass(frozen=True)
class PlayOptions(Options, prefix="--"):
    """How a bag is published.

    Attributes:
        rate: how many times faster than recorded.
        start: where in the bag it begins [s].
        wait: how long subscriptions to each topic are waited for [s].
    """

    topics: tuple[str, ...] = ()
    rate: Positive = 1.0
    start: NotNegative = 0.0
    loop: bool = False
    wait: Positive = 3.0


@dataclass
class PlayReport:
    """What was published.

    Attributes:
        late_s: the largest time by which a message was published after it was due [s].
    """

    messages: int = 0
    rounds: int = 0
    late_s: float = 0.0


class Player:
    """Publishes a bag, which is read as it is published."""

    def __init__(self, node: Node, bag: Bag, options: PlayOptions, print_line: Callable[[str], None]) -> None:
        self._node, self._bag, self._options, self._print = node, bag, options, print_line
        self._offers, left_out = offers_of(bag, options.topics, node.network.distro)
        for line in described(self._offers):
            print_line(line)
        for topic, reason in left_out.items():
            print_line(f"{topic} is left out: {reason}")
        self._publishers = {one.topic: node.publisher(one.topic, one.msgtype, one.qos) for one in self._offers}
        self._latched = {one.topic for one in self._offers if one.qos.transient_local}
        self.report = PlayReport()

    def run(self, stop: Callable[[], bool]) -> PlayReport:
        """Publish until the end, or until `stop` returns true.

        Raises:
            DatasetError: the bag cannot be read, or ends before `start`.
        """
        self._wait(stop)
        for text in self._warnings():
            self._print(f"warning: {text}")
        while not stop() and self._play(stop) and self._options.loop:
            pass
        for publisher in self._publishers.values():
            if not stop():
                publisher.wait_for_acks(_LAST_S)
        return self.report

    def _wait(self, stop: Callable[[], bool]) -> None:
        """Wait until each topic has a subscription, but no longer than that is to be waited for."""
        end = time.monotonic() + self._options.wait
        while not stop() and time.monotonic() < end:
            if all(one.receivers for one in self._publishers.values()):
                time.sleep(_SETTLE_S)
                return
            time.sleep(_POLL_S)
        if not stop() and not any(one.receivers for one in self._publishers.values()):
            self._print(f"No node subscribes to any of these topics, after {self._options.wait:g} s; published anyway.")

    def _warnings(self) -> Iterator[str]:
        """Yield what others on the network should not be surprised by."""
        others = [one for one in self._node.graph.endpoints() if not one.is_own]
        for offer in self._offers:
            nodes = {one.node or "an unnamed node" for one in others if one.topic == offer.topic and one.is_publisher}
            if nodes:
                yield f"{', '.join(sorted(nodes))} publishes {offer.topic}, too: those who subscribe receive both."
            nodes = {
                one.node or "an unnamed node" for one in others if one.topic == offer.topic and not one.is_publisher
            }
            if offer.commands and nodes:
                yield f"{offer.topic} commands a robot, and {', '.join(sorted(nodes))} subscribes to it."
        yield from self._node.graph.all_mismatches()

    def _play(self, stop: Callable[[], bool]) -> bool:
        """Publish once; return whether the end was reached."""
        options = self._options
        first: int | None = None
        newest, begun, length_s = 0, time.monotonic(), 0.0
        kept: dict[str, list[bytes]] = {}  # of latched topics, what was sent before the start
        is_empty = True
        names = {name: "/" + name.lstrip("/") for name in self._bag.topics}
        for name, received, _, data in self._bag.messages(names, note=True):  # times are those of the whole bag
            first = received if first is None else first
            if received < newest - _PAUSE_S * 1e9:  # the recorder's clock was set back: the bag goes on from there
                first, newest = first - (newest - received), received
            newest = max(newest, received)
            length_s = (newest - first) / 1e9
            topic = names[name]
            if stop():
                return False
            if length_s < options.start:
                if topic in self._latched:
                    kept.setdefault(topic, []).append(data)
                    del kept[topic][:-_MOST_KEPT]
                continue
            if is_empty:
                is_empty = False
                self._send_kept(kept)
                begun = time.monotonic()
            if topic not in self._publishers:
                continue
            due = begun + (length_s - options.start) / options.rate
            if not self._sleep_until(due, stop):
                return False
            self._send(self._publishers[topic], data)
            late_s = time.monotonic() - due
            self.report.late_s = max(self.report.late_s, late_s)
            if late_s > _PAUSE_S:
                begun += late_s
        if is_empty:
            raise ConfigError(
                f"--start is {options.start:g}; the messages of {self._bag.path} end after {length_s:.3g} s."
            )
        self.report.rounds += 1
        end = begun + max(length_s - options.start, _SHORTEST_S) / options.rate
        return not options.loop or self._sleep_until(end, stop)

    def _send_kept(self, kept: dict[str, list[bytes]]) -> None:
        for topic, several in kept.items():
            for data in several:
                self._send(self._publishers[topic], data)

    def _send(self, publisher: Publisher, data: bytes) -> None:
        publisher.send(data)
        self.report.messages += 1

    def _sleep_until(self, due: float, stop: Callable[[], bool]) -> bool:
        """Sleep until a message is due; return whether it is to be sent."""
        while (left := due - time.monotonic()) > 0:
            if stop():
                return False
            time.sleep(min(left, _LONGEST_S))
        return not stop()
