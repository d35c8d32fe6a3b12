"""`bhd-record` with a robot and a teleoperator of another package."""

import io
import json
import math
import os
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.cli.record import main
from bhd_lerobot.control.messages import Limit, Mode
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import ConfigError, DatasetError, RealtimeError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.lock import RobotLock
from bhd_lerobot.rollout.progress import FAULT_STATUS
from bhd_lerobot.rollout.replay.on_robot import replay_on_robot
from tests.forks import Fork
from tests.recording.support import saved
from tests.robots.external.mock_devices import MockArm
from tests.waiting import until

CAMERAS = "{front: {type: mock_camera}, wrist: {type: mock_camera}}"


def options(root: Path, **overrides: object) -> list[str]:
    values: dict[str, object] = {
        "robot.type": "mock_arm",
        "robot.cameras": CAMERAS,
        "robot.port": root,
        "robot.calibration_dir": root.parent / "calibration",
        "teleop.type": "mock_leader",
        "teleop.calibration_dir": root.parent / "calibration",
        "task.instruction": "wave",
        "task.duration_s": 0.5,
        "dataset.root": root,
        "dataset.num_episodes": 2,
        "output_dir": root.parent / f"{root.name}_run",
        **{key.replace("__", "."): value for key, value in overrides.items()},
    }
    return [f"--{key}={value}" for key, value in values.items() if value is not None]


def run(root: Path, **overrides: object) -> tuple[RecordResult, str]:
    console = Console(file=io.StringIO(), width=200)
    result = record(parse(RecordConfig, options(root, **overrides)), console)
    return result, console.file.getvalue()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one episode, which is only read."""
    root = tmp_path_factory.mktemp("recorded") / "d"
    run(root, dataset__num_episodes=1)
    return root


def test_requested_and_applied_actions_times_and_images_of_every_device(tmp_path: Path) -> None:
    result, text = run(tmp_path / "d", teleop__amplitude=200, gate__max_change=8)
    assert result.exit_status == 0
    assert "not promised" in text
    info = dataset_info(tmp_path / "d")
    assert (len(info.episodes), info.robot_type) == (2, "mock_arm")
    assert check_dataset(tmp_path / "d").is_valid
    columns = read_episode(tmp_path / "d", 0)
    asked, applied = np.stack(columns["action"]), np.stack(columns["control.applied_action"])
    assert np.abs(asked).max() > 100
    assert np.abs(applied).max() <= 90  # the robot's own range, which `send_action` returns
    assert (np.asarray(columns["control.limits"]) & Limit.VELOCITY).any()
    assert np.stack(columns["control.image_age"]).shape == (info.episodes[0].frames, 2)
    assert info.episodes[0].frames <= 15  # fewer where a busy machine skips a frame: a take lasts as long as it says
    assert set(columns["control.mode"]) <= {Mode.HOLD, Mode.TRACKING}
    time_s = np.asarray(columns["control.time"], np.float64)
    assert (np.diff(time_s) > 0).all()
    about = json.loads(info.episodes[0].metadata["brain"])
    assert about == {"type": "teleop", "teleop": "mock_leader"}
    # Where a robot is connected is not what it is.
    assert "port" not in json.dumps(info.recording)
    assert "calibration" not in json.dumps(info.recording)


def test_stock_lerobot_reads_it_and_it_is_continued(recorded: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    shutil.copytree(recorded, tmp_path / "d")
    result, _ = run(tmp_path / "d", resume="true", robot__port="/dev/other")
    assert result.recorded == 1
    dataset = LeRobotDataset("local/d", root=tmp_path / "d", video_backend="pyav")
    assert dataset.num_episodes == 2
    assert dataset[0]["observation.images.front"].shape == (3, 48, 64)


def test_a_processor_stands_between(tmp_path: Path) -> None:
    run(tmp_path / "d", dataset__num_episodes=1, processor="tests.robots.external.processors:halved")
    columns = read_episode(tmp_path / "d", 0)
    assert np.abs(np.stack(columns["action"])).max() <= 10.0 + 1e-6


FAULTS: dict[str, dict[str, Any]] = {
    "the camera was unplugged": {"robot__cameras": "{front: {type: mock_camera, fail_after: 15}}"},
    "the teleoperator mock_leader failed: ConnectionError": {"teleop__fault": "raises"},
    "The teleoperator gave no 'elbow.pos'": {"teleop__fault": "missing key"},
}


@pytest.mark.parametrize("words", FAULTS)
def test_a_fault_ends_the_run_and_what_was_recorded_is_saved(tmp_path: Path, words: str) -> None:
    result, text = run(tmp_path / "d", task__duration_s=3, **FAULTS[words])
    assert result.exit_status == FAULT_STATUS
    assert words in text
    (episode,) = dataset_info(tmp_path / "d").episodes
    assert episode.metadata["outcome"] == "fault"
    assert check_dataset(tmp_path / "d").is_valid
    assert 2 <= episode.frames < 60


def test_a_silent_teleoperator_lets_the_robot_hold_and_then_ends_the_episode(tmp_path: Path) -> None:
    limits = {"gate__brain_timeout_s": 0.1, "gate__end_timeout_s": 0.5}
    result, text = run(tmp_path / "d", task__duration_s=5, teleop__fault="silent", **limits)
    assert result.exit_status == FAULT_STATUS
    assert "no action for" in text
    columns = read_episode(tmp_path / "d", 0)
    assert Mode.HOLD in set(columns["control.mode"])


def test_a_teleoperator_that_gives_nan_moves_nothing(tmp_path: Path) -> None:
    run(tmp_path / "d", dataset__num_episodes=1, teleop__fault="nan", teleop__fault_at=1)
    columns = read_episode(tmp_path / "d", 0)
    applied = np.stack(columns["control.applied_action"])
    assert np.isfinite(applied).all()
    assert (applied[:, 1] == 0).all()
    # A frame that goes by while the machine is busy has no action.
    flagged = np.asarray(columns["control.limits"])[1:-1] & Limit.NON_FINITE != 0
    assert flagged.mean() > 0.5


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"robot__fault": "no connection"}, "'mock_arm' cannot be connected: ConnectionError: there is no such port"),
        ({"task__type": "avoid", "task__instruction": None}, "task.type is 'avoid'.*--task.type=free"),
        ({"brain__type": "avoidance"}, "brain.type is 'avoidance'.*robot.type is 'mock_arm'"),
        ({"teleop__type": None, "teleop__calibration_dir": None}, "--brain.type, or --teleop.type"),
        ({"teleop__type": "mock_ledger"}, "mock_ledger.*mock_leader"),
        ({"robot__type": "mock_arms"}, "mock_arms.*mock_arm"),
        ({"map__elbow.pos": "elbow"}, "elbow.*elbow.pos"),
        ({"processor": "nowhere:f"}, "processor is 'nowhere:f', which cannot be imported"),
        ({"gate__range__wrist": "[0, 1]"}, "wrist.*elbow.pos"),
        ({"map__elbow.pos": "elbow.pos", "processor": "a:b"}, "leave one of them out"),
        ({"robot__type": "turtlebot3", "robot__cameras": None, "robot__port": None}, "robot.clock=realtime"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(tmp_path: Path, overrides: dict[str, Any], message: str) -> None:
    with pytest.raises((ConfigError, RealtimeError), match=message):
        run(tmp_path / "d", **overrides)
    assert not (tmp_path / "d").exists()


def test_lerobots_own_robots_and_teleoperators_are_imported_when_they_are_asked_for() -> None:
    arguments = [
        "--robot.type=so101_follower",
        "--robot.port=/dev/null",
        "--task.instruction=wave",
        "--teleop.type=so101_leader",
        "--teleop.port=/dev/null",
    ]
    cameras = "--robot.cameras={front: {type: opencv, index_or_path: 0, width: 640, height: 480, fps: 30}}"
    config = parse(RecordConfig, [*arguments, "--dataset.root=data", cameras])
    assert config.robot.type in ("so100_follower", "so101_follower")  # one class with two names
    assert config.robot.cameras["front"].width == 640
    assert config.brain.teleop.type in ("so100_leader", "so101_leader")


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_costs_at_most_the_running_episode(tmp_path: Path, number: signal.Signals) -> None:
    root = tmp_path / "d"
    plugin = "--robot.discover_packages_path=tests.robots.external.mock_devices"
    arguments = [plugin, *options(root, dataset__num_episodes=50)]
    process = Fork(main, arguments, output=tmp_path / "log")
    until(lambda: saved(root) >= 2 or process.poll() is not None, "two episodes are saved")
    os.kill(process.pid, number)
    until(lambda: process.poll() is not None, "it has ended")
    result, _ = run(root, resume="true", dataset__num_episodes=saved(root) + 1)
    assert result.exit_status == 0
    assert check_dataset(root).is_valid
    assert math.isfinite(result.wall_s)


def test_a_replay_sends_the_recorded_actions_through_the_gate(recorded: Path, tmp_path: Path) -> None:
    actions = np.stack(read_episode(recorded, 0)["action"])
    config = parse(RecordConfig, options(tmp_path / "other", robot__log=tmp_path / "log"))
    console = Console(file=io.StringIO(), width=120)
    replay_on_robot(recorded, 0, config.robot, GateConfig(max_change=50.0), console)
    sent = np.loadtxt(tmp_path / "log")
    np.testing.assert_array_equal(sent, actions)
    assert "elbow.pos" in console.file.getvalue()
    with pytest.raises(ConfigError, match=r"gate.max_change is not set"):
        replay_on_robot(recorded, 0, config.robot, GateConfig(), console)
    for change in ({"elbow.pos": 50.0}, {}):
        with pytest.raises(ConfigError, match=r"gate.max_change does not limit shoulder.pos, .*would jump"):
            replay_on_robot(recorded, 0, config.robot, GateConfig(max_change=change), console)
    assert len(np.loadtxt(tmp_path / "log")) == len(sent)


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
def test_a_press_while_a_replay_connects_its_robot_moves_nothing(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    connect = MockArm.connect

    def pressed(self: MockArm, calibrate: bool = True) -> None:
        os.kill(os.getpid(), number)
        connect(self)

    before = signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # as a command that starts leaves it to nobody
    try:
        monkeypatch.setattr(MockArm, "connect", pressed)
        robot = parse(RecordConfig, options(tmp_path / "other", robot__log=tmp_path / "log")).robot
        with pytest.raises(RealtimeError, match=f"stopped after .* frames: .*{number.name}"):
            replay_on_robot(recorded, 0, robot, GateConfig(max_change=90.0), Console(file=io.StringIO()))
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert not (tmp_path / "log").exists()


def rewrite(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info["features"])
    path.write_text(json.dumps(info))


def test_a_replay_is_by_name_and_in_the_recorded_units_or_is_refused_before_anything_moves(
    recorded: Path, tmp_path: Path
) -> None:
    actions = np.stack(read_episode(recorded, 0)["action"])
    log, number = tmp_path / "log", iter(range(9))

    def replay(change: Callable[[dict[str, Any]], object], **overrides: object) -> str:
        root = Path(shutil.copytree(recorded, tmp_path / f"copy{next(number)}"))
        rewrite(root, change)
        robot = parse(RecordConfig, options(tmp_path / "other", robot__log=log, **overrides)).robot
        console = Console(file=io.StringIO(), width=120)
        replay_on_robot(root, 0, robot, GateConfig(max_change=90.0), console)
        return console.file.getvalue()

    for refused, message in (
        (lambda features: features["action"].update(names=None), "not named one by one"),
        (lambda features: features["action"].update(names=["actions"]), "not named one by one"),
        (lambda features: features["action"].update(names=["a", "b", "c"]), "are a, b, c; those of mock_arm are"),
    ):
        with pytest.raises(DatasetError, match=message):
            replay(refused)
    with pytest.raises(ConfigError, match=r"robot.use_degrees = true, and it is false.*--robot.use_degrees=true"):
        replay(lambda features: None, robot__use_degrees="false")
    assert not log.exists()
    dictionary = replay(lambda features: features["action"].update(names={"motors": features["action"]["names"]}))
    np.testing.assert_array_equal(np.loadtxt(log), actions)
    assert "elbow.pos" in dictionary
    log.unlink()
    assert "nothing is compared" in replay(lambda features: features["observation.state"].update(names=None))
    log.unlink()
    replay(lambda features: [features[key]["names"].reverse() for key in ("action", "observation.state")])
    np.testing.assert_array_equal(np.loadtxt(log), actions[:, ::-1])


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_replay_and_lets_go_of_the_robot(
    recorded: Path, tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = parse(RecordConfig, options(tmp_path / "other"))
    ended = []
    send, disconnect = MockArm.send_action, MockArm.disconnect

    def interrupted(self: MockArm, action: dict[str, Any]) -> dict[str, Any]:
        if self.sent == 3:
            assert signal.getsignal(number) not in (signal.SIG_DFL, signal.default_int_handler)
            os.kill(os.getpid(), number)
        return send(self, action)

    def let_go(self: MockArm) -> None:
        ended.append(self.sent)
        disconnect(self)

    monkeypatch.setattr(MockArm, "send_action", interrupted)
    monkeypatch.setattr(MockArm, "disconnect", let_go)
    console = Console(file=io.StringIO(), width=120)
    with pytest.raises(RealtimeError, match=rf"stopped after \d+ of \d+ frames: {number.name}") as stopped:
        replay_on_robot(recorded, 0, config.robot, GateConfig(max_change=50.0), console)
    assert stopped.value.exit_status == 128 + number
    assert ended
    assert ended[0] < 15


def test_two_programs_do_not_use_one_robot(tmp_path: Path) -> None:
    config: Any = parse(RecordConfig, options(tmp_path / "d", robot__id="shared")).robot
    with RobotLock(config):
        with pytest.raises(RealtimeError, match=rf"mock_arm .*is used by process {os.getpid()}"):
            run(tmp_path / "d", robot__id="shared")
        with pytest.raises(RealtimeError, match="is used by process"):  # a port is one robot, whatever it is called
            run(tmp_path / "d", robot__id="renamed")
        run(tmp_path / "other", robot__id="another", dataset__num_episodes=1)
    run(tmp_path / "again", robot__id="shared", dataset__num_episodes=1)


def test_a_rate_that_the_robot_does_not_keep_is_said_with_the_one_that_it_does(tmp_path: Path) -> None:
    _, text = run(tmp_path / "d", dataset__num_episodes=1, robot__read_s=0.05, task__duration_s=2)
    found = re.search(r"keeps about (\d+) of the 30 frames a second", text)
    assert found, text
    assert int(found[1]) <= 20
