"""A plant of an arm with perfect joints whose readings a test falsifies while it runs in the cerebellum's process."""

import os
import time
from typing import Any

import numpy as np

from bhd_lerobot.control.plant import Plant, PlantReading

LOG = "BHD_TEST_LYING_ARM"  # names the file that both processes map
LIES = ("nothing", "step", "wrapped", "from the future", "frozen")
ROWS = 100_000
DTYPE = np.dtype([("lie", np.int64), ("count", np.int64), ("mode", np.int8, (ROWS,)), ("written", float, (ROWS, 7))])


def shared(path: str, *, new: bool = False) -> Any:
    """Return what the test and the plant share: which lie is wanted, and all that was written."""
    return np.memmap(path, DTYPE, "w+" if new else "r+", shape=(1,))[0]


class LyingArm(Plant):
    """Joints that are where they were commanded to be a tick ago."""

    n = 1

    def __init__(self, config: Any, body: Any) -> None:
        self._shared = shared(os.environ[LOG])
        self._true, self._velocity = np.array(body.arm.home), np.zeros(7)
        self._frozen = self._true.copy()
        self._period = 1 / config.rates.control_hz
        self._mode = 0

    def read(self, out: PlantReading) -> None:
        lie = LIES[int(self._shared["lie"])]
        out.position[0], out.velocity[0] = self._true, self._velocity
        assert out.stamp_ns is not None
        out.stamp_ns[0] = time.monotonic_ns()
        if lie == "step":
            out.position[0, 1] += 0.3
        elif lie == "wrapped":
            out.position[0, :6] = (out.position[0, :6] + 2 * np.pi) % (2 * np.pi)
        elif lie == "from the future":
            out.stamp_ns[0] += 10**10
        elif lie == "frozen":
            out.position[0], out.velocity[0] = self._frozen, 0.0
        if lie != "frozen":
            self._frozen[:] = self._true

    def set_mode(self, mode: np.ndarray) -> None:
        self._mode = int(mode[0])

    def write(self, ctrl: np.ndarray) -> None:
        count = int(self._shared["count"])
        if count < ROWS:
            self._shared["written"][count], self._shared["mode"][count] = ctrl[0], self._mode
            self._shared["count"] = count + 1
        self._velocity = (ctrl[0] - self._true) / self._period
        self._true = ctrl[0].copy()
