"""What brains that give goals have in common: one goal at a time for each simulation, and its result."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.tabletop import check_camera_error
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, Positive
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures


@dataclass
class GoalBrainConfig(BrainConfig):
    """Parameters of brains that give an arm goals.

    Attributes:
        max_velocity: speed of the fastest joint on free motions [rad/s], at most the largest of the arm.
        max_acceleration: acceleration of the fastest joint on free motions [rad/s^2].
        attempts: how often it tries in all.
        camera_error_m: known error of the positions that the task reports, x, y, z in the base frame [m]; it is
            subtracted.
    """

    max_velocity: Positive = 2.0
    max_acceleration: Positive = 8.0
    attempts: Count = 3
    camera_error_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        check_camera_error("brain.camera_error_m", self.camera_error_m)


class GoalBrain(Brain, ABC):
    """A brain that gives each simulation one goal after the other.

    A subclass returns the next goal in `decide`, which is called at the start, whenever a goal has ended, and in each
    frame without one.

    Attributes:
        config: the parameters.
        doing: what each simulation's brain is doing, as text; recorded as the column `subtask`.

    Args:
        config: the parameters.
    """

    needs: tuple[type, ...] = (Arm,)
    has_plan = True

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._pending: list[str | None] = []
        self._numbers: list[int] = []
        self.doing: list[str] = []
        self._done: list[bool] = []

    def bind(self, robot: RobotFeatures) -> None:
        """Check the speed of free motions.

        Raises:
            ConfigError: no joint of the arm is so fast.
        """
        arm = robot.need(Arm)
        for name, limits in (("max_velocity", arm.limits.velocity), ("max_acceleration", arm.limits.acceleration)):
            most, own = max(limits[: len(arm.chain.joints)]), type(self.config)
            if (value := getattr(self.config, name, 0.0)) <= most:
                continue
            if value != getattr(own, name):
                unit = "rad/s" if name == "max_velocity" else "rad/s^2"
                raise ConfigError(f"brain.{name} is {value}; the arm's fastest joint has {most:.6g} {unit} at most.")
            self.config = replace(self.config, **{name: most})  # slower than what is usual

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Start an episode in one simulation."""

    @abstractmethod
    def decide(
        self, sim: int, seen: Observation, result: CommandResult | None
    ) -> BrainCommand | NDArray[np.float64] | None:
        """Return the next goal of one simulation, or the setpoint of a frame, shape (actions,); None for none any more.

        Args:
            sim: the simulation.
            seen: what all simulations see.
            result: how the last goal ended; None at the start.
        """

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes in some simulations."""
        if len(self._pending) != n:
            self._pending, self._numbers = [None] * n, [0] * n
            self.doing, self._done = [""] * n, [False] * n
        for place, sim in enumerate(np.asarray(ids).tolist()):
            self._pending[sim], self._numbers[sim], self.doing[sim], self._done[sim] = None, 0, "", False
            self.begin_episode(sim, seeds[place], instructions[place] if instructions else "")

    def act(self, observation: Observation) -> Goals:
        """Return the goals that come next."""
        commands: dict[int, list[BrainCommand]] = {}
        setpoints: NDArray[np.float64] | None = None
        running = np.ones(len(self._pending), np.bool_) if observation.running is None else observation.running
        for sim in np.flatnonzero(running).tolist():
            if self._done[sim]:
                continue
            result = None
            if self._pending[sim] is not None:
                ends = [one for one in observation.results.get(sim, ()) if one.task_id == self._pending[sim]]
                if not ends:
                    continue
                result = ends[-1]
            command = self.decide(sim, observation, result)
            if isinstance(command, np.ndarray):
                setpoints = np.full((len(running), len(command)), np.nan) if setpoints is None else setpoints
                setpoints[sim], self._pending[sim] = command, None
                continue
            self._pending[sim] = None if command is None else command.task_id
            self._done[sim] = command is None
            if command is not None:
                commands[sim] = [command]
        return Goals(commands, setpoints)

    def subtasks(self) -> Sequence[str]:
        """Return what each simulation's brain is doing, as text."""
        return self.doing

    def new_id(self, sim: int, step: str) -> str:
        """Return a new `task_id` for a goal."""
        self._numbers[sim] += 1
        return f"{self._numbers[sim]}-{step}"
