"""Import of bags in which something went wrong: on the robot, in the recorder, or in what was named."""

import io
import itertools
import json
import shutil
import sqlite3

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from tests.cli.data.import_support import TASK, imported, refused, run
from tests.ros2.bag import support as bags
from tests.ros2.bag.support import NANO, START, STORE, changed, drive, write


@pytest.fixture(scope="module")
def messages():
    return drive(seconds=4)


@pytest.fixture(scope="module")
def plain(tmp_path_factory, messages):
    return write(tmp_path_factory.mktemp("faults") / "plain", messages)


def places(root):
    """Return of each episode why it began, and when."""
    sources = [json.loads(episode.metadata["source"]) for episode in dataset_info(root).episodes]
    return [(source["why"], (source["start_ns"] - START) / NANO) for source in sources]


def shorten(bag, topic, places):
    """Cut messages of a topic of an SQLite bag short."""
    with sqlite3.connect(bag / f"{bag.name}.db3") as file:
        rows = file.execute(
            "SELECT m.id FROM messages m JOIN topics t ON t.id = m.topic_id WHERE t.name = ? ORDER BY m.id", (topic,)
        ).fetchall()
        for place in places:
            file.execute("UPDATE messages SET data = substr(data, 1, 40) WHERE id = ?", rows[place])
    return len(rows)


def test_messages_that_are_too_short_count_as_lost_and_are_reported(tmp_path, messages, capsys):
    bag = write(tmp_path / "bag", messages, "sqlite3")
    short = {"/scan": [7], "/odom": [1, 7], "/cmd_vel": [2, 9]}
    counts = {topic: shorten(bag, topic, numbers) for topic, numbers in short.items()}
    info = imported(bag, tmp_path / "d")
    error, problems = capsys.readouterr().err, json.loads(info.episodes[0].metadata["source"])["problems"]
    for topic, numbers in short.items():
        text = f"{len(numbers)} of the {counts[topic]} messages of {topic} cannot be read, and are left out as if they"
        assert f"damaged: bag: {text} had been lost" in error
        assert any(problem.startswith(f"bag: {text}") for problem in problems)
    # Just as if the messages had never come.
    numbers = {topic: itertools.count() for topic in short}
    rest = [message for message in messages if next(numbers[message[0]]) not in short[message[0]]]
    imported(write(tmp_path / "rest", rest), tmp_path / "r")
    ours, theirs = read_episode(tmp_path / "d", 0), read_episode(tmp_path / "r", 0)
    for key, values in theirs.items():
        assert np.array_equal(values, ours[key]), key


def test_a_topic_that_is_mostly_unreadable_is_refused_with_the_numbers(tmp_path, messages, capsys):
    bag = write(tmp_path / "bag", messages, "sqlite3")
    total = shorten(bag, "/odom", range(0, 60, 3))
    error = refused(bag, tmp_path / "d", capsys)
    assert f"20 of the {total} messages of /odom cannot be read, which is more than 10 %" in error
    assert "of 40 bytes cannot be read as nav_msgs/msg/Odometry" in error


def test_a_row_without_bytes_or_time_does_not_end_the_bag(tmp_path, messages, capsys):
    bag = write(tmp_path / "bag", messages, "sqlite3")
    with sqlite3.connect(bag / "bag.db3") as file:
        numbers = dict(file.execute("SELECT name, id FROM topics"))
        first = "(SELECT id FROM messages WHERE topic_id = ? LIMIT 1 OFFSET 5)"
        file.execute(f"UPDATE messages SET data = 7 WHERE id = {first}", (numbers["/odom"],))
        file.execute(f"UPDATE messages SET timestamp = 'soon' WHERE id = {first}", (numbers["/scan"],))
    info = imported(bag, tmp_path / "d")
    error = capsys.readouterr().err
    assert "1 of the 80 messages of /odom cannot be read" in error
    assert "1 messages that cannot be decompressed, or have no possible time" in error
    assert info.frames > 30


def test_a_topic_of_two_types_matters_only_if_it_is_read(tmp_path, capsys):
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for number, (topic, received, message) in enumerate(drive(seconds=4)):
            both = [(topic, message)]
            if topic == "/odom":
                both.append(("/chatter", bags.twist(1, 1) if number % 2 else bags.header(received, "x")))
            for name, one in both:
                key = name, one.__msgtype__
                if key not in connections:
                    connections[key] = writer.add_connection(*key, typestore=STORE)
                writer.write(connections[key], received, STORE.serialize_cdr(one, one.__msgtype__))
    assert len(imported(tmp_path / "bag", tmp_path / "d").episodes) == 1
    error = refused(tmp_path / "bag", tmp_path / "e", capsys, "--cmd=/chatter")
    assert "/chatter" in error
    assert "std_msgs/msg/Header" in error


def test_commands_on_other_topics_are_reported(tmp_path, messages, capsys, plain):
    imported(plain, tmp_path / "a")
    assert "/cmd_vel" not in capsys.readouterr().err
    more = [("/cmd_vel_nav", at, message) for topic, at, message in messages if topic == "/cmd_vel"]
    imported(write(tmp_path / "two_topics", sorted([*messages, *more], key=lambda one: one[1])), tmp_path / "b")
    error = capsys.readouterr().err
    assert "commands on other topics, too: /cmd_vel_nav (40). The action is of /cmd_vel alone (40)" in error


def reset_odometry(at, *, dx=0.0, turn=0.0):
    """Return odometry that starts from another pose."""
    message = bags.odometry(at - 5 * 10**6)
    pose = message.pose.pose
    pose.position.x += dx
    w, z = pose.orientation.w, pose.orientation.z
    pose.orientation.w = float(w * np.cos(turn / 2) - z * np.sin(turn / 2))
    pose.orientation.z = float(z * np.cos(turn / 2) + w * np.sin(turn / 2))
    return message


@pytest.mark.parametrize("reset", [{"dx": -3.0}, {"turn": 2.5}])
def test_an_odometry_that_starts_anew_begins_an_episode(tmp_path, messages, capsys, reset):
    late = START + 2 * NANO
    bag = write(tmp_path / "bag", changed(messages, "/odom", lambda at: reset_odometry(at, **reset), since=late))
    imported(bag, tmp_path / "d", "--odometry", "--beams=36")
    error = capsys.readouterr().err
    assert "/odom: the pose jumped by" in error
    assert "a new episode begins" in error
    (first, _), (second, began) = places(tmp_path / "d")
    assert (first, second) == ("start", "reset")
    assert 2.0 <= began <= 2.3
    names = dataset_info(tmp_path / "d").features["observation.state"]["names"]
    columns = [names.index(name) for name in ("x.pos", "y.pos", "theta.pos")]
    for episode in range(2):
        pose = read_episode(tmp_path / "d", episode)["observation.state"][:, columns]
        assert pose[0].tolist() == [0, 0, 0]
        assert np.abs(np.diff(pose, axis=0)).max() < 0.1
    # Without the pose in the observation nothing jumps.
    assert len(imported(bag, tmp_path / "e").episodes) == 1


def test_time_without_a_sensor_is_reported_at_both_ends_and_after_a_break(tmp_path, messages, capsys):
    def received(topic, first, last):
        return [message for message in messages if message[0] != topic or first <= (message[1] - START) / NANO <= last]

    imported(write(tmp_path / "dies", received("/scan", 0, 2)), tmp_path / "a")
    error = capsys.readouterr().err
    assert "/scan was last received 1." in error
    assert "/odom" not in error
    imported(write(tmp_path / "late", received("/odom", 2.5, 9)), tmp_path / "b")
    assert "/odom was first received 2.5" in capsys.readouterr().err
    # After the clock has jumped back there is no scan any more.
    back = [(topic, at - 3600 * NANO, one) for topic, at, one in messages if topic != "/scan"]
    imported(write(tmp_path / "break", [*messages, *back]), tmp_path / "c")
    assert "/scan was not received in the 3." in capsys.readouterr().err
    assert len(places(tmp_path / "c")) == 1
    imported(write(tmp_path / "plain", messages), tmp_path / "d")
    assert "received" not in capsys.readouterr().err


def test_a_command_stays_in_force_when_the_pose_starts_anew(tmp_path, messages, capsys):
    commands = [message for message in messages if message[0] == "/cmd_vel"]
    once = [message for message in messages if message[0] != "/cmd_vel" or message is commands[0]]
    late = START + 2 * NANO
    bag = write(tmp_path / "bag", changed(once, "/odom", lambda at: reset_odometry(at, dx=9.0), since=late))
    imported(bag, tmp_path / "d", "--odometry", "--beams=36", "--command_timeout=inf")
    assert [why for why, _ in places(tmp_path / "d")] == ["start", "reset"]
    actions = np.concatenate([read_episode(tmp_path / "d", episode)["action"] for episode in range(2)])
    twist = commands[0][2]
    np.testing.assert_allclose(actions, np.tile([twist.linear.x, twist.angular.z], (len(actions), 1)), rtol=1e-6)
    # Before the first one there was none.
    rest = [one for one in once if one[0] != "/cmd_vel"]
    bag = write(tmp_path / "late", sorted([*rest, ("/cmd_vel", late, twist)], key=lambda one: one[1]))
    imported(bag, tmp_path / "e", "--command_timeout=inf")
    assert "come before the first command; their action is 0, though the robot moved" in capsys.readouterr().err


def test_a_pose_that_was_never_set_matters_only_where_it_is_observed(tmp_path, messages, capsys):
    def unset(at):
        message = bags.odometry(at - 5 * 10**6)
        message.pose.pose.position.x = float("nan")
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        return message

    bag = write(tmp_path / "bag", changed(messages, "/odom", unset))
    assert len(imported(bag, tmp_path / "d").episodes) == 1
    assert "not finite" not in capsys.readouterr().err
    assert "no message of /odom has finite values" in refused(bag, tmp_path / "e", capsys, "--odometry")


def test_a_pose_that_jumps_all_the_time_is_refused(tmp_path, messages, capsys):
    jumping = changed(messages, "/odom", lambda at: reset_odometry(at, dx=float(at // 10**8 % 2)))
    error = refused(write(tmp_path / "bag", jumping), tmp_path / "d", capsys, "--odometry", "--beams=36")
    assert "in 80 messages, farther than a robot with the limits 0.22 m/s" in error
    assert "--odometry" in error


def test_a_simulation_that_starts_anew_begins_an_episode(tmp_path, messages, capsys):
    late, back = START + 2 * NANO, 60 * NANO  # the recorder's clock goes on
    anew = changed(messages, "/odom", lambda at: bags.odometry(at - back), since=late)
    anew = changed(anew, "/scan", lambda at: bags.scan(at - back), since=late)
    imported(write(tmp_path / "bag", anew), tmp_path / "d")
    error = capsys.readouterr().err
    assert "its header stamps jumped back 1 times, as when a simulation or a driver is restarted" in error
    (first, _), (second, began) = places(tmp_path / "d")
    assert (first, second) == ("start", "clock")
    assert 2.0 <= began <= 2.3


def test_stamps_of_two_clocks_are_no_restart(tmp_path, messages, capsys):
    mixed = changed(messages, "/odom", lambda at: bags.odometry(at if at % 3 else 0))
    assert len(imported(write(tmp_path / "bag", mixed), tmp_path / "d").episodes) == 1
    assert "which no restart explains" in capsys.readouterr().err


def test_the_same_drive_is_not_imported_twice(tmp_path, plain, messages, capsys):
    (tmp_path / "link").symlink_to(plain)
    (tmp_path / "hard.mcap").hardlink_to(plain / "plain.mcap")
    for other in (plain / "plain.mcap", tmp_path / "link", tmp_path / "hard.mcap", plain.parent):
        arguments = ["import", str(plain), str(other), "--repo_id=t/t", f"--root={tmp_path / 'd'}", TASK]
        assert main.main(arguments) == 2
        error = capsys.readouterr().err
        assert "are the same recording: both have the file" in error
        assert str(plain) in error
    shutil.copytree(plain, tmp_path / "copy")
    for other in (tmp_path / "copy", write(tmp_path / "converted", messages, "sqlite3")):
        arguments = ["import", str(plain), str(other), "--repo_id=t/t", f"--root={tmp_path / 'd'}", TASK]
        assert main.main(arguments) == 2
        error = capsys.readouterr().err
        assert f"{plain} and {other} hold the same drive" in error
        assert not (tmp_path / "d").exists()


def test_messages_of_an_unknown_compression_are_named(tmp_path, messages, capsys):
    bag = write(tmp_path / "bag", messages, "sqlite3")
    with sqlite3.connect(bag / "bag.db3") as file:
        file.execute("UPDATE messages SET data = CAST(X'04224D18' || data AS BLOB)")
    error = refused(bag, tmp_path / "d", capsys)
    assert "it begins with '04 22 4d 18'" in error
    assert "ros2 bag convert" in error
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(
        text.replace("compression_mode: ''", "compression_mode: MESSAGE").replace(
            "compression_format: ''", "compression_format: lz4"
        )
    )
    assert "are compressed with 'lz4'; only zstd can be read" in refused(bag, tmp_path / "d", capsys)


def test_a_bag_without_messages_is_refused(tmp_path, capsys):
    with Writer(tmp_path / "none", version=8, storage_plugin=StoragePlugin.MCAP):
        pass
    with Writer(tmp_path / "silent", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=STORE)
    assert "no topic /scan" in refused(tmp_path / "none", tmp_path / "d", capsys)
    assert "no message of /scan" in refused(tmp_path / "silent", tmp_path / "d", capsys)


def mounted(z, w):
    """Return a message of `/tf_static` that says how the scanner is turned."""
    types = bags.T
    still = types["geometry_msgs/msg/TransformStamped"](
        header=bags.header(START, "tb3_1/base_link"),
        child_frame_id="tb3_1/laser",
        transform=types["geometry_msgs/msg/Transform"](
            translation=bags.Vector(x=0.0, y=0.0, z=0.1), rotation=bags.Quaternion(x=0.0, y=0.0, z=z, w=w)
        ),
    )
    return ("/tf_static", START, types["tf2_msgs/msg/TFMessage"](transforms=[still]))


def test_a_robot_in_a_namespace(tmp_path, messages, plain, capsys):
    """What another robot without one states of a frame of the same name does not count."""
    named = changed(messages, "/scan", lambda at: bags.scan(at - 5 * 10**6, frame="tb3_1/laser"))
    named = changed(named, "/odom", lambda at: bags.odometry(at, child="tb3_1/base_footprint"))
    named = [(f"/tb3_1{topic}", at, message) for topic, at, message in [mounted(1.0, 0.0), *named]]
    topics = [f"--{role}=/tb3_1/{topic}" for role, topic in (("scan", "scan"), ("odom", "odom"), ("cmd", "cmd_vel"))]
    assert run(write(tmp_path / "bag", [*named, mounted(0.0, 1.0)]), tmp_path / "d", *topics) == 0
    assert "turned by 180.0 degrees, from /tf_static" in capsys.readouterr().err


def jpegs(count=40):
    """Return compressed images at 10 Hz, each brighter than the one before."""
    messages = []
    for number in range(count):
        file = io.BytesIO()
        Image.fromarray(np.full((16, 24, 3), 5 * number, np.uint8)).save(file, "JPEG")
        at = START + number * NANO // 10
        message = bags.T["sensor_msgs/msg/CompressedImage"](
            header=bags.header(at, "camera"), format="jpeg", data=np.frombuffer(file.getvalue(), np.uint8)
        )
        messages.append(("/image", at + 10**6, message))
    return messages


def test_images_that_are_lost_are_as_old_as_those_in_their_place(tmp_path, messages, capsys):
    whole, arguments = jpegs(), ["--camera=front=/image", "--beams=36", "--max_age=0.25"]
    bag = write(tmp_path / "whole", sorted([*messages, *whole], key=lambda one: one[1]))
    imported(bag, tmp_path / "w", *arguments)
    capsys.readouterr()
    images = jpegs()
    for place in (0, 1, 2, 20):
        images[place][2].data = images[place][2].data[:100]  # the camera stumbled; its message is whole
    bag = write(tmp_path / "bag", sorted([*messages, *images], key=lambda one: one[1]))
    imported(bag, tmp_path / "d", *arguments)
    error = capsys.readouterr().err
    assert "images of an episode cannot be decoded; the previous image takes their place" in error
    (_, begin), (_, began) = places(tmp_path / "w")[0], places(tmp_path / "d")[0]
    skipped = round((began - begin) * 10)
    assert 1 <= skipped <= 3
    assert f"the episode begins {skipped} frames later, with the first image that can be decoded" in error
    ours, theirs = read_episode(tmp_path / "d", 0), read_episode(tmp_path / "w", 0)
    older = ours["control.age"] - theirs["control.age"][skipped:]
    assert (older >= 0).all()
    assert (older > 0.01).sum() == 1  # where nothing else is as old
    assert np.array_equal(ours["observation.state"], theirs["observation.state"][skipped:])
    for place in range(3, 40, 3):
        images[place][2].data = images[place][2].data[:100]
    bag = write(tmp_path / "broken", sorted([*messages, *images], key=lambda one: one[1]))
    error = refused(bag, tmp_path / "e", capsys, *arguments)
    assert "images of an episode cannot be decoded, which is more than 10 %" in error
