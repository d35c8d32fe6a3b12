"""A scanning range finder on simulated scenes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.errors import ConfigError

if TYPE_CHECKING:  # configurations check their beams without MuJoCo
    from bhd_lerobot.sim.world import World


class Lidar:
    """Scans for all simulations of a world, each with its own random numbers.

    A scan is taken at one instant; the distortion by the robot's motion during the turn of the head is not simulated.

    Args:
        world: the simulations.
        spec: the range finder.
        beams: number of beams kept, evenly spaced; a divisor of `spec.beams`. All of them if None.
    """

    def __init__(self, world: "World", spec: LidarSpec, beams: int | None = None) -> None:
        beams = spec.beams if beams is None else beams
        check_beams(beams, spec)
        self.spec = spec
        self.beams = beams
        self._world = world
        angle = 2 * np.pi * np.arange(beams) / beams
        self._directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(beams)], axis=1)
        self._ranges = np.full((world.n, beams), spec.range_max)
        self.ranges: NDArray[np.float64] = self._ranges.view()
        self.ranges.flags.writeable = False

    def scan(self, rngs: Sequence[np.random.Generator], ids: NDArray[np.intp] | None = None) -> None:
        """Take a scan: `ranges` of the simulations named becomes it.

        Args:
            rngs: the random generators of all simulations of the world, shape (n,).
            ids: the simulations, all if None.
        """
        distance, sims = self._world.rays(self.spec.site, self._directions, ids)
        if self.spec.noise_std > 0:
            for row, sim in enumerate(sims):
                # Noise on an infinite distance stays infinite: a beam without a return has none to disturb.
                distance[row] += rngs[sim].normal(0.0, self.spec.noise_std, self.beams)
        self._ranges[sims] = np.clip(distance, self.spec.range_min, self.spec.range_max)


def check_beams(beams: int, spec: LidarSpec) -> None:
    """Raise unless `beams` evenly spaced beams can be picked from the range finder's.

    Raises:
        ConfigError: names the valid numbers.
    """
    if isinstance(beams, bool) or not isinstance(beams, int) or beams < 1 or spec.beams % beams:
        valid = ", ".join(str(b) for b in range(1, spec.beams + 1) if spec.beams % b == 0)
        raise ConfigError(f"beams is {beams!r}; it must divide {spec.beams}. Valid: {valid}.")
