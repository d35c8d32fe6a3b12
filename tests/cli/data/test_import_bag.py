"""Import of bags of a real TurtleBot3, written by the tests with rosbags."""

import json
import re

import numpy as np
import pytest

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from tests.cli.data.import_support import TASK, imported, refused, run
from tests.ros2.bag import support as bags
from tests.ros2.bag.support import NANO, START, drive, without, write


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write(tmp_path_factory.mktemp("real") / "plain", drive())


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, plain):
    """The dataset that is made of it."""
    root = tmp_path_factory.mktemp("real") / "d"
    imported(plain, root)
    return root


def source_of(root, episode=0):
    """Return where an episode is from."""
    return json.loads(dataset_info(root).episodes[episode].metadata["source"])


@pytest.mark.law
@pytest.mark.parametrize(("storage", "stamped"), [("sqlite3", False), ("mcap", True)])
def test_bags_of_humble_and_jazzy_become_what_was_measured(tmp_path, storage, stamped):
    source = write(tmp_path / "bag", drive(stamped=stamped), storage)
    info = imported(source, tmp_path / "d")
    columns = read_episode(tmp_path / "d", 0)
    (episode,) = info.episodes
    start = json.loads(episode.metadata["source"])["start_ns"]
    times = (start - START) / NANO + np.arange(episode.frames) / 10
    assert columns["control.time"] == pytest.approx(np.arange(episode.frames) / 10, abs=1e-9)
    assert 55 <= episode.frames <= 60
    # Of each topic the newest until then: at most a period old, and not from later.
    forward = columns["observation.state"][:, 0]
    known = np.array([bags.speed(t)[0] for t in times])
    assert np.abs(forward - known).max() < 0.05 * 0.075
    commands = np.array([bags.command(t)[0] for t in times])
    assert np.abs(columns["action"][:, 0] - commands).max() < 0.05 * 0.15
    assert np.array_equal(columns["action"], columns["control.applied_action"])
    assert (columns["control.age"] >= 0).all()
    assert (columns["control.age"] < 0.25).all()
    assert columns["control.age"].max() > 0.15  # the scan's
    assert not columns["control.late"].any()
    assert (columns["control.mode"] == 3).all()
    assert columns["next.done"].tolist() == [False] * (episode.frames - 1) + [True]
    assert main.main(["check", str(tmp_path / "d")]) == 0


def test_gaps_are_flagged_or_begin_an_episode(tmp_path, capsys):
    def keep(message):
        time = (message[1] - START) / NANO
        short = message[0] == "/odom" and 1.0 < time < 1.5
        long = message[0] == "/scan" and 3.0 < time < 4.6
        return not short and not long

    source = write(tmp_path / "bag", list(filter(keep, drive(seconds=8))))
    info = imported(source, tmp_path / "d")
    error = capsys.readouterr().err
    assert "/scan was silent for 1." in error
    (late_note,) = (line for line in error.splitlines() if "older than 0.3 s; control.late is true" in line)
    assert len(info.episodes) == 2
    columns = read_episode(tmp_path / "d", 0)
    late = columns["control.late"]
    assert np.array_equal(late, columns["control.age"] > 0.3)
    assert 1 <= late.sum() <= 3
    total = late.sum() + read_episode(tmp_path / "d", 1)["control.late"].sum()
    assert f"{total} of {info.frames} frames, in " in late_note
    assert columns["control.time"][-1] < 3.3
    assert [json.loads(episode.metadata["source"])["why"] for episode in info.episodes] == ["start", "gap"]
    assert main.main(["check", str(tmp_path / "d")]) == 0
    one = imported(source, tmp_path / "one", "--max_gap=2")
    assert len(one.episodes) == 1


@pytest.mark.parametrize(
    ("jump", "note", "storage"),
    [
        (-3600, "jumped back 1 times", "sqlite3"),
        (86400 * 365, "clock jumped ahead", "mcap"),
        (-0.3, "the clock jumped back", "mcap"),  # as by NTP
    ],
)
def test_clock_jumps_split_the_episode(tmp_path, capsys, jump, note, storage):
    first, second = drive(seconds=4), drive(seconds=4, start=START + int((4 + jump) * NANO))
    info = imported(write(tmp_path / "bag", first + second, storage), tmp_path / "d")
    assert note in capsys.readouterr().err
    assert len(info.episodes) == 2
    alone = imported(write(tmp_path / "alone", first), tmp_path / "alone_d")
    frames = alone.episodes[0].frames  # in a gap there may be a few more, whose readings are fresh enough
    assert 0 <= info.episodes[0].frames - frames <= 3
    for key, values in read_episode(tmp_path / "alone_d", 0).items():
        assert key == "next.done" or np.array_equal(values, read_episode(tmp_path / "d", 0)[key][:frames]), key


def test_silence_of_the_commands_is_a_standstill(tmp_path, capsys):
    messages = [one for one in drive(stamped=True) if one[0] != "/cmd_vel" or not 2 < (one[1] - START) / NANO < 4]
    source = write(tmp_path / "bag", messages)
    imported(source, tmp_path / "d", "--command_timeout=0.5")
    columns = read_episode(tmp_path / "d", 0)
    silent = columns["control.watchdog"] == 1
    assert 13 <= silent.sum() <= 16
    assert (columns["action"][silent] == 0).all()
    assert (columns["action"][~silent] != 0).all()
    assert (columns["control.mode"] == np.where(silent, 2, 3)).all()
    assert columns["control.command_age"].max() <= 0.5
    imported(source, tmp_path / "held")  # a TurtleBot3 goes on with its last command
    held = read_episode(tmp_path / "held", 0)
    assert (held["action"] != 0).all()
    assert held["control.command_age"].max() > 1.5


def test_a_command_beyond_the_limits_is_limited_and_flagged(tmp_path):
    messages = [(t, at, bags.twist(0.5, 0.1) if t == "/cmd_vel" else message) for t, at, message in drive()]
    imported(write(tmp_path / "bag", messages), tmp_path / "d")
    columns = read_episode(tmp_path / "d", 0)
    driven = columns["control.mode"] == 3
    assert driven.sum() > 50
    assert (columns["action"][driven] == np.float32([0.5, 0.1])).all()
    assert (columns["control.applied_action"][driven] == np.float32([0.22, 0.1])).all()
    assert (columns["control.limits"][driven] == 2).all()


def test_all_topics_that_are_missing_are_named_at_once(tmp_path, capsys):
    left = [(f"/r{topic}", at, message) for topic, at, message in drive() if topic in ("/odom", "/cmd_vel")]
    error = refused(write(tmp_path / "bag", left), tmp_path / "d", capsys)
    for part in (
        "no topic /scan",
        "no topic /odom",
        "no topic /cmd_vel",
        "observation.x.vel",
        "action.x.vel",
        "Of the right type: /r/odom",
        "--no_odom",
    ):
        assert part in error
    assert "Name another one with --scan" not in error
    assert "none is of type sensor_msgs/msg/LaserScan" in error
    error = refused(tmp_path / "bag", tmp_path / "d", capsys, "--odom=/r/odom", "--camera=front=/image")
    assert "no topic /image, which images.front is read from" in error
    assert "/odom, which" not in error


def test_a_topic_has_its_name_with_and_without_the_slash(tmp_path, plain, dataset):
    plains = [(topic.removeprefix("/"), at, message) for topic, at, message in drive()]
    imported(write(tmp_path / "bag", plains), tmp_path / "d")
    imported(plain, tmp_path / "e", "--scan=scan", "--cmd=/cmd_vel")
    for key, values in read_episode(dataset, 0).items():
        for root in (tmp_path / "d", tmp_path / "e"):
            assert np.array_equal(values, read_episode(root, 0)[key]), key


def test_without_odometry_the_state_is_the_scan_if_that_is_asked_for(tmp_path, capsys, dataset):
    source = write(tmp_path / "bag", list(filter(without("/odom"), drive())))
    assert "--no_odom" in refused(source, tmp_path / "d", capsys)
    imported(source, tmp_path / "d", "--no_odom", "--beams=36")
    assert "no odometry is read: the state is scan_000.pos to scan_035.pos, without x.vel" in capsys.readouterr().err
    names = dataset_info(tmp_path / "d").features["observation.state"]["names"]
    assert list(names) == [f"scan_{beam:03d}.pos" for beam in range(36)]
    assert main.main(["check", str(tmp_path / "d")]) == 0
    imported(source, tmp_path / "e", "--no_odom")
    states = [read_episode(root, 0)["observation.state"] for root in (tmp_path / "e", dataset)]
    assert (
        np.isin(states[0][:, 0], states[1][:, 2]).mean() > 0.95
    )  # frames begin with the first scan, not with odometry
    for option in ("--odom=/odom", "--odometry", "--odom_frame=base"):
        assert "--no_odom and --odom" in refused(source, tmp_path / "f", capsys, "--no_odom", option)


def joint_states(*names):
    state = bags.T["sensor_msgs/msg/JointState"](
        header=bags.header(START, ""), name=list(names), position=np.zeros(len(names)),
        velocity=np.zeros(0), effort=np.zeros(0),
    )  # fmt: skip
    return [("/joint_states", START, state)]


def test_a_bag_of_an_arm_is_refused_with_the_way_to_read_it(tmp_path, capsys):
    arm = write(tmp_path / "arm", joint_states("shoulder_pan_joint", "elbow_joint"))
    error = refused(arm, tmp_path / "d", capsys)
    assert "no topic /scan" in error
    assert "--map=FILE.yaml names the fields of any other robot, --map=ur5" in error
    assert "--map=FILE.yaml" not in refused(arm, tmp_path / "d", capsys, "--map=ur5")


def test_another_topic_can_be_named_and_must_be_of_the_right_type(tmp_path, capsys):
    source = write(tmp_path / "bag", [(f"/tb3{topic}", at, message) for topic, at, message in drive()])
    error = refused(source, tmp_path / "d", capsys)
    assert "Of the right type: /tb3/" in error
    named = ["--scan=/tb3/scan", "--odom=/tb3/odom", "--cmd=/tb3/cmd_vel"]
    error = refused(source, tmp_path / "d", capsys, *named, "--odom=/tb3/scan")
    assert "is of type sensor_msgs/msg/LaserScan; valid for --odom: nav_msgs/msg/Odometry" in error
    assert len(imported(source, tmp_path / "d", *named).episodes) == 1


def test_other_frames_are_refused_until_an_option_names_them(tmp_path, capsys, dataset):
    source = write(tmp_path / "bag", drive(frame="laser"))
    error = refused(source, tmp_path / "d", capsys)
    for part in ("frame 'laser'", "--scan_frame=laser", "--scan_yaw"):
        assert part in error
    imported(source, tmp_path / "b", "--scan_frame=laser", f"--scan_yaw={np.pi / 2}")
    ours, theirs = (read_episode(root, 0)["observation.state"][:, 2:] for root in (dataset, tmp_path / "b"))
    assert np.array_equal(theirs, np.roll(ours, 90, axis=1))
    messages = [(t, at, bags.odometry(at, child="imu") if t == "/odom" else message) for t, at, message in drive()]
    odd = write(tmp_path / "odd", messages)
    assert "--odom_frame=imu" in refused(odd, tmp_path / "d", capsys)
    imported(odd, tmp_path / "c", "--odom_frame=imu")
    mixed = [(t, at, bags.scan(at, frame="other") if t == "/scan" and at % 2 else m) for t, at, m in drive()]
    assert "several frames" in refused(write(tmp_path / "mixed", mixed), tmp_path / "d", capsys)


def static(*transforms):
    """Return a message of `/tf_static`: parent, child, z and w of the rotation of each transform."""
    types = bags.T
    stamped = [
        types["geometry_msgs/msg/TransformStamped"](
            header=bags.header(START, parent),
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=bags.Vector(x=0.0, y=0.0, z=0.1),
                rotation=bags.Quaternion(x=0.0, y=0.0, z=float(z), w=float(w)),
            ),
        )
        for parent, child, z, w in transforms
    ]
    return ("/tf_static", START, types["tf2_msgs/msg/TFMessage"](transforms=stamped))


def test_a_static_transform_turns_the_scanner_and_a_lost_one_must_be_replaced(tmp_path, capsys, dataset):
    expected = read_episode(dataset, 0)["observation.state"]
    turn = np.sin(np.pi / 8), np.cos(np.pi / 8)
    turned = static(("base_link", "mast", *turn), ("mast", "laser", *turn))
    imported(write(tmp_path / "bag", [turned, *drive(frame="laser")]), tmp_path / "b")
    assert "turned by 90.0 degrees, from /tf_static" in capsys.readouterr().err
    assert np.array_equal(read_episode(tmp_path / "b", 0)["observation.state"][:, 2:], np.roll(expected[:, 2:], 90, 1))
    bag = write(tmp_path / "lost", [static(("base_link", "base_scan", np.nan, 1.0)), *drive()])
    assert "--scan_yaw (0 is straight ahead)" in refused(bag, tmp_path / "d", capsys)
    imported(bag, tmp_path / "d", "--scan_yaw=0")
    assert "1 messages of /tf_static cannot be read" in capsys.readouterr().err
    assert np.array_equal(read_episode(tmp_path / "d", 0)["observation.state"], expected)


def test_an_action_is_the_answer_to_its_observation(tmp_path):
    """A brain answers each observation after a while; the action of a frame is that answer, not the one before."""
    base = [message for message in drive(seconds=4) if message[0] != "/cmd_vel"]
    imported(write(tmp_path / "silent", [*base, ("/cmd_vel", base[0][1], bags.twist(0, 0))]), tmp_path / "a")
    start = source_of(tmp_path / "a")["start_ns"]
    for late_ms in (0, 99):
        answers = [
            ("/cmd_vel", start + frame * NANO // 10 + late_ms * NANO // 1000, bags.twist(frame / 1000, -frame / 500))
            for frame in range(60)
        ]
        root = tmp_path / f"d{late_ms}"
        imported(write(tmp_path / f"bag{late_ms}", sorted([*base, *answers], key=lambda message: message[1])), root)
        action = read_episode(root, 0)["action"]
        assert action[:, 0] == pytest.approx(np.arange(len(action)) / 1000), late_ms
        assert action[:, 1] == pytest.approx(-np.arange(len(action)) / 500), late_ms


def test_a_key_press_is_in_force_until_the_next(tmp_path, capsys):
    """Teleoperation by keys publishes once, and a TurtleBot3 goes on: its node has no time-out of its own."""
    presses = {0.02: (0.1, 0.0), 2.5: (0.0, 0.6), 4.0: (0.2, -0.6)}
    base = [message for message in drive() if message[0] != "/cmd_vel"]
    keys = [("/cmd_vel", START + int(at * NANO), bags.twist(*values)) for at, values in presses.items()]
    imported(write(tmp_path / "bag", sorted([*base, *keys], key=lambda message: message[1])), tmp_path / "d")
    columns = read_episode(tmp_path / "d", 0)
    ends = columns["control.time"] + (source_of(tmp_path / "d")["start_ns"] - START) / NANO + 0.1
    newest = [max(at for at in presses if at < end) for end in ends]
    assert (columns["action"] == np.float32([presses[at] for at in newest])).all()
    assert (columns["control.mode"] == 3).all()


def test_a_robot_that_moves_without_a_command_needs_a_choice(tmp_path, capsys):
    messages = [one for one in drive() if one[0] != "/cmd_vel" or one[1] > START + 2 * NANO]
    source = write(tmp_path / "bag", messages)
    error = refused(source, tmp_path / "d", capsys)
    assert "--cmd" in error
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]
    for timeout, first in (("inf", "the last command"), ("0.5", "none, after so many seconds")):
        says = rf"={timeout}, {first}: the robot moves in (\d+) frames with the action 0, and stands in (\d+) although"
        found = re.search(f"--command_timeout{says}", error)
        assert found
        root = tmp_path / f"d{timeout}"
        imported(source, root, f"--command_timeout={timeout}")
        columns = read_episode(root, 0)
        moves = (np.abs(columns["observation.state"][:, :2]) > 0.01).any(axis=1)
        silent = columns["control.mode"] == 2
        assert int(found[1]) == (moves & silent).sum() > 0.1 * len(moves)
        assert int(found[2]) == (~moves & ~silent).sum()
    few = [one for one in drive() if one[0] != "/cmd_vel" or one[1] > START + NANO // 2]
    imported(write(tmp_path / "few", few), tmp_path / "few_d")
    assert "come before the first command" in capsys.readouterr().err


def test_a_robot_that_stands_against_its_last_command_is_reported(tmp_path, capsys):
    still = bags.T["geometry_msgs/msg/TwistWithCovariance"](twist=bags.twist(0, 0), covariance=np.zeros(36))
    messages = drive()
    for topic, at, message in messages:
        if topic == "/odom" and at > START + 3 * NANO:
            message.twist = still
    imported(write(tmp_path / "bag", messages), tmp_path / "d")
    assert re.search(r"in (29|3[01]) of 60 frames .* stands though its last command", capsys.readouterr().err)


def test_a_computer_whose_clock_is_off_is_noticed_where_it_matters(tmp_path, capsys):
    """Else each observation would have the command of another time."""
    make = {"/scan": bags.scan, "/odom": bags.odometry}
    fast = [(topic, at, make[topic](at + 3 * NANO // 2) if topic in make else one) for topic, at, one in drive()]
    source = write(tmp_path / "bag", fast)
    error = refused(source, tmp_path / "d", capsys, "--stamps=header")
    assert "/cmd_vel is 1.50 s behind /odom. Their stamps are of different clocks" in error
    assert imported(source, tmp_path / "d").frames == imported(source, tmp_path / "a", "--stamps=auto").frames > 30
    # With headers everywhere it does not matter whether the recorder's clock is that of the robot, or as fast.
    slow = [(topic, START + 2 * (at - START), one) for topic, at, one in drive(stamped=True)]
    assert imported(write(tmp_path / "slow", slow), tmp_path / "s", "--stamps=header").frames > 30


def test_several_bags_become_several_episodes(tmp_path, plain):
    folder = tmp_path / "drives"
    folder.mkdir()
    for index in range(2):
        write(folder / f"drive_{index}", drive(seed=index + 1))
    info = imported(folder, tmp_path / "d")
    assert [json.loads(episode.metadata["source"])["bag"] for episode in info.episodes] == ["drive_0", "drive_1"]
    arguments = ["import", str(plain), str(folder), "--repo_id=t/t", f"--root={tmp_path / 'e'}", TASK]
    assert main.main(arguments) == 0
    assert len(dataset_info(tmp_path / "e").episodes) == 3


def test_values_that_are_not_finite_count_as_lost(tmp_path, capsys):
    messages = [
        (topic, at, bags.twist(np.nan, 0) if topic == "/cmd_vel" and number % 20 == 0 else message)
        for number, (topic, at, message) in enumerate(drive())
    ]
    imported(write(tmp_path / "bag", messages), tmp_path / "d")
    assert "with values that are not finite, left out" in capsys.readouterr().err
    assert np.isfinite(read_episode(tmp_path / "d", 0)["action"]).all()


def test_images_and_gyroscope(tmp_path):
    types = bags.T
    messages = drive(seconds=3)
    for number in range(60):
        at = START + number * NANO // 20
        grey = np.full(16 * 24 * 3, 4 * number, np.uint8)
        image = types["sensor_msgs/msg/Image"](
            header=bags.header(at, "camera"), height=16, width=24, encoding="bgr8", is_bigendian=0, step=72, data=grey
        )
        messages.append(("/camera/image", at + 10**6, image))
        zero = bags.Vector(x=0.0, y=0.0, z=0.0)
        imu = types["sensor_msgs/msg/Imu"](
            header=bags.header(at, "imu_link"), orientation=bags.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.zeros(9), angular_velocity=bags.Vector(x=0.0, y=0.0, z=number / 10),
            angular_velocity_covariance=np.zeros(9), linear_acceleration=zero,
            linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        messages.append(("/imu", at + 10**6, imu))
    source = write(tmp_path / "bag", sorted(messages, key=lambda one: one[1]))
    info = imported(source, tmp_path / "d", "--camera=front=/camera/image", "--imu=/imu", "--beams=36")
    assert info.features["observation.images.front"]["shape"] == [16, 24, 3]
    columns = read_episode(tmp_path / "d", 0)
    start = json.loads(info.episodes[0].metadata["source"])["start_ns"]
    newest = (start - START + np.arange(len(columns["action"])) * NANO // 10) // (NANO // 20)
    assert columns["observation.state"][:, -1] == pytest.approx(newest / 10)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("t/t", root=tmp_path / "d", video_backend="pyav")
    for frame in (0, 10, 20):
        grey = dataset[frame]["observation.images.front"].numpy().mean() * 255
        assert grey == pytest.approx(4 * newest[frame], abs=4)


def test_an_outcome_is_given_or_marked_later(tmp_path, plain):
    info = imported(plain, tmp_path / "d", "--outcome=success")
    columns = read_episode(tmp_path / "d", 0)
    assert (info.episodes[0].metadata["outcome"], columns["event"][-1], columns["next.success"][-1]) == (
        "success",
        1,
        1,
    )
    assert not columns["event"][:-1].any()
    assert "outcome" not in imported(plain, tmp_path / "e").episodes[0].metadata
    assert main.main(["mark", str(tmp_path / "e"), "--episodes=0", "--outcome=collision"]) == 0
    assert dataset_info(tmp_path / "e").episodes[0].metadata["outcome"] == "collision"


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_random_damage_is_read_or_refused_and_never_a_surprise(tmp_path, storage):
    (path,) = (one for one in write(tmp_path / "bag", drive(seconds=2), storage).iterdir() if one.suffix != ".yaml")
    whole, damaged = path.read_bytes(), tmp_path / f"damaged{path.suffix}"
    statuses = set()
    for seed in range(14):
        rng = np.random.default_rng(seed)
        content = np.frombuffer(whole, np.uint8).copy()
        reach = len(content) if seed % 2 else 6000
        content[rng.integers(0, reach, rng.choice([1, 3, 20]))] = rng.integers(0, 256)
        damaged.write_bytes(content.tobytes())
        root = tmp_path / f"out_{seed}"
        status = run(damaged, root)
        statuses.add(status)
        assert status in (0, 2)
        assert root.exists() == (status == 0)
    assert statuses == {0, 2}
