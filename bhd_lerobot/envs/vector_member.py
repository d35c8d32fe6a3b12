"""One environment of a vector environment, as others ask for it."""

from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.envs.course import Course
from bhd_lerobot.envs.stage import Stage
from bhd_lerobot.errors import ConfigError, unknown_name

# Attributes of a `BhdEnv` that are the vector environment's or the course's, by their names there.
_OF_THE_VECTOR = {
    **{name: name for name in ("task", "render_mode", "metadata", "spec")},
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
_OF_THE_COURSE = {"seed": "seed", "split": "split", "episode_index": "episode"}
_SETTABLE = ("seed", "split", "stride", "render_mode")


class Member:
    """What `get_attr`, `call` and `set_attr` of a vector environment find: what a `BhdEnv` would have."""

    def __init__(self, stage: Stage, sim: int, course: Course, vector: Any) -> None:
        self.stage, self.course = stage, course
        self._sim, self._vector = sim, vector

    def __getattr__(self, name: str) -> Any:
        for source, names in ((self._vector, _OF_THE_VECTOR), (self.course, _OF_THE_COURSE)):
            if name in names:
                return getattr(source, names[name])
        raise AttributeError(f"An environment has no attribute {name!r}.", name=name, obj=self)

    @property
    def task_description(self) -> str:
        """The instruction of this episode."""
        return self.stage.instruction(self._sim)

    @property
    def _max_episode_steps(self) -> int:
        return self.stage.frames

    def render(self) -> NDArray[np.uint8] | None:
        """Return the scene from outside, shape (height, width, 3); None without a render mode."""
        return None if self.render_mode is None else self.stage.render(self._sim)

    def set(self, name: str, value: Any) -> None:
        """Set an attribute: `seed`, `split` or `stride` of the episodes to come, or `render_mode`."""
        if name not in _SETTABLE:
            raise ConfigError(unknown_name("attribute that can be set", name, _SETTABLE))
        if name == "render_mode":
            self._vector.render_mode = value
            return
        course = self.course
        values = {"seed": course.seed, "split": course.split, "stride": course.stride, name: value}
        self.course = Course(**values, first=course.following)
        self.course.episode = course.episode


class Images(Sequence[NDArray[np.uint8]]):
    """Renderings of all simulations, each made when it is read."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage

    def __len__(self) -> int:
        return self._stage.n

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[NDArray[np.uint8]]: ...

    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | Sequence[NDArray[np.uint8]]:
        if isinstance(index, slice):
            return [self._stage.render(sim) for sim in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self._stage.render(index % len(self))
