"""What the commands of `bhd-ros2` share that are a node on the network."""

import argparse
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, Run, add_command
from bhd_lerobot.options.declared import Count, Positive, check_option
from bhd_lerobot.ros2.live.network import NetworkConfig
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.messages.mapping import MappingConfig


def add_network_command(
    commands: Commands, name: str, help_text: str, run: Run, positional: str = ""
) -> argparse.ArgumentParser:
    """Add a command of a node, with the options that say where others are; `positional` names a topic, if not empty."""
    command = add_command(commands, name, help_text, run, names_dataset=False)
    if positional:
        command.add_argument("topic", metavar=positional, help="name of the topic")
        add_map(command)
    command.add_argument("--domain", type=int, metavar="N", help="ROS domain (default: ROS_DOMAIN_ID, or 0)")
    command.add_argument(
        "--interface", default="lo", metavar="NAME",
        help="network interface or address; lo (default) finds nodes of this machine, auto takes the usual one",
    )  # fmt: skip
    command.add_argument(
        "--peers", action="append", default=[], metavar="ADDRESS", help="a machine to look on; may be given again"
    )
    command.add_argument("--distro", default="jazzy", help="jazzy (default) and later, or humble")
    command.add_argument("--wait", type=float, default=3.0, metavar="S", help="time to find others (default: 3)")
    return command


def add_map(command: argparse.ArgumentParser) -> None:
    """Add the option that defines further types."""
    command.add_argument(
        "--map", type=Path, metavar="FILE",
        help="a YAML file, a mapping as of `bhd-data`, whose `types` define further message types",
    )  # fmt: skip


def node_of(options: argparse.Namespace) -> Node:
    """Return the node of a command; register the types of its mapping."""
    for option, kind in (("--wait", Positive), ("--window", Positive), ("--seconds", Positive), ("-n", Count)):
        check_option(option, getattr(options, option.lstrip("-"), None), kind)
    network = NetworkConfig(options.domain, options.interface, list(options.peers), options.distro)
    node = Node("bhd_ros2", network)
    if getattr(options, "map", None) is not None:
        register_types(MappingConfig.load(options.map).types)
    return node
