"""Brains as teleoperators, alone and under the stock command lines."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.teleoperators.bhd_brain import BhdBrain
from bhd_lerobot.teleoperators.config_bhd_brain import BhdBrainConfig
from tests.forks import Fork


@pytest.fixture
def robot(tmp_path):
    with TurtleBot3(TurtleBot3Config(calibration_dir=tmp_path, id="one", arena="empty")) as robot:
        yield robot


@pytest.fixture
def teleop(tmp_path):
    with BhdBrain(BhdBrainConfig(calibration_dir=tmp_path)) as teleop:
        yield teleop


def test_it_drives_the_robot_that_is_connected_by_the_last_observation(robot, teleop, monkeypatch):
    assert list(teleop.action_features) == list(robot.action_features)
    robot.get_observation()
    with monkeypatch.context() as patch:
        patch.setattr(robot.host, "observe", lambda: pytest.fail("observed again"))
        assert teleop.get_action() == {"x.vel": 0.2, "theta.vel": 0.0}
    for _ in range(300):
        robot.get_observation()
        action = teleop.get_action()
        if action["x.vel"] == 0:
            break
        robot.send_action(action)
    assert action == {"x.vel": 0.0, "theta.vel": 0.5}  # something is ahead now


def test_it_needs_exactly_one_robot_and_to_be_connected_once(tmp_path, teleop):
    with pytest.raises(DeviceAlreadyConnectedError):
        teleop.connect()
    with pytest.raises(DeviceNotConnectedError):
        BhdBrain(BhdBrainConfig(calibration_dir=tmp_path)).get_action()
    with pytest.raises(ConfigError, match="connected are: none"):
        teleop.get_action()
    configs = [TurtleBot3Config(calibration_dir=tmp_path, id=name, arena="empty") for name in ("one", "two")]
    with TurtleBot3(configs[0]), TurtleBot3(configs[1]):
        with pytest.raises(ConfigError, match=r"teleop\.robot_id"):
            teleop.get_action()
        teleop.config.robot_id = "two"
        assert teleop.get_action()["x.vel"] == 0.2
        teleop.config.robot_id = "tow"
        with pytest.raises(ConfigError, match="Did you mean 'two'"):
            teleop.get_action()


def test_a_robot_that_is_connected_again_gets_a_brain_of_its_own_and_every_brain_is_closed(robot, teleop, monkeypatch):
    calls = []
    for call in ("reset", "close"):
        monkeypatch.setattr(AvoidanceBrain, call, lambda *_, call=call: calls.append(call))
    teleop.get_action()
    teleop.get_action()
    assert calls == ["reset"]
    robot.disconnect()
    robot.connect()
    teleop.get_action()
    assert calls == ["reset", "close", "reset"]
    teleop.disconnect()
    assert calls == ["reset", "close", "reset", "close"]


def record_and_replay(robot: str, fps: int, *options: str) -> None:
    """Run LeRobot's commands, and print what is in the dataset. Time passes for them only while they wait."""
    from lerobot.datasets import LeRobotDataset
    from lerobot.scripts import lerobot_record, lerobot_replay

    now = [0.0]
    clock, wait = SimpleNamespace(perf_counter=lambda: now[0]), lambda seconds: now.__setitem__(0, now[0] + seconds)
    for command in (lerobot_record, lerobot_replay):
        command.time, command.precise_sleep = clock, wait
    common = [f"--robot.type={robot}", "--play_sounds=false", f"--dataset.root={robot}"]
    common += [f"--dataset.repo_id=test/{robot}", *(option for option in options if option.startswith("--robot"))]
    sys.argv = [
        "lerobot-record", *common, "--teleop.type=bhd_brain", "--dataset.single_task=Go.",
        f"--dataset.fps={fps}", "--dataset.num_episodes=1", "--dataset.episode_time_s=1",
        "--dataset.reset_time_s=0", "--dataset.push_to_hub=false",
        *(option for option in options if option.startswith("--teleop")),
    ]  # fmt: skip
    lerobot_record.main()
    dataset = LeRobotDataset(f"test/{robot}", root=robot)
    assert dataset.meta.robot_type == robot, dataset.meta.robot_type
    width, last = dataset[0]["observation.state"].shape[0], dataset[dataset.num_frames - 1]["action"].tolist()
    print("RECORDED", dataset.num_frames, width, last)
    sys.argv = ["lerobot-replay", *common, "--dataset.episode=0"]
    lerobot_replay.main()
    print("REPLAYED")


def test_stock_record_and_replay_work(tmp_path, monkeypatch):
    """`lerobot-record` and `lerobot-replay` of the robots, in processes of their own: they end with these."""
    monkeypatch.chdir(tmp_path)
    outputs = []
    for options in (
        ("turtlebot3", 10),
        ("ur5", 25, "--robot.scene=pick", "--teleop.brain.type=pick"),
        ("turtlebot3_manipulation", 25, "--robot.scene=fetch", "--teleop.brain.type=fetch"),
    ):
        log = tmp_path / "log"
        status = Fork(record_and_replay, *options, output=log).wait()
        outputs.append(log.read_text())
        assert status == 0, outputs[-1]
    lines = "".join(outputs).splitlines()
    recorded = [line.split(" ", 3) for line in lines if line.startswith("RECORDED")]
    assert [int(width) for _, _, width, _ in recorded] == [362, 14, 372]
    for (_, frames, _, _), fps in zip(recorded, (10, 25, 25), strict=True):
        assert fps <= int(frames) <= fps + 1  # of one second
    base, arm, mobile = (json.loads(action) for *_, action in recorded)
    assert np.allclose(base, [0.2, 0.0])
    assert not np.allclose(arm, UR5Config().body().arm.home, atol=0.05)  # it was on its way
    *held, _, turn = mobile
    assert np.allclose(held, TurtleBot3ManipulationConfig().body().arm.home, atol=0.01)
    assert turn  # it drives, or turns to where it will
    assert lines.count("REPLAYED") == 3
