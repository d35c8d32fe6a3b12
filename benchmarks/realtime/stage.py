"""What all loops of the benchmark step: the UR5 of the pick task, with the objects of one scene on its table.

Needs neither torch nor LeRobot, so that the loops' processes can use it.
"""

from types import SimpleNamespace

import numpy as np

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.tasks.pick import PickConfig, PickTask

SEED = 1  # of every scene
HZ = 1000
FPS = 25
_SETTLING_FRAMES = 5


def pick_scene(fps: int = FPS) -> TableScene:
    """Return the scene."""
    return PickTask(PickConfig(), 1, fps).sample(SEED)


def settled_robot(hz: int = HZ) -> UR5Simulation:
    """Return the robot in the scene, holding its posture; what stands on the table has settled.

    Args:
        hz: physics steps and control ticks a second [Hz].
    """
    body, rates = ur5(), Rates(hz, hz, FPS)
    values = {"control": "servo", "action_space": "joint", "tool_pose": False, "camera": False}
    values |= {"physics_hz": hz, "control_hz": hz}
    config = SimpleNamespace(**values, fps=FPS, rates=rates, body=lambda: body, clock="lockstep")
    simulation = UR5Simulation(config, 1, 1)  # type: ignore[arg-type]
    simulation.reset(np.zeros(1, np.intp), [pick_scene()], [SEED])
    for _ in range(_SETTLING_FRAMES):
        simulation.act(np.array([body.home]))
    return simulation
