"""Which episode an environment runs next."""

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import SPLITS, Split, episode_seed


class Course:
    """The episodes of one environment, by their numbers in a run.

    Attributes:
        seed: the run's seed.
        split: `train` or `held_out`.
        episode: number of the present episode; -1 before the first.
        following: number of the next one.
        stride: how many episodes further each one after it is.

    Args:
        seed: the run's seed.
        split: which of two disjoint sets of episodes.
        first: number of the first episode.
        stride: how many episodes further each next one is: with n, n environments that start at 0 to n - 1 run
            different episodes.

    Raises:
        ConfigError: there is no such split, or a number is out of range.
    """

    def __init__(self, seed: int = 0, split: Split = "train", first: int = 0, stride: int = 1) -> None:
        for name, value, least in (("seed", seed, 0), ("first_episode", first, 0), ("episode_stride", stride, 1)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{name} is {value!r}; it must be a whole number of at least {least}.")
        if split not in SPLITS:
            raise ConfigError(f"split is {split!r}. Valid: {', '.join(SPLITS)}.")
        self.seed, self.split, self.stride = seed, split, stride
        self.episode = -1
        self.following = first

    def advance(self, episode: int | None = None) -> int:
        """Go on to an episode, the next one if None; return its seed."""
        self.episode = self.following if episode is None else int(episode)
        self.following = self.episode + self.stride
        return episode_seed(self.seed, self.episode, self.split)
