"""What may be wrong with what a task senses for a brain: noise, delay and gaps, as of a real robot's tracker."""

from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.options.declared import Options, Range, Share


@dataclass
class SensingConfig(Options, prefix="sensing."):
    """What is wrong with what the task senses; nothing by default: then it is the truth.

    Attributes:
        noise_m: standard deviation of the noise on each coordinate of a position, anew in every frame [m].
        delay_s: how old it is, in whole frames [s].
        dropout: probability that something is missing, for each thing and anew in every frame: an object is left out;
            of a target, a goal or the robot's pose, what was sensed before is repeated.
    """

    noise_m: Annotated[float, Range("[0, 100]")] = 0.0
    delay_s: Annotated[float, Range("[0, 3600]")] = 0.0
    dropout: Share = 0.0

    @property
    def is_exact(self) -> bool:
        """Whether nothing is wrong."""
        return not (self.noise_m or self.delay_s or self.dropout)

    def draw_seed(self, rng: np.random.Generator) -> int:
        """Return the seed of what is wrong in an episode; 0, and nothing is drawn, if nothing is."""
        return 0 if self.is_exact else int(rng.integers(2**31))


class Sensing:
    """What n tasks sense of some things each, with noise, late and with gaps.

    Args:
        config: what is wrong.
        n: number of simulations.
        fps: frames a second [Hz].
        position: which fields of a thing are its position [m].
        absent: the fields of a thing that is not there, shape (fields,); None if it always is.
    """

    def __init__(
        self, config: SensingConfig, n: int, fps: int, position: slice, absent: NDArray[np.float64] | None = None
    ) -> None:
        self._config, self._position, self._absent = config, position, absent
        self._rngs = [np.random.default_rng(0)] * n
        self._past: list[deque[NDArray[np.float64]]] = [deque(maxlen=1 + round(config.delay_s * fps)) for _ in range(n)]
        self._frame = np.full(n, -1)
        self._sensed: list[NDArray[np.float64]] = [np.zeros((0, 0))] * n

    def begin(self, sim: int, seed: int) -> None:
        """Start an episode in one simulation."""
        self._rngs[sim] = np.random.default_rng(seed)
        self._past[sim].clear()
        self._frame[sim] = -1

    def sense(self, state: NDArray[np.float64], frame: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return what is sensed; in the same frame again, it is the same again.

        Args:
            state: what is true, shape (n, things, fields).
            frame: number of each episode's frame, shape (n,).

        Returns:
            likewise, shape (n, things, fields); `state` itself where nothing is wrong.
        """
        if self._config.is_exact:
            return state
        for sim in np.flatnonzero(self._frame != frame).tolist():
            self._sensed[sim] = self._measure(sim, state[sim])
        self._frame[:] = frame
        return np.stack(self._sensed)

    def _measure(self, sim: int, state: NDArray[np.float64]) -> NDArray[np.float64]:
        config, absent, past, rng = self._config, self._absent, self._past[sim], self._rngs[sim]
        is_first = not past
        past.append(state.copy())
        sensed = past[0].copy()  # at an episode's start, what was so then
        present = np.ones(len(sensed), np.bool_) if absent is None else (sensed != absent).any(axis=1)
        at = sensed[:, self._position]
        at += config.noise_m * rng.standard_normal(at.shape) * present[:, None]
        is_missing = rng.random(len(sensed)) < config.dropout
        if absent is not None:
            sensed[is_missing] = absent
        elif not is_first:
            sensed[is_missing] = self._sensed[sim][is_missing]
        return sensed
