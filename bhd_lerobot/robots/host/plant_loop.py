"""The loop of a plant in a process of its own, which follows fresh commands and stops the robot when there are none.

The clock and the sleep are given, so that everything in here runs on a virtual clock in tests.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import MOVING
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.grid import Slot, TickGrid
from bhd_lerobot.realtime.plant_link import CommandGuard, PlantPhase
from bhd_lerobot.robots.host.plant_stop import PlantStop

_OWN_STOP = np.array([Mode.FAULT], np.int8)
_ENDING_S = 4.0  # so long at the most a robot may take to come to rest before the process ends


@dataclass(frozen=True)
class PlantTick:
    """A tick of the plant, for its state.

    Attributes:
        start_ns: when it started, monotonic [ns].
        actuators: what the actuators got, shape (1, joints).
    """

    slot: Slot
    start_ns: int
    actuators: NDArray[np.float64]


class PlantWorld(Protocol):
    """What a `PlantLoop` runs."""

    def read(self, out: PlantReading) -> None:
        """Write the joint readings into `out`."""

    def write(self, actuators: NDArray[np.float64]) -> None:
        """Take actuator commands, shape (1, joints)."""

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the mode of the robot, shape (1,)."""

    def advance(self) -> None:
        """Let one tick go by."""

    def publish(self, tick: PlantTick, reading: PlantReading, guard: CommandGuard) -> None:
        """Publish what is so at the end of a tick."""


class PlantLoop:
    """Runs the ticks of a plant, each half a period after one of the cerebellum's.

    Args:
        control_hz: ticks a second [Hz].
        clock: monotonic time [ns].
        sleep: waits for a time [s].
    """

    def __init__(
        self,
        world: PlantWorld,
        guard: CommandGuard,
        stop: PlantStop,
        words: NDArray[np.int64],
        *,
        joints: int,
        control_hz: int,
        most_catch_up: int,
        is_orphan: Callable[[], bool],
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.world, self.guard, self.stop, self.words = world, guard, stop, words
        self.reading = PlantReading(1, joints)
        self.period_ns = NANOSECONDS // control_hz
        self._most_catch_up, self._most_ending = most_catch_up, round(_ENDING_S * control_hz)
        self._is_orphan, self._clock, self._sleep = is_orphan, clock, sleep
        self._actuators = np.zeros((1, joints))
        self._ending = 0

    def run(self, start_ns: int) -> TickGrid:
        """Run ticks until the loop is to stand, or until the process is to end and the robot is at rest.

        They begin at once and wait for the cerebellum, so that it finds fresh readings from its first tick on.

        Args:
            start_ns: when the cerebellum's tick 0 is due [ns].
        """
        clock, sleep, alive = self._clock, self._sleep, int(Word.PLANT_ALIVE)
        first = start_ns + self.period_ns // 2
        first -= max(0, first - clock()) // self.period_ns * self.period_ns
        grid = TickGrid(first, self.period_ns)
        self.guard.begin()
        self._ending = 0
        while not self._is_over():
            now = clock()
            left = grid.next_due_ns - now
            if left > 0:
                sleep(left / NANOSECONDS)
                now = clock()
            self.tick(grid.begin(now), now)
            ended = clock()
            grid.end(ended)
            self.words[alive] = ended
        return grid

    def tick(self, slot: Slot, now_ns: int) -> None:
        """Run one tick.

        Args:
            now_ns: the time [ns].
        """
        guard, world, reading = self.guard, self.world, self.reading
        stops = guard.stops
        phase = guard.check(now_ns, reading.position)
        if guard.stops != stops:
            self.stop.begin(self._actuators)
        if phase != PlantPhase.WAITING:
            world.set_mode(guard.mode if phase == PlantPhase.DRIVEN else _OWN_STOP)
            for number in range(1 + min(slot.skipped, self._most_catch_up)):
                if phase == PlantPhase.DRIVEN:
                    if number:
                        guard.follow()
                    actuators: NDArray[np.float64] = guard.actuators
                else:
                    world.read(reading)
                    actuators = self.stop.command(reading)
                world.write(actuators)
                world.advance()
            self._actuators[:] = actuators
        world.read(reading)
        world.publish(PlantTick(slot, now_ns, self._actuators), reading, guard)

    def _is_over(self) -> bool:
        words = self.words
        if not (words[Word.END] or self._is_orphan()):
            return bool(words[Word.PAUSE])
        # A robot is not left alone while it moves: commands cease, the guard stops it, and then this ends.
        self._ending += 1
        rest = self.guard.phase != PlantPhase.DRIVEN and np.abs(self.reading.velocity).max() < MOVING
        return bool(rest) or self._ending > self._most_ending
