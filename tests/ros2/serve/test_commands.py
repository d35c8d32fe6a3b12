"""What becomes of commands to a served robot: none is lost, a refused one changes nothing, what is cut is said."""

import json
import re
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.ros2.live.network import LATCHED, SENSOR_DATA, Qos
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.messages.images import COMPRESSED, decode_image
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.views import CAMERA_INFO
from bhd_lerobot.ros2.serve.interface import COMMAND, COMMAND_TOPIC, ESTOP_TOPIC
from tests.ros2.peer_env import Peer
from tests.ros2.programs import BOOL, Served, Side, put, served
from tests.ros2.serve.bridges import burst
from tests.waiting import until

STAMPED = "geometry_msgs/msg/TwistStamped"
STRING = "std_msgs/msg/String"
FORWARD = {"linear": {"x": 0.1}}
FLOOD = 1000  # goals, more than the robot takes while they are sent
JOINTS = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]


def moves(side: Side) -> None:
    side.wait(lambda state: state.is_moving, "it drives")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    yield from served("turtlebot3", tmp_path_factory.mktemp("base"), "--robot.arena=empty")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    yield from served("ur5", tmp_path_factory.mktemp("arm"))


@pytest.mark.parametrize(
    "values",
    [[True] + [False] * 11, [False] * 500 + [True] + [False] * 3000, [True] * 20 + [False] * 20],
    ids=["followed", "inside", "many"],
)
def test_a_press_among_any_number_of_messages_presses(values: list[bool], base: Side) -> None:
    publisher = base.publisher(ESTOP_TOPIC, BOOL)
    data = {value: encode(BOOL, {"data": value}, 1)[0] for value in (False, True)}
    for value in values:
        put(publisher, data[value])
    base.wait(lambda state: state.emergency_stop, "the stop is latched")
    base.reset()


def test_a_best_effort_publisher_presses_and_is_no_mismatch(base: Side) -> None:
    before, publisher = len(base.served.text), base.node.publisher(ESTOP_TOPIC, BOOL, Qos(1, reliable=False))
    [data] = encode(BOOL, {"data": True}, 1)
    # What is sent before both sides have found each other is lost: a button publishes as long as it is pressed.
    base.wait(lambda state: state.emergency_stop or put(publisher, data), "the stop is latched")
    base.reset()
    assert "best effort" not in base.served.text[before:]


def goal(name: str, x: float) -> dict[str, Any]:
    pose = {"position": {"x": x}, "orientation": {"w": 1.0}}
    return {"header": {"frame_id": "odom"}, "task_id": name, "target_pose": pose}


def test_each_goal_of_a_flood_has_one_result_and_the_stop_is_not_behind_it(base: Side) -> None:
    publisher, far = base.publisher(COMMAND_TOPIC, COMMAND), goal("", 0.0)
    messages = [encode(COMMAND, far | {"task_id": f"flood {k}"}, 1)[0] for k in range(FLOOD)]
    for message in messages:
        put(publisher, message)
    before = len(base.results.take())
    base.press()
    assert before < FLOOD  # it is pressed while goals still wait
    names = [one.task_id for one in base.ended(FLOOD - before)]
    assert len(set(names)) == len(names) == FLOOD - before
    base.reset()


def test_each_goal_of_a_burst_has_one_result(base: Side, arm: Side) -> None:
    for side, robot in ((base, "turtlebot3"), (arm, "ur5")):
        burst(side, robot)


def test_the_result_of_a_stopped_robot_names_the_topic_that_resets_it(arm: Side) -> None:
    pose = {"position": {"x": 0.5, "y": 0.1, "z": 0.4}, "orientation": {"y": 1.0, "w": 0.0}}
    arm.press()
    arm.send(COMMAND_TOPIC, COMMAND, {"task_id": "stopped", "target_pose": pose})
    [result] = arm.ended(1)
    assert not result.success
    assert result.message.endswith("clear its cause, then send a message on /emergency_stop/reset.")
    arm.served.wait_for(f": {COMMAND_TOPIC}: estop")
    arm.reset()


def test_a_refused_twist_leaves_the_goal_alone(base: Side) -> None:
    ahead = {"target_pose": {"position": {"x": 0.15}, "orientation": {"w": 1.0}}}
    base.send(COMMAND_TOPIC, COMMAND, ahead | {"task_id": "the goal"})
    for value in (np.nan, np.inf):
        base.send("/cmd_vel", STAMPED, {"twist": {"linear": {"x": value}}})
    base.served.wait_for("/cmd_vel: the command holds NaN or an infinity")
    [result] = base.ended(1)
    assert (result.task_id, result.success) == ("the goal", True)
    base.send(COMMAND_TOPIC, COMMAND, ahead | {"task_id": "another"})
    moves(base)
    base.send("/cmd_vel", STAMPED, {"twist": {"linear": {"x": 0.0}}})
    [result] = base.ended(1)
    assert (result.task_id, result.success) == ("another", False)


@pytest.mark.parametrize("seconds", [0, 2_000_000_000], ids=["zero", "tomorrow"])
def test_twists_with_wrong_stamps_are_taken_as_a_real_robot_does(seconds: int, base: Side) -> None:
    stamped = {"header": {"stamp": {"sec": np.array([seconds])}}, "twist": FORWARD}
    base.wait(lambda state: [base.send("/cmd_vel", STAMPED, stamped), state.is_moving][1], "it drives")
    base.wait(lambda state: not state.is_moving, "it stands without commands")


def test_a_flood_of_commands_is_followed_and_the_robot_still_answers(base: Side) -> None:
    flood = ("/cmd_vel", STAMPED, json.dumps({"twist": FORWARD}), "--hz=1000", "--burst=10")
    with Peer("topic.py", "pub", *flood, domain=base.node.network.domain_number):
        moves(base)
        for _ in range(20):
            base.state()
    base.wait(lambda state: not state.is_moving, "it stands without commands")


def test_a_command_of_an_absurd_size_gets_its_result_and_others_theirs(base: Side) -> None:
    for name in ("a" * 10_000_000, "small"):
        wrong = goal(name, 0.0) | {"target_pose": {"orientation": {"w": 0.0}}}
        base.send(COMMAND_TOPIC, COMMAND, wrong)
        [result] = base.ended(1)
        assert (result.task_id, result.success) == (name, False)


def test_a_node_that_comes_later_receives_the_description(base: Side) -> None:
    subscription = base.node.subscription("/robot_description", STRING, LATCHED)
    [received] = until(subscription.take, "the description comes")
    assert '<robot name="turtlebot3">' in received.message().data


def test_a_node_whose_topic_does_not_fit_is_named(base: Side) -> None:
    misfits = [
        ("of type", base.node.publisher("/cmd_vel", STRING), f"of /cmd_vel in /other is of type {STRING}"),
        (
            "effort",
            base.node.publisher("/cmd_vel", STAMPED, Qos(1, reliable=False)),
            "/cmd_vel in /other is best effort",
        ),
        ("scan", base.node.subscription("/scan", "sensor_msgs/msg/LaserScan", LATCHED), "is reliable, transient local"),
    ]
    for _, end, text in misfits:
        base.served.wait_for(text)
        del end


def trajectory(arm: Side, positions: NDArray[np.float64], ahead_s: float | None = None, **point: Any) -> None:
    stamp = 0 if ahead_s is None else time.time_ns() + round(ahead_s * 1e9)
    parts = {"sec": np.array([stamp // 10**9]), "nanosec": np.array([stamp % 10**9])}
    last = {"positions": positions[None], "time_from_start": {"sec": np.array([1])}, **point}
    arm.send(ur.TRAJECTORY_TOPIC, ur.TRAJECTORY, {"header": {"stamp": parts}, "joint_names": JOINTS, "points": [last]})


def joint(number: int, angle: float) -> NDArray[np.float64]:
    return angle * np.eye(6)[number]


def is_at(arm: Side, positions: NDArray[np.float64]) -> None:
    arm.wait(lambda state: np.abs(np.asarray(state.joint_positions)[:6] - positions).max() < 0.01, "it arrives")


def test_a_stamp_is_the_start_of_a_trajectory(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + 0.1, -10.0)
    arm.served.wait_for("by its stamp the trajectory ended 9")
    trajectory(arm, home + 0.1, 3.0)
    arm.served.wait_for("by its stamp the trajectory starts in")
    begin = time.monotonic()
    np.testing.assert_allclose(arm.joints, home, atol=0.03)
    assert time.monotonic() - begin < 2.0, "the machine was too slow to see that it waits"
    is_at(arm, home + 0.1)
    trajectory(arm, home, -0.3)  # the rest of one that began already
    is_at(arm, home)


def test_a_trajectory_that_waits_does_not_outlive_an_emergency_stop(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + 0.1, 1.5)
    arm.send(ESTOP_TOPIC, BOOL, {"data": True})
    arm.served.wait_for("the arm was stopped before the trajectory's start")
    arm.reset()
    time.sleep(2.0)
    np.testing.assert_allclose(arm.joints, home, atol=0.03)


def test_one_message_of_positions_is_followed_to_its_end(arm: Side) -> None:
    home = arm.joints
    for target in (home + joint(0, 1.0), home):
        arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": target[None]})
        is_at(arm, target)
    arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": (home + joint(0, 0.5))[None]})
    for refused in (home[None, :5], np.full((1, 6), np.nan)):
        arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": refused})
    is_at(arm, home + joint(0, 0.5))
    trajectory(arm, home)
    is_at(arm, home)


def test_what_the_limits_cut_is_printed_and_published(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + joint(1, 1.2))  # into the table
    arm.served.wait_for("the arm holds short of the last position of shoulder_lift_joint")
    arm.served.wait_for("by the robot's limit of clearance")
    until(lambda: "limit of clearance" in str(arm.newest(arm.diagnostics)), "it is published")
    trajectory(arm, home)
    is_at(arm, home)


def test_a_second_robot_in_the_domain_is_named(base: Side, tmp_path: Path) -> None:
    domain = base.node.network.domain_number
    with Served("turtlebot3", "--robot.arena=empty", domain=domain, log=tmp_path / "log") as second:
        for robot in (second, base.served):
            robot.wait_for("Another node, /turtlebot3, subscribes to /brain/command, /cmd_vel, /emergency_stop")


def test_every_camera_of_an_arm_has_images_and_its_geometry(tmp_path: Path) -> None:
    size = ("--robot.camera=true", "--robot.camera_width=64", "--robot.camera_height=48")
    for arm in served("ur5", tmp_path, *size):
        for name in ("scene", "wrist"):
            infos = arm.node.subscription(f"/{name}/camera_info", CAMERA_INFO, SENSOR_DATA)
            images = arm.node.subscription(f"/{name}/image_raw/compressed", COMPRESSED, SENSOR_DATA)
            info = arm.newest(infos)
            assert (info.width, info.height, info.header.frame_id) == (64, 48, f"{name}_optical_frame")
            assert 20 < info.k[0] < 100
            assert decode_image(name, COMPRESSED, until(images.take, "an image comes")[-1].data).shape == (48, 64, 3)


def test_an_arm_without_a_gripper_goes_on_whatever_comes_for_one(tmp_path: Path) -> None:
    text = resources.files("bhd_lerobot.bodies").joinpath("so101.xml").read_text(encoding="utf-8")
    text = re.sub(r'<body name="jaw".*?</body>', "", text, flags=re.DOTALL)
    path = tmp_path / "bare.xml"
    path.write_text(text.replace('<position name="gripper" joint="gripper"/>', ""), encoding="utf-8")
    for arm in served("arm", tmp_path, f"--robot.mjcf={path}"):
        publisher = arm.node.publisher(ur.GRIPPER_TOPIC, ur.FLOATS)
        home = np.asarray(arm.state().joint_positions)
        assert len(home) == 5
        [opening] = encode(ur.FLOATS, {"data": np.array([[0.02]])}, 1)
        target = home + 0.1
        arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": target[None]})
        arm.wait(
            lambda state, target=target, publisher=publisher, opening=opening: [
                publisher.send(opening),
                np.abs(state.joint_positions - target).max() < 0.01,
            ][1],
            "it arrives",
        )
