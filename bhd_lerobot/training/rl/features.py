"""What the network sees of n robots whose episodes are not in step."""

from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray

_KEYS = {"agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}

Rows = dict[str, NDArray[np.float32]]


def rows_of(observation: dict[str, Any]) -> Rows:
    """Return an environment's observation, by LeRobot's names, each of shape (n, width)."""
    return {key: observation[name] for name, key in _KEYS.items() if name in observation}


class FeatureStack:
    """Histories of n robots, and the vectors that `bhd_mlp` makes of them.

    Normalisation and features are computed by the policy and its processors, so that what is learned here is what runs
    elsewhere; only a convolution over beams, which is learned, is left to the learner.
    """

    def __init__(self, front: Any, before: Any, n: int) -> None:
        self._front, self._before, self.size = front, before, int(front.feature_size)
        config = front.config
        self._length, self._single = config.history, config.n_obs_steps == 1
        self._back = np.arange(config.n_obs_steps)[::-1] * config.obs_stride
        self._keys = [key for key in (OBS_STATE, OBS_ENV_STATE) if key in config.input_features]
        self._history = {
            key: np.zeros((self._length, n, config.input_features[key].shape[0]), np.float32) for key in self._keys
        }
        self._head = 0

    def restart(self, ids: NDArray[np.intp], rows: Rows) -> None:
        """Begin episodes: nothing was before their first frame but that frame."""
        for key in self._keys:
            self._history[key][:, ids] = rows[key][ids]

    def push(self, rows: Rows) -> None:
        """Add a frame of all robots."""
        self._head = (self._head + 1) % self._length
        for key in self._keys:
            self._history[key][self._head] = rows[key]

    def features(self) -> NDArray[np.float32]:
        """Return the vectors, shape (n, size)."""
        batch = {}
        for key in self._keys:
            picked = self._history[key][(self._head - self._back) % self._length]
            values = picked[0] if self._single else picked.swapaxes(0, 1)
            batch[key] = torch.from_numpy(np.ascontiguousarray(values))
        with torch.inference_mode():
            return self._front.features(self._before(batch)).numpy()


def in_units(after: Any, actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return normalised actions in the robot's units, shape (n, actions), by the policy's own postprocessor."""
    with torch.inference_mode():
        return after(torch.from_numpy(np.ascontiguousarray(actions, np.float32))).numpy()
