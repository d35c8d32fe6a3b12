"""What a range scan says: the nearest valid reading of each sector, and where readings are."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import find_scan

Array = NDArray[np.float64]

MIN_BEAMS = 36  # with fewer, a post of 0.1 m can stand unseen within a turning circle
_SECTORS = 120  # more beams than this are merged


class ScanReader:
    """Reads the scans of n robots.

    `limits`: a reading outside them is not valid [m]; a beam without a return reads exactly the upper one.

    Attributes:
        columns: where the scan lies among the observation's floats.
        angles: of the beams in the robot's frame [rad], shape (beams,).
        sectors: number of sectors, evenly spaced from straight ahead, counter-clockwise.
        spread: a reading may lie this far to either side of its sector's middle [rad].
    """

    def __init__(self, names: Sequence[str], who: str, limits: tuple[float, float]) -> None:
        self.columns, self.angles = find_scan(names, who)
        self._limits = limits
        beams = len(self.angles)
        if beams < MIN_BEAMS:
            raise ConfigError(f"The brain {who!r} needs at least {MIN_BEAMS} beams; this robot has {beams}.")
        # An odd number of beams in a sector, so that the first is centred straight ahead.
        self._group = next((g for g in range(beams // _SECTORS, 1, -1) if g % 2 and beams % g == 0), 1)
        self.sectors = beams // self._group
        self.spread = np.pi * max(self._group - 1, 0.5) / beams

    def valid(self, scan: Array) -> NDArray[np.bool_]:
        """Return which readings are valid, shape (n, beams)."""
        # False for NaN; the limits' own values may have come through single precision.
        return (scan >= self._limits[0] - 1e-6) & (scan <= self._limits[1] + 1e-6)

    def nearest(self, scan: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the nearest valid range of each sector, shape (n, sectors), and who is blind, shape (n,).

        A sector without a valid reading takes over its nearer neighbour's; if neither has one, the robot is blind.
        """
        seen = np.where(self.valid(scan), scan, np.inf)
        if self._group > 1:
            seen = np.roll(seen, self._group // 2, axis=1).reshape(len(scan), -1, self._group).min(axis=2)
        missing: NDArray[np.bool_] = np.isinf(seen)
        if missing.any():
            seen = np.where(missing, np.minimum(np.roll(seen, 1, axis=1), np.roll(seen, -1, axis=1)), seen)
            missing = np.isinf(seen)
        blind: NDArray[np.bool_] = np.zeros(len(scan), np.bool_)
        missing.any(axis=1, out=blind)
        return np.where(missing, self._limits[0], seen), blind
