"""`bhd-data export`: episodes as ROS 2 bags."""

import argparse
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.cli.data.episode_list import parse_episodes
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import ConfigError, counted, quoted
from bhd_lerobot.ros2.bag.exporter.episode import START_S, ExportOptions
from bhd_lerobot.ros2.bag.exporter.export import export_bags
from bhd_lerobot.ros2.bag.storage.write import FORMATS
from bhd_lerobot.ros2.messages.robot_views import robot_view


def add_to(commands: Commands) -> None:
    """Add `export`."""
    help_text = "write episodes as ROS 2 bags, which ros2 bag play, Foxglove and `bhd-data import` read"
    command = add_command(commands, "export", help_text, _run)
    command.set_defaults(stopped="no bag was written")
    command.add_argument("--format", choices=FORMATS, default="mcap", help="storage of the bags (default: mcap)")
    command.add_argument("--output", type=Path, required=True, help="new folder, with a bag for each episode")
    command.add_argument("--episodes", metavar="LIST", help="episodes, such as 0,3,5-9; all if left out")
    command.add_argument("--one_bag", action="store_true", help="all episodes in one bag, which is --output itself")
    command.add_argument("--twist", action="store_true", help="commands of a base as Twist instead of TwistStamped")
    command.add_argument("--compressed_images", action="store_true", help="images as JPEG instead of raw")
    command.add_argument(
        "--start_time", type=float, default=START_S, metavar="S",
        help=f"when the first episode starts, seconds since 1970 (default: {START_S})",
    )  # fmt: skip


def _run(options: argparse.Namespace) -> int:
    if not 0 <= options.start_time < 2**31 - 1:  # ROS counts seconds in 32 bits
        raise ConfigError(f"--start_time is {options.start_time}; it must be from 0 to {2**31 - 2}.")
    root = root_of(options)
    info = dataset_info(root)
    report = export_bags(
        root,
        options.output.expanduser(),
        view=robot_view(info.robot_type, info.recording),
        repo_id=options.repo_id or "",
        options=ExportOptions(
            storage=options.format,
            episodes=None if options.episodes is None else parse_episodes(options.episodes),
            one_bag=options.one_bag,
            bare_twist=options.twist,
            compressed_images=options.compressed_images,
            start_s=options.start_time,
        ),
    )
    what = counted(report.episodes, "episode")
    bags = counted(len(report.bags), "bag")
    play = f"ros2 bag play {quoted(report.bags[0])}"
    print(f"{options.output}: {what}, {report.messages} messages, in {bags}. Play one: {play}")
    return 0
