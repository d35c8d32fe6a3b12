"""A robot by its mapping: whose topics it is, what may be sent, and the numbers that its bag has."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.external.device import Device
from bhd_lerobot.ros2.bag.importer.sources import Reading, mapped_sources
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.messages.mapping import FieldsReader, MappingConfig, topics_of
from bhd_lerobot.ros2.messages.scan import static_frames
from bhd_lerobot.ros2.messages.serialize import decode, encode
from bhd_lerobot.ros2.messages.views import TF
from bhd_lerobot.ros2.robots.config_robot import Ros2RobotConfig
from bhd_lerobot.ros2.robots.plant import scan_reader
from bhd_lerobot.ros2.robots.robot import Ros2Robot
from tests.cases import each_case
from tests.ros2.feed import FLOATS, JOINTS, ODOMETRY, SCAN, TWIST, Sent, feed, head, mounted, odometry, scan
from tests.waiting import until

ODOM = {"topic": "/odom", "type": ODOMETRY}
SPEED, YAW = ODOM | {"field": "twist.twist.linear.x"}, ODOM | {"field": "pose.pose.orientation"}
SCANNER = {"topic": "/scan", "type": SCAN, "beams": 8, "range_min": 0.1, "range_max": 10.0}
DRIVE = {"topic": "/cmd_vel", "type": TWIST, "field": "linear.x"}
BATTERY, STAMPED = "sensor_msgs/msg/BatteryState", "geometry_msgs/msg/TwistStamped"
RANGES = np.arange(1.0, 9.0)


def config(tmp_path: Path, tree: dict[str, Any], **network: Any) -> Ros2RobotConfig:
    import yaml

    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return Ros2RobotConfig(mapping=str(path), ros2=Ros2Config(**network), topic_timeout_s=5.0)


@contextmanager
def connected(tmp_path: Path, observation: dict[str, Any], **network: Any) -> Iterator[Ros2Robot]:
    robot = Ros2Robot(config(tmp_path, {"observation": observation, "action": {"x.vel": DRIVE}}, **network))
    try:
        robot.connect()
        yield robot
    finally:
        robot.disconnect()


def test_a_namespace_is_in_front_of_every_topic(tmp_path: Path, domain: int) -> None:
    """Two robots are on the network; the one without a namespace is neither read nor commanded."""
    feeding = feed(
        domain,
        lambda _: [
            ("/odom", ODOMETRY, odometry(0.11)),
            ("/tb3_1/odom", ODOMETRY, odometry(0.55)),
            ("/tb3_1/scan", SCAN, scan(RANGES)),
        ],
        receives=(("/tb3_1/cmd_vel", TWIST), ("/cmd_vel", TWIST)),
        frames=tuple(
            (f"{name}/tf_static", mounted("base_scan", yaw)) for name, yaw in (("/tb3_1", math.pi / 2), ("", 3.0))
        ),
    )
    observed = {"x.vel": SPEED, "scan": SCANNER}
    with feeding as received, connected(tmp_path, observed, domain=domain, namespace="tb3_1/") as robot:
        observation = robot.get_observation()
        assert observation["x.vel"] == 0.55
        assert [observation[f"scan_{k:03d}.pos"] for k in range(8)] == np.roll(RANGES, 2).tolist()
        until(lambda: [robot.send_action({"x.vel": 0.2}), len(received) > 3][1], "it is commanded")
    assert {topic for topic, _ in received} == {"/tb3_1/cmd_vel"}


def test_a_namespace_is_in_front_of_images_and_of_topics_without_a_slash(tmp_path: Path) -> None:
    image = {"topic": "image", "width": 4, "height": 4}
    tree = {"observation": {"x.vel": SPEED | {"topic": "odom"}}, "images": {"front": image}}
    spec = Ros2Robot(config(tmp_path, tree, domain=1, namespace="/r")).spec
    assert (spec.cameras[0].topic, spec.inputs[0].topic) == ("/r/image", "/r/odom")


@each_case(
    ("network", "message"),
    [
        ({"silence_s": 0.5}, r"robot.ros2.silence_s is 0.5;.*--robot.topic_timeout_s=0.5"),
        ({"latency_s": 0.1}, "robot.ros2.latency_s is 0.1; it is of robots with --robot.plant=ros2"),
        ({"scan_yaw": 0.1}, "robot.ros2.scan_yaw is 0.1; .* has no scan"),
        ({"wheel_speeds": "rad/s"}, r"robot.ros2.wheel_speeds is 'rad/s'; .*`scale`"),
    ],
)
def test_an_option_that_would_not_act_is_refused(tmp_path: Path, network: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Ros2Robot(config(tmp_path, {"observation": {"x.vel": SPEED}}, **network))


@each_case("network", [{"domain": 3}, {"namespace": "/tb3_1"}, {"latency_s": 0.2}])
def test_a_network_without_a_plant_on_it_is_refused(network: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=rf"robot.ros2.{next(iter(network))} .* add --robot.plant=ros2"):
        TurtleBot3Config(ros2=Ros2Config(**network))


def element(field: str, kind: str = FLOATS) -> dict[str, str]:
    return {"topic": "/commands", "type": kind, "field": field}


@pytest.mark.law
@each_case(
    ("action", "message"),
    [
        ([element("data[0]"), element("data[5]")], "no element 1, 2, 3, 4; they would be sent as 0"),
        ([element("data[1]")], "no element 0"),
        ([element("layout.dim[1].size")], "layout.dim on /commands the mapping has no element 0"),
        (
            [element("pose.covariance[0]", "geometry_msgs/msg/PoseWithCovarianceStamped")],
            "pose.covariance on /commands the mapping has no element 1, 2",
        ),
        ([element("points[0].positions[0]", "trajectory_msgs/msg/JointTrajectory")], "without the joints' names"),
        ([element("position[0]", JOINTS)], "without the joints' names. Name each joint"),
        ([element("pose.orientation", "geometry_msgs/msg/PoseStamped")], "a quaternion .* cannot be sent"),
    ],
)
def test_what_would_be_sent_as_zero_or_without_a_name_is_refused(tmp_path, action, message):
    tree = {"observation": {"x.vel": SPEED}, "action": {f"a{k}.pos": one for k, one in enumerate(action)}}
    with pytest.raises(ConfigError, match=message):
        Ros2Robot(config(tmp_path, tree, domain=1))


@each_case(
    "action",
    [
        [element(f"data[{k}]") for k in (2, 0, 1)],
        [element(f"position[name={name}]", JOINTS) for name in ("elbow", "wrist")],
        [element("linear.x", TWIST)],
    ],
)
def test_what_is_whole_may_be_sent(tmp_path: Path, action: list[dict[str, str]]) -> None:
    tree = {"observation": {"x.vel": SPEED}, "action": {f"a{k}.pos": one for k, one in enumerate(action)}}
    assert len(Ros2Robot(config(tmp_path, tree, domain=1)).action_features) == len(action)


# --- the numbers of a bag ---------------------------------------------------------------------------------------------

ANGLES = {
    "on and on": np.arange(0, 25, 0.3),
    "backwards over the half turn": 3.0 - np.arange(0, 12, 0.7),
    "to and fro at the half turn": math.pi + 0.2 * np.sin(np.arange(0, 20)),
}


@each_case("angles", ANGLES.values())
@each_case("scale", [1.0, -1.0, 180 / math.pi])
@each_case("signs", ["one", "both"])
def test_a_yaw_counts_on_live_as_in_a_bag(angles: np.ndarray, scale: float, signs: str) -> None:
    mapping = MappingConfig.of({"observation": {"yaw": YAW | {"scale": scale}}}, "it")
    flips = np.where(np.arange(len(angles)) % 3 == 1, -1.0, 1.0) if signs == "both" else np.ones(len(angles))
    pairs = zip(angles.tolist(), flips.tolist(), strict=True)
    messages = [decode(ODOMETRY, encode(ODOMETRY, odometry(yaw=yaw, sign=sign), 1)[0]) for yaw, sign in pairs]
    [fields], [source] = topics_of(mapping.observation, {}), mapped_sources(mapping)
    empty: Any = None
    in_bag = source.readers[ODOMETRY](Reading("/odom", empty, messages, {}, static_lost=False, notes=[]))[:, 0]
    reader = FieldsReader(fields, ["yaw"])
    live = np.array([reader.read(message)[0] for message in messages])
    np.testing.assert_allclose(np.diff(live), scale * np.diff(angles), atol=1e-9)
    turn = 2 * math.pi * abs(scale)
    np.testing.assert_allclose(live - turn * round(live[0] / turn), in_bag - turn * round(in_bag[0] / turn), atol=1e-9)


def test_a_message_whose_feature_is_not_finite_is_left_out_as_in_a_bag() -> None:
    from bhd_lerobot.errors import DatasetError

    [fields] = topics_of(MappingConfig.of({"observation": {"x.vel": SPEED}}, "it").observation, {})
    with pytest.raises(DatasetError, match=r"x\.vel is nan"):
        FieldsReader(fields, ["x.vel"]).read(decode(ODOMETRY, encode(ODOMETRY, odometry(math.nan), 1)[0]))


def test_a_yaw_begins_within_half_a_turn_with_each_episode(tmp_path: Path, domain: int) -> None:
    with (
        feed(domain, lambda at: [("/odom", ODOMETRY, odometry(yaw=5 * at))]),
        connected(tmp_path, {"yaw.pos": YAW}, domain=domain) as robot,
    ):
        until(lambda: robot.get_observation()["yaw.pos"] > 10, "it has turned")
        robot.begin_episode()
        assert abs(robot.get_observation()["yaw.pos"]) <= math.pi


def test_scanners_that_are_mounted_turned_read_live_as_in_a_bag(tmp_path: Path, domain: int) -> None:
    yaws = dict(enumerate((0.0, math.pi / 2, -math.pi / 4, math.pi)))
    frames = {f"{robot}laser_{k}": yaw for robot in ("", "robot/") for k, yaw in yaws.items()} | {"base_scan": 0.3}
    tree = {"transforms": [one for frame, yaw in frames.items() for one in mounted(frame, yaw)["transforms"]]}
    static, _ = static_frames(encode(TF, tree, 1))
    in_bag, observed = [], {f"s{k}": SCANNER | {"topic": f"/scan_{k}"} for k in range(len(frames))}
    for source, frame in zip(mapped_sources(MappingConfig.of({"observation": observed}, "it")), frames, strict=True):
        message = decode(SCAN, encode(SCAN, scan(RANGES, frame), 1)[0])
        reading = Reading("/scan", None, [message], static, static_lost=False, notes=[])  # type: ignore[arg-type]
        in_bag += source.readers[SCAN](reading)[0].tolist()
        assert source.feature == keys.OBSERVATION_STATE
    with (
        feed(
            domain,
            lambda _: [(f"/scan_{k}", SCAN, scan(RANGES, frame)) for k, frame in enumerate(frames)],
            frames=(("/tf_static", tree),),
        ),
        connected(tmp_path, observed, domain=domain) as robot,
    ):
        assert list(robot.get_observation().values()) == in_bag
    assert len({tuple(in_bag[k : k + 8]) for k in range(0, len(in_bag), 8)}) >= len(yaws)


@each_case(("options", "shift"), [({}, 0), ({"scan_yaw": math.pi / 2}, 2)])
def test_options_say_how_a_scanner_is_mounted(options: dict[str, float], shift: int) -> None:
    lidar = LidarSpec("", 8, 0.1, 10.0, rate_hz=5, noise_std=0.0)
    reader = scan_reader(Ros2Config(scan_frame="laser", **options), "/scan", lidar, 8)  # type: ignore[arg-type]
    message = decode(SCAN, encode(SCAN, scan(RANGES, "laser"), 1)[0])
    assert reader.read(message).tolist() == np.roll(RANGES, shift).tolist()


def test_two_publishers_of_one_topic_are_named_however_rare_its_messages(tmp_path: Path, domain: int) -> None:
    second: list[bool] = []

    def make(at: float) -> list[Sent]:
        also = [("/odom#2", ODOMETRY, odometry(0.9))] if second and int(at * 3) % 2 else []
        return [("/odom", ODOMETRY, odometry(0.1)), *also]

    with feed(domain, make, hz=3), connected(tmp_path, {"x.vel": SPEED}, domain=domain) as robot:
        robot.get_observation()
        second.append(True)
        with pytest.raises(RealtimeError, match=r"Several nodes send /odom at a time: /robot"):
            until(lambda: [robot.get_observation(), False][1], "it is noticed")


# --- times ------------------------------------------------------------------------------------------------------------


def test_a_frame_is_taken_when_it_is_asked_for_and_each_topic_has_an_age(tmp_path: Path, domain: int) -> None:
    """A scan that is 0.8 s late by its stamp, on the same clock, is so old; the frame is of now all the same."""

    def make(at: float) -> list[Sent]:
        rare = (
            [("/battery", BATTERY, {"header": head(), "percentage": np.array([0.5])})] if int(at * 20) % 20 == 0 else []
        )
        return [("/odom", ODOMETRY, odometry(0.1)), ("/scan", SCAN, scan(RANGES, late_s=0.8)), *rare]

    observed = {"x.vel": SPEED, "scan": SCANNER, "b.pos": {"topic": "/battery", "type": BATTERY, "field": "percentage"}}
    with feed(domain, make), connected(tmp_path, observed, domain=domain) as robot:
        device = Device(robot)
        assert device.reading_names == ("/odom", "/battery", "/scan")
        times = []
        for _ in range(5):
            before = time.monotonic_ns()
            reading = device.observe()
            times.append(reading.state_ns)
            assert before <= reading.state_ns <= time.monotonic_ns()
            ages = {name: (reading.state_ns - at) / 1e9 for name, at in reading.reading_ns.items()}
            assert min(ages.values()) >= 0
            assert ages["/scan"] >= 0.8 > ages["/odom"]
            assert reading.oldest_ns == min(reading.reading_ns.values())
        assert times == sorted(set(times))
        until(lambda: 1.0 < device.sensor_period_s < 2.0, "the slowest topic's period is known")


def test_a_command_that_no_node_receives_is_named_before_the_first_episode(tmp_path, domain, monkeypatch):
    monkeypatch.setattr("bhd_lerobot.ros2.live.link._RECEIVED_S", 2.0)

    def fails(message: str, *receives: tuple[str, str]) -> None:
        with (
            feed(domain, lambda _: [("/odom", ODOMETRY, odometry())], receives=receives),
            pytest.raises(RealtimeError, match=message),
            connected(tmp_path, {"x.vel": SPEED}, domain=domain),
        ):
            pass

    fails(
        r"The subscription of /cmd_vel in /robot is of type .*TwistStamped; .*Correct the type", ("/cmd_vel", STAMPED)
    )
    fails(r"No node receives /cmd_vel \(.*Twist\).*Of this type there are: /base/cmd_vel", ("/base/cmd_vel", TWIST))


@pytest.mark.parametrize("moves", [False, True])
def test_a_robot_that_stands_against_its_commands_is_named(tmp_path, domain, capsys, monkeypatch, moves):
    monkeypatch.setattr("bhd_lerobot.ros2.robots.robot._STANDS_NS", 300_000_000)
    started: list[bool] = []
    with (
        feed(domain, lambda _: [("/odom", ODOMETRY, odometry(0.15 if moves and started else 0.0))]),
        connected(tmp_path, {"x.vel": SPEED}, domain=domain) as robot,
    ):

        def step(commanded: float) -> str:
            robot.send_action({"x.vel": commanded})
            robot.get_observation()
            return capsys.readouterr().err

        def printed_within_a_second(commanded: float) -> str:
            end, printed = time.monotonic() + 1, ""
            while time.monotonic() < end:
                printed += step(commanded)
                time.sleep(0.02)
            return printed

        robot.get_observation()
        started.append(True)
        until(lambda: not moves or robot.get_observation()["x.vel"], "it moves")
        assert "has not moved" not in printed_within_a_second(0.0)
        if moves:
            assert "has not moved" not in printed_within_a_second(0.2)
        else:
            text = "has not moved for 0.3 s, though it is commanded to, on /cmd_vel"
            until(lambda: text in step(0.2), "it is named")


def test_an_arm_and_a_gripper_on_one_topic_are_read_as_in_a_bag(tmp_path: Path, domain: int) -> None:
    """Each publishes its own joints; only two publishers of the same joint are a problem."""
    second: list[bool] = []

    def joints(angles: dict[str, float]) -> dict[str, Any]:
        return {"header": head(), "name": list(angles), "position": np.array([list(angles.values())])}

    def make(at: float) -> list[Sent]:
        also = [("/joint_states#3", JOINTS, joints({"elbow": 9.0}))] * bool(second)
        return [
            ("/joint_states", JOINTS, joints({"wrist": 0.2, "elbow": 0.1})),
            ("/joint_states#2", JOINTS, joints({"finger": 0.03})),
            *also,
        ]

    place = {"topic": "/joint_states", "type": JOINTS}
    observed = {f"{name}.pos": place | {"field": f"position[name={name}]"} for name in ("elbow", "finger", "wrist")}
    with feed(domain, make), connected(tmp_path, observed, domain=domain) as robot:
        assert robot.reading_names == ("/joint_states",)
        for _ in range(20):
            assert robot.get_observation() == {"elbow.pos": 0.1, "finger.pos": 0.03, "wrist.pos": 0.2}
            time.sleep(0.02)
        second.append(True)
        with pytest.raises(RealtimeError, match="Several nodes send /joint_states at a time"):
            until(lambda: [robot.get_observation(), False][1], "it is noticed")
