"""The arm of `examples/network_arm`: a plant that is no simulation of ours, in a process of its own."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bhd_lerobot.cli import record
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import DatasetError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Word
from bhd_lerobot.rollout.replay.simulated import Replay
from tests.forks import Fork
from tests.waiting import until

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "network_arm"
PATIENT = ["--robot.realtime.plant_timeout_s=1.0", "--robot.realtime.most_misses=1000000"]
# What a recorder says that a loaded machine kept from running for longer than `PATIENT`: it is started again.
STALLED = r"newest reading is \d+\.\d\d s old|has published nothing for|rad from its reference"
ALONE = r"""
import json, sys
from lerobot_robot_network_arm import NetworkArmConfig, NetworkArm
from bhd_lerobot import Mode, RealtimeConfig, check_robot
from bhd_lerobot.errors import BhdError, CommandRefusedError

def make(address=sys.argv[1]):
    realtime = RealtimeConfig(plant_timeout_s=1.0, most_misses=1_000_000)
    return NetworkArm(NetworkArmConfig(address=address, realtime=realtime))

print(json.dumps({"findings": check_robot(make)}), flush=True)
robot = make()
robot.connect()
print(json.dumps({"heavy": robot.host.link.about["heavy"]}), flush=True)
for line in sys.stdin:  # drives for as long as it is asked to
    start = robot.get_observation()
    action = {name: start[name] for name in robot.action_features}
    action["wrist_3.pos"] += 0.02
    try:
        robot.send_action(action)
        refused = ""
    except CommandRefusedError as error:
        refused = str(error)
    if line.strip() == "reset":
        try:
            robot.reset()
            robot.activate()
        except CommandRefusedError as error:
            refused = str(error)
    mode = Mode(int(robot.host.modes[0])).name
    print(json.dumps({"mode": mode, "refused": refused, "at": start["wrist_3.pos"]}), flush=True)
robot.disconnect()
try:
    make("127.0.0.1:9").connect()
except BhdError as error:
    print(json.dumps({"unreachable": str(error)}), flush=True)
"""


class Arm:
    """The arm's process."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, str(EXAMPLE / "network_arm.py"), "--port=0", "--watchdog=1.0", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().split()[-1]

    def signal(self, number: int) -> None:
        self.process.send_signal(number)


@pytest.fixture
def arms() -> Iterator[Callable[[], Arm]]:
    """Yield what starts another arm; all are killed at the end."""
    started: list[Arm] = []

    def start() -> Arm:
        started.append(Arm())
        return started[-1]

    yield start
    for arm in started:
        arm.process.kill()
        arm.process.wait()


@pytest.fixture
def network_arm(arms: Callable[[], Arm]) -> Arm:
    return arms()


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let processes find the example as if it were installed; return where it is, for those that are forked."""
    about = tmp_path / "site" / "lerobot_robot_network_arm-0.1.0.dist-info" / "METADATA"
    about.parent.mkdir(parents=True)
    about.write_text("Metadata-Version: 2.1\nName: lerobot_robot_network_arm\nVersion: 0.1.0\n", encoding="utf-8")
    folders = [str(EXAMPLE), str(tmp_path / "site")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    return folders


def start(program: Callable[..., Any], folders: list[str], arguments: list[str], output: Path) -> Fork:
    """Run a command in a process that finds the example."""
    return Fork(_find_and_run, program, folders, arguments, output=output)


def _find_and_run(program: Callable[..., Any], folders: list[str], arguments: list[str]) -> Any:
    sys.path[:0] = folders
    return program(arguments)


def record_with_lerobot(arguments: list[str]) -> None:
    from lerobot.scripts.lerobot_record import main

    sys.argv[1:] = arguments
    main()


def recording(arm: Arm, root: Path, *options: str) -> list[str]:
    return [
        "--robot.type=network_arm",
        *(f"--robot.address={arm.address}", *PATIENT, "--task.type=reach", "--brain.type=reach"),
        *("--dataset.repo_id=me/arm", f"--dataset.root={root}", f"--output_dir={root}-run", *options),
    ]


def test_it_is_recorded(arms: Callable[[], Arm], installed: list[str], tmp_path: Path) -> None:
    for number in itertools.count():
        root, output = tmp_path / f"data_{number}", tmp_path / f"output_{number}"
        if start(record.main, installed, recording(arms(), root, "--dataset.num_episodes=2"), output).wait() == 0:
            break
        assert re.search(STALLED, " ".join(output.read_text().split())), output.read_text()
    assert check_dataset(root).is_valid
    with pytest.raises(DatasetError, match="not simulated, by the plant network_arm:NetworkPlant"):
        Replay(root, 0)


def test_its_death_ends_the_episode_with_the_reason(arms, installed, tmp_path):
    # The time is over before the tool has been at the target for so long: the next episode goes on until it is ended.
    longer = ("--task.hold_s=500", "--task.duration_s=600", "--task.start_spread_rad=0", "--dataset.num_episodes=2")
    for number in itertools.count():
        arm, root, name = arms(), tmp_path / f"data_{number}", f"dies_{number}"
        output = tmp_path / f"output_{number}"
        process = start(record.main, installed, [*recording(arm, root, *longer), f"--robot.id={name}"], output)
        if is_killed := _runs(process, name):
            arm.signal(signal.SIGKILL)
        status, said = process.wait(), " ".join(output.read_text().split())
        if is_killed and "rad from its reference" not in said:  # a slow arm, which was stopped before it was killed
            break
        assert re.search(STALLED, said), said
    assert status == 4, said
    assert re.search(r"stopped by a fault: its newest reading is \d+\.\d\d s old", said), said
    assert check_dataset(root).is_valid
    info = dataset_info(root)
    assert [episode.metadata["outcome"] for episode in info.episodes] == ["fault"]
    columns = read_episode(root, 0)
    assert len(columns[keys.MODE]) > 40
    assert columns[keys.MODE][-1] == Mode.FAULT
    assert keys.PHYSICS_STATE not in info.features
    assert info.features[keys.EFFORT]["names"][0] == "shoulder_pan.effort"
    assert "address" not in info.recording["robot"]  # which is nobody else's business


def _runs(process: Fork, name: str) -> bool:
    """Wait until a recorder's first episode runs; return False if the recorder ended before."""
    block = until(lambda: _block(name) or process.poll() is not None, "its block is there, or it ended")
    if block is True:
        return False
    until(
        lambda: (
            (block.words[Word.SEGMENT] >= 2 and block.ring.latest()["executed"] > 250) or process.poll() is not None
        ),
        "the first episode runs, or it ended",
    )
    block.close()
    return process.poll() is None


def _block(name: str) -> Any:
    try:
        return LiveBlock.watch(name)
    except RealtimeError:
        return None


@pytest.mark.thorough
@pytest.mark.usefixtures("installed")
def test_it_is_a_robot_that_is_stopped_frozen_and_driven_again(network_arm: Arm) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", ALONE, network_arm.address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    lines, answers = process.stdin, process.stdout
    assert json.loads(answers.readline()) == {"findings": []}
    assert json.loads(answers.readline()) == {"heavy": []}

    def drive(word: str = "") -> dict[str, Any]:
        lines.write(f"{word}\n")
        lines.flush()
        answer: dict[str, Any] = json.loads(answers.readline())
        return answer

    def drive_until(mode: Mode, word: str = "") -> dict[str, Any]:
        return until(lambda: answer if (answer := drive(word))["mode"] == mode.name else None, mode.name)  # type: ignore[no-any-return]

    first = drive()["at"]
    until(lambda: drive()["at"] > first + 0.05, "it moves")
    # Its own emergency stop, pressed and released.
    network_arm.signal(signal.SIGUSR1)
    drive_until(Mode.ESTOP)
    assert "emergency stop" in drive()["refused"].lower()
    network_arm.signal(signal.SIGUSR1)
    drive_until(Mode.TRACKING, "reset")
    # It freezes: readings grow old, and it has stopped by itself by the time it is back.
    network_arm.signal(signal.SIGSTOP)
    frozen = drive_until(Mode.FAULT)["at"]
    network_arm.signal(signal.SIGCONT)
    again = drive_until(Mode.TRACKING, "reset")["at"]
    assert abs(again - frozen) < 0.1
    until(lambda: drive()["at"] > again + 0.05, "it moves")
    lines.close()
    unreachable = json.loads(answers.readline())["unreachable"]
    assert re.search(r"The plant network_arm:NetworkPlant cannot be opened: TimeoutError: no arm answers", unreachable)
    assert process.wait() == 0


def test_the_stock_recorder_drives_it(network_arm: Arm, installed: list[str], tmp_path: Path) -> None:
    arguments = [
        *("--robot.type=network_arm", f"--robot.address={network_arm.address}"),
        *(option for option in PATIENT if "most" not in option),
        *("--teleop.type=bhd_brain", "--teleop.brain.type=noop", "--dataset.repo_id=me/arm", "--dataset.fps=25"),
        *(f"--dataset.root={tmp_path / 'data'}", "--dataset.num_episodes=1", "--dataset.episode_time_s=2"),
        *("--dataset.reset_time_s=0", "--dataset.push_to_hub=false", "--dataset.single_task=nothing"),
        *("--play_sounds=false", "--dataset.video=false"),
    ]
    process = start(record_with_lerobot, installed, arguments, tmp_path / "output")
    assert process.wait() == 0, (tmp_path / "output").read_text()[-2000:]
    assert dataset_info(tmp_path / "data").frames > 10
