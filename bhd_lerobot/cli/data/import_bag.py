"""`bhd-data import`: ROS 2 bags become a dataset."""

import argparse
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.errors import ConfigError, DatasetError, counted, quoted, unknown_name
from bhd_lerobot.options.parse import read_line
from bhd_lerobot.ros2.bag.importer.convert import ImportReport, import_bags
from bhd_lerobot.ros2.bag.importer.exported import exported
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.sources import base_sources, mapped_sources
from bhd_lerobot.ros2.bag.storage.find import check_distinct, find_bags
from bhd_lerobot.ros2.bag.storage.place import refuse_existing
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages import presets
from bhd_lerobot.ros2.messages.mapping import MappingConfig, features_of
from bhd_lerobot.ros2.messages.types import require_rosbags
from bhd_lerobot.tasks.task import OUTCOMES

ROBOTS = ("turtlebot3",)
_STAMPS = ("receive", "header", "auto")
_TOPICS = {"scan": "/scan", "odom": "/odom", "cmd": "/cmd_vel"}
_BASE = (*_TOPICS, "no_odom", "imu", "camera", "odometry", "beams", "odom_frame")  # options for a TurtleBot3's bags
_RESAMPLE = ("fps", "stamps", "max_age", "max_gap", "command_timeout")  # of these one resamples an exported bag


def add_to(commands: Commands) -> None:
    """Add `import`."""
    help_text = "convert ROS 2 bags to a dataset: bags of a TurtleBot3, or of any robot with --map"
    command = add_command(commands, "import", help_text, _run, names_dataset=False)
    command.set_defaults(stopped="no dataset was made", entries_of="map")
    command.add_argument("bags", nargs="+", type=Path, help="bags: folders, .mcap or .db3 files, or a folder of bags")
    command.add_argument("--repo_id", required=True, help="name of the dataset, user/name")
    command.add_argument("--root", type=Path, help="where to put it; LeRobot's default place if left out")
    command.add_argument("--task", help="the instruction, a sentence (default: that of an exported bag)")
    command.add_argument("--fps", type=int, help="frames a second (default: 10, or those of an exported bag)")
    command.add_argument("--stamps", help="source of timestamps: receive (default), header or auto")
    command.add_argument("--max_age", type=float, metavar="S", help="age of a reading that makes a frame late")
    command.add_argument(
        "--max_gap", type=float, metavar="S", help="silence that ends an episode (default: 1.0, or a longer --max_age)"
    )
    command.add_argument(
        "--min_episode_s", type=float, metavar="S",
        help="shorter episodes are left out (default: 1.0; 0 of an exported bag)",
    )  # fmt: skip
    command.add_argument(
        "--outcome",
        help=f"outcome of the episodes: {', '.join(OUTCOMES)} (default: that of an exported bag, none of others)",
    )
    real = command.add_argument_group("the robot")
    real.add_argument(
        "--robot",
        help=f"valid: {', '.join(ROBOTS)} (default). With --map any name, of the dataset's robot (default: that of "
        "the file)",
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
    as_stated, robot_is_stated = all(getattr(options, name) is None for name in _RESAMPLE), False
    if (found := exported(bags[0])) is not None:
        if mapping is None and all(getattr(options, name) is None for name in ("robot", *_BASE)):
            mapping, options.robot, robot_is_stated = found.mapping, found.robot_type, found.mapping is not None
            if mapping is None and found.robot_type not in ROBOTS:
                raise DatasetError(
                    f"{bags[0].path} was exported of a dataset without a state or an action of floats, each with a "
                    "name of its own, and an import needs both. --map names fields of its topics to read instead."
                )
        options.fps = found.fps if options.fps is None else options.fps
        options.min_episode_s = options.min_episode_s or 0.0  # what was an episode is one, however short
    root = default_root(options.repo_id) if options.root is None else options.root.expanduser()
    refuse_existing(root, "--root")  # before the bags are read, which may take long
    common = _common(options) | {"as_stated": as_stated, "robot_is_stated": robot_is_stated}
    wanted = _of_turtlebot3(options, common) if mapping is None else _of_mapping(options, mapping, common)
    report = import_bags(bags, root, options.repo_id, wanted)
    _print(report, bags)
    return 0


def _common(options: argparse.Namespace) -> dict[str, Any]:
    """Return how bags are read whichever robot it is, by the names in `ImportOptions`."""
    stamps = options.stamps or _STAMPS[0]
    if stamps not in _STAMPS:
        raise ConfigError(unknown_name("stamps", stamps, _STAMPS))
    if options.outcome is not None and options.outcome not in OUTCOMES:
        raise ConfigError(unknown_name("outcome", options.outcome, OUTCOMES))
    fps = 10 if options.fps is None else options.fps
    if fps < 1:
        raise ConfigError(f"--fps is {fps}; it must be a whole number of at least 1.")
    timeout = math.inf if options.command_timeout is None else options.command_timeout
    if not timeout > 0:
        raise ConfigError(f"--command_timeout is {timeout}; it must be positive.")
    if options.scan_yaw is not None and not math.isfinite(options.scan_yaw):
        raise ConfigError(f"--scan_yaw is {options.scan_yaw}; it must be an angle in rad.")
    lidar = turtlebot3_burger().lidar
    assert lidar is not None
    # As `bhd-record` judges it: a frame, and a period of the slowest sensor.
    max_age = 1 / fps + 1 / lidar.rate_hz if options.max_age is None else options.max_age
    max_gap = max(1.0, max_age) if options.max_gap is None else options.max_gap
    for name, value, at_least in (("max_age", max_age, 0.0), ("max_gap", max_gap, max_age)):
        if not value > 0 or value < at_least or math.isinf(value):
            raise ConfigError(
                f"--{name} is {value}; it must be positive" + (f", {at_least:g} at least." if at_least else ".")
            )
    min_episode_s = 1.0 if options.min_episode_s is None else options.min_episode_s
    if not 0 <= min_episode_s < math.inf:
        raise ConfigError(f"--min_episode_s is {min_episode_s}; it must be 0 or positive.")
    default = turtlebot3_burger().limits.command_timeout_s
    return {
        "task": options.task or "",
        "fps": fps,
        "command_timeout_s": timeout,
        "timeouts": (math.inf, default) if options.command_timeout is None else (),
        "given": {name: getattr(options, name) for name in ("scan_frame", "scan_yaw", "odom_frame")},
        "max_age_s": max_age,
        "max_gap_s": max_gap,
        "min_episode_s": min_episode_s,
        "stamps": stamps,
        "outcome": options.outcome,
    }


def _of_turtlebot3(options: argparse.Namespace, common: dict[str, Any]) -> ImportOptions:
    robot = options.robot or ROBOTS[0]
    if robot not in ROBOTS:
        raise ConfigError(
            f"{unknown_name('robot', robot, ROBOTS)} Bags of other robots need --map, which names the fields to read: "
            f"a YAML file, or {' or '.join(presets.PRESETS)}."
        )
    from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config  # seconds to import

    beams, pose = 360 if options.beams is None else options.beams, bool(options.odometry)
    TurtleBot3Config(fps=10, beams=beams)  # refuses numbers of beams that do not divide a turn
    topics: dict[str, Any] = {role: getattr(options, role) or topic for role, topic in _TOPICS.items()}
    if options.no_odom:
        if given := [name for name in ("odom", "odometry", "odom_frame") if getattr(options, name) is not None]:
            raise ConfigError(f"--no_odom and --{given[0]} are both given; with --no_odom no odometry is read.")
        topics["odom"] = None
    topics |= {"imu": options.imu, "cameras": _cameras(options.camera or []), "beams": beams, "pose": pose}
    stamped, bare = (presets.turtlebot3(**topics, stamped=one) for one in (True, False))
    return ImportOptions(
        robot_type=robot,
        observation_names=features_of(stamped.observation),
        action_names=features_of(stamped.action),
        sources=tuple(base_sources(stamped, bare, options.odom_frame, options.scan_frame, options.scan_yaw)),
        pose=pose,
        max_speed=turtlebot3_burger().limits.velocity,
        **common,
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


def _of_mapping(options: argparse.Namespace, mapping: MappingConfig, common: dict[str, Any]) -> ImportOptions:
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
    observed, actions = features_of(mapping.observation), features_of(mapping.action)
    for names in (observed, actions):
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"The mapping has the feature {twice[0]} twice; a scan's are NAME_000.pos and so on.")
    held = [name for name in actions if not name.endswith(".vel")]
    if held and not math.isinf(common["command_timeout_s"]):
        raise ConfigError(
            f"--command_timeout is for actions that are speeds, whose names end in .vel; {held[0]} is none, and a "
            "robot holds it."
        )
    return ImportOptions(
        robot_type=options.robot if common["robot_is_stated"] else options.robot or Path(options.map or "robot").stem,
        observation_names=observed,
        action_names=actions,
        sources=tuple(mapped_sources(mapping, options.scan_frame, options.scan_yaw)),
        max_speed=None,
        **common | {"given": common["given"] | {"mapping": asdict(mapping)}},
    )


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
