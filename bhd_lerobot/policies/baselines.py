"""What a trained brain has to beat: doing nothing, and moving at random."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Range
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures, find_columns

_SPEED, _POSITION = ".vel", ".pos"


@BrainConfig.register_subclass("noop")
@dataclass
class NoopConfig(BrainConfig):
    """The brain that does nothing has no parameters."""


@BrainConfig.register_subclass("random")
@dataclass
class RandomConfig(BrainConfig):
    """Parameters of the brain that moves at random.

    Attributes:
        period_s: time from one random action to the next; between them it goes in a straight line. 0: a new one in
            every frame.
        scale: share of each action's range that is used: around 0 for speeds, around where the episode began for
            positions.
    """

    period_s: NotNegative = 1.0
    scale: Annotated[float, Range("(0, 1]")] = 1.0


class NoopBrain(Brain):
    """Holds: speeds are 0, and positions are those that the episode began with."""

    name = "noop"
    uses_privileged_state = False
    attempts = False

    def __init__(self, config: BrainConfig | None = None) -> None:
        self.config = config or NoopConfig()
        self._held: NDArray[np.float64] = np.zeros((0, 0))  # the actions that hold, shape (n, actions)
        self._fresh = np.zeros(0, np.bool_)  # whose episode has not been seen yet
        self._targets: NDArray[np.intp] = np.zeros(0, np.intp)
        self._sources: NDArray[np.intp] = np.zeros(0, np.intp)
        self._width = 0

    def bind(self, robot: RobotFeatures) -> None:
        """Find the positions among the observations."""
        held = [name for name in robot.action_names if not name.endswith(_SPEED)]
        odd = [name for name in held if not name.endswith(_POSITION)]
        if odd:
            raise ConfigError(f"The brain {self.name!r} does not know how to hold the action {odd[0]!r}.")
        self._sources = find_columns(robot.observation_names, held, self.name, "observation")
        self._targets = find_columns(robot.action_names, held, self.name, "action")
        self._width = len(robot.action_names)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Hold what is seen next."""
        if len(self._fresh) != n:
            self._fresh, self._held = np.ones(n, np.bool_), np.zeros((n, self._width))
        self._fresh[ids] = True

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return the actions that hold, shape (n, actions)."""
        running = np.ones(len(self._fresh), np.bool_) if observation.running is None else observation.running
        new = np.flatnonzero(self._fresh & running)
        if len(new):
            self._held[new[:, None], self._targets] = observation.state[new[:, None], self._sources]
            self._fresh[new] = False
        return self._held.copy()


class RandomBrain(NoopBrain):
    """Goes from one random action to the next, within the limits of the robot's body."""

    name = "random"
    config: RandomConfig

    def __init__(self, config: RandomConfig | None = None) -> None:
        super().__init__(config or RandomConfig())
        self._period = 1
        self._lower: NDArray[np.float64] = np.zeros(0)
        self._upper: NDArray[np.float64] = np.zeros(0)
        self._generators: dict[int, np.random.Generator] = {}
        self._from = self._to = np.zeros((0, 0))
        self._frame = np.zeros(0, np.int64)

    def bind(self, robot: RobotFeatures) -> None:
        """Find the range of every action."""
        super().bind(robot)
        self._period = max(1, round(self.config.period_s * robot.fps))
        limits = None if robot.body is None else robot.body.limits
        if limits is None or tuple(limits.names) != tuple(robot.action_names):
            raise ConfigError(
                f"The brain 'random' knows no range for the actions {', '.join(robot.action_names)}. It drives a "
                "simulated base, and an arm with --robot.action_space=joint."
            )
        self._lower, self._upper = np.array(limits.bounds)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start anew from each episode's seed."""
        super().reset(ids, seeds, n, instructions)
        if len(self._frame) != n:
            self._frame = np.zeros(n, np.int64)
            self._from, self._to = np.zeros((n, len(self._upper))), np.zeros((n, len(self._upper)))
        self._frame[ids] = 0
        for sim, seed in zip(ids.tolist(), seeds, strict=True):
            self._generators[sim] = np.random.default_rng(seed)

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return the actions, shape (n, actions)."""
        super().act(observation)
        n = len(self._frame)
        running = np.arange(n) if observation.running is None else np.flatnonzero(observation.running)
        for sim in running[self._frame[running] % self._period == 0].tolist():
            self._from[sim] = self._to[sim] if self._frame[sim] else self._held[sim]
            self._to[sim] = self._draw(sim)
        share = ((self._frame % self._period + 1) / self._period)[:, None]
        self._frame[running] += 1
        return self._from * (1 - share) + self._to * share

    def _draw(self, sim: int) -> NDArray[np.float64]:
        middle, half = self._held[sim], self.config.scale * (self._upper - self._lower) / 2
        lower, upper = np.maximum(middle - half, self._lower), np.minimum(middle + half, self._upper)
        return self._generators[sim].uniform(lower, upper)
