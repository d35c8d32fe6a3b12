"""LeRobot's SO-101 arm on a fake serial bus, recorded by `bhd-record`."""

from pathlib import Path

import numpy as np
import pytest
from lerobot.motors import MotorCalibration
from lerobot.robots.so_follower import SO101Follower

from bhd_lerobot.datasets.format.columns import read_episode
from bhd_lerobot.datasets.format.summary import dataset_info
from tests.robots.external import mock_devices  # noqa: F401  registers them
from tests.robots.external.test_record import run
from tests.robots.fake_feetech import HIGH, LOW, so101

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def test_it_is_recorded_within_its_calibrated_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, made = so101(tmp_path, monkeypatch)

    def load(self: SO101Follower) -> None:
        self.calibration = {name: MotorCalibration(number, 0, 0, LOW, HIGH) for number, name in enumerate(JOINTS, 1)}

    monkeypatch.setattr(SO101Follower, "_load_calibration", load)
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "arm.json").touch()
    mapped = {f"map__{joint}.pos": "{from: elbow.pos, scale: 20}" for joint in JOINTS}
    options = {"robot__port": "/dev/none", "robot__id": "arm", "robot__cameras": None}
    result, text = run(tmp_path / "d", robot__type="so101_follower", dataset__num_episodes=1, **options, **mapped)
    assert result.exit_status == 0
    assert "range: 6 of 6 actions limited" in text
    assert dataset_info(tmp_path / "d").robot_type == SO101Follower.name  # as LeRobot's own recorder writes it
    columns = read_episode(tmp_path / "d", 0)
    asked, applied = np.stack(columns["action"]), np.stack(columns["control.applied_action"])
    assert np.abs(asked).max() > 100
    half = (HIGH - LOW) / 2 * 360 / 4095
    assert np.abs(applied[:, :5]).max() <= half + 1e-3
    assert (applied[:, 5] >= 0).all()
    assert (applied[:, 5] <= 100).all()
    wire = np.array([list(goal.values()) for bus in made for goal in bus.goals])
    assert LOW - 1 <= wire.min() <= wire.max() <= HIGH + 1
