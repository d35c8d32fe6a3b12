"""`--view=true`: a simulated robot in MuJoCo's own viewer.

The viewer is a process of its own that reads what the robot publishes in shared memory. Nothing waits for it.
"""

import itertools
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from multiprocessing.connection import Connection
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.scenes import scene_to_json
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.programs import start_program
from bhd_lerobot.realtime.block import LiveBlock, LiveLayout
from bhd_lerobot.robots.host.process import LiveSpec
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.robots.host.robots import Robots
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim.window import require_display

_OPEN_S = 60.0  # that a window may take
_STATES = 4  # that can still be read; the newest is shown
_numbers = itertools.count()


def prepare_view(view: bool) -> None:
    """Raise if a robot is to be shown and cannot be, before it is made.

    Raises:
        ConfigError: there is no display.
    """
    if view:
        require_display()


@contextmanager
def viewed(robots: Robots, view: bool) -> Iterator[None]:
    """Show robots in a viewer until the end of the context, if `view` says so."""
    with closing(Viewer(robots)) if view else nullcontext():
        yield


class Viewer:
    """The viewer of simulated robots, of which it shows the first. Closing its window leaves the robots alone.

    Args:
        robots: the robots.

    Raises:
        RenderingError: no window can be opened.
    """

    def __init__(self, robots: Robots) -> None:
        self._own: LiveBlock | None = None
        self._lockstep: Simulation | None = None
        if isinstance(robots, LiveHost):
            mirror, block = cast(Simulation, robots), robots.link.block
        else:
            mirror = self._lockstep = cast(Simulation, robots)
            block = self._own = _publish(mirror)
        ours, theirs = socket.socketpair()
        with theirs:
            descriptor = theirs.fileno()
            self._process = start_program("bhd_lerobot.robots.viewer.process", descriptor, descriptors=(descriptor,))
        self._pipe = Connection(ours.detach())
        try:
            self._pipe.send(LiveSpec.of(mirror, block.name))
            self._wait()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

    def _wait(self) -> None:
        problem = f"it has not opened its window within {_OPEN_S:g} s"
        try:
            if self._pipe.poll(_OPEN_S):
                problem = self._pipe.recv()
        except (EOFError, OSError):
            problem = f"its process ended with status {self._process.wait()} (what it printed is above)"
        if problem:
            raise RenderingError(f"MuJoCo's viewer: {problem.rstrip('.')}. Leave --view out, or use bhd-monitor --3d.")

    def close(self) -> None:
        """End the viewer, also one that hangs or is stopped. May be called twice."""
        self._process.kill()
        self._process.wait()
        self._pipe.close()
        if self._lockstep is not None:
            self._lockstep.on_change = None
        if self._own is not None:
            self._own.close()
            self._own = None


def _publish(simulation: Simulation) -> LiveBlock:
    """Let simulations on the lockstep clock publish what the first of them does."""
    physics = sum(part.shape[1] for part in simulation.physics)
    dtype = np.dtype([("physics", np.float64, (1, physics))])
    name = f"{simulation.config.type}-view-{os.getpid()}-{next(_numbers)}"
    block = LiveLayout(dtype, _STATES).create(name, {})
    record = np.zeros((), dtype)

    def publish(ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        if 0 in ids and scenes:
            block.publish_scene(scene_to_json(scenes[list(ids).index(0)]))
        record["physics"][0] = np.concatenate([part[0] for part in simulation.physics])
        block.ring.publish(record)

    simulation.on_change = publish
    return block
