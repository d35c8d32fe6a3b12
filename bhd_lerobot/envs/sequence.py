"""Which episode an environment runs next."""

import numpy as np

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import SPLITS, Split, episode_seed

STREAM = 2**32
"""How many episodes further an environment goes each time by default.

Clients seed environment i of n with seed + i, and only once. What follows must not be an episode of another
environment, so the numbers of an environment with seed k are k, k + 2**32, k + 2 * 2**32, …: two seeds below 2**32, to
which Stable-Baselines3 and NumPy's own seeds are limited, never meet.
"""

_END = 2**63  # infos of vector environments hold the numbers as int64


class EpisodeSequence:
    """The episodes of one environment: `episode` is the number of the present one, -1 before the first."""

    def __init__(self, seed: int = 0, split: Split = "train", first: int | None = None, stride: int = STREAM) -> None:
        first = int(np.random.default_rng().integers(STREAM)) if first is None else first
        for name, value, least in (("seed", seed, 0), ("first_episode", first, 0), ("episode_stride", stride, 1)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{name} is {value!r}; it must be a whole number of at least {least}.")
        if split not in SPLITS:
            raise ConfigError(f"split is {split!r}. Valid: {', '.join(SPLITS)}.")
        self.seed, self.split, self.stride = seed, split, stride
        self.episode = -1
        self.following = first

    def advance(self, episode: int | None = None) -> int:
        """Continue to an episode, the next one if None; return its seed."""
        episode = self.following if episode is None else episode
        if not 0 <= episode < _END:
            raise ConfigError(f"The number of an episode is {episode}; it must be from 0 to 2**63 - 1.")
        self.episode = int(episode)
        self.following = self.episode + self.stride
        return episode_seed(self.seed, self.episode, self.split)
