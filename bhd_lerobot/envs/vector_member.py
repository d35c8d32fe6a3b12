"""One environment of a vector environment, as others ask for it."""

from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.envs.episodes import SteppedEpisodes
from bhd_lerobot.envs.sequence import EpisodeSequence
from bhd_lerobot.errors import ConfigError, unknown_name

# Attributes of a `BhdEnv` that are the vector environment's or the sequence's, by their names there.
_OF_THE_VECTOR = {
    **{name: name for name in ("task", "render_mode", "metadata", "spec")},
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
_OF_THE_SEQUENCE = {"seed": "seed", "split": "split", "episode_index": "episode"}
_SETTABLE = ("seed", "split", "stride", "render_mode")


class Member:
    """What `get_attr`, `call` and `set_attr` of a vector environment find: what a `BhdEnv` would have."""

    def __init__(self, episodes: SteppedEpisodes, sim: int, sequence: EpisodeSequence, vector: Any) -> None:
        self.episodes, self.sequence = episodes, sequence
        self._sim, self._vector = sim, vector

    def __getattr__(self, name: str) -> Any:
        for source, names in ((self._vector, _OF_THE_VECTOR), (self.sequence, _OF_THE_SEQUENCE)):
            if name in names:
                return getattr(source, names[name])
        raise AttributeError(f"An environment has no attribute {name!r}.", name=name, obj=self)

    @property
    def task_description(self) -> str:
        """The instruction of this episode."""
        return self.episodes.instruction(self._sim)

    @property
    def _max_episode_steps(self) -> int:
        return self.episodes.frames

    def render(self) -> NDArray[np.uint8] | None:
        """Return the scene from outside, shape (height, width, 3); None without a render mode."""
        return None if self.render_mode is None else self.episodes.render(self._sim)

    def set(self, name: str, value: Any) -> None:
        """Set an attribute: `seed`, `split` or `stride` of the episodes to come, or `render_mode`."""
        if name not in _SETTABLE:
            raise ConfigError(unknown_name("attribute that can be set", name, _SETTABLE))
        if name == "render_mode":
            self._vector.render_mode = value
            return
        sequence = self.sequence
        values = {"seed": sequence.seed, "split": sequence.split, "stride": sequence.stride, name: value}
        self.sequence = EpisodeSequence(**values, first=sequence.following)
        self.sequence.episode = sequence.episode


class Images(Sequence[NDArray[np.uint8]]):
    """Renderings of all simulations, each made when it is read."""

    def __init__(self, episodes: SteppedEpisodes) -> None:
        self._stepped = episodes

    def __len__(self) -> int:
        return self._stepped.n

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[NDArray[np.uint8]]: ...

    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | Sequence[NDArray[np.uint8]]:
        if isinstance(index, slice):
            return [self._stepped.render(sim) for sim in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self._stepped.render(index % len(self))
