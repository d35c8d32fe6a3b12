"""`bhd-ros2 record` and `bhd-ros2 play`: topics of a network as a bag, and a bag as topics of a network."""

import argparse
import time
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands
from bhd_lerobot.cli.network import add_map, add_network_command, node_of
from bhd_lerobot.errors import ConfigError, DatasetError, RealtimeError, counted
from bhd_lerobot.rollout.signals import stop_on_signals
from bhd_lerobot.ros2.bag.player.play import Player, PlayOptions
from bhd_lerobot.ros2.bag.recorder.record import Recorder, RecordOptions, RecordReport
from bhd_lerobot.ros2.bag.storage.find import find_bags
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.bag.storage.write import FORMATS
from bhd_lerobot.ros2.messages.types import require_rosbags


def add_to(commands: Commands) -> None:
    """Add `record` and `play`."""
    add_record(commands)
    add_play(commands)


def add_record(commands: Commands) -> None:
    """Add `record`."""
    text = "topics of a network into a bag, as long as it runs; Ctrl-C ends with a summary"
    record = add_network_command(commands, "record", text, _record)
    record.add_argument("topics", nargs="*", metavar="TOPIC", help="names of topics, which may appear later")
    record.add_argument("--all", action="store_true", help="all topics but those of actions, also later ones")
    record.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="the bag, a new folder")
    record.add_argument("--storage", choices=FORMATS, default="mcap", help="of the bag (default: mcap)")
    record.add_argument("--seconds", type=float, metavar="S", help="end after this time")
    record.add_argument(
        "--exclude", metavar="REGEX", help="leave out topics whose whole name this regular expression describes"
    )
    add_map(record)


def add_play(commands: Commands) -> None:
    """Add `play`."""
    text = "a bag into a network, with the recorded times and quality of service; Ctrl-C ends it"
    play = add_network_command(commands, "play", text, _play)
    play.add_argument("bag", type=Path, metavar="BAG", help="a folder, or a .mcap or .db3 file")
    play.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="only these")
    play.add_argument("--rate", type=float, default=1.0, metavar="X", help="times faster than recorded (default: 1)")
    play.add_argument("--start", type=float, default=0.0, metavar="S", help="begin at this time of the bag")
    play.add_argument("--loop", action="store_true", help="begin anew at the end, until Ctrl-C")
    add_map(play)


def _record(options: argparse.Namespace) -> int:
    require_rosbags()
    if bool(options.topics) == options.all:
        raise ConfigError("Name topics, or give --all for all of them.")
    topics = tuple("/" + topic.lstrip("/") for topic in options.topics)
    wanted = RecordOptions(options.output.expanduser(), topics, options.exclude, options.storage, options.seconds)
    with node_of(options) as node, stop_on_signals() as stop:
        recorder = Recorder(node, wanted, _print)
        _print(f"Recording into {wanted.output}; Ctrl-C ends it.")
        missing_at = time.monotonic() + options.wait

        def stopped() -> bool:
            nonlocal missing_at
            if time.monotonic() > missing_at:
                missing_at = float("inf")
                for topic in recorder.missing():
                    _print(f"Nobody publishes {topic}, after {options.wait:g} s; it is waited for.")
            return bool(stop)

        report = recorder.run(stopped)
    print("\n".join(_summary(report)))
    if not report.counts:
        reasons = " ".join(f"{topic}: {reason}" for (topic, _), reason in report.left_out.items())
        raise RealtimeError(
            f"No topic was recorded, and no bag was made. {reasons or 'Nobody published one.'} `bhd-ros2 topics list` "
            "shows what is on the network."
        )
    return 0


def _summary(report: RecordReport) -> list[str]:
    width = max((len(topic) for topic, _ in report.counts), default=0)
    lines = [
        f"{topic:<{width}}  {count:>8}  {msgtype}"
        + (f"  {report.lost[topic, msgtype]} lost" if (topic, msgtype) in report.lost else "")
        for (topic, msgtype), count in sorted(report.counts.items())
    ]
    if report.counts:
        lost = sum(report.lost.values())
        lines.append(
            f"{report.output}: {counted(report.messages, 'message')} in {report.duration_s:.1f} s, {lost} lost."
        )
    return lines


def _play(options: argparse.Namespace) -> int:
    require_rosbags()
    wanted = PlayOptions(tuple(options.topics), options.rate, options.start, loop=options.loop, wait=options.wait)
    bag = _bag_at(options.bag.expanduser())
    with node_of(options) as node, stop_on_signals() as stop:
        player = Player(node, bag, wanted, _print)
        report = player.run(lambda: bool(stop))
    for problem in bag.problems:
        _print(f"warning: {problem}")
    late = f"; the latest was {report.late_s:.2f} s late" if report.late_s > _LATE_S else ""
    print(f"{bag.path}: {counted(report.messages, 'message')} published{late}.")
    return 0


_LATE_S = 0.1


def _bag_at(path: Path) -> Bag:
    bags = find_bags(path)
    if len(bags) > 1:
        raise DatasetError(f"{path} has {len(bags)} bags; name one: {', '.join(str(bag.path) for bag in bags[:8])}.")
    return bags[0]


def _print(line: str) -> None:
    print(line, flush=True)
