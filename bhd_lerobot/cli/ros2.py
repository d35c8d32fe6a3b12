"""`bhd-ros2`: robots on a ROS 2 network, without a ROS installation."""

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from typing import Any

import yaml

from bhd_lerobot.cli import bag
from bhd_lerobot.cli.network import add_network_command, node_of
from bhd_lerobot.cli.start import leaving_on_interrupt
from bhd_lerobot.options.command import Parser, exit_status
from bhd_lerobot.ros2.live.topics import Intervals, at_path, described, found_topics, is_hidden, plain, subscribed

_END = "...\n"  # which YAML puts after a value that is neither a mapping nor a list


class _Dumper(yaml.SafeDumper):
    """Writes each field on a line, and numbers of an array on one."""


_Dumper.add_representer(
    list,
    lambda dumper, values: dumper.represent_sequence(
        "tag:yaml.org,2002:seq", values, flow_style=not any(isinstance(one, dict) for one in values)
    ),
)


def _parser() -> Parser:
    parser = Parser(prog="bhd-ros2", description=__doc__.split(": ", 1)[1])
    commands: Any = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands", required=True)
    bag.add_to(commands)
    commands.add_parser("serve", help="a simulated robot as a ROS 2 robot; `bhd-ros2 serve --help` has its options")
    commands.add_parser("bridge", help="the cerebellum in front of a real robot; `bhd-ros2 bridge --help` likewise")
    help_text = "what is on the network"
    topics = commands.add_parser("topics", help=help_text, description=help_text)
    _add_topics(topics.add_subparsers(dest="kind", metavar="COMMAND", title="commands", required=True))
    return parser


def network_parser() -> argparse.ArgumentParser:
    """Return a parser of all commands that are a node of the network, by their names, for the reference."""
    parser = Parser(prog="bhd-ros2")
    commands: Any = parser.add_subparsers()
    _add_topics(commands, "topics ")
    bag.add_to(commands)
    return parser


def _add_topics(kinds: Any, before: str = "") -> None:
    listed = add_network_command(
        kinds, f"{before}list", "topics, their types, publishers and subscriptions, and what does not fit", _list
    )
    listed.add_argument("--all", action="store_true", help="topics of actions, too")
    rate = add_network_command(
        kinds, f"{before}hz", "the rate of a topic, each second; Ctrl-C ends with a summary", _hz, "TOPIC"
    )
    rate.add_argument("--window", type=float, default=10.0, metavar="S", help="time that a line is about (default: 10)")
    rate.add_argument("--seconds", type=float, metavar="S", help="end after this time")
    echo = add_network_command(
        kinds, f"{before}echo", "messages of a topic, as YAML; long arrays are shortened", _echo, "TOPIC"
    )
    echo.add_argument("--field", default="", metavar="PATH", help="only this: pose.pose.position, or ranges.0")
    echo.add_argument("-n", type=int, metavar="N", help="end after so many messages")


def _list(options: argparse.Namespace) -> int:
    with node_of(options) as node:
        found = [one for one in found_topics(node, options.wait) if options.all or not is_hidden(one.topic)]
    print("\n".join(described(found)) or "There are nodes, and no topics.")
    return 0


def _hz(options: argparse.Namespace) -> int:
    intervals = Intervals(options.window)
    with node_of(options) as node:
        subscription = subscribed(node, options.topic, options.wait)
        begun = time.monotonic()
        due = begun + 1.0
        try:
            while options.seconds is None or time.monotonic() < begun + options.seconds:
                node.wait(max(0.0, due - time.monotonic()))
                for received in subscription.take():
                    intervals.add(received.arrived_ns / 1e9)
                if (now := time.monotonic()) >= due:
                    print(intervals.of_window(now), flush=True)
                    due += 1.0
        except KeyboardInterrupt:
            pass
        print(f"all: {intervals.of_all()}")
    return 0


def _echo(options: argparse.Namespace) -> int:
    with node_of(options) as node:
        subscription = subscribed(node, options.topic, options.wait)
        left = options.n
        while left is None or left > 0:
            node.wait(1.0)
            for received in subscription.take()[:left]:
                value = plain(at_path(received.message(), options.field))
                print(
                    f"{yaml.dump(value, Dumper=_Dumper, sort_keys=False, width=120).removesuffix(_END)}---", flush=True
                )
                left = None if left is None else left - 1
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-ros2`; return the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] in (["serve"], ["bridge"]):
        with leaving_on_interrupt():
            serve = importlib.import_module("bhd_lerobot.cli.serve").main
        return int(serve(given))

    def run() -> int:
        options = _parser().parse(given)
        return int(options.run(options))

    return exit_status(run)


if __name__ == "__main__":
    sys.exit(main())
