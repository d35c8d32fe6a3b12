"""Fields of messages and features of a robot, by names."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.ros2.messages.mapping import FieldConfig, MappingConfig, has_header, register_types, topics_of
from bhd_lerobot.ros2.messages.serialize import decode
from tests.cases import each_case

ODOMETRY, JOINTS = "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"

FEATURES = {
    "x.vel": FieldConfig("odom", ODOMETRY, "twist.twist.linear.x"),
    "shoulder.pos": FieldConfig("/joint_states", JOINTS, "position[name=shoulder]", scale=np.pi / 180, offset=0.5),
    "theta.vel": FieldConfig("/odom", ODOMETRY, "twist.twist.angular.z", scale=-1),
    "elbow.pos": FieldConfig("/joint_states", JOINTS, "position[name=elbow]"),
    "second.pos": FieldConfig("/path", "trajectory_msgs/msg/JointTrajectory", "points[1].positions[2]"),
    "lift.pos": FieldConfig("/numbers", "bhd_msgs/msg/Numbers", "values[names=lift.pos]"),
    "wheel.pos": FieldConfig("/tf", "tf2_msgs/msg/TFMessage", "transforms[child_frame_id=wheel].transform.rotation.z"),
}


def test_features_are_grouped_by_topic_and_come_back_from_what_is_sent() -> None:
    values = np.linspace(-1, 1, len(FEATURES))
    found = np.full(len(FEATURES), np.nan)
    topics = topics_of(FEATURES, {})
    assert [topic.topic for topic in topics] == ["/odom", "/joint_states", "/path", "/numbers", "/tf"]
    for topic in topics:
        columns = list(topic.columns)
        message = decode(topic.msgtype, topic.encode(values[columns], 1_500_000_000))
        if has_header(topic.msgtype):
            assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
        found[columns] = topic.read(message)
    np.testing.assert_allclose(found, values, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("", "A field of nav_msgs/msg/Odometry is missing; it has: header, child_frame_id, pose, twist"),
        ("twist.twist.linear", "is geometry_msgs/msg/Vector3; a feature is one number"),
        ("header.frame_id", "is text"),
        ("pose.covariance[3].x", "name an element"),
        ("twist[2]", "is not an array"),
        ("twist..x", "is no name"),
    ],
)
def test_a_wrong_field_is_named(path: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        topics_of({"q": FieldConfig("odom", ODOMETRY, path)}, {})


def test_a_topic_of_two_types_is_named() -> None:
    two = {"a": FEATURES["x.vel"], "b": FieldConfig("odom", "std_msgs/msg/Float64", "data")}
    with pytest.raises(ConfigError, match="mapped with several types"):
        topics_of(two, {})


@pytest.mark.law
@each_case(
    ("msgtype", "field", "value", "sent"),
    [
        ("Int32", "data", 2.6, 3),
        ("UInt8", "data", -4.0, 0),
        ("UInt8", "data", 300.0, 255),
        ("UInt64", "data", 1e30, 2**64 - 1),
        ("Bool", "data", 0.3, False),
        ("Bool", "data", 0.8, True),
        ("Int16MultiArray", "data[0]", -1.7, -2),
        ("Float32", "data", 0.5, 0.5),
    ],
)
def test_a_whole_number_or_a_truth_value_is_sent_as_the_nearest_that_there_is(msgtype, field, value, sent):
    [topic] = topics_of({"grip.pos": FieldConfig("/grip", f"std_msgs/msg/{msgtype}", field)}, {})
    message = decode(topic.msgtype, topic.encode(np.array([value]), 0))
    assert topic.fields[0].read(message) == sent


YAML = """
observation:
  x.vel: {topic: /odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x}
  load: {topic: /load, type: my_msgs/msg/Load, field: "parts[0].mass", scale: 2}
action:
  x.vel: {topic: /cmd_vel, type: geometry_msgs/msg/Twist, field: linear.x}
images:
  front: {topic: /camera/image_raw/compressed, width: 640, height: 480}
types:
  my_msgs/msg/Load: "my_msgs/Part[] parts"
  my_msgs/msg/Part: "float64 mass"
"""


def test_a_file_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robot.yaml").write_text(YAML)
    monkeypatch.setenv("HOME", str(tmp_path))
    mapping = MappingConfig.load("~/robot.yaml")  # which a shell leaves as it is behind --robot.mapping=
    assert list(mapping.observation) == ["x.vel", "load"]
    assert mapping.images["front"].type == "sensor_msgs/msg/CompressedImage"
    _, load = topics_of(mapping.observation, mapping.types)
    assert load.read(decode(load.msgtype, load.encode(np.array([3.0]), 0))) == [3.0]


def test_a_key_that_is_there_twice_is_named(tmp_path: Path) -> None:
    """YAML would take the last: an action of which another field moves than the one that was read first."""
    entry = "{topic: /odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x}"
    (tmp_path / "robot.yaml").write_text(f"observation:\n  x.vel: {entry}\n  x.vel: {entry}\n")
    with pytest.raises(ConfigError, match=r"'x.vel' occurs twice .* line 2; leave one of them"):
        MappingConfig.load(tmp_path / "robot.yaml")


@each_case(
    ("wrong", "text"),
    [
        ("topic:", "x.vel: topic is None; it is text"),
        ("topic: /odom, type: 5", "x.vel: type is 5; it is text"),
        ("topic: /odom, field: [twist]", "x.vel: field is .*; it is text"),
        ("topic: /odom, scale:", "x.vel: float"),
        ("topic: /scan, beams: 8.0", "x.vel: beams is 8.0; it is a whole number"),
    ],
)
def test_a_value_that_is_missing_or_of_another_kind_is_named(wrong: str, text: str) -> None:
    entry = {"type": ODOMETRY} | yaml.safe_load(f"{{{wrong}}}")
    with pytest.raises(ConfigError, match=text):
        MappingConfig.of({"observation": {"x.vel": entry}}, "robot.yaml")


def test_a_type_has_one_definition() -> None:
    types = {"twice_msgs/msg/A": "float64 x"}
    for _ in range(2):
        register_types(types)
    with pytest.raises(ConfigError, match="already present with different definition"):
        register_types({"twice_msgs/msg/A": "float32 x"})
