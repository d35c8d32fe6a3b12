"""One part of the robots of a host."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.messages import Reason
from bhd_lerobot.control.plant import PlantReading

Refused = dict[int, tuple[Reason, str]]
Ids = NDArray[np.intp]
GYROSCOPE = "imu_gyro"  # the name of the sensor in every body's MJCF


class Part(ABC):
    """The arms, or the drives with their lidars, of n robots: what they observe and how they act.

    Arrays of actions, commands and readings are its own columns.

    Attributes:
        controller: turns its commands into actuator commands.
        action_names: names of its actions, in order.
        observation_names: names of the floats that it observes, in order; the last `derived` follow from the others.
        sensors: how many of `PlantReading.sensors` are its.
        knows: the fields of a task's truth that it measures itself.
        sensor_period_s: time between two readings of its slowest sensor [s]; 0 if all are read at every tick.
        host: the `Host` that it is a part of, once it is.
        first: its first joint in a reading of the robot.
    """

    controller: Controller
    action_names: tuple[str, ...]
    observation_names: tuple[str, ...]
    derived = 0
    sensors = 0
    knows: frozenset[str] = frozenset()
    sensor_period_s = 0.0
    host: Any
    first = 0

    @abstractmethod
    def sense(self, reading: PlantReading, out: NDArray[np.float64]) -> None:
        """Write its observation's floats but the derived ones, shape (n, features); `reading` is the robot's."""

    def derive(self, out: NDArray[np.float64]) -> None:
        """Write the derived floats of its observation, shape (n, features), of which the others are there."""
        return

    def oldest(self) -> NDArray[np.int64]:
        """Return the tick of its oldest reading, shape (n,)."""
        return np.full(self.host.n, self.host.tick)

    @abstractmethod
    def truth(self, reading: PlantReading) -> dict[str, Any]:
        """Return what tasks judge by, as far as it is known, by field; `reading` is the robot's."""

    @abstractmethod
    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where it was in recorded observations of the robot, shape (frames, 7); see `Robots.track`."""

    def place(self, ids: Ids, scenes: Sequence[Any]) -> None:
        """Take over what is known of the scenes that robots are in."""
        return

    def begin(self, ids: Ids) -> None:
        """Begin episodes."""
        return

    def start_goal(self, scene: Any) -> BrainCommand | None:
        """Return the goal that brings it to the start of a scene without a world; None if a person does that."""
        return None

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return commands, shape (n, width), in the space of the actions, shape (n, actions)."""
        return command.copy()

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Refused]:
        """Turn actions into commands, see `Host.to_setpoints`; `before` has shape (n, width)."""
        return action, {}


class SimulatedPart(Part):
    """One part of n simulated robots.

    Attributes:
        touch_kinds: how many kinds of touches it tells apart.
        touches: what was touched since the start of the last frame, by kind, live, shape (touch_kinds, n).
    """

    touch_kinds = 0
    touches: NDArray[np.bool_]

    @property
    def not_in_state(self) -> tuple[str, ...]:
        """Observed features that do not follow from a physics state."""
        return ()

    def privileged_state(self) -> NDArray[np.float64]:
        """Return what is true and no sensor measures, see `Simulation.privileged_state`."""
        return np.zeros((self.host.n, 0))

    def started(self, ids: Ids) -> None:
        """Take first readings of what is not read every frame, at the start of episodes."""
        return

    def after_step(self) -> None:
        """Note touches after a physics step: one may last a single step."""
        return

    def after_tick(self) -> None:
        """Read sensors with a rhythm of their own."""
        return

    def ticks_left(self) -> int:
        """Return after how many ticks `after_tick` reads a sensor; 0 if never."""
        return 0

    def resense(self, sim: int, time_s: float, age_s: float) -> None:
        """Read again, in a restored state, what is not read every frame, see `Simulation.resense`."""
        return
