"""`bhd-data import`: ROS 2 bags become a dataset."""

import argparse
import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.errors import ConfigError, counted, quoted, unknown_name
from bhd_lerobot.options.parse import read_line
from bhd_lerobot.ros2.bag.importer.convert import ImportReport, import_bags
from bhd_lerobot.ros2.bag.importer.exported import (
    ExportedEpisode,
    exported_episodes,
    is_exported,
    names_of,
    sources_of,
)
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.sources import base_sources, mapped_sources
from bhd_lerobot.ros2.bag.storage.find import check_distinct, find_bags
from bhd_lerobot.ros2.bag.storage.place import refuse_existing
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages import presets
from bhd_lerobot.ros2.messages.base import TWIST
from bhd_lerobot.ros2.messages.mapping import MappingConfig, features_of
from bhd_lerobot.ros2.messages.types import require_rosbags
from bhd_lerobot.tasks.task import OUTCOMES

ROBOTS = ("turtlebot3",)
_STAMPS = ("auto", "header", "receive")
_TOPICS = {"scan": "/scan", "odom": "/odom", "cmd": "/cmd_vel"}
_BASE = (*_TOPICS, "no_odom", "imu", "camera", "odometry", "beams", "odom_frame")  # options for a TurtleBot3's bags
_REAL = (*_BASE, "scan_frame", "scan_yaw", "command_timeout")  # options for bags of a real robot


def add_to(commands: Commands) -> None:
    """Add `import`."""
    help_text = (
        "convert ROS 2 bags to a dataset: bags of a TurtleBot3, of any robot with --map, or of `bhd-data export`"
    )
    command = add_command(commands, "import", help_text, _run, names_dataset=False)
    command.set_defaults(stopped="no dataset was made", entries_of="map")
    command.add_argument("bags", nargs="+", type=Path, help="bags: folders, .mcap or .db3 files, or a folder of bags")
    command.add_argument("--repo_id", required=True, help="name of the dataset, user/name")
    command.add_argument("--root", type=Path, help="where to put it; LeRobot's default place if left out")
    command.add_argument("--task", help="the instruction, a sentence; exported bags contain it")
    command.add_argument("--fps", type=int, help="frames a second (default: 10, or that of the exported dataset)")
    command.add_argument("--stamps", default="receive", help="source of timestamps: receive (default), header or auto")
    command.add_argument("--max_age", type=float, metavar="S", help="age of a reading that makes a frame late")
    command.add_argument(
        "--max_gap", type=float, default=1.0, metavar="S", help="silence that ends an episode (default: 1.0)"
    )
    command.add_argument(
        "--min_episode_s", type=float, metavar="S",
        help="shorter episodes are left out (default: 1.0, or 0 for exported bags)",
    )  # fmt: skip
    command.add_argument("--outcome", help=f"outcome of the episodes: {', '.join(OUTCOMES)}; nothing if left out")
    real = command.add_argument_group("bags of a real robot")
    real.add_argument(
        "--robot",
        help=f"valid: {', '.join(ROBOTS)} (default); given, exported bags are read as a real robot's, too. "
        "With --map any name, of the dataset's robot (default: that of the file)",
    )
    real.add_argument(
        "--map",
        metavar="FILE",
        help=f"fields of any robot's topics, and their features: a YAML file, or {' or '.join(presets.PRESETS)}. One "
        "more: --map.observation.x.vel='{topic: /odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x}'",
    )
    real.add_argument("--scan", help=f"topic of the scans (default: {_TOPICS['scan']})")
    real.add_argument("--odom", help=f"topic of the odometry (default: {_TOPICS['odom']})")
    real.add_argument(
        "--no_odom", action="store_true", default=None, help="read no odometry: the state has the scan, and no speeds"
    )
    real.add_argument("--cmd", help=f"topic of the commands (default: {_TOPICS['cmd']})")
    real.add_argument("--imu", help="topic of the IMU, to observe the gyroscope; not observed if left out")
    real.add_argument("--camera", action="append", metavar="NAME=TOPIC", help="a camera to record: front=/image")
    real.add_argument("--odometry", action="store_true", default=None, help="observe x.pos, y.pos and theta.pos, too")
    real.add_argument("--beams", type=int, help="beams of a scan in the dataset (default: 360)")
    real.add_argument("--scan_frame", metavar="FRAME", help="name of the scanner's frame, if it is not base_scan")
    real.add_argument("--scan_yaw", type=float, metavar="RAD", help="direction of its zero angle; 0 is straight ahead")
    real.add_argument("--odom_frame", metavar="FRAME", help="name of the base's frame, if it is not base_footprint")
    real.add_argument(
        "--command_timeout", type=float, metavar="S",
        help="silence after which the robot stops; inf (default): the last command continues, as on a TurtleBot3",
    )  # fmt: skip


def _run(options: argparse.Namespace) -> int:
    require_rosbags()
    mapping = _mapping(options)
    bags = [bag for path in options.bags for bag in find_bags(path.expanduser())]
    check_distinct(bags)
    root = default_root(options.repo_id) if options.root is None else options.root.expanduser()
    refuse_existing(root, "--root")  # before the bags are read, which may take long
    exported = [options.robot is None and mapping is None and is_exported(bag) for bag in bags]
    if all(exported):
        episodes = exported_episodes(bags)
        wanted = _wanted_of_exported(options, episodes[0][0], bags[0])
        report = import_bags(bags, root, options.repo_id, wanted, episodes)
    elif any(exported):
        raise ConfigError(
            f"{bags[exported.index(True)].path} was written by bhd-data export, {bags[exported.index(False)].path} was "
            "not. Import them one after the other into two datasets, or all of them as a real robot's with "
            f"--robot={ROBOTS[0]}."
        )
    else:
        wanted = _wanted(options) if mapping is None else _wanted_of_mapping(options, mapping)
        report = import_bags(bags, root, options.repo_id, wanted)
    _print(report, bags)
    return 0


def _wanted_of_exported(options: argparse.Namespace, episode: ExportedEpisode, bag: Bag) -> ImportOptions:
    """Return how exported bags are to be read."""
    if given := [name for name in _REAL if getattr(options, name) is not None]:
        raise ConfigError(
            f"--{given[0]} is for bags of a real robot; this one was written by bhd-data export, and describes what "
            f"is in it. Leave the option out, or read the bag as a real robot's with --robot={ROBOTS[0]}."
        )
    fps = episode.fps if options.fps is None else options.fps
    limits = turtlebot3_burger().limits if episode.robot_type in ROBOTS else None
    actions = names_of(episode, keys.ACTION)
    return ImportOptions(
        robot_type=episode.robot_type,
        task=options.task,
        fps=fps,
        observation_names=names_of(episode, keys.OBSERVATION_STATE),
        environment_names=names_of(episode, keys.ENVIRONMENT_STATE),
        action_names=actions,
        sources=tuple(sources_of(episode, bag)),
        max_speed=limits.velocity if limits is not None and limits.names == actions else None,
        command_timeout_s=math.inf,
        **_times(options, fps, least=0.0),
    )


def _times(options: argparse.Namespace, fps: int, least: float) -> dict[str, Any]:
    """Return the times that frames and episodes keep to, by their names in `ImportOptions`."""
    if options.task == "":
        raise ConfigError("--task is empty; it must be a sentence.")
    if options.stamps not in _STAMPS:
        raise ConfigError(unknown_name("stamps", options.stamps, _STAMPS))
    if options.outcome is not None and options.outcome not in OUTCOMES:
        raise ConfigError(unknown_name("outcome", options.outcome, OUTCOMES))
    if fps < 1:
        raise ConfigError(f"--fps is {fps}; it must be a whole number of at least 1.")
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    # As `bhd-record` judges it: a frame, and a period of the slowest sensor.
    max_age = 1 / fps + 1 / lidar.rate_hz if options.max_age is None else options.max_age
    for name, value, at_least in (("max_age", max_age, 0.0), ("max_gap", options.max_gap, max_age)):
        if not value > 0 or value < at_least or math.isinf(value):
            raise ConfigError(
                f"--{name} is {value}; it must be positive" + (f", {at_least:g} at least." if at_least else ".")
            )
    shortest = least if options.min_episode_s is None else options.min_episode_s
    if not 0 <= shortest < math.inf:
        raise ConfigError(f"--min_episode_s is {shortest}; it must be 0 or positive.")
    return {
        "max_age_s": max_age,
        "max_gap_s": options.max_gap,
        "min_episode_s": shortest,
        "stamps": options.stamps,
        "outcome": options.outcome,
    }


def _wanted(options: argparse.Namespace) -> ImportOptions:
    """Return how a real robot's bags are to be read."""
    robot = options.robot or ROBOTS[0]
    if robot not in ROBOTS:
        raise ConfigError(
            f"{unknown_name('robot', robot, ROBOTS)} Bags of other robots need --map, which names the fields to read: "
            f"a YAML file, or {' or '.join(presets.PRESETS)}."
        )
    real, body = _real(options), turtlebot3_burger()
    from bhd_lerobot.robots.base_host import observation_names
    from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config  # seconds to import

    beams, pose = 360 if options.beams is None else options.beams, bool(options.odometry)
    config = TurtleBot3Config(
        fps=10, beams=beams, odometry=pose, imu=options.imu is not None
    )  # refuses numbers of beams that do not divide a turn
    topics: dict[str, Any] = {role: getattr(options, role) or topic for role, topic in _TOPICS.items()}
    names = observation_names(config)
    if options.no_odom:
        if given := [name for name in ("odom", "odometry", "odom_frame") if getattr(options, name) is not None]:
            raise ConfigError(f"--no_odom and --{given[0]} are both given; with --no_odom no odometry is read.")
        topics["odom"] = None
        names = tuple(name for name in names if name not in TWIST)
    topics |= {"imu": options.imu, "cameras": _cameras(options.camera or []), "beams": beams, "pose": pose}
    stamped, bare = (presets.turtlebot3(**topics, stamped=one) for one in (True, False))
    return ImportOptions(
        robot_type=robot,
        observation_names=names,
        action_names=body.limits.names,
        sources=tuple(base_sources(stamped, bare, options.odom_frame, options.scan_frame, options.scan_yaw)),
        pose=pose,
        max_speed=body.limits.velocity,
        **real,
    )


def _mapping(options: argparse.Namespace) -> MappingConfig | None:
    """Return what --map says; None if there is no such option."""
    tree: dict[str, dict[str, Any]] = {}
    for name, value in read_line(options.entries).options.items():
        section, _, feature = name.removeprefix("map.").partition(".")
        if feature:
            tree.setdefault(section, {})[feature] = value
        else:
            tree[section] = value
    if options.map is None and not tree:
        return None
    if options.map is None:
        mapping = MappingConfig()
    elif options.map in presets.PRESETS:
        mapping = presets.PRESETS[options.map]()
    elif not Path(options.map).exists() and not Path(options.map).suffix:
        raise ConfigError(f"{unknown_name('mapping', options.map, presets.PRESETS)} Or name a YAML file.")
    else:
        mapping = MappingConfig.load(Path(options.map).expanduser())
    return MappingConfig.of(tree, "--map").over(mapping)


def _wanted_of_mapping(options: argparse.Namespace, mapping: MappingConfig) -> ImportOptions:
    """Return how the bags of any robot are to be read."""
    if given := [name for name in _BASE if getattr(options, name) is not None]:
        raise ConfigError(f"--{given[0]} is for bags of a TurtleBot3; with --map the mapping names the topics.")
    for section in ("observation", "action"):
        if not getattr(mapping, section):
            raise ConfigError(
                f"The mapping has no {section}. Name a field with --map.{section}.NAME='{{topic: …, type: …, "
                "field: …}'."
            )
    if wrong := [name for name in mapping.images if not name.isidentifier()]:
        raise ConfigError(f"The camera {wrong[0]!r} of the mapping has no valid name: letters, digits and underscores.")
    real, observed, actions = _real(options), features_of(mapping.observation), features_of(mapping.action)
    for names in (observed, actions):
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"The mapping has the feature {twice[0]} twice; a scan's are NAME_000.pos and so on.")
    held = [name for name in actions if not name.endswith(".vel")]
    if held and not math.isinf(real["command_timeout_s"]):
        raise ConfigError(
            f"--command_timeout is for actions that are speeds, whose names end in .vel; {held[0]} is none, and a "
            "robot holds it."
        )
    return ImportOptions(
        robot_type=options.robot or Path(options.map or "robot").stem,
        observation_names=observed,
        action_names=actions,
        sources=tuple(mapped_sources(mapping, options.scan_frame, options.scan_yaw)),
        max_speed=None,
        **real | {"given": real["given"] | {"mapping": dataclasses.asdict(mapping)}},
    )


def _real(options: argparse.Namespace) -> dict[str, Any]:
    """Return how a real robot's bags are to be read, whichever robot it is, by the names in `ImportOptions`."""
    if not options.task:
        raise ConfigError("Describe the robot's task: --task='Drive around without touching anything.'")
    fps = 10 if options.fps is None else options.fps
    timeout = math.inf if options.command_timeout is None else options.command_timeout
    if not timeout > 0:
        raise ConfigError(f"--command_timeout is {timeout}; it must be positive.")
    if options.scan_yaw is not None and not math.isfinite(options.scan_yaw):
        raise ConfigError(f"--scan_yaw is {options.scan_yaw}; it must be an angle in rad.")
    default = turtlebot3_burger().limits.command_timeout_s
    return {
        "task": options.task,
        "fps": fps,
        "command_timeout_s": timeout,
        "timeouts": (math.inf, default) if options.command_timeout is None else (),
        "given": {name: getattr(options, name) for name in ("scan_frame", "scan_yaw", "odom_frame")},
        **_times(options, fps, least=1.0),
    }


def _cameras(texts: list[str]) -> dict[str, str]:
    cameras = {}
    for text in texts:
        name, separator, topic = text.partition("=")
        if not separator or not name.isidentifier() or not topic or name in cameras:
            raise ConfigError(f"--camera is {text!r}; it must be NAME=TOPIC, such as front=/image, each name once.")
        cameras[name] = topic
    return cameras


def _print(report: ImportReport, bags: list[Bag]) -> None:
    for problem in report.problems:
        print(f"damaged: {problem}", file=sys.stderr)
    for note in report.notes:
        print(f"note: {note}", file=sys.stderr)
    episodes = counted(report.episodes, "episode")
    source = "1 bag" if len(bags) == 1 else f"{len(bags)} bags"
    print(
        f"{report.root}: {episodes}, {report.frames} frames, of {source}. To validate it: bhd-data check "
        f"{quoted(report.root)}"
    )
