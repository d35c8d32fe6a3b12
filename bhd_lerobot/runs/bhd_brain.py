"""Any brain as a LeRobot teleoperator, so that the stock command lines can be driven by it."""

from functools import cached_property
from typing import Any

import numpy as np
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.robots.simulated_robot import SimulatedRobot, connected_robots
from bhd_lerobot.robots.simulation import TurtleBot3Simulation
from bhd_lerobot.runs.config_bhd_brain import BhdBrainConfig
from bhd_lerobot.runs.registry import make_brain


class BhdBrain(Teleoperator):
    """A brain in place of a person: its actions follow from what the robot in this process last observed.

    LeRobot asks a teleoperator for actions and shows it nothing; this one looks at the simulated robot that is
    connected in the same process.

    Args:
        config: the configuration.
    """

    config_class = BhdBrainConfig
    name = "bhd_brain"

    def __init__(self, config: BhdBrainConfig) -> None:
        super().__init__(config)
        self.config = config
        self._is_connected = False
        self._brain: Brain | None = None
        self._robot: SimulatedRobot | None = None

    @cached_property
    def action_features(self) -> dict[str, type]:
        """The actions that it gives."""
        return dict.fromkeys(TurtleBot3Simulation.action_names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """It takes no feedback."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """A brain needs no calibration."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Get ready; the robot may be connected later.

        Raises:
            DeviceAlreadyConnectedError: it is connected.
        """
        if self._is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        self._is_connected = True

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure beyond the configuration."""

    def get_action(self) -> dict[str, Any]:
        """Return what the brain wants, given the robot's last observation.

        Raises:
            DeviceNotConnectedError: `connect` was not called.
            ConfigError: there is no robot to drive, or several and `robot_id` does not choose.
        """
        if not self._is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected. Call connect() first.")
        robot = self._find_robot()
        if robot is not self._robot or self._brain is None:
            self._brain = make_brain(self.config.brain)
            self._brain.bind(robot.observation_names, robot.action_names, self.config.fps or robot.config.fps)
            self._brain.reset(np.zeros(1, np.intp), [self.config.seed], 1)
            self._robot = robot
        seen = robot.last_observation
        state = np.array([[seen[name] for name in robot.observation_names]])
        images = {name: seen[name][None] for name in robot.camera_shapes}
        action = self._brain.act(Observation(robot.observation_names, state, images))
        return dict(zip(robot.action_names, action[0].tolist(), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: a brain feels no feedback."""

    def disconnect(self) -> None:
        """Forget the robot. May be called twice."""
        self._is_connected = False
        self._brain = self._robot = None

    def _find_robot(self) -> SimulatedRobot:
        robots = connected_robots()
        if self.config.robot_id is not None:
            robots = [robot for robot in robots if robot.id == self.config.robot_id]
            if not robots:
                names = [str(robot.id) for robot in connected_robots()]
                raise ConfigError(unknown_name("teleop.robot_id", self.config.robot_id, names))
        if len(robots) != 1:
            found = ", ".join(str(robot) for robot in robots) or "none"
            raise ConfigError(
                f"bhd_brain drives one simulated robot of its own process; connected are: {found}. "
                "Use --robot.type=turtlebot3, and --teleop.robot_id if there are several."
            )
        return robots[0]
