"""One environment of a vector environment, as others ask for it."""

from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.envs.course import Course
from bhd_lerobot.envs.stage import Stage
from bhd_lerobot.errors import ConfigError, unknown_name

_SETTABLE = ("seed", "split", "stride", "render_mode")


class Member:
    """What `get_attr`, `call` and `set_attr` of a vector environment find: what a `BhdEnv` would have.

    Attributes:
        course: which episode comes next.

    Args:
        stage: all simulations.
        sim: the number of this one.
        course: its episodes.
        vector: the vector environment.
    """

    def __init__(self, stage: Stage, sim: int, course: Course, vector: Any) -> None:
        self.stage, self.course = stage, course
        self._sim, self._vector = sim, vector

    @property
    def task(self) -> str:
        """Name of the environment."""
        return str(self._vector.task)

    @property
    def task_description(self) -> str:
        """What is asked for in this episode, in words."""
        return self.stage.instruction(self._sim)

    @property
    def _max_episode_steps(self) -> int:
        return self.stage.frames

    @property
    def render_mode(self) -> str | None:
        """``"rgb_array"`` or None."""
        return self._vector.render_mode

    @property
    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata."""
        return dict(self._vector.metadata)

    @property
    def spec(self) -> Any:
        """Gymnasium's specification, if it was made by `gymnasium.make_vec`."""
        return self._vector.spec

    @property
    def observation_space(self) -> Any:
        """The space of its observations."""
        return self._vector.single_observation_space

    @property
    def action_space(self) -> Any:
        """The space of its actions."""
        return self._vector.single_action_space

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self.course.seed

    @property
    def split(self) -> str:
        """Which of two disjoint sets of episodes."""
        return self.course.split

    @property
    def episode_index(self) -> int:
        """Number of the present episode."""
        return self.course.episode

    def render(self) -> NDArray[np.uint8] | None:
        """Return the scene from outside, shape (height, width, 3); None without a render mode."""
        return None if self.render_mode is None else self.stage.render(self._sim)

    def set(self, name: str, value: Any) -> None:
        """Set an attribute: `seed`, `split` or `stride` of the episodes to come, or `render_mode`.

        Raises:
            ConfigError: there is no such attribute, or the value cannot be honoured.
        """
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
    """Renderings of all simulations, each made when it is asked for."""

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
