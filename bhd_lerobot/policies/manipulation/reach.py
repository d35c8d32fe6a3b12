"""The scripted brain of the reach task."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain, GoalBrainConfig

TARGET = tuple(f"target_{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))


@BrainConfig.register_subclass("reach")
@dataclass
class ReachBrainConfig(GoalBrainConfig):
    """Parameters of the scripted reach brain. Between two attempts the arm goes home, where other ways begin."""


class ReachBrain(GoalBrain):
    """Gives the target pose as a goal; where no way leads there from the present posture, by way of home."""

    name = "reach"

    def __init__(self, config: ReachBrainConfig | None = None) -> None:
        super().__init__(config or ReachBrainConfig())
        self._columns: NDArray[np.intp] = np.zeros(0, np.intp)
        self._tries: dict[int, int] = {}
        self._home: tuple[float, ...] = ()  # of the joints

    def bind(self, robot: RobotFeatures) -> None:
        """Find the target, and home."""
        super().bind(robot)
        arm = robot.need(Arm)
        self._home = arm.home[: len(arm.chain.joints)]
        self._columns = find_columns(robot.environment_names, TARGET, self.name, "environment")

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Count attempts from 0."""
        self._tries[sim] = 0

    def decide(self, sim: int, seen: Observation, result: CommandResult | None) -> BrainCommand | None:
        """Return the target, or home between two attempts."""
        if result is not None and result.success and self.doing[sim] != "go home":
            self.doing[sim] = "hold"
            return None
        if result is not None and not result.success:
            if self._tries[sim] >= self.config.attempts:
                self.doing[sim] = f"give up: {result.message}"
                return None
            if self.doing[sim] != "go home":
                self.doing[sim] = "go home"
                return self._goal(sim, "home", joint_target=self._home)
        if seen.environment_state is None:
            raise AssertionError("The brain was bound to a target.")
        x, y, z, *quaternion = seen.environment_state[sim, self._columns].tolist()
        # Observations are rounded to single precision, and so is the quaternion's length.
        length = math.sqrt(sum(value * value for value in quaternion))
        if not (0.5 < length < 2 and math.isfinite(x + y + z)):
            self.doing[sim] = "give up: there is no target pose"
            return None
        self._tries[sim] += 1
        self.doing[sim] = "move the tool to the target"
        dx, dy, dz = self.config.camera_error_m
        w, i, j, k = (value / length for value in quaternion)
        return self._goal(sim, "reach", target_pose=Pose((x - dx, y - dy, z - dz), (w, i, j, k)))

    def _goal(self, sim: int, step: str, **target: Any) -> BrainCommand:
        speed, acceleration = self.config.max_velocity, self.config.max_acceleration
        return BrainCommand(self.new_id(sim, step), max_velocity=speed, max_acceleration=acceleration, **target)
