"""A rule: drive until something is near in front, then turn left."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive, LidarSpec
from bhd_lerobot.options.declared import Finite, Range
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures, find_columns, find_scan
from bhd_lerobot.policies.navigation.driving import resting

_ROUNDING = 1e-6  # [m]


@BrainConfig.register_subclass("avoidance")
@dataclass
class AvoidanceConfig(BrainConfig):
    """Parameters of the avoidance rule.

    Attributes:
        renamed: what nodes of ROS 2 tutorials call them, whose names are read, too.
        front_sector_deg: the front sector reaches this far to either side [deg].
        safe_distance_m: nearer than this in the front sector, the robot turns [m].
        forward_speed: speed when the way is free [m/s].
        turn_speed: yaw rate when it is not, positive to the left [rad/s].
        range_min_m: a reading below this is not valid [m].
        range_max_m: a reading above this is not valid [m]; a beam without a return reads exactly this.
    """

    renamed: ClassVar[dict[str, str]] = {
        "safe_distance": "safe_distance_m",
        "linear_speed": "forward_speed",
        "angular_speed": "turn_speed",
    }

    front_sector_deg: Annotated[float, Range("(0, 180]")] = 30.0
    safe_distance_m: Finite = 0.5
    forward_speed: Finite = 0.2
    turn_speed: Finite = 0.5
    range_min_m: Finite = 0.12
    range_max_m: Finite = 3.5


class AvoidanceBrain(Brain):
    """Front sector ±30°; nothing nearer than 0.5 m: 0.2 m/s ahead; otherwise turn left at 0.5 rad/s; blind: stop."""

    name = "avoidance"
    needs = (Drive, LidarSpec)
    uses_privileged_state = False

    def __init__(self, config: AvoidanceConfig | None = None) -> None:
        self.config = config or AvoidanceConfig()
        self._scan = slice(0)
        self._front: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._forward = self._turn = 0
        self._rest: NDArray[np.float64] = np.zeros(0)

    def bind(self, robot: RobotFeatures) -> None:
        """Find the scan and the twist."""
        self._scan, angles = find_scan(robot.observation_names, self.name)
        self._front = np.abs(angles) <= math.radians(self.config.front_sector_deg) + 1e-9
        self._forward, self._turn = find_columns(robot.action_names, ("x.vel", "theta.vel"), self.name, "action")
        self._rest = resting(robot, self.name)

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Return the twist, shape (n, actions)."""
        config = self.config
        front = observation.state[:, self._scan][:, self._front]
        # A reading at a limit is valid, also after it was rounded to single precision. False for NaN.
        valid = (front >= config.range_min_m - _ROUNDING) & (front <= config.range_max_m + _ROUNDING)
        nearest = np.where(valid, front, np.inf).min(axis=1)
        seen = valid.any(axis=1)
        free = nearest >= config.safe_distance_m
        action = np.tile(self._rest, (len(front), 1))
        action[:, self._forward] = np.where(seen & free, config.forward_speed, 0.0)
        action[:, self._turn] = np.where(seen & ~free, config.turn_speed, 0.0)
        return action
