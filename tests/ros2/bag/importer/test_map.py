"""Import of the bags of any robot: fields of topics become features by a mapping."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.ros2.messages.mapping import MappingConfig, topics_of
from tests.cases import each_case
from tests.cli.data.import_support import imported, refused
from tests.ros2.bag import support as bags
from tests.ros2.bag.support import NANO, START, T, drive, write

JOINTS, NUMBERS = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
PERIODS = {"arm": 0.02, "hand": 0.11, "command": 0.05, "torso": 0.04, "image": 0.1}
MAP = f"""
observation:
  elbow.pos: {{topic: joint_states, type: {JOINTS}, field: "position[name=elbow]"}}
  hand.pos: {{topic: /joint_states, type: {JOINTS}, field: "position[name=hand]", scale: 0.001, offset: 0.5}}
  elbow.vel: {{topic: /joint_states, type: {JOINTS}, field: "velocity[name=elbow]"}}
  torso.pos: {{topic: /torso, type: geometry_msgs/msg/PoseStamped, field: pose.orientation, scale: -57.29577951308232}}
action:
  elbow.pos: {{topic: /commands, type: {NUMBERS}, field: "data[1]"}}
  hand.pos: {{topic: /commands, type: {NUMBERS}, field: "data[0]"}}
images:
  top: {{topic: top/image}}
"""


def value(kind, time_s):
    """Return what a topic says at a time: another thing each time."""
    return {
        "arm": (np.sin(time_s), np.cos(time_s)),
        "hand": (40 + 10 * np.sin(3 * time_s),),
        "command": (0.04 + 0.01 * np.cos(time_s), 0.5 * np.sin(2 * time_s)),
        "torso": (1.5 * time_s,),  # several turns
        "image": (int(20 * time_s) % 200,),
    }[kind]


def message(kind, stamp):
    values = value(kind, (stamp - START) / NANO)
    numbers = np.array(values, np.float64)
    if kind == "arm":  # with a joint that is not wanted, and in another order
        return T[JOINTS](
            bags.header(stamp, ""),
            ["wrist", "elbow"],
            np.array([9.0, values[0]]),
            np.array([9.0, values[1]]),
            np.zeros(0),
        )
    if kind == "hand":
        return T[JOINTS](bags.header(stamp, ""), ["hand"], numbers, np.zeros(0), np.zeros(0))
    if kind == "command":
        return T[NUMBERS](T["std_msgs/msg/MultiArrayLayout"]([], 0), numbers)
    if kind == "torso":
        turn = bags.Quaternion(x=0.0, y=0.0, z=float(np.sin(values[0] / 2)), w=float(np.cos(values[0] / 2)))
        pose = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), turn)
        return T["geometry_msgs/msg/PoseStamped"](bags.header(stamp, "base"), pose)
    grey = np.full(16 * 24 * 3, values[0], np.uint8)
    return T["sensor_msgs/msg/Image"](bags.header(stamp, "top"), 16, 24, "rgb8", 0, 72, grey)


TOPIC = {
    "arm": "/joint_states",
    "hand": "/joint_states",
    "command": "/commands",
    "torso": "torso",
    "image": "/top/image",
}


def work(*, seed=0, seconds=6.0, kinds=tuple(PERIODS)):
    """Return the messages of a robot at work, jittered, in the order of reception."""
    rng = np.random.default_rng(seed)
    found = []
    for kind in kinds:
        for number in range(int(seconds / PERIODS[kind])):
            stamp = START + int((number + rng.uniform(0, 0.4)) * PERIODS[kind] * NANO)
            found.append((TOPIC[kind], stamp + int(rng.uniform(0.001, 0.01) * NANO), message(kind, stamp)))
    return sorted(found, key=lambda one: one[1])


@pytest.fixture(scope="module")
def mapping(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "my_robot.yaml"
    path.write_text(MAP)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("map") / "bag", work(), "sqlite3")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, bag, mapping):
    root = tmp_path_factory.mktemp("map") / "d"
    imported(bag, root, f"--map={mapping}", "--fps=20")
    return root


def newest(messages, topic, at, read):
    """Return of each time what the newest message with a value says, and its age [s]: an independent reading."""
    known = [(received, read(one)) for name, received, one in messages if name == topic and read(one) is not None]
    found = [max((one for one in known if one[0] <= time), key=lambda one: one[0]) for time in at.tolist()]
    return np.array([one for _, one in found]), (at - np.array([time for time, _ in found])) / NANO


def joint(name, field):
    return lambda one: getattr(one, field)[one.name.index(name)] if name in one.name else None


def test_each_feature_is_the_newest_value_and_never_from_later(dataset, mapping):
    info, messages, columns = dataset_info(dataset), work(), read_episode(dataset, 0)
    (episode,) = info.episodes
    start = json.loads(episode.metadata["source"])["start_ns"]
    at = start + np.arange(episode.frames) * NANO // 20
    assert (info.fps, info.robot_type) == (20, "my_robot")
    assert info.features["observation.state"]["names"] == ["elbow.pos", "hand.pos", "elbow.vel", "torso.pos"]
    assert info.features["action"]["names"] == ["elbow.pos", "hand.pos"]
    assert info.features["observation.images.top"]["shape"] == [16, 24, 3]
    assert episode.frames > 110
    elbow, age = newest(messages, "/joint_states", at, joint("elbow", "position"))
    hand, of_hand = newest(messages, "/joint_states", at, joint("hand", "position"))
    speed, _ = newest(messages, "/joint_states", at, joint("elbow", "velocity"))
    turn = lambda one: 2 * np.arctan2(one.pose.orientation.z, one.pose.orientation.w)  # noqa: E731
    torso, of_torso = newest(messages, "torso", at, turn)
    torso = -np.degrees(np.unwrap(torso))
    _, of_image = newest(messages, "/top/image", at, lambda one: 0)
    state = np.stack([elbow, 0.001 * hand + 0.5, speed, torso], axis=1)
    np.testing.assert_allclose(columns["observation.state"], state, rtol=1e-6, atol=1e-6)
    assert columns["observation.state"][-1, 3] < -360
    assert columns["control.age"] == pytest.approx(np.max([age, of_hand, of_torso, of_image], axis=0), abs=1e-6)
    command = [newest(messages, "/commands", at + NANO // 20 - 1, lambda one, i=i: one.data[i])[0] for i in (1, 0)]
    np.testing.assert_allclose(columns["action"], np.stack(command, axis=1), rtol=0, atol=1e-6)
    assert main.main(["check", str(dataset)]) == 0


def test_what_happens_later_changes_nothing_before(tmp_path, dataset, mapping):
    until = START + 3 * NANO
    other = [one for one in work() if one[1] <= until]
    other += [(topic, time + NANO, one) for topic, time, one in work(seed=5, seconds=9) if time > until]
    imported(write(tmp_path / "bag", other), tmp_path / "d", f"--map={mapping}", "--fps=20")
    ours, theirs = read_episode(dataset, 0), read_episode(tmp_path / "d", 0)
    start = json.loads(dataset_info(dataset).episodes[0].metadata["source"])["start_ns"]
    count = (until - start) // (NANO // 20) - 1
    assert count > 50
    for key, values in ours.items():
        assert key == "next.done" or np.array_equal(values[:count], theirs[key][:count]), key


def test_a_mapping_on_the_command_line_is_that_of_the_file(tmp_path, bag, dataset, mapping):
    given = [
        f"--map.{section}.{name}={json.dumps(entry)}"
        for section, entries in yaml.safe_load(MAP).items()
        for name, entry in entries.items()
    ]
    info = imported(bag, tmp_path / "d", "--fps=20", "--robot=mine", *given)
    assert info.robot_type == "mine"
    for key, values in read_episode(dataset, 0).items():
        assert np.array_equal(values, read_episode(tmp_path / "d", 0)[key]), key
    # One entry more, or another one in the place of the file's.
    two = "{topic: /commands, type: std_msgs/msg/Float64MultiArray, field: 'data[0]', scale: 2}"
    info = imported(bag, tmp_path / "e", "--fps=20", f"--map={mapping}", f"--map.action.elbow.pos={two}")
    action, before = read_episode(tmp_path / "e", 0)["action"], read_episode(dataset, 0)["action"]
    np.testing.assert_allclose(action[:, 0], 2 * before[:, 1], rtol=1e-6)
    assert np.array_equal(action[:, 1], before[:, 1])


def test_frames_before_the_first_command_of_a_position_are_left_out(tmp_path, bag, dataset, mapping, capsys):
    late = [one for one in work() if one[0] != "/commands" or one[1] > START + 2 * NANO]
    imported(write(tmp_path / "bag", late), tmp_path / "d", f"--map={mapping}", "--fps=20")
    error = capsys.readouterr().err
    ours, theirs = read_episode(dataset, 0), read_episode(tmp_path / "d", 0)
    lost = len(ours["action"]) - len(theirs["action"])
    assert 36 < lost <= 41
    assert f"the first {lost} of {len(ours['action'])} frames come before the first command, and are left out" in error
    for key in ("observation.state", "action", "control.age"):
        assert np.array_equal(ours[key][lost:], theirs[key]), key
    silent = write(tmp_path / "silent", [one for one in late if one[0] != "/commands" or one[1] < START + 3 * NANO])
    imported(silent, tmp_path / "e", f"--map={mapping}", "--fps=20")  # a position stays where it is
    assert (read_episode(tmp_path / "e", 0)["control.mode"] == 3).all()
    assert "is for actions that are speeds" in refused(
        bag, tmp_path / "f", capsys, f"--map={mapping}", "--command_timeout=1"
    )


def test_a_turtlebot3_by_its_preset_is_the_robot(tmp_path, capsys):
    source = write(tmp_path / "bag", drive(stamped=True))
    imported(source, tmp_path / "a", "--map=turtlebot3")
    imported(source, tmp_path / "b")
    ours, theirs = (read_episode(tmp_path / name, 0) for name in "ab")
    for key, values in ours.items():
        assert np.array_equal(values, theirs[key]), key
    assert dataset_info(tmp_path / "a").features == dataset_info(tmp_path / "b").features
    # A robot that moves while its action would be 0 asks here, too.
    mute = write(
        tmp_path / "mute", [one for one in drive(stamped=True) if one[0] != "/cmd_vel" or one[1] > START + 3 * NANO]
    )
    assert "choose what is in force" in refused(mute, tmp_path / "c", capsys, "--map=turtlebot3")
    imported(mute, tmp_path / "c", "--map=turtlebot3", "--command_timeout=inf")


def test_the_yaw_of_an_orientation_that_was_never_set_counts_as_lost(tmp_path, mapping, capsys):
    messages = work()
    torsos = [one for topic, _, one in messages if topic == "torso"]
    for one in torsos[::20]:
        one.pose.orientation = bags.Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    imported(write(tmp_path / "some", messages), tmp_path / "d", f"--map={mapping}")
    assert (
        f"torso: {len(torsos[::20])} of {len(torsos)} messages have the orientation 0, 0, 0, 0"
        in capsys.readouterr().err
    )
    for one in torsos:
        one.pose.orientation = bags.Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    bag = write(tmp_path / "all", messages)
    assert "Leave out the feature" in refused(bag, tmp_path / "e", capsys, f"--map={mapping}")


@each_case(
    ("change", "parts"),
    [
        ({"position[name=elbow]": "positon[name=elbow]"}, ["The mapping's observation: elbow.pos", "'position'?"]),
        ({"position[name=elbow]": "position[name=elbw]"}, ["read from: name has no 'elbw'; it has", "'elbow'"]),
        ({"position[name=elbow]": "position"}, ["a feature is one number"]),
        ({"data[1]": "data[7]"}, ["elbow.pos is read from: data has 2 elements; there is no element 7"]),
        ({"type: geometry_msgs/msg/PoseStamped": "type: geometry_msgs/msg/PoseStampd"}, ["Did you mean 'geometry_"]),
        ({"type: geometry_msgs/msg/PoseStamped, field: pose.o": "type: nav_msgs/msg/Odometry, field: pose.pose.o"},
         ["is of type geometry_msgs/msg/PoseStamped; valid for --map: nav_msgs/msg/Odometry"]),
        ({"/torso": "/torsoo"}, ["no topic /torsoo, which observation.torso.pos is read from", "Did you mean torso?"]),
        ({"{topic: /torso": "{topic: /a", "top/image": "/b"}, ["no topic /a, which", "no topic /b, which images."]),
        ({"top: {topic: top/image}": "top: {topic: torso}"}, ["valid for --map: sensor_msgs/msg/Image"]),
        ({"top/image}": "top/image, width: 24, height: 10}"}, ["have 24 x 16 pixels; the mapping says 24 x 10"]),
        ({"field: pose.orientation": "feld: pose.orientation"}, ["Did you mean 'field'"]),
        ({"observation:": "observations:"}, ["Did you mean 'observation'"]),
        ({"field: pose.orientation": "field: pose.orientation, beams: 8"}, ["beams is 8; it is"]),
    ],
)  # fmt: skip
def test_a_mapping_that_does_not_fit_is_refused(tmp_path, bag, capsys, change, parts):
    text = MAP
    for old, new in change.items():
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    error = refused(bag, tmp_path / "d", capsys, f"--map={path}")
    assert all(part in error for part in parts), error
    assert [one.name for one in tmp_path.iterdir()] == ["robot.yaml"]


@each_case(
    ("arguments", "part"),
    [
        (["--map=ur"], "Unknown mapping 'ur'. Did you mean 'ur5'?"),
        (["--map=none.yaml"], "The mapping none.yaml cannot be read"),
        (["--map.observation.x.vel={topic: /a}"], "--map: observation.x.vel has no type"),
        (["--map.observatio.x.vel={topic: /a}"], "Did you mean 'observation'"),
        (["--map.observation.x.vel"], "Option --map.observation.x.vel has no value"),
        (["--map.observation.x.vel={topic: /torso, type: geometry_msgs/msg/PoseStamped, field: pose.position.x}"],
         "The mapping has no action. Name a field with --map.action.NAME="),
        (["--map.images.a/b={topic: /a}", "--map=ur5"], "The camera 'a/b' of the mapping has no valid name"),
        (["--map.observation.s_000.pos={topic: a, type: std_msgs/msg/Float64, field: data}", "--map=ur5",
          "--map.observation.s={topic: a, type: sensor_msgs/msg/LaserScan, beams: 2, range_max: 1}"],
         "The mapping has the feature s_000.pos twice"),
        (["--map=ur5", "--map.observation=3"], "--map: observation is not a mapping of names"),
        (["--map=ur5", "--scan=/scan"], "--scan is for bags of a TurtleBot3"),
        (["--map=ur5", "--task="], "Describe the robot's task"),
        (["--robot=ur5"], "Bags of other robots need --map"),
    ],
)  # fmt: skip
def test_options_of_a_mapping_that_cannot_be_honoured_are_refused(tmp_path, bag, capsys, arguments, part):
    assert part in refused(bag, tmp_path / "d", capsys, *arguments)


def test_a_mapping_is_stored_with_the_dataset(dataset, mapping):
    about = json.loads((Path(dataset) / "meta/bhd.json").read_text())["recording"]["imported"]
    assert about["mapping"]["observation"]["hand.pos"]["field"] == "position[name=hand]"
    assert about["mapping"]["observation"]["hand.pos"]["scale"] == 0.001


SPEEDS = """
observation:
  scan: {topic: /scan, type: sensor_msgs/msg/LaserScan, beams: 4, range_min: 0.2, range_max: 1.2}
  lag.vel: {topic: /load, type: yard_msgs/msg/Load, field: "parts[id=7].speed"}
action:
  x.vel: {topic: /cmd_vel, type: geometry_msgs/msg/Twist, field: linear.x}
  lag.vel: {topic: load, type: yard_msgs/msg/Load, field: "parts[id=7].speed"}
types:
  yard_msgs/msg/Load: "std_msgs/Header header\\nyard_msgs/Part[] parts"
  yard_msgs/msg/Part: "string id\\nfloat32 speed\\nbool on"
"""


def test_scans_speeds_and_types_of_any_base(tmp_path, capsys):
    """Without odometry, of a type that only the mapping defines; the action may be what a sensor reads next."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in yaml.safe_load(SPEEDS)["types"].items():
        store.register(get_types_from_msg(text, name))
    load, part = store.types["yard_msgs/msg/Load"], store.types["yard_msgs/msg/Part"]
    messages = [one for one in drive() if one[0] != "/odom" and not (one[0] == "/cmd_vel" and one[1] < START + NANO)]
    messages = [one for one in messages if not (one[0] == "/cmd_vel" and 3 < (one[1] - START) / NANO < 5)]
    for number in range(120):
        at = START + number * NANO // 20
        parts = [part("3", 9.0, False), part("7", number / 8, True)]
        messages.append(("/load", at + 10**6, load(bags.header(at, ""), parts)))
    messages.sort(key=lambda one: one[1])
    path, source = tmp_path / "base.yaml", tmp_path / "bag"
    path.write_text(SPEEDS)
    with Writer(source, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, at, one in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, one.__msgtype__, typestore=store)
            writer.write(connections[topic], at, store.serialize_cdr(one, one.__msgtype__))
    imported(source, tmp_path / "d", f"--map={path}", "--command_timeout=0.5")
    error, columns = capsys.readouterr().err, read_episode(tmp_path / "d", 0)
    assert "no odometry is read" not in error  # it is no TurtleBot3: whether it has speeds is not known
    names = dataset_info(tmp_path / "d").features["observation.state"]["names"]
    assert names == ["scan_000.pos", "scan_001.pos", "scan_002.pos", "scan_003.pos", "lag.vel"]
    start = json.loads(dataset_info(tmp_path / "d").episodes[0].metadata["source"])["start_ns"]
    at = start + np.arange(len(columns["action"])) * NANO // 10
    scan, _ = newest(messages, "/scan", at, lambda one: np.clip(one.ranges[::90], 0.2, 1.2))
    np.testing.assert_allclose(columns["observation.state"][:, :4], scan, atol=1e-6)
    lag, _ = newest(messages, "/load", at, lambda one: one.parts[1].speed)
    after, _ = newest(messages, "/load", at + NANO // 10 - 1, lambda one: one.parts[1].speed)
    assert np.array_equal(columns["observation.state"][:, 4], lag)
    assert np.array_equal(columns["action"][:, 1], after)
    silent = columns["control.mode"] == 2  # before the first command, and long after the newest
    assert (columns["action"][silent, 0] == 0).all()
    assert (columns["action"][~silent, 0] != 0).all()
    assert 20 < silent.sum() < 30
    assert main.main(["check", str(tmp_path / "d")]) == 0


def test_the_manuals_example_is_a_mapping():
    manual = Path(__file__).resolve().parents[4] / "docs/how_to/ros2_bags.md"
    (text,) = (block for block in manual.read_text().split("```") if block.startswith("yaml\nobservation:"))
    mapping = MappingConfig.of(yaml.safe_load(text.removeprefix("yaml")), "the manual")
    assert [topic.topic for topic in topics_of(mapping.action, mapping.types)] == [
        "/forward_position_controller/commands"
    ]
    assert len(topics_of(mapping.observation, mapping.types)) == 2
    assert mapping.images["wrist"].topic == "/wrist/image_raw/compressed"


ARM = [f"j{number}" for number in range(4)]
ARM_MAP = "observation:\n" + "".join(
    f'  {name}.pos: {{topic: /joint_states, type: {JOINTS}, field: "position[name={name}]"}}\n' for name in ARM
)
ARM_MAP += f'action:\n  j0.pos: {{topic: /commands, type: {NUMBERS}, field: "data[0]"}}\n'


def arm_bag(path, others=(), *, posture=lambda t: 0.3 * np.arange(1, 5) + 0.2 * np.sin(t), seconds=6.0):
    """Write an arm's joints at 50 Hz and commands; and other messages of its joints: pairs of a time [s] and values."""
    joints = [(k / 50, posture(k / 50)) for k in range(int(50 * seconds))]
    found = [
        ("/joint_states", START + round(t * NANO), T[JOINTS](
            bags.header(START + round(t * NANO), ""), ARM, np.asarray(values, np.float64), np.zeros(0), np.zeros(0)))
        for t, values in (*joints, *others)
    ]  # fmt: skip
    layout = T["std_msgs/msg/MultiArrayLayout"]([], 0)
    found += [
        ("/commands", START + round(k / 20 * NANO) + 1000, T[NUMBERS](layout, np.array([k / 100])))
        for k in range(int(20 * seconds))
    ]
    return write(path, sorted(found, key=lambda one: one[1]), "sqlite3")


def arm_states(tmp_path, name, bag):
    (tmp_path / "arm.yaml").write_text(ARM_MAP)
    imported(bag, tmp_path / name, f"--map={tmp_path / 'arm.yaml'}", "--fps=20")
    return np.stack(read_episode(tmp_path / name, 0)["observation.state"])


@each_case(
    ("others", "where"),
    [
        ([(0.11 + k / 10, np.zeros(4)) for k in range(55)], "at 0"),
        ([(1.001 + k / 1000, np.zeros(4)) for k in range(15)], "at 0"),  # once, a burst
        ([(1.001 + k / 100, np.zeros(4)) for k in range(100)], "at 0"),  # a second of them, beside the driver's
        ([(0.11 + k / 7, np.array([1.5, 0.0, -1.5, 0.7])) for k in range(35)], r"at [ 1.5"),
    ],
)
def test_a_second_publisher_of_one_posture_is_named_and_left_out(tmp_path, capsys, others, where):
    clean = arm_states(tmp_path, "clean", arm_bag(tmp_path / "clean_bag"))
    capsys.readouterr()
    states = arm_states(tmp_path, "mixed", arm_bag(tmp_path / "mixed_bag", others))
    np.testing.assert_array_equal(states, clean)
    printed = " ".join("".join(capsys.readouterr()).split())
    assert f"{len(others)} of {300 + len(others)} messages have all joints {where}" in printed


def stops(t):
    """Stand at 0, go to a posture and back, without a leap, several times; the last two joints are a hand's."""
    way = np.clip(np.sin(2 * t), 0.0, 0.5)
    return np.array([way, -way, 0.04 * (t % 1 > 0.5), 0.0])


@each_case(
    "posture", [stops, lambda t: np.zeros(4), lambda t: np.full(4, 0.7), lambda t: np.array([0, 0, 0, t % 1 > 0.5])]
)
def test_what_a_robot_does_itself_is_kept(tmp_path, capsys, posture):
    states = arm_states(tmp_path, "d", arm_bag(tmp_path / "bag", posture=posture))
    expected = [posture(number / 50) for number in np.arange(len(states)) * 50 // 20]
    np.testing.assert_allclose(states, expected, atol=1e-6)
    assert "joint_state_publisher" not in "".join(capsys.readouterr())
