"""What the real-time process of a real robot is made of."""

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from bhd_lerobot.realtime.loop import LoopLimits
from bhd_lerobot.realtime.privileges import RealtimeSettings
from bhd_lerobot.robots.arm_host import ArmHost
from bhd_lerobot.robots.base_host import BaseHost
from bhd_lerobot.robots.config import BhdRobotConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.host.host import Host
from bhd_lerobot.robots.host.link import _plain
from bhd_lerobot.robots.host.process import LiveSpec

PLANT = """
from bhd_lerobot.control.plant import Plant

class Standing(Plant):
    n = 1
    def __init__(self, config, body): self.position, self.sensors = body.home if hasattr(body, "home") else 0.0, 1.0
    def read(self, out): out.position[0], out.sensors[0] = self.position, self.sensors
    def write(self, ctrl): pass
"""
RUN = """
import pickle, sys
import bhd_lerobot.robots.host.process as process
sys.path.insert(0, sys.argv[1])
spec = pickle.loads(sys.stdin.buffer.read())
plant = spec.make_plant()
host = spec.make_host(plant)
plant.read(host.cerebellum.reading)
host.observe(), host.truth(), host.step(None)
print(sorted({"torch", "lerobot", "mujoco"} & set(sys.modules)))
"""


@pytest.mark.parametrize(
    ("config", "host"),
    [
        (UR5Config(), ArmHost),
        (UR5Config(control="impedance", action_space="tool"), ArmHost),
        (TurtleBot3Config(imu=True), BaseHost),
    ],
)
def test_the_process_of_a_real_robot_needs_neither_torch_nor_lerobot_nor_mujoco(
    config: BhdRobotConfig, host: type[Host], tmp_path: Path
) -> None:
    (tmp_path / "standing.py").write_text(PLANT, encoding="utf-8")
    spec = LiveSpec(
        host=f"{host.__module__}:{host.__qualname__}",
        plant="standing:Standing",
        values=_plain(config),
        rates=config.rates,
        body=config.body(),
        block="",
        privileges=RealtimeSettings(),
        limits=LoopLimits(),
    )
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path)], input=pickle.dumps(spec), capture_output=True, check=False
    )
    assert done.stdout.decode().strip() == "[]", done.stderr.decode()
