"""`bhd-data import`: ROS 2 bags become a dataset."""

import argparse
import math
import sys
from pathlib import Path

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.errors import ConfigError, quoted, unknown_name
from bhd_lerobot.rosbag.importer.dataset import ImportReport, RobotImport
from bhd_lerobot.rosbag.importer.headers import is_ours
from bhd_lerobot.rosbag.importer.restore import restore
from bhd_lerobot.rosbag.importer.robot import import_robot
from bhd_lerobot.rosbag.importer.tracks import TrackOptions
from bhd_lerobot.rosbag.messages.types import require_rosbags
from bhd_lerobot.rosbag.storage.find import check_distinct, find_bags
from bhd_lerobot.rosbag.storage.place import refuse_existing
from bhd_lerobot.rosbag.storage.read import Bag
from bhd_lerobot.tasks.task import OUTCOMES

ROBOTS = ("turtlebot3",)
_STAMPS = ("auto", "header", "receive")


def add_to(commands: Commands) -> None:
    """Add `import`."""
    help_text = "make a dataset of ROS 2 bags: of a real TurtleBot3, or of `bhd-data export`"
    command = add_command(commands, "import", help_text, _run, names_dataset=False)
    command.set_defaults(stopped="no dataset was made")
    command.add_argument("bags", nargs="+", type=Path, help="bags: folders, .mcap or .db3 files, or a folder of bags")
    command.add_argument("--repo_id", required=True, help="name of the dataset, user/name")
    command.add_argument("--root", type=Path, help="where to put it; LeRobot's default place if left out")
    real = command.add_argument_group("bags of a real robot")
    real.add_argument("--resample", action="store_true", help="treat bags of bhd-data export as those of a real robot")
    real.add_argument("--robot", default="turtlebot3", help=f"valid: {', '.join(ROBOTS)} (default)")
    real.add_argument("--task", help="the instruction, a sentence; needed")
    real.add_argument("--fps", type=int, default=10, help="frames a second (default: 10)")
    real.add_argument("--scan", default="/scan", help="topic of the scans (default: /scan)")
    real.add_argument("--odom", default="/odom", help="topic of the odometry (default: /odom)")
    real.add_argument("--cmd", default="/cmd_vel", help="topic of the commands (default: /cmd_vel)")
    real.add_argument("--imu", help="topic of the IMU, to observe the gyroscope; not observed if left out")
    real.add_argument(
        "--camera", action="append", default=[], metavar="NAME=TOPIC", help="a camera to record, such as front=/image"
    )
    real.add_argument("--odometry", action="store_true", help="observe x.pos, y.pos and theta.pos, too")
    real.add_argument("--beams", type=int, default=360, help="beams of a scan in the dataset (default: 360)")
    real.add_argument("--stamps", default="receive", help="whose time counts: receive (default), header or auto")
    real.add_argument("--scan_frame", metavar="FRAME", help="name of the scanner's frame, if it is not base_scan")
    real.add_argument("--scan_yaw", type=float, metavar="RAD", help="where its zero points; 0 is straight ahead")
    real.add_argument("--odom_frame", metavar="FRAME", help="name of the base's frame, if it is not base_footprint")
    real.add_argument("--max_age", type=float, metavar="S", help="age of a reading that makes a frame late")
    real.add_argument("--max_gap", type=float, default=1.0, metavar="S", help="silence that ends an episode (1.0)")
    real.add_argument(
        "--command_timeout", type=float, metavar="S",
        help="silence after which the robot stands; inf: it goes on (default: that of our robot)",
    )  # fmt: skip
    real.add_argument("--min_episode_s", type=float, default=1.0, metavar="S", help="shorter ones are left out (1.0)")
    real.add_argument("--outcome", help=f"what the episodes ended with: {', '.join(OUTCOMES)}; nothing if left out")


def _run(options: argparse.Namespace) -> int:
    require_rosbags()
    bags = [bag for path in options.bags for bag in find_bags(path.expanduser())]
    check_distinct(bags)
    root = default_root(options.repo_id) if options.root is None else options.root.expanduser()
    refuse_existing(root, "--root")  # before the bags are read, which may take long
    ours = [is_ours(bag.topics()) for bag in bags]
    if any(ours) and not all(ours) and not options.resample:
        raise ConfigError(
            f"{bags[ours.index(True)].path} was written by bhd-data export, {bags[ours.index(False)].path} was not. "
            "Import them one after the other into two datasets, or all of them as a robot's with --resample."
        )
    if all(ours) and not options.resample:
        _refuse_options(options)
        report = restore(bags, root, options.repo_id)
    else:
        report = import_robot(bags, root, options.repo_id, _wanted(options))
    _tell(report, bags)
    return 0


_PLAIN = ("task", "imu", "scan_frame", "scan_yaw", "odom_frame", "max_age", "command_timeout", "outcome")


def _refuse_options(options: argparse.Namespace) -> None:
    given = [name for name in _PLAIN if getattr(options, name) is not None]
    given += ["camera"] * bool(options.camera) + ["odometry"] * options.odometry
    for name, default in (("fps", 10), ("beams", 360), ("stamps", "receive"), ("max_gap", 1.0)):
        given += [name] * (getattr(options, name) != default)
    if given:
        raise ConfigError(
            f"--{given[0]} is for bags of a real robot; this one was written by bhd-data export, and comes back as it "
            "was. Leave the option out, or resample the bag as if it were a robot's, with --resample."
        )


def _wanted(options: argparse.Namespace) -> RobotImport:
    """Return what the options ask for.

    Raises:
        ConfigError: a value that cannot be honoured.
    """
    if options.robot not in ROBOTS:
        raise ConfigError(f"{unknown_name('robot', options.robot, ROBOTS)} Only its bags can be resampled.")
    if not options.task:
        raise ConfigError("Say what the robot was to do: --task='Drive around without touching anything.'")
    if options.stamps not in _STAMPS:
        raise ConfigError(unknown_name("stamps", options.stamps, _STAMPS))
    if options.outcome is not None and options.outcome not in OUTCOMES:
        raise ConfigError(unknown_name("outcome", options.outcome, OUTCOMES))
    if options.fps < 1:
        raise ConfigError(f"--fps is {options.fps}; it must be a whole number of at least 1.")
    body = turtlebot3_burger()
    assert body.lidar is not None
    # As `bhd-record` judges it: a frame, and a period of the slowest sensor.
    max_age = 1 / options.fps + 1 / body.lidar.rate_hz if options.max_age is None else options.max_age
    timeout = body.limits.command_timeout_s if options.command_timeout is None else options.command_timeout
    for name, value, least in (
        ("max_age", max_age, 0.0),
        ("max_gap", options.max_gap, max_age),
        ("command_timeout", timeout, 0.0),
    ):
        if not value > 0 or value < least or (math.isinf(value) and name != "command_timeout"):
            raise ConfigError(
                f"--{name} is {value}; it must be positive" + (f", {least:g} at least." if least else ".")
            )
    if not 0 <= options.min_episode_s < math.inf:
        raise ConfigError(f"--min_episode_s is {options.min_episode_s}; it must be 0 or positive.")
    if options.scan_yaw is not None and not math.isfinite(options.scan_yaw):
        raise ConfigError(f"--scan_yaw is {options.scan_yaw}; it must be an angle in rad.")
    from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config  # seconds to import
    from bhd_lerobot.robots.turtlebot3_simulation import observation_names

    config = TurtleBot3Config(
        fps=10, beams=options.beams, odometry=options.odometry, imu=options.imu is not None
    )  # refuses numbers of beams that do not divide a turn
    topics = {"scan": options.scan, "odom": options.odom, "cmd": options.cmd}
    if options.imu is not None:
        topics["imu"] = options.imu
    return RobotImport(
        robot_type=options.robot,
        task=options.task,
        fps=options.fps,
        observation_names=observation_names(config),
        action_names=body.limits.names,
        tracks=TrackOptions(
            topics=topics,
            cameras=_cameras(options.camera),
            beams=options.beams,
            lidar=body.lidar,
            stamps=options.stamps,
            scan_frame=options.scan_frame,
            odom_frame=options.odom_frame,
            scan_yaw=options.scan_yaw,
            pose=options.odometry,
        ),
        max_speed=body.limits.velocity,
        max_age_s=max_age,
        max_gap_s=options.max_gap,
        command_timeout_s=timeout,
        min_episode_s=options.min_episode_s,
        outcome=options.outcome,
    )


def _cameras(texts: list[str]) -> dict[str, str]:
    cameras = {}
    for text in texts:
        name, separator, topic = text.partition("=")
        if not separator or not name.isidentifier() or not topic or name in cameras:
            raise ConfigError(f"--camera is {text!r}; it must be NAME=TOPIC, such as front=/image, each name once.")
        cameras[name] = topic
    return cameras


def _tell(report: ImportReport, bags: list[Bag]) -> None:
    for problem in report.problems:
        print(f"damaged: {problem}", file=sys.stderr)
    for note in report.notes:
        print(f"note: {note}", file=sys.stderr)
    episodes = "1 episode" if report.episodes == 1 else f"{report.episodes} episodes"
    source = "1 bag" if len(bags) == 1 else f"{len(bags)} bags"
    print(
        f"{report.root}: {episodes}, {report.frames} frames, of {source}. Is it valid? "
        f"bhd-data check {quoted(report.root)}"
    )
