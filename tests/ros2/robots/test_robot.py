"""Any ROS 2 robot as a LeRobot robot: a stand-in for a TurtleBot3, by rclpy, described by a mapping."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from bhd_lerobot.errors import ActionError, ConfigError, RealtimeError
from bhd_lerobot.ros2.live.network import NetworkConfig, Ros2Config
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.images import COMPRESSED, encode_image
from bhd_lerobot.ros2.messages.parts import Frames
from bhd_lerobot.ros2.robots.config_robot import Ros2RobotConfig
from bhd_lerobot.ros2.robots.robot import Ros2Robot
from tests.ros2.peer_env import Peer
from tests.waiting import until

TWIST = "type: geometry_msgs/msg/TwistStamped"
MAPPING = f"""
observation:
  x.vel: {{topic: /odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x}}
  scan: {{topic: /scan, type: sensor_msgs/msg/LaserScan, beams: 8, range_min: 0.12, range_max: 3.5}}
  left.pos: {{topic: /joint_states, type: sensor_msgs/msg/JointState, field: "position[name=wheel_left_joint]"}}
action:
  x.vel: {{topic: /cmd_vel, {TWIST}, field: twist.linear.x}}
  theta.vel: {{topic: /cmd_vel, {TWIST}, field: twist.angular.z}}
"""
MIXED = """
action:
  x.vel: {topic: /commands, type: std_msgs/msg/Float64MultiArray, field: "data[0]"}
  lift.pos: {topic: /commands, type: std_msgs/msg/Float64MultiArray, field: "data[1]"}
"""
FORWARD = {"x.vel": 0.1, "theta.vel": 0.0}


def config_of(tmp_path: Path, domain: int, text: str = MAPPING, **options: object) -> Ros2RobotConfig:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    return Ros2RobotConfig(mapping=str(path), ros2=Ros2Config(domain=domain), **options)  # type: ignore[arg-type]


def speed(robot: Ros2Robot, action: dict[str, float] | None) -> Callable[[], float]:
    def step() -> float:
        if action is not None:
            robot.send_action(action)
        observation: float = robot.get_observation()["x.vel"]
        return observation

    return step


def test_observations_actions_and_the_stop_when_actions_cease(tmp_path: Path, domain: int) -> None:
    robot = Ros2Robot(config_of(tmp_path, domain))
    assert list(robot.observation_features) == ["x.vel", *(f"scan_{k:03d}.pos" for k in range(8)), "left.pos"]
    assert list(robot.action_features) == ["x.vel", "theta.vel"]
    with Peer("standin_turtlebot3.py", "--open", domain=domain) as peer:
        peer.wait_event("ready")
        with robot:
            before = robot.get_observation()
            assert all(np.isfinite(value) for value in before.values())
            forward, nothing = speed(robot, FORWARD), speed(robot, None)
            until(lambda: forward() > 0.08, "it drives")
            assert robot.get_observation()["left.pos"] > before["left.pos"]
            until(lambda: abs(nothing()) < 0.01, "it stands without actions")
            for wrong in ({"x.vel": 0.1}, {"x.vel": np.nan, "theta.vel": 0.0}):
                with pytest.raises(ActionError):
                    robot.send_action(wrong)
            until(lambda: forward() > 0.08, "it drives again")
            peer.signal(9)
            with pytest.raises(RealtimeError, match=r"no message for|any more"):
                until(lambda: [forward(), False][1], "its end is noticed")


def test_images_arrive_with_the_time_at_which_they_were_taken(tmp_path: Path, domain: int) -> None:
    robot = Ros2Robot(config_of(tmp_path, domain, "images: {front: {topic: /image, width: 64, height: 48}}"))
    image = np.full((48, 64, 3), 200, np.uint8)
    stop = threading.Event()
    with Node("camera", NetworkConfig(domain)) as node:
        publisher = node.publisher("/image", COMPRESSED)

        def publish() -> None:
            while not stop.wait(0.05):
                frames = Frames(0, np.zeros(1, np.int64), np.array([time.time_ns()]))
                publisher.send(encode_image(frames, "front", image, compressed=True))

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            robot.connect()
            found = robot.get_observation()["front"]
            np.testing.assert_allclose(found, image, atol=2)
            taken = robot.cameras["front"].latest_timestamp
            assert taken is not None
            assert 0 <= time.perf_counter() - taken < 60
        finally:
            robot.disconnect()
            stop.set()
            thread.join()


@pytest.mark.thorough
def test_stock_lerobot_record(tmp_path: Path, domain: int) -> None:
    config_of(tmp_path, domain)
    root = tmp_path / "data"
    with Peer("standin_turtlebot3.py", "--open", domain=domain) as peer:
        peer.wait_event("ready")
        subprocess.run(
            [
                *(
                    sys.executable,
                    "-c",
                    "import pty, sys; sys.exit(pty.spawn(sys.argv[1:]) >> 8)",
                ),  # keys of a terminal
                *(Path(sys.executable).parent / "lerobot-record", "--robot.type=ros2"),
                f"--robot.mapping={tmp_path / 'robot.yaml'}",
                f"--robot.ros2.domain={domain}",
                *("--teleop.type=bhd_keyboard_base", "--dataset.repo_id=me/drives", f"--dataset.root={root}"),
                *("--dataset.num_episodes=1", "--dataset.episode_time_s=2", "--dataset.reset_time_s=0"),
                *("--dataset.single_task=Drive.", "--dataset.push_to_hub=false", "--play_sounds=false"),
            ],
            check=True,
            stdin=subprocess.DEVNULL,
        )
    dataset = LeRobotDataset("me/drives", root)
    assert dataset.num_frames > 10
    assert dataset[0]["observation.state"].shape == (10,)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (MAPPING + "images: {front: {topic: /image}}", {}, "images.front has no width and height"),
        (MAPPING, {"stop": {"y.vel": 0.0}}, "Did you mean 'x.vel'"),
        (
            MIXED,
            {"stop": {"x.vel": 0.0}},
            r"robot.stop has no lift.pos, .* /commands .* Set --robot.stop.lift.pos, too",
        ),
    ],
)
def test_a_mapping_that_cannot_be_used_is_refused(tmp_path, text, options, message):
    with pytest.raises(ConfigError, match=message):
        Ros2Robot(config_of(tmp_path, 1, text, **options))
