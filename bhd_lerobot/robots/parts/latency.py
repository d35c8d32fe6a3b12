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

    Attributes:
        plant: what they are passed on to.
        ring: the last commands, shape (ticks, n, actuators).
        latency: by how many ticks commands are late, shape (n,).
        waited: ticks since that was set, shape (n,): before, nothing was commanded.
        written: commands that were written to the ring.

    Args:
        actuators: how many there are.
        max_ticks: largest latency [ticks].
    """

    def __init__(self, plant: SimulatedPlant, actuators: int, max_ticks: int = MAX_LATENCY) -> None:
        self.n = plant.n
        self.plant = plant
        self.latency: NDArray[np.int64] = np.zeros(plant.n, np.int64)
        self.waited: NDArray[np.int64] = np.zeros(plant.n, np.int64)
        self._sims = np.arange(plant.n)
        self._largest = max_ticks
        self.ring: NDArray[np.float64] = np.zeros((max_ticks + 1, plant.n, actuators))
        self.written = 0
        self.is_late = False

    def set_latency(self, ids: NDArray[np.intp], ticks: Sequence[int]) -> None:
        """Set by how many ticks the servos of some simulations get their commands late."""
        for value in ticks:
            if not 0 <= value <= self._largest:
                raise ConfigError(f"latency_ticks is {value}; it must be between 0 and {self._largest}.")
        self.latency[ids] = ticks
        self.waited[ids] = 0
        self.is_late = bool(self.latency.any())

    def read(self, out: PlantReading) -> None:
        """Write the newest joint readings into `out`."""
        self.plant.read(out)

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Pass on the modes at once."""
        self.plant.set_mode(mode)

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the actuator commands, shape (n, actuators)."""
        if not self.is_late:
            self.plant.write(ctrl)
            return
        self.ring[self.written % len(self.ring)] = ctrl
        # What came before the episode is not this episode's: its first command counts until a later one arrives.
        behind = np.minimum(self.latency, self.waited)
        self.plant.write(self.ring[(self.written - behind) % len(self.ring), self._sims])
        self.pass_by(1)

    def pass_by(self, ticks: int) -> None:
        """Count commands that were written to the ring."""
        self.written += ticks
        self.waited += ticks
