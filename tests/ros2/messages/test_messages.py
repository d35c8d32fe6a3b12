"""Messages: made of arrays, read back from either byte order, refused where they are something else."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.ros2.bag.exporter.episode import scan_stream
from bhd_lerobot.ros2.messages import types
from bhd_lerobot.ros2.messages.base import ScanPart
from bhd_lerobot.ros2.messages.parts import Frames, header, header_stamps, image_topic, own_topic
from bhd_lerobot.ros2.messages.serialize import decode, encode
from bhd_lerobot.ros2.messages.split import parts_of
from bhd_lerobot.ros2.messages.views import TF
from bhd_lerobot.tasks.task import Event
from tests.ros2.bag.support import STORE, odometry, scan

SCAN, JOINTS = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/JointState"


@pytest.mark.law
def test_trees_of_arrays_become_messages():
    stamps = np.array([5 * 10**9 + 7, 6 * 10**9])
    ranges = np.random.default_rng(0).random((2, 37)).astype(np.float32)
    trees = {
        SCAN: {"header": header(stamps, "base_scan"), "range_max": 3.5, "ranges": ranges},
        JOINTS: {"header": header(stamps, "x"), "name": ["a", "bcd", ""], "position": np.arange(6.0).reshape(2, 3)},
        types.NUMBERS: {"header": header(stamps), "frame_index": np.array([3, -4]), "values": ranges[:, :2]},
        TF: {"transforms": [{"child_frame_id": name, "transform": {"rotation": {"w": 1.0}}} for name in ("a", "bb")]},
    }
    read = {kind: [decode(kind, message) for message in encode(kind, tree, 2)] for kind, tree in trees.items()}
    scan, joints, numbers, moved = (messages[1] for messages in read.values())
    assert header_stamps(read[SCAN]).tolist() == stamps.tolist()
    assert (scan.header.frame_id, scan.range_max, scan.angle_min) == ("base_scan", 3.5, 0.0)
    assert np.array_equal(scan.ranges, ranges[1])
    assert (joints.name, joints.position.tolist(), joints.velocity.tolist()) == (["a", "bcd", ""], [3.0, 4.0, 5.0], [])
    assert (numbers.frame_index, numbers.values.tolist()) == (-4, ranges[1, :2].tolist())
    assert [(transform.child_frame_id, transform.transform.rotation.w) for transform in moved.transforms] == [
        ("a", 1.0),
        ("bb", 1.0),
    ]
    with pytest.raises(KeyError, match="no field"):
        encode(SCAN, {"beams": 3}, 1)


@pytest.mark.parametrize("name", ["front", "cam-1", "0", "3d.left", "カメラ", "_x_"])
def test_features_of_every_name_have_topics_that_ros_takes(name):
    valid = r"(/[A-Za-z][A-Za-z0-9_]*)+"
    topics = [own_topic(name), *(image_topic(f"observation.images.{name}", compressed=one) for one in (True, False))]
    assert all(re.fullmatch(valid, topic) for topic in topics), topics


@pytest.mark.parametrize("little", [True, False])
def test_decoding_takes_either_byte_order(little):
    one = scan(10**9 + 1, beams=5)
    found = decode(SCAN, bytes(STORE.serialize_cdr(one, SCAN, little_endian=little)))
    assert header_stamps([found]).tolist() == [10**9 + 1]
    assert np.array_equal(one.ranges, found.ranges)


def test_a_message_of_another_type_cut_off_or_of_another_encoding_is_refused():
    whole = bytes(STORE.serialize_cdr(odometry(10**9), "nav_msgs/msg/Odometry"))
    for wrong in (whole, whole[:40], whole[:3], b""):
        with pytest.raises(DatasetError, match=r"LaserScan"):
            decode(SCAN, wrong)
    with pytest.raises(DatasetError, match="plain CDR"):
        decode("nav_msgs/msg/Odometry", b"\x00\x07" + whole[2:])


@pytest.mark.parametrize(
    ("definition", "prefix", "enum"),
    [
        (types.STATE, "", Mode),
        (types.OUTCOME, "", Event),
        (types.STATE, "LIMIT_", Limit),
        (types.STATE, "WATCHDOG_", Watchdog),
    ],
)
def test_constants_of_the_messages_are_those_of_the_program(definition, prefix, enum):
    constants = dict(re.findall(rf"int64 {prefix}([A-Z][A-Z_]*)=(\d+)", types.DEFINITIONS[definition]))
    values = {int(value) for name, value in constants.items() if prefix or not name.startswith(("LIMIT", "WATCHDOG"))}
    assert values == {int(one) for one in enum if prefix == "" or int(one)}


def test_of_an_unknown_robot_everything_is_plain_numbers():
    names = ["x.vel", "theta.vel", "shoulder.pos"]
    (part,) = parts_of("observation.state", names, "so100", lidar=None)
    assert (part.msgtype, part.topic, part.names) == (types.NUMBERS, "/bhd/observation_state", tuple(names))
    kinds = [one.kind for one in parts_of("observation.state", names, "ur5", lidar=None)]
    assert kinds == ["OdometryPart", "JointsPart"]


def test_without_rosbags_the_command_that_installs_it_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag2", None)
    with pytest.raises(ConfigError, match=r"pip install -e '\.\[ros2\]'"):
        types.require_rosbags()


@pytest.mark.law
def test_a_scan_is_never_stamped_before_an_observation_that_did_not_have_it():
    """On the wall clock the age includes the way to the brain: 5 ms here, for a scan 1 ms after an observation."""
    lidar = turtlebot3_burger().lidar
    part = ScanPart("/scan", tuple(f"scan_{beam:03d}.pos" for beam in range(4)), lidar=lidar)
    observed = np.array([0, 100, 200, 300]) * 10**6 + 10**18
    values = np.repeat([[1.0], [1.0], [2.0], [2.0]], 4, axis=1)
    age = np.array([0.005, 0.105, 0.104, 0.204], np.float32)
    stream = scan_stream(part, Frames(0, np.arange(4), observed), values, age)
    received, messages = zip(*stream.messages, strict=True)
    assert received == (observed[0], observed[2])
    first, second = header_stamps([decode(SCAN, message) for message in messages])
    assert first == pytest.approx(observed[0] - 5 * 10**6, abs=100)
    assert second == observed[1] + 1


def test_the_ament_package_lists_every_message_and_what_they_depend_on() -> None:
    folder = Path(types.__file__).parent
    messages = {f"msg/{path.name}": path.read_text(encoding="utf-8") for path in (folder / "msg").glob("*.msg")}
    cmake = (folder / "CMakeLists.txt").read_text(encoding="utf-8")
    assert set(re.findall(r'"(msg/.*)"', cmake)) == set(messages)
    used = {package for text in messages.values() for package in re.findall(r"^(\w+)/\w+ ", text, re.MULTILINE)}
    package = ElementTree.parse(folder / "package.xml")
    assert {one.text for one in package.iterfind("depend")} == used
    assert re.search(r"^  DEPENDENCIES (.*)$", cmake, re.MULTILINE)[1].split() == sorted(used)  # type: ignore[index]
    assert used <= set(re.findall(r"find_package\((\w+) REQUIRED\)", cmake))
    assert package.findtext("name") == types.INTERFACES
