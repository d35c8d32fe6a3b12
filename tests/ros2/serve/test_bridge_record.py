"""What a robot does behind a bridge, as a dataset: its episodes, and that the bridge goes on whatever becomes of it."""

import itertools
import json
import os
import resource
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from bhd_lerobot.cli import serve
from bhd_lerobot.cli.data import main as data
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.ros2.serve.interface import COMMAND, COMMAND_TOPIC
from tests.ros2.peer_env import Peer
from tests.ros2.programs import Program, log_of, newest_of
from tests.ros2.serve.bridges import NEAR, STAND, TWIST, arm, base, drives, twist
from tests.waiting import until

INSTRUCTION = "drive ahead"


def options(root: Path, **others: Any) -> list[str]:
    given = {"root": root, "task": INSTRUCTION, "idle_s": 1.0} | others
    return [f"--record.{name}={value}" for name, value in given.items()]


def episodes(root: Path) -> list[tuple[str, bool]]:
    """Return how the episodes of a valid dataset ended, and whether with success."""
    assert data.main(["check", str(root)]) == 0
    summary = dataset_info(root)
    dataset = LeRobotDataset(f"local/{root.name}", root=root)
    assert dataset.num_frames == sum(episode.frames for episode in summary.episodes)
    assert dataset[0]["task"] == INSTRUCTION
    return [(str(one.metadata["outcome"]), bool(one.metadata["success"])) for one in summary.episodes]


def once(outcomes: list[tuple[str, bool]]) -> list[tuple[str, bool]]:
    """Return outcomes without repetitions: on a busy machine, twists may cease for a while."""
    return [one for one, _ in itertools.groupby(outcomes)]


def test_twists_are_an_episode_until_they_cease_and_after_a_stop_and_at_the_end_too(domain, tmp_path):
    root = tmp_path / "drives"
    with base(domain, tmp_path, *options(root)) as (side, _, log):
        for _ in range(20):  # to stand is no command of a robot that stands
            side.send("/brain/cmd_vel", TWIST, {})
            side.state()
        until(lambda: drives(side, log), "it drives")
        side.served.wait_for("Episode 0 is saved: timeout")
        until(lambda: drives(side, log), "it drives again")
        side.press()
        side.served.wait_for("is saved: estop")
        side.reset()
        until(lambda: drives(side, log), "it drives after the reset")
        assert side.served.stop() == 0
    ended = episodes(root)
    assert f"The dataset {root} has {len(ended)} episodes" in side.served.text
    assert once(ended) == [("timeout", False), ("estop", False), ("timeout", False)]
    first, stopped = read_episode(root, 0), read_episode(root, ended.index(("estop", False)))
    followed = first[keys.COMMAND_AGE] > 0
    assert followed[0]
    assert not followed[-1]
    assert first[keys.ACTION][followed] == pytest.approx(np.broadcast_to([0.15, 0.0], (followed.sum(), 2)))
    assert first[keys.ACTION][~followed] == pytest.approx(first[keys.APPLIED_ACTION][~followed])
    assert first[keys.OBSERVATION_STATE][:, 0].max() > 0.1
    assert first[keys.OBSERVATION_STATE][[0, -1], 0] == pytest.approx([0, 0], abs=0.02)
    assert (np.diff(first[keys.TIME]) > 0).all()
    assert stopped[keys.MODE].tolist().count(Mode.ESTOP) == 1
    # The dataset is continued by the same robot, and by no other one; a kill costs the running episode alone.
    number = len(ended)
    with base(domain, tmp_path, *options(root, episode_time_s=1)) as (side, _, log):
        side.served.wait_for(f"Recording into {root}, from episode {number} on")
        last = f"Episode {number + 1} is saved"
        until(lambda: drives(side, log) and last in side.served.text, "its time is over, twice")
        until(lambda: drives(side, log), "it drives on")
        os.kill(side.served.pid, signal.SIGKILL)
        side.served.process.wait()
        until(lambda: twist(log) == STAND, "it stands")
    assert data.main(["repair", str(root)]) == 0
    assert once(episodes(root)[number:]) == [("timeout", False)]
    summary = dataset_info(root)
    assert max(episode.frames for episode in summary.episodes[number:]) == summary.fps
    with Program(serve.main, of("ur5", domain, *options(root)), log=tmp_path / "other") as bridge:
        assert bridge.process.wait() == 2
        assert "cannot be resumed, because it was recorded differently: robot_type: recorded" in bridge.text


def of(robot: str, domain: int, *options: str) -> list[str]:
    return ["bridge", f"--robot.type={robot}", "--robot.plant=ros2", f"--robot.ros2.domain={domain}", *options]


def test_goals_of_an_arm_are_episodes_with_the_outcome_of_their_results(domain: int, tmp_path: Path) -> None:
    root = tmp_path / "goals"
    with arm(domain, tmp_path, *options(root)) as (side, _, log):
        with Peer("brain_node.py", "--name=test_move", *NEAR, domain=domain) as brain:
            assert brain.wait_event("summary")["once"] == 2
            succeeded = [line["success"] for line in brain.events("result")]  # not always, beside other programs
        side.served.wait_for("Episode 1 is saved")
        pose = {"position": {"x": 0.5, "y": 0.1, "z": 0.4}, "orientation": {"y": 1.0}}
        goal = {"task_id": "cut", "target_pose": pose, "max_velocity": 0.05}  # it takes long
        side.send(COMMAND_TOPIC, COMMAND, goal)
        side.wait(lambda state: state.is_moving, "it moves")
        here = [*newest_of(log, "state")["position"], 0.0]
        side.send("/brain/commands", "std_msgs/msg/Float64MultiArray", {"data": np.array([here])})
        side.served.wait_for("Episode 3 is saved: timeout")
        assert side.served.stop() == 0
    ended = [("success", True) if one else ("failure", False) for one in succeeded]
    assert episodes(root) == [*ended, ("failure", False), ("timeout", False)]
    summary = dataset_info(root)
    results = [json.loads(str(episode.metadata["brain"])) for episode in summary.episodes]
    goals = ["test_move-0", "test_move-1", "cut", None]
    assert [one.get("goal") for one in results] == goals
    assert [one.get("result") == "succeeded" for one in results[:2]] == succeeded
    assert [one.get("result") for one in results[2:]] == ["replaced_by_setpoint", None]
    for number in range(2):
        columns = read_episode(root, number)
        assert columns[keys.ACTION] == pytest.approx(columns[keys.APPLIED_ACTION])  # what the cerebellum made of a goal
        assert np.ptp(columns[keys.OBSERVATION_STATE], axis=0)[:6].max() > 0.1 or not succeeded[number]


def test_a_fault_is_an_episode_s_end_and_recording_goes_on_after_the_reset(domain: int, tmp_path: Path) -> None:
    """Also one that ends the bridge: its loop is killed."""
    root = tmp_path / "faults"
    with base(domain, tmp_path, *options(root), silence_s=0.5) as (side, robot, log):
        until(lambda: drives(side, log), "it drives")
        robot.signal(signal.SIGKILL)
        side.served.wait_for("Episode 0 is saved: fault")
        with Peer("standin_turtlebot3.py", "--open", "--log", tmp_path / "second", domain=domain):

            def goes_on() -> bool:
                side.send("/emergency_stop/reset", "std_msgs/msg/Empty", {})
                return drives(side, tmp_path / "second")

            until(lambda: (tmp_path / "second").is_file() and log_of(tmp_path / "second", "pose"), "it is back")
            until(goes_on, "it drives again")
            os.kill(side.served.pid_of("robots.host.process"), signal.SIGKILL)
            assert side.served.process.wait() == 2
            until(lambda: twist(tmp_path / "second") == STAND, "it stands")
    first, *_, last = episodes(root)
    assert first == last == ("fault", False)


def test_a_disk_that_is_full_ends_the_recording_and_not_the_bridge(domain: int, tmp_path: Path) -> None:
    root = tmp_path / "full"
    with base(domain, tmp_path, *options(root)) as (side, _, log):
        until(lambda: drives(side, log), "it drives")
        side.served.wait_for("Episode 0 is saved: timeout")
        resource.prlimit(side.served.pid, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
        until(lambda: drives(side, log), "it drives again")
        side.served.wait_for("Recording has ended, the robot goes on. ")
        assert "file-size limit" in side.served.text
        until(lambda: drives(side, log), "it drives without a recording")
        assert side.served.stop() == 0
    assert data.main(["repair", str(root)]) == 0
    assert once(episodes(root)) == [("timeout", False)]


@pytest.mark.parametrize(
    ("given", "error"),
    [
        (["--record.root=/proc/none/dataset"], "/proc/none"),
        (["--record.root=data", "--record.task=''"], "record.task is empty"),
    ],
)
def test_a_recording_that_cannot_be_made_is_refused_before_the_robot_starts(
    given: list[str], error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert serve.main(of("turtlebot3", 0, *given)) == 2
    assert error in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []
