"""Publishers whose messages are late, gone, without a number or from another time."""

import argparse
import math
import signal
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.node import Node


def at(kind: str) -> Callable[[str], tuple[Any, ...]]:
    """Return a parser of options like TOPIC:START:DURATION."""
    names = kind.split(":")

    def parse(text: str) -> tuple[Any, ...]:
        parts = text.split(":")
        if len(parts) != len(names):
            raise argparse.ArgumentTypeError(f"{text!r} is not {kind}")
        return tuple(part if name == "TOPIC" else float(part) for name, part in zip(names, parts, strict=True))

    return parse


def add_faults(parser: argparse.ArgumentParser) -> Any:
    """Add the options of what can be wrong with a topic, named without its first slash, or with all."""
    faults = parser.add_argument_group("faults")
    for name, kind, text in (
        ("--gap", "TOPIC:START:DURATION", "nothing is published for a time"),
        ("--nan", "TOPIC:START:DURATION", "numbers are NaN for a time"),
        ("--swap", "TOPIC:EVERY", "each so many messages, one is published after its successor"),
    ):
        faults.add_argument(name, action="append", default=[], type=at(kind), metavar=kind, help=text)
    faults.add_argument("--silence", metavar="TOPIC", help="nothing is published any more after SIGUSR1")
    faults.add_argument("--zero-stamp", action="append", default=[], metavar="TOPIC", help="no time in the header")
    faults.add_argument("--repeat", type=float, default=math.inf, help="times begin anew each so many seconds")
    return faults


class Outlet:
    """A publisher with the faults of its topic; `clock` gives the time since the start [s]."""

    def __init__(
        self,
        args: argparse.Namespace,
        clock: Callable[[], float],
        node: Node,
        topic: str,
        kind: type,
        *,
        qos: Any = 10,
        frame: str = "",
    ) -> None:
        names = (topic.removeprefix("/"), "all")

        def mine(faults: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
            return [rest for name, *rest in faults if name in names]

        self.clock = lambda: clock() % args.repeat
        self.gaps = mine(args.gap)
        if args.silence in names:
            signal.signal(signal.SIGUSR1, lambda *_: self.gaps.append((0.0, math.inf)))
        self.nans = mine(args.nan)
        self.frame = frame
        self.has_stamp = not set(names) & set(args.zero_stamp)
        self.every = int(next((every for (every,) in mine(args.swap)), 0))
        self.publisher = node.create_publisher(kind, topic, qos)
        self.held: Any = None
        self.count = 0

    @property
    def is_nan(self) -> bool:
        """Whether the numbers are to be NaN now."""
        return self._is_within(self.nans)

    def _is_within(self, times: list[tuple[Any, ...]]) -> bool:
        return any(start <= self.clock() < start + duration for start, duration in times)

    def publish(self, message: Any, header: Any = None, stamp: int = 0) -> None:
        """Publish a message, but for the faults; its header gets the frame and a stamp [ns]."""
        if self._is_within(self.gaps):
            return
        if header is not None:
            header.stamp = Time(sec=stamp // 10**9, nanosec=stamp % 10**9) if self.has_stamp else Time()
            header.frame_id = self.frame
        self.count += 1
        if self.every and self.count % self.every == 0 and self.held is None:
            self.held = message
            return
        self.publisher.publish(message)
        if self.held is not None:
            self.publisher.publish(self.held)
            self.held = None
