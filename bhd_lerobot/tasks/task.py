"""What a task is: it makes episodes from seeds and judges them on the simulator's truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.errors import ConfigError

Split = Literal["train", "held_out"]
SPLITS: tuple[Split, ...] = ("train", "held_out")


class Event(IntEnum):
    """What happened in a frame; the `event` column of a dataset."""

    NOTHING = 0
    SUCCESS = 1
    COLLISION = 2
    STUCK = 3
    TIMEOUT = 4
    INTERVENTION = 5
    ESTOP = 6

    @property
    def cause(self) -> str:
        """The event's name in an episode's metadata."""
        return self.name.lower()


def episode_seed(seed: int, episode: int, split: Split) -> int:
    """Return the seed of an episode, a whole number below 2**63.

    Training seeds are even and held-out seeds are odd, so that the two can never meet, whatever run they come from.

    Args:
        seed: the run's seed.
        episode: the episode's number in the run.
        split: which of the two sets the episode belongs to.

    Raises:
        ConfigError: there is no such split, or a number is negative.
    """
    if split not in SPLITS:
        raise ConfigError(f"Unknown split {split!r}. Valid: {', '.join(SPLITS)}.")
    if seed < 0 or episode < 0:
        raise ConfigError(f"Seeds and episode numbers start at 0; got seed {seed}, episode {episode}.")
    word = np.random.SeedSequence([seed, episode]).generate_state(1, np.uint64)[0]
    return (int(word) >> 2) * 2 + SPLITS.index(split)


@dataclass(frozen=True)
class Truth:
    """What the simulator knows, at the end of a frame.

    Attributes:
        base_pose_in_world: x [m], y [m], yaw [rad], shape (n, 3).
        touched: whether the robot touched the scene at any time in the frame, shape (n,).
    """

    base_pose_in_world: NDArray[np.float64]
    touched: NDArray[np.bool_]


@dataclass(frozen=True)
class Outcome:
    """How an episode ended.

    Attributes:
        success: whether the task was achieved.
        event: what ended it.
        score: between 0 and 1, more is better; defined by the task.
        details: further numbers, by name.
    """

    success: bool
    event: Event
    score: float
    details: dict[str, float] = field(default_factory=dict)


class Task(Protocol):
    """A task for n simulations at once; each of them is in an episode of its own."""

    name: str
    instruction: str
    duration_s: float

    def sample(self, seed: int) -> Arena:
        """Return the scene and the start pose of the episode with this seed."""

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[Arena]) -> None:
        """Start episodes in some simulations."""

    def judge(self, truth: Truth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the reward and the `Event` of the frame that just ended, each of shape (n,).

        An event other than `NOTHING` ends the episode. Simulations that are not running get 0.
        """

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how the episode of one simulation ended, given the event that ended it."""

    def parameters(self) -> dict[str, Any]:
        """Return everything that defines the task, as plain values."""
