"""An SO-101 that LeRobot's own driver finds on a simulated bus, see `tests/robots/feetech_double`."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from lerobot.robots.so_follower import SO101FollowerConfig

from bhd_lerobot.robots.config_arm import SO101Config
from tests.robots.host.support import relaxed

DOUBLE = Path(__file__).resolve().parents[1] / "feetech_double"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
STEPS = 4095 / 6.283185307179586  # of an encoder, for each radian
RANGES = ((-1.92, 1.92), (-1.745, 1.745), (-1.69, 1.69), (-1.658, 1.658), (None, None), (-0.1745, 1.745))  # [rad]
START = (0.1, -1.0, 0.6, 1.2, -0.5, 0.3)  # [rad]


class Bus:
    """The file that stands for a port, and the calibration of what is on it."""

    def __init__(self, folder: Path) -> None:
        self.port, self.calibration = folder / "bus", folder / "calibration"
        self.change()
        self.calibration.mkdir()
        motors = {}
        for number, (name, ends) in enumerate(zip(JOINTS, RANGES, strict=True)):
            low, high = (0, 4095) if ends[0] is None else (2048 + round(end * STEPS) for end in ends)
            motors[name] = {"id": number + 1, "drive_mode": 0, "homing_offset": 0, "range_min": low, "range_max": high}
        (self.calibration / "arm.json").write_text(json.dumps(motors))

    def change(self, **about: Any) -> None:
        """State what the arm on the bus is, see the double."""
        self.port.write_text(json.dumps({"start": START, **about}))

    @property
    def fault(self) -> Path:
        """While this file exists, the bus answers nothing."""
        return Path(f"{self.port}.fault")

    @property
    def goals(self) -> list[dict[str, int]]:
        """The goals that were sent, in encoder steps by the motor's number."""
        log = Path(f"{self.port}.log")
        return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []

    @property
    def is_on(self) -> bool:
        """Whether the motors were switched on last."""
        return Path(f"{self.port}.torque").read_text() == "1"

    def device(self, **options: Any) -> SO101FollowerConfig:
        values = {"port": str(self.port), "id": "arm", "calibration_dir": self.calibration, **options}
        return SO101FollowerConfig(**values)

    def config(self, device: Any = None, **options: Any) -> SO101Config:
        realtime = relaxed(plant_timeout_s=5.0)
        return SO101Config(plant="lerobot", device=device or self.device(), realtime=realtime, **options)


@pytest.fixture
def bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bus:
    folders = [str(DOUBLE), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    return Bus(tmp_path)
