"""A plant whose servos get their commands late, for domain randomisation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.plant import SimulatedPlant

MAX_LATENCY = 25  # [ticks] 0.05 s at 500 Hz


class LatePlant(Plant):
    """Passes readings on at once, and commands some ticks later, for each simulation its own number.

    Args:
        actuators: how many there are.
        max_ticks: largest latency [ticks].
    """

    def __init__(self, plant: SimulatedPlant, actuators: int, max_ticks: int = MAX_LATENCY) -> None:
        self.n = plant.n
        self._plant = plant
        self._latency = np.zeros(plant.n, np.int64)
        self._late = False
        self._sims = np.arange(plant.n)
        self._largest = max_ticks
        self._ring = np.zeros((max_ticks + 1, plant.n, actuators))
        self._ticks = 0
        self._waiting = np.zeros(plant.n, np.int64)  # ticks since the latency was set: before, nothing was commanded

    def set_latency(self, ids: NDArray[np.intp], ticks: Sequence[int]) -> None:
        """Set by how many ticks the servos of some simulations get their commands late."""
        for value in ticks:
            if not 0 <= value <= self._largest:
                raise ConfigError(f"latency_ticks is {value}; it must be between 0 and {self._largest}.")
        self._latency[ids] = ticks
        self._waiting[ids] = 0
        self._late = bool(self._latency.any())

    def read(self, out: PlantReading) -> None:
        """Write the newest joint readings into `out`."""
        self._plant.read(out)

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Pass on the modes at once."""
        self._plant.set_mode(mode)

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the actuator commands, shape (n, actuators)."""
        if not self._late:
            self._plant.write(ctrl)
            return
        self._ring[self._ticks % len(self._ring)] = ctrl
        # What came before the episode is not this episode's: its first command counts until a later one arrives.
        behind = np.minimum(self._latency, self._waiting)
        self._plant.write(self._ring[(self._ticks - behind) % len(self._ring), self._sims])
        self._ticks += 1
        self._waiting += 1
