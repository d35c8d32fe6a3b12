"""LeRobot's own `so101_follower` on a simulated bus, below our cerebellum."""

import io
import os
import pickle
import re
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.datasets.validate.dataset import check_dataset
from bhd_lerobot.errors import BhdError, CommandRefusedError
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.robots.arm import SO101
from bhd_lerobot.robots.config_arm import SO101Config
from bhd_lerobot.robots.device.plant import Channel, DeviceJob, DevicePlant, Word
from bhd_lerobot.robots.device.process import DeviceProcess
from tests.robots.device.support import JOINTS, START, STEPS, Bus
from tests.robots.device.support import bus as bus  # noqa: PLC0414
from tests.robots.external.mock_devices import MockArmConfig
from tests.robots.host.support import is_alive, mode
from tests.waiting import until


def refusal(device: Any, **units: Any) -> str:
    """Return why a device cannot be the plant of an SO-101."""
    options = SO101Config(plant="lerobot", device=device, units=units)
    config = SimpleNamespace(**options.plant_values(), rates=options.rates)
    plant = DevicePlant(config, options.body())
    try:
        plant.open()
        plant.enable()
    except BhdError as error:
        return str(error)
    finally:
        plant.close()
    return ""


def children(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def resets(robot: SO101) -> bool:
    try:
        robot.reset()
        robot.activate()
    except CommandRefusedError:
        return False
    return True


def test_it_follows_setpoints_and_goals_and_stops(bus: Bus) -> None:
    with SO101(bus.config(id="table")) as robot:
        [device] = [int(line) for line in children(robot.host.link.pid)]
        assert "speeds are the slopes" in " ".join(robot.host.notes)
        seen = robot.get_observation()
        wanted = [*START[:5], (START[5] + 0.1745) * 0.073 / (0.85 + 0.1745)]
        for joint, position in zip(JOINTS, wanted, strict=True):
            assert seen[f"{joint}.pos"] == pytest.approx(position, abs=0.1)  # without torque it sinks
        action = {name: seen[name] for name in robot.action_features} | {"shoulder_pan.pos": 0.4, "gripper.pos": 0.05}

        def arrives() -> bool:
            where = robot.get_observation()["shoulder_pan.pos"]
            # Not far ahead: on a busy machine the arm is late, and is not to seem blocked.
            robot.send_action(action | {"shoulder_pan.pos": where + np.clip(0.4 - where, -0.05, 0.05)})
            return bool(abs(where - 0.4) < 0.01)

        until(arrives, "the first joint is where it was sent")
        goals = (np.array([list(goal.values()) for goal in bus.goals])[:, :5] - 2048) / STEPS
        # It begins where it was read, and stays within its limits but for what carries the arm's weight.
        np.testing.assert_allclose(goals[0], START[:5], atol=0.2)
        limits = robot.body.limits
        assert (goals > np.array(limits.lower[:5]) - 0.12).all()
        assert (goals < np.array(limits.upper[:5]) + 0.12).all()
        until(lambda: mode(robot) == Mode.HOLD, "it holds")
        goal = BrainCommand("home", joint_target=robot.body.arm.home[:5], gripper=0.02, max_velocity=0.2)
        assert robot.host.bridge.submit(goal) is None
        [result] = until(robot.take_results, "the goal ends")
        assert result.success, result
        found = robot.get_observation()
        for joint, home in zip(JOINTS, robot.body.arm.home[:5], strict=False):
            assert found[f"{joint}.pos"] == pytest.approx(home, abs=0.03)
        robot.estop()
        until(lambda: mode(robot) == Mode.ESTOP, "it is stopped")
        with pytest.raises(CommandRefusedError, match="ESTOP"):
            robot.send_action(action)
        until(lambda: resets(robot), "it is at rest")
    until(lambda: not is_alive(device), "nothing of it is left")
    assert not bus.is_on  # at an orderly end the device's own options count


def test_reach_is_recorded_with_the_command_of_the_simulation(bus: Bus, tmp_path: Any) -> None:
    arguments = [
        *("--robot.type=so101", "--robot.plant=lerobot", "--robot.device.type=so101_follower", "--robot.device.id=arm"),
        *(f"--robot.device.port={bus.port}", f"--robot.device.calibration_dir={bus.calibration}"),
        *("--robot.realtime.plant_timeout_s=5.0", "--robot.realtime.most_misses=1000000"),
        *("--robot.realtime.brain_timeout_s=20", "--task.type=reach", "--task.duration_s=120", "--brain.type=reach"),
        "--brain.max_velocity=0.1",  # on a busy machine the arm is late by a second, and is not to seem blocked
        *(f"--dataset.root={tmp_path / 'd'}", f"--output_dir={tmp_path / 'run'}", "--dataset.num_episodes=1"),
    ]
    while True:
        console = Console(file=io.StringIO(), width=200)
        if record(parse(RecordConfig, arguments), console).exit_status == 0:
            break
        assert "rad from its" in console.file.getvalue()  # type: ignore[attr-defined]  the arm was later than that
        for folder in ("d", "run"):
            shutil.rmtree(tmp_path / folder, ignore_errors=True)
    assert check_dataset(tmp_path / "d").is_valid
    info = dataset_info(tmp_path / "d")
    assert (info.robot_type, info.episodes[0].metadata["outcome"]) == ("so101", "success")
    assert not {"device", "units"} & set(info.recording["robot"])  # where it is, and not what it is
    states = np.stack(read_episode(tmp_path / "d", 0)["observation.state"])
    assert np.ptp(states[:, :5], axis=0).max() > 0.05


def test_a_reading_that_is_lost_is_none_of_three_in_a_row_the_first_one_included(tmp_path: Path) -> None:
    ours, theirs = Pipe()
    device = MockArmConfig(id="lossy", calibration_dir=tmp_path, fault="disconnect", fault_at=2)
    channel = Channel(3)
    process = DeviceProcess(DeviceJob(pickle.dumps(device), 3, 100), channel, theirs)
    ours.send(["shoulder.pos", "elbow.pos", "gripper.pos"])
    process.connect()
    with ThreadPoolExecutor(1) as thread, closing(process):
        running = thread.submit(process.run)
        until(lambda: running.done() or len(channel.readings) > 3, "it goes on")
        channel.words[Word.END] = 1
        running.result()
    reading = channel.readings.latest()
    assert reading is not None
    assert reading["problem"] == b""


@pytest.mark.parametrize("victim", ["device", "cerebellum"])
def test_its_processes_may_die(bus: Bus, victim: str) -> None:
    with SO101(bus.config(id=f"without_{victim}")) as robot:
        cerebellum = robot.host.link.pid
        [device] = [int(line) for line in children(cerebellum)]
        until(lambda: bus.goals, "it is commanded")
        if victim == "device":
            os.kill(device, signal.SIGKILL)
            until(lambda: mode(robot) == Mode.FAULT, "its death is a fault")
            assert robot.host.is_lost
            assert "process of the device ended" in robot.host.problem
        else:
            bus.fault.touch()
            until(lambda: mode(robot) == Mode.FAULT, "its silence is a fault")
            assert "no status packet" in robot.host.problem
            os.kill(cerebellum, signal.SIGKILL)
    until(lambda: not is_alive(device), "nothing of it is left")
    assert bus.is_on


def test_shares_of_its_range_are_the_same_positions_for_one_program_at_a_time(bus: Bus) -> None:
    options = bus.config(bus.device(use_degrees=False))
    config, reading = SimpleNamespace(**options.plant_values(), rates=options.rates), PlantReading(1, 6)
    with closing(DevicePlant(config, options.body())) as plant:
        plant.open()
        plant.read(reading)
        assert "is used by process" in refusal(bus.device())
    np.testing.assert_allclose(reading.position[0, :5], START[:5], atol=0.1)
    assert not reading.has_effort


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda bus: bus.device(port=f"{bus.port}_not"), "cannot be connected: .*Check its power, its cable"),
        (lambda bus: bus.device(id="other"), "is not calibrated, .* run lerobot-calibrate"),
    ],
)
def test_a_device_that_is_not_this_arm_is_refused(make: Any, text: str, bus: Bus) -> None:
    found = refusal(make(bus))
    assert re.search(text, found), found


def test_a_calibration_that_home_does_not_fit_is_refused(bus: Bus) -> None:
    found = refusal(bus.device(), elbow_flex=[[0.0, 3.0], [90.0, 3.0 + np.pi / 2]])
    assert "elbow_flex of 'so100_follower' or 'so101_follower' 'arm' is calibrated from 1.31" in found
    assert "and home is 0.810, outside of that. Calibrate it" in found
    with pytest.raises(BhdError, match=r"robot\.units has 'hip', and the joints are shoulder_pan"):
        refusal(bus.device(), hip="deg")
