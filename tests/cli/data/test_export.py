"""Export, read by readers that are not ours."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5 as ur5_body
from bhd_lerobot.cli.data import main
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.features import dataset_features
from bhd_lerobot.datasets.format.state import DatasetState
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import UnsupportedDatasetError
from bhd_lerobot.ros2.bag.exporter.episode import EpisodeTopics, ExportOptions
from bhd_lerobot.ros2.messages.views import RobotView
from tests.cases import each_case
from tests.datasets import support
from tests.recording.support import run_record

NANO = 10**9


@pytest.fixture(scope="module")
def turtlebot3(tmp_path_factory):
    root = tmp_path_factory.mktemp("export") / "tb3"
    run_record(root, n_envs=2, seed=4, robot__beams=360, robot__odometry="true", robot__imu="true",
               dataset__num_episodes=2)  # fmt: skip
    return root


@pytest.fixture(scope="module")
def ur5(tmp_path_factory):
    root = tmp_path_factory.mktemp("export") / "ur5"
    run_record(root, seed=4, robot__type="ur5", brain__type="reach", task__type="reach", robot__beams=None,
               dataset__repo_id="test/reach", dataset__num_episodes=2, n_envs=2)  # fmt: skip
    return root


def export(root, output, *arguments):
    assert main.main(["export", str(root), f"--output={output}", *arguments]) == 0
    return output


def decoded(path):
    """Return topic -> its messages as an independent reader has them: (time of reception, message)."""
    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            found[channel.topic].append((message.log_time, content))
    return found


VIDEO = {"dtype": "video", "shape": [4, 4, 3]}


@each_case(
    ("features", "fps", "message"),
    [
        ({"depth": {**VIDEO, "shape": [4, 4, 1]}}, 10, r"'depth' of data is of type video, shape \(4, 4, 1\)"),
        ({"outcome": {"dtype": "string", "shape": [1]}}, 10, "share the topic /bhd/outcome"),
        ({"note.a": {"dtype": "string", "shape": [1]}, "note_a": {"dtype": "int64", "shape": [2]}}, 10, "/bhd/note_a"),
        ({f"observation.images.a{sign}b": VIDEO for sign in "-_"}, 10, "share the topic /a_b/image_raw"),
        ({"front": VIDEO}, 29.97, r"29\.97 frames a second; bags state a whole number"),
    ],
)
def test_what_no_bag_can_hold_is_refused_before_anything_is_written(features, fps, message):
    state = DatasetState(Path("data"), {"features": features, "fps": fps}, None)
    with pytest.raises(UnsupportedDatasetError, match=message):
        EpisodeTopics(state, RobotView(), "", ExportOptions())


@pytest.fixture(scope="module")
def base_bags(turtlebot3):
    """A bag for each episode of a base, from 1000 s on."""
    return export(turtlebot3, turtlebot3.with_name("base_bags"), "--start_time=1000")


@pytest.fixture(scope="module")
def base(base_bags):
    """Topics of the base's first episode."""
    return decoded(base_bags / "episode_000000/episode_000000.mcap")


@pytest.fixture(scope="module")
def arm(ur5):
    """Topics of the arm's second episode."""
    bags = export(ur5, ur5.with_name("arm_bags"), "--episodes=1")
    assert [bag.name for bag in bags.iterdir()] == ["episode_000001"]
    return decoded(bags / "episode_000001/episode_000001.mcap")


def stamp(message):
    return message.header.stamp.sec * NANO + message.header.stamp.nanosec


@pytest.mark.parametrize("compressed", [[], ["--compressed_images"]])
def test_texts_and_images_of_an_unknown_robot(video_episodes, tmp_path, capsys, compressed):
    bags = export(video_episodes, tmp_path / "my bags", *compressed)
    assert f"Play one: ros2 bag play '{bags}/episode_000000'" in capsys.readouterr().out
    topics = decoded(bags / "episode_000001/episode_000001.mcap")
    assert "/bhd/observation_state" in topics
    assert [message.text for _, message in topics["/bhd/note"]] == [f"1/{k}" for k in range(support.length(1))]
    image = "/front/image_raw" + "/compressed" * bool(compressed)
    if not compressed:
        for frame, (_, message) in enumerate(topics[image]):
            assert (message.height, message.width, message.step, message.encoding) == (32, 48, 144, "rgb8")
            assert abs(np.frombuffer(message.data, np.uint8).mean() - support.grey(1, frame)) < 3
    assert len(topics[image]) == support.length(1)


def test_an_independent_reader_sees_what_was_recorded_of_a_base(turtlebot3, base):
    topics = base
    columns = read_episode(turtlebot3, 0)
    names = dataset_info(turtlebot3).features["observation.state"]["names"]
    state = {name: columns["observation.state"][:, column] for column, name in enumerate(names)}
    times = 1000 * NANO + np.round(columns["control.time"] * NANO).astype(np.int64)
    n = len(times)
    for topic in ("/odom", "/imu", "/cmd_vel", "/joint_states", "/cmd_vel_applied", "/bhd/outcome"):
        assert len(topics[topic]) == n, topic
    odom = [message for _, message in topics["/odom"]]
    assert [stamp(one) for one in odom] == times.tolist()
    assert [one.twist.twist.linear.x for one in odom] == state["x.vel"].tolist()
    assert [one.twist.twist.angular.z for one in odom] == state["theta.vel"].tolist()
    assert [one.pose.pose.position.x for one in odom] == state["x.pos"].tolist()
    yaw = [2 * np.arctan2(one.pose.pose.orientation.z, one.pose.pose.orientation.w) for one in odom]
    assert yaw == pytest.approx(state["theta.pos"], abs=1e-12)
    assert {(one.header.frame_id, one.child_frame_id) for one in odom} == {("odom", "base_footprint")}
    commands = [(m.twist.linear.x, m.twist.angular.z) for _, m in topics["/cmd_vel"]]
    assert commands == [tuple(row) for row in columns["action"].tolist()]
    applied = [(stamp(m), m.twist.linear.x, m.twist.angular.z) for _, m in topics["/cmd_vel_applied"]]
    ends = [*times[1:].tolist(), int(times[-1]) + NANO // 10]
    assert applied == [(end, *row) for end, row in zip(ends, columns["control.applied_action"].tolist(), strict=True)]
    assert [m.angular_velocity.z for _, m in topics["/imu"]] == state["imu_z.vel"].tolist()
    assert {m.orientation_covariance[0] for _, m in topics["/imu"]} == {-1.0}
    assert [m.event for _, m in topics["/bhd/outcome"]] == columns["event"].tolist()
    assert [m.mode for _, m in topics["/bhd/cerebellum"]] == columns["control.mode"].tolist()
    assert [m.time for _, m in topics["/bhd/cerebellum"]] == columns["control.time"].tolist()
    wheels = topics["/joint_states"][-1][1]
    assert list(wheels.name) == ["wheel_left_joint", "wheel_right_joint"]
    assert list(wheels.position) == columns["simulation.state"][-1, 7:9].tolist()
    frames = {transform.child_frame_id: transform for transform in topics["/tf_static"][0][1].transforms}
    assert frames["base_scan"].transform.translation.z + frames["base_link"].transform.translation.z == 0.182
    episode = topics["/bhd/episode"][0][1]
    assert (episode.task, episode.frames, episode.episode_index) == (dataset_info(turtlebot3).episodes[0].task, n, 0)


def test_each_scan_is_exported_once_with_infinity_for_no_return(turtlebot3, base_bags):
    for episode in (0, 1):
        columns = read_episode(turtlebot3, episode)
        name = f"episode_{episode:06d}"
        topics = decoded(base_bags / name / f"{name}.mcap")
        start = topics["/bhd/episode"][0][0]
        scans = [message for _, message in topics["/scan"]]
        measured = np.array([stamp(scan) for scan in scans])
        # 5 Hz at 10 frames a second, and stamped when it was measured
        assert np.diff(measured).tolist() == [NANO // 5] * (len(scans) - 1)
        assert measured[0] == start
        assert all(time >= stamp(message) for time, message in topics["/scan"])
        times = start + np.round(columns["control.time"] * NANO).astype(np.int64)
        seen = np.array([scans[np.searchsorted(measured, time, side="right") - 1].ranges for time in times])
        recorded = columns["observation.state"][:, 2:362]
        assert np.array_equal(np.isinf(seen), recorded == np.float32(3.5))
        assert np.array_equal(np.where(np.isinf(seen), np.float32(3.5), seen.astype(np.float32)), recorded)
        one = scans[0]
        assert (one.angle_min, one.header.frame_id, len(one.ranges)) == (0.0, "base_scan", 360)
        assert one.angle_increment == pytest.approx(2 * np.pi / 360)
        assert (one.range_min, one.range_max, one.scan_time) == pytest.approx((0.12, 3.5, 0.2))


def test_an_independent_reader_sees_what_was_recorded_of_an_arm(ur5, arm):
    columns = read_episode(ur5, 1)
    state = columns["observation.state"].astype(np.float64)
    joints = [message for _, message in arm["/joint_states"]]
    assert np.array_equal([joint.position for joint in joints], state[:, :7])
    assert np.array_equal([joint.velocity for joint in joints], state[:, 7:])
    assert list(joints[0].name)[:2] == ["shoulder_pan_joint", "shoulder_lift_joint"]
    assert np.array_equal([m.position for _, m in arm["/joint_command"]], columns["action"].astype(np.float64))
    texts = [message.subtask for _, message in arm["/bhd/outcome"]]
    assert texts == columns["subtask"].tolist()


@pytest.mark.parametrize(("robot", "storage"), [("turtlebot3", "mcap"), ("ur5", "sqlite3")])
def test_rosbags_reads_it_with_embedded_definitions_and_the_metadata_that_ros_needs(request, tmp_path, robot, storage):
    bag = export(request.getfixturevalue(robot), tmp_path / "bags", "--one_bag", f"--format={storage}")
    with AnyReader([bag]) as reader:
        count, before, newest = 0, {}, 0
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            count += 1
            assert time >= newest
            newest = time
            if hasattr(message, "header"):
                assert stamp(message) > before.get(connection.topic, 0)
                before[connection.topic] = stamp(message)
        assert count == reader.message_count
        latched = {
            connection.topic
            for connection in reader.connections
            if connection.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
        }
        assert latched == {"/tf_static", "/bhd/episode"}
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (metadata["version"], metadata["storage_identifier"]) == (8, storage)
    topics = [topic["topic_metadata"] for topic in metadata["topics_with_message_count"]]
    for topic in topics:
        (profile,) = yaml.safe_load(topic["offered_qos_profiles"])  # a text in version 8
        assert (profile["durability"], profile["depth"]) == ((1, 1) if topic["name"] in latched else (2, 10))
        assert (profile["history"], profile["reliability"]) == (1, 1)
        forever = {"sec": 9223372036, "nsec": 854775807}
        assert [profile[key] for key in ("deadline", "lifespan", "liveliness_lease_duration")] == [forever] * 3
        assert re.fullmatch(r"RIHS01_[0-9a-f]{64}", topic["type_description_hash"])
    hashes = {topic["type"]: topic["type_description_hash"] for topic in topics}
    if robot == "turtlebot3":  # as ROS 2 computes it
        known = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
        assert hashes["sensor_msgs/msg/LaserScan"] == known


@pytest.mark.parametrize(("robot", "expected"), [("base", "odom"), ("arm", "base_link")])
def test_every_frame_is_in_one_tree(request, robot, expected):
    topics = request.getfixturevalue(robot)
    transforms = [
        transform for name in ("/tf", "/tf_static") for _, message in topics[name] for transform in message.transforms
    ]
    parents = {}
    for transform in transforms:
        turn = transform.transform.rotation
        assert turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2 == pytest.approx(1)
        assert parents.setdefault(transform.child_frame_id, transform.header.frame_id) == transform.header.frame_id
    (root,) = set(parents.values()) - parents.keys()
    assert root == expected
    used = {message.header.frame_id for name, sent in topics.items() if not name.startswith(("/bhd", "/tf"))
            for _, message in sent}  # fmt: skip
    assert used - {""} <= {root, *parents}
    # Nothing is sent before the transform that places it.
    begin = min(stamp(transform) for transform in transforms)
    assert all(stamp(message) >= begin for _, message in topics["/scan"])


def matrix(one):
    """Return a transform as a matrix, by another formula than ours."""
    turn, place = one.transform.rotation, one.transform.translation
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    found[:3, 3] = place.x, place.y, place.z
    return found


def tree(topics, frame):
    """Return child -> (parent, transform) at a frame, as tf2 has them: the static ones, and what is sent then."""
    moving = defaultdict(list)
    for _, message in topics["/tf"]:
        moving[stamp(message.transforms[0])] += message.transforms
    found = [*topics["/tf_static"][0][1].transforms, *moving[sorted(moving)[frame]]]
    assert len({one.child_frame_id for one in found}) == len(found)
    return {one.child_frame_id: (one.header.frame_id, matrix(one)) for one in found}


def lookup(links, parent, child):
    """Return a frame in another one that is above it."""
    pose = np.eye(4)
    while child != parent:
        child, step = links[child]
        pose = step @ pose
    return pose


def write_arm(root, names, values):
    """Record frames of an arm that is anywhere."""
    features = dataset_features(names, ["gripper.pos"], {}, {"simulation.state": ["q"]})
    with DatasetRecorder.create("t/t", 10, features, robot_type="ur5", root=root) as recorder:
        writer, n = recorder.begin_episode(), len(values)
        columns = {key: np.zeros((n, *one["shape"]) if one["shape"] != (1,) else n, one["dtype"])
                   for key, one in features.items()}  # fmt: skip
        columns["observation.state"][:] = values
        columns["control.time"] = np.arange(n) / 10
        writer.set_columns(columns)
        recorder.save(writer, task="turn", metadata={})
    return root


def test_the_links_of_an_arm_add_up_to_its_forward_kinematics(tmp_path):
    joints = np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (40, 6)).astype(np.float32)
    joints[0] = 0
    names = [f"{joint}.pos" for joint in ur5_body().arm.chain.joints]
    bags = export(write_arm(tmp_path / "d", names, joints), tmp_path / "bags")
    topics = decoded(bags / "episode_000000/episode_000000.mcap")
    kinematics = ForwardKinematics(ur5_body().arm.chain)
    frames, tool = kinematics.frames(joints.astype(np.float64)), kinematics.tool(joints.astype(np.float64))
    for frame in range(len(joints)):
        links = tree(topics, frame)
        base = lookup(links, "base_link", "base")
        assert np.allclose(base, np.diag([-1, -1, 1, 1]), atol=1e-15)  # REP-103: x is where the arm points to at zero
        for name, expected in (("tool0", frames[frame, 6]), ("wrist_3_link", frames[frame, 6]), ("tool", tool[frame])):
            found = lookup(links, "base_link", name)
            assert np.allclose(np.linalg.inv(base) @ found, expected, atol=1e-12), (frame, name)
        # The flange's x axis is tool0's z axis.
        flange, tool0 = lookup(links, "base_link", "flange"), lookup(links, "base_link", "tool0")
        assert np.allclose(flange[:3, 0], tool0[:3, 2], atol=1e-12)
        # Each link is at its joint's axis, which is the z axis of the Denavit-Hartenberg frame before it.
        order = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
        for number, link in enumerate(order):
            found = lookup(links, "base_link_inertia", f"{link}_link")
            assert np.allclose(found[:3, 2], frames[frame, number, :3, 2], atol=1e-12), link
    # Published positions of ur_description for the UR5, config/ur5/default_kinematics.yaml.
    at_zero = tree(topics, 0)
    for link, place in (("shoulder", (0, 0, 0.089159)), ("upper_arm", (0, 0, 0)), ("forearm", (-0.425, 0, 0)),
                        ("wrist_1", (-0.39225, 0, 0.10915)), ("wrist_2", (0, -0.09465, 0)),
                        ("wrist_3", (0, 0.0823, 0))):  # fmt: skip
        assert np.allclose(at_zero[f"{link}_link"][1][:3, 3], place, atol=1e-12), link


def test_an_arm_without_joints_has_its_tool_and_nothing_that_hangs_in_the_air(tmp_path):
    names = [f"tool_{name}.pos" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    bags = export(write_arm(tmp_path / "d", names, np.array([[0.1, 0.2, 0.3, 0, 1, 0, 0]] * 3)), tmp_path / "bags")
    links = tree(decoded(bags / "episode_000000/episode_000000.mcap"), 1)
    expected = {"base_link_inertia": "base_link", "base": "base_link", "tool": "base", "wrist_optical_frame": "tool"}
    assert {child: parent for child, (parent, _) in links.items()} == expected
    assert lookup(links, "base", "tool")[:3, 3] == pytest.approx((0.1, 0.2, 0.3), abs=1e-7)


def test_the_wheels_of_a_base_are_where_the_urdf_has_them_and_turn_with_their_joints(turtlebot3, base):
    state = read_episode(turtlebot3, 0)["simulation.state"]
    for frame in (0, len(state) // 2, len(state) - 1):
        links = tree(base, frame)
        for column, (side, y) in enumerate((("left", 0.08), ("right", -0.08))):
            wheel = lookup(links, "base_link", f"wheel_{side}_link")
            assert np.allclose(wheel[:3, 3], (0, y, 0.023), atol=1e-12)
            assert np.allclose(wheel[:3, 2], (0, 1, 0), atol=1e-12)
            # Forward: what was on top comes to the front.
            angle = state[frame, 7 + column]
            spoke = wheel[:3, :3] @ Rotation.from_euler("x", 90, degrees=True).apply([0.0, 0.0, 1.0])
            assert np.allclose(spoke, (np.sin(angle), 0, np.cos(angle)), atol=1e-9)
            assert lookup(links, "odom", f"wheel_{side}_link")[2, 3] == pytest.approx(
                turtlebot3_burger().drive.wheel_radius
            )
        for name, place in (("base_scan", (-0.032, 0, 0.172)), ("imu_link", (-0.032, 0, 0.068)),
                            ("caster_back_link", (-0.081, 0, -0.004))):  # fmt: skip
            assert np.allclose(lookup(links, "base_link", name)[:3, 3], place, atol=1e-12)


def test_covariances_are_those_of_the_simulated_sensors_and_zeros_where_they_are_unknown(turtlebot3, base, tmp_path):
    drive = turtlebot3_burger().drive
    # Counts of both wheels are rounded at the start and now: an experiment of its own.
    rng = np.random.default_rng(0)
    moved = rng.uniform(0, 10, (200_000, 2, 2)) * drive.encoder_ticks
    error = np.diff(np.floor(moved) - moved, axis=1)[:, 0] * 2 * np.pi * drive.wheel_radius / drive.encoder_ticks
    distance, yaw = error.mean(axis=1).var(), (np.diff(error, axis=1) / drive.wheel_separation).var()
    for _, one in base["/odom"]:
        pose, twist = (np.array(part.covariance).reshape(6, 6) for part in (one.pose, one.twist))
        assert np.trace(pose[:2, :2]) == pytest.approx(distance, rel=0.02)
        assert pose[5, 5] == pytest.approx(yaw, rel=0.02)
        for covariance in (pose, twist):
            assert np.array_equal(covariance, covariance.T)
            assert (np.linalg.eigvalsh(covariance) >= -1e-20).all()
        assert 0 < twist[0, 0] < 1e-12
        assert 0 < twist[5, 5] < 1e-12
    for _, one in base["/imu"]:
        assert 0 < one.angular_velocity_covariance[0] == one.angular_velocity_covariance[8] < 1e-12
        assert one.orientation_covariance[0] == one.linear_acceleration_covariance[0] == -1
    # Of an imported drive of a real robot, nothing says how good its sensors are.
    (turtlebot3 / "meta/bhd.json").rename(tmp_path / "bhd.json")
    try:
        topics = decoded(export(turtlebot3, tmp_path / "unknown", "--one_bag") / "unknown.mcap")
    finally:
        (tmp_path / "bhd.json").rename(turtlebot3 / "meta/bhd.json")
    assert not any(np.any(one.pose.covariance) or np.any(one.twist.covariance) for _, one in topics["/odom"])
    assert not any(np.any(one.angular_velocity_covariance) for _, one in topics["/imu"])


def test_the_same_dataset_gives_the_same_bytes(turtlebot3, tmp_path):
    first, second = (export(turtlebot3, tmp_path / name / "b", "--one_bag") for name in ("x", "y"))
    assert (first / "b.mcap").read_bytes() == (second / "b.mcap").read_bytes()
