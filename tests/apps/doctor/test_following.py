"""How late a robot follows its commands, by what was recorded of it."""

import re

import numpy as np
import pytest

from bhd_lerobot.apps.doctor.following import following_latency
from bhd_lerobot.cli.doctor import main
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder


def drive(latency: float, motor: float, fps: int, seed: int = 0, seconds: float = 20.0):
    """Return times, commands that are held for a frame each, and speeds, of a base with a dead time and a motor."""
    rng, fine = np.random.default_rng(seed), 1000
    times = np.arange(round(seconds * fps)) / fps
    commands = np.repeat(rng.uniform(-0.2, 0.2, len(times) // fps + 1), fps)[: len(times)]
    speed, speeds = 0.0, []
    for tick in range(round(seconds * fine)):
        sent = tick / fine - latency
        wanted = commands[min(int(sent * fps + 1e-9), len(commands) - 1)] if sent >= 0 else commands[0]
        if tick % round(fine / fps) == 0:
            speeds.append(speed)
        speed = wanted if not motor else speed + (wanted - speed) / fine / motor
    return times, commands, np.array(speeds)[: len(times)]


@pytest.mark.parametrize("latency", [0.0, 0.1, 0.25, 0.5])
@pytest.mark.parametrize("motor", [0.0, 0.1])
@pytest.mark.parametrize("fps", [10, 25])
def test_it_is_measured_to_within_a_frame(latency: float, motor: float, fps: int) -> None:
    """With the motor's time constant; a command that is recorded at a frame's beginning acts up to a frame later."""
    found = following_latency(*drive(latency, motor, fps))
    assert found == pytest.approx(latency + motor, abs=1.01 / fps)


@pytest.mark.parametrize(
    "observed", [np.zeros(200), np.random.default_rng(0).normal(0, 0.1, 200)], ids=["still", "noise"]
)
def test_what_does_not_follow_shows_no_latency(observed: np.ndarray) -> None:
    times, commands, _ = drive(0.1, 0.1, 10)
    assert following_latency(times, commands, observed) is None


def test_the_doctor_proposes_the_option(tmp_path, capsys) -> None:
    vector = {"dtype": "float32", "shape": (1,), "names": ["x.vel"]}
    keys = ("observation.state", "action", "control.applied_action")
    features = dict.fromkeys(keys, vector) | {"control.time": {"dtype": "float64", "shape": (1,), "names": None}}
    with DatasetRecorder.create("t/t", 10, features, robot_type="turtlebot3", root=tmp_path / "d") as recorder:
        times, commands, speeds = drive(0.2, 0.0, 10)
        writer, columns = recorder.begin_episode(), (speeds, commands, commands)
        numbers = {key: one[:, None].astype(np.float32) for key, one in zip(keys, columns, strict=True)}
        writer.set_columns(numbers | {"control.time": times})
        recorder.save(writer, task="drive", metadata={})
    assert main([f"--dataset={tmp_path / 'd'}"]) == 0
    printed = capsys.readouterr().out
    found = re.search(r"follows its commands after (.*?) s, .*--robot.ros2.latency_s=(.*)", printed)
    assert found
    assert float(found[1]) == pytest.approx(0.2, abs=0.11)
    assert float(found[2]) == pytest.approx(1.25 * float(found[1]), abs=0.01)
    assert main([f"--dataset={tmp_path / 'none'}"]) != 0
