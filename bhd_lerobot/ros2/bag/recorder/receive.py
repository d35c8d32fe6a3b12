"""Receiving all that publishers of a topic send, whatever quality of service each of them offers."""

import time
from collections.abc import Collection

from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.live.node import MOST_TAKEN, Node, Received, Subscription

DEPTH = 5000
"""Messages that wait on a subscription: 10 s at 500 Hz."""

_MOST_SEEN, _LATEST_NS = 20_000, 5 * 10**9  # of what two subscriptions receive: how much apart, and how late

type _Kind = tuple[bool, bool]
"""What decides who hears whom: reliable, transient local."""

_PLAIN: _Kind = False, False


class TopicReceiver:
    """Receives the messages of a type on a topic, each once.

    There is a subscription for each quality of service that is offered: a reliable one does not hear what is sent best
    effort, and one without history not what a latched topic sent before. A reliable one may receive nothing of a
    publisher of Fast DDS until its heartbeat comes, seconds later; so until each publisher was heard reliably, it is
    heard best effort as well.

    Attributes:
        taken_ns: when messages were looked for last, monotonic [ns].
    """

    def __init__(self, node: Node, topic: str, msgtype: str) -> None:
        self.topic, self.msgtype = topic, msgtype
        self._node = node
        self._subscriptions: dict[_Kind, Subscription] = {}
        self._heard: set[int] = set()  # publishers, by another subscription than the plain one
        self._seen: dict[tuple[int, int, int], None] = {}
        self._forget_ns = 0  # when those that were seen by one subscription have been seen by the other
        self.taken_ns = time.monotonic_ns()

    def update(self, offered: Collection[Qos]) -> None:
        """Have the subscriptions that publishers now need."""
        kinds = [(one.reliable, one.transient_local) for one in offered]
        wanted = set(kinds)
        strict = [one for kind, one in self._subscriptions.items() if kind != _PLAIN]
        publishers = {sender for one in strict for sender in one.sender_ids}  # of a new one not at once
        if publishers - self._heard or len(publishers) < len(kinds) - kinds.count(_PLAIN):
            wanted.add(_PLAIN)
        if offered and _PLAIN not in wanted and (plain := self._subscriptions.pop(_PLAIN, None)) is not None:
            self._node.remove(plain)
            self._forget_ns = time.monotonic_ns() + _LATEST_NS
        for reliable, transient_local in sorted(wanted - self._subscriptions.keys()):
            self._subscriptions[reliable, transient_local] = self._node.raw_subscription(
                f"rt{self.topic}", self.msgtype, Qos(DEPTH, reliable, transient_local)
            )

    def take(self) -> list[Received]:
        """Return what has arrived since the last call, of each publisher in the order of sending."""
        found: list[Received] = []
        self.taken_ns = time.monotonic_ns()
        if self._seen and len(self._subscriptions) == 1 and self.taken_ns > self._forget_ns:
            self._seen.clear()
        several = len(self._subscriptions) > 1 or bool(self._seen)
        for kind, one in self._subscriptions.items():
            while taken := one.take():
                found += [message for message in taken if self._is_new(message)] if several else taken
                if kind != _PLAIN and not self._heard.issuperset(senders := {message.sender for message in taken}):
                    self._heard |= senders
                if len(taken) < MOST_TAKEN:
                    break
        if several:
            found.sort(key=lambda message: message.sent_ns)
        return found

    def _is_new(self, message: Received) -> bool:
        key = message.sender, message.sent_ns, len(message.data)
        if key in self._seen:
            return False
        if len(self._seen) >= _MOST_SEEN:
            del self._seen[next(iter(self._seen))]
        self._seen[key] = None
        return True

    @property
    def lost(self) -> int:
        """How many messages Cyclone DDS knows to be lost."""
        return sum(
            one.reader.get_sample_lost_status().total_count
            for kind, one in self._subscriptions.items()
            if kind != _PLAIN or len(self._subscriptions) == 1
        )
