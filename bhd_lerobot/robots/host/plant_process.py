"""The plant's process: the simulated world of one robot, ticking on the wall clock as a motor controller would.

Started by `LiveLink` as ``python -m bhd_lerobot.robots.host.plant_process``, where ``robot.realtime.plant_process``
asks for it. It imports neither torch nor LeRobot. At every tick of its own it takes the newest command of the
cerebellum, or stops the robot by itself if that is too old, steps the world, and publishes what its sensors read.
"""

import gc
import os
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.guard import Guard, WireLimits
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import BhdError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Word
from bhd_lerobot.realtime.grid import Slot
from bhd_lerobot.realtime.plant_link import CommandGuard, PlantLink
from bhd_lerobot.robots.host.plant_loop import PlantLoop, PlantTick
from bhd_lerobot.robots.host.plant_stop import make_stop
from bhd_lerobot.robots.host.process import LiveSpec, run_worker
from bhd_lerobot.robots.host.simulation import Simulation

_WARM_UP_S = 0.2
_POLL_S = 0.02


class SensedWorld:
    """The world of a simulation of one robot, with its sensors; published into a ring.

    Args:
        simulation: the simulation; its cerebellum is not used.
        states: where the states go, of the dtype of its `PlantShape`.
        clock: monotonic time [ns].
    """

    def __init__(
        self, simulation: Simulation, states: StateRing, dtype: np.dtype, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.simulation, self._states, self._clock = simulation, states, clock
        self._plant = simulation.cerebellum.plant
        self._record = np.zeros(1, dtype)
        self._sensors_ns = -1  # when what was published last was measured, in the simulation's time
        self._field = {name: self._record[name] for name in dtype.names or ()}

    def place(self, scene: Any, seed: int) -> None:
        """Put the robot into a scene, at rest at its start."""
        self.simulation.reset(np.zeros(1, np.intp), [scene], [seed])

    def read(self, out: PlantReading) -> None:
        """Write the joint readings into `out`."""
        self._plant.read(out)

    def write(self, actuators: NDArray[np.float64]) -> None:
        """Take actuator commands, shape (1, joints)."""
        self._plant.write(actuators)

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the mode of the robot, shape (1,)."""
        self._plant.set_mode(mode)

    def advance(self) -> None:
        """Let one tick go by."""
        self.simulation.advance()

    def publish(self, tick: PlantTick, reading: PlantReading, guard: CommandGuard) -> None:
        """Publish what is so at the end of a tick, with an observation of now."""
        simulation, field = self.simulation, self._field
        for number, flag in enumerate(simulation.touches):
            if flag[0]:
                field["touches"][0, number] += 1
                flag[0] = False
        field["index"][0], field["due_ns"][0], field["start_ns"][0] = tick.slot.index, tick.slot.due_ns, tick.start_ns
        field["phase"][0], field["stops"][0], field["stopped_ns"][0] = guard.phase, guard.stops, guard.stopped_ns
        field["command"][0], field["command_ns"][0] = guard.number, guard.stamp_ns
        field["actuators"][0] = tick.actuators
        field["position"][0], field["velocity"][0] = reading.position, reading.velocity
        field["effort"][0] = reading.effort
        field["observation"][0], oldest = simulation.sense()
        field["tick"][0], field["oldest"][0] = simulation.tick, oldest[0]
        field["qpos"][0], field["qvel"][0] = simulation.world.qpos, simulation.world.qvel
        field["stamp_ns"][0] = now = self._clock()
        newest = simulation.cerebellum.reading
        if newest.sensors_ns[0] != self._sensors_ns:
            self._sensors_ns, field["sensors_ns"][0] = int(newest.sensors_ns[0]), now
        field["sensors"][0] = newest.sensors
        self._states.publish(self._record[0])


class PlantProcess:
    """The process's side of the pipe."""

    def __init__(self, spec: LiveSpec, connection: Connection) -> None:
        self._connection = connection
        self._block = block = LiveBlock.attach(spec.block)
        link = PlantLink.of(block)
        if link is None:
            raise RealtimeError(f"The block {spec.block!r} has no place for a plant.")
        self._simulation: Simulation = spec.make_host()
        simulation = self._simulation
        self._world = SensedWorld(simulation, link.states, link.shape.state_dtype)
        control_hz = spec.rates.control_hz
        wire = Guard(WireLimits.of(simulation.body, control_hz), 1)
        timeout_ns = round(spec.limits.plant_timeout_s * NANOSECONDS)
        guard = CommandGuard(link, timeout_ns, wire, NANOSECONDS // control_hz)
        parent = os.getppid()
        self._loop = PlantLoop(
            self._world,
            guard,
            make_stop(simulation.body, link.shape.joints),
            block.words,
            joints=link.shape.joints,
            control_hz=control_hz,
            most_catch_up=spec.limits.most_catch_up,
            is_orphan=lambda: os.getppid() != parent,
        )
        self._warm_up_ticks = round(_WARM_UP_S * spec.rates.control_hz)
        self._warm = False

    def work(self) -> None:
        """Take messages until the brain's process says end, or is gone."""
        while not self._block.words[Word.END]:
            self._block.show_life(Word.PLANT_ALIVE)
            try:
                if not self._connection.poll(_POLL_S):
                    continue
                kind, *arguments = self._connection.recv()
                if kind == "end":
                    return
                if kind == "place":
                    self._place(*arguments)
                self._connection.send((kind, None))
                if kind == "run":
                    grid = self._loop.run(*arguments)
                    self._connection.send(("stood", (grid.executed, grid.skipped)))
            except (EOFError, BrokenPipeError):
                return
            except BhdError as error:
                self._connection.send(("refused", str(error)))

    def _place(self, scene: Any, seed: int) -> None:
        loop, world = self._loop, self._world
        world.place(scene, seed)
        if not self._warm:
            # Warm-up ticks: the first executions take longest.
            for index in range(self._warm_up_ticks):
                world.read(loop.reading)
                world.write(loop.stop.command(loop.reading))
                world.advance()
                world.publish(PlantTick(Slot(index, 0, 0, 0), 0, loop.guard.actuators), loop.reading, loop.guard)
            world.place(scene, seed)
            self._warm = True
        loop.guard.place()
        # What is so before the first tick: the cerebellum starts from it.
        loop.tick(Slot(-1, time.monotonic_ns(), 0, 0), time.monotonic_ns())
        gc.collect()  # the loop runs without a collector

    def close(self) -> None:
        """Free everything."""
        self._simulation.close()
        self._block.close()


if __name__ == "__main__":
    sys.exit(run_worker(PlantProcess))
