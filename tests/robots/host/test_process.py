"""What the real-time process of a real robot is made of."""

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

from bhd_lerobot.robots.config import BhdRobotConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.checked_plant import Unconnected
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.process import LiveSpec

PLANT = """
from bhd_lerobot.control.plant import Plant

class Standing(Plant):
    n = 1
    def __init__(self, config, body): self.position, self.sensors = body.arm.home if body.arm else 0.0, 1.0
    def read(self, out): out.position[0], out.sensors[0] = self.position, self.sensors
    def write(self, ctrl): pass
"""
RUN = """
import pickle, sys
import bhd_lerobot.robots.host.process as process
sys.path.insert(0, sys.argv[1])
for spec in pickle.loads(sys.stdin.buffer.read()):
    plant = spec.make_plant()
    host = spec.make_host(plant)
    plant.read(host.cerebellum.reading)
    host.observe(), host.truth(), host.step(None)
print({"torch", "lerobot", "mujoco"} & set(sys.modules))
import bhd_lerobot.robots.parts.simulated_arm, bhd_lerobot.robots.parts.simulated_drive
print({"torch", "lerobot"} & set(sys.modules))
"""


STANDING: Any = {"plant": "standing:Standing", "clock": "realtime"}


def spec_of(config: BhdRobotConfig) -> LiveSpec:
    return LiveSpec.of(Host(config, Unconnected()), block="")


def test_processes_need_neither_torch_nor_lerobot_and_that_of_a_real_robot_no_mujoco(tmp_path: Path) -> None:
    (tmp_path / "standing.py").write_text(PLANT, encoding="utf-8")
    specs = [
        spec_of(UR5Config(**STANDING)),
        spec_of(UR5Config(control="impedance", action_space="tool", **STANDING)),
        spec_of(TurtleBot3Config(imu=True, **STANDING)),
    ]
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path)], input=pickle.dumps(specs), capture_output=True, check=False
    )
    assert done.stdout.decode().split() == ["set()"] * 2, done.stderr.decode()
