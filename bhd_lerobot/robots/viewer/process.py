"""The process of a viewer, which reads what a robot publishes and shows it.

Started by `Viewer` as a program of its own, ``python -m bhd_lerobot.robots.viewer.process``. It maps the robot's memory
for reading only and holds no lock: whatever becomes of it, the robot does not notice.
"""

import os
import signal
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np

from bhd_lerobot.bodies.scenes import scene_from_json
from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.robots.host.process import LiveSpec
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim.window import Window

_PERIOD_S = 1 / 60  # between two states that are shown
_NICENESS = 10  # what is watched comes first
_FIRST = np.zeros(1, np.intp)


def show_new(block: LiveBlock, simulation: Simulation, window: Window, seen: tuple[int, int]) -> tuple[int, int]:
    """Show what a robot has published since, if anything.

    Args:
        block: where the robot publishes.
        simulation: is put into what it publishes.
        seen: how many scenes and states there had been.

    Returns:
        How many there have been now.
    """
    scenes, text = block.scene
    states = len(block.ring)
    if (scenes, states) == seen:
        return seen
    if scenes != seen[0]:
        simulation.place(_FIRST, [scene_from_json(text)])
    state: Any = block.ring.latest()
    if state is not None:
        simulation.restore_physics(0, state["physics"][0])
    window.show()
    return scenes, states


def main() -> int:
    """Show a robot until the window is closed or the robot's process has ended; return the exit status."""
    connection = Connection(int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # keys of the terminal are for the brain's process
    os.nice(_NICENESS)

    def fail(message: str) -> NoReturn:
        connection.send(message)
        os._exit(1)

    threading.excepthook = lambda failed: fail(f"{failed.exc_type.__name__}: {failed.exc_value}")
    spec: LiveSpec = connection.recv()
    try:
        simulation: Simulation = spec.make_host()
        block = LiveBlock.watch(spec.block)
        window = Window(simulation.world)
    except BhdError as error:
        fail(str(error))
    connection.send("")
    seen = (0, 0)
    while window.is_open and not connection.poll(_PERIOD_S):  # the pipe's end is the end of the robot's process
        seen = show_new(block, simulation, window, seen)
    return 0


if __name__ == "__main__":
    sys.exit(main())
