"""What brains have in common that drive along free paths: parameters, inputs and the twist."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive, LidarSpec
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Positive, Range, Share
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.navigation.clearance import LONGEST, Footprint, Paths, make_paths
from bhd_lerobot.policies.navigation.scan import ScanReader
from bhd_lerobot.policies.navigation.steering import Steering

PLACE_SPACING = 0.2  # [m] between two places of a path that are judged
_TWIST = ("x.vel", "theta.vel")

Array = NDArray[np.float64]


@dataclass
class DrivingConfig(BrainConfig):
    """Parameters of driving along free paths.

    Attributes:
        forward_speed: speed when driving straight [m/s]; the base's largest if not set.
        rim_speed: highest speed of a wheel's rim [m/s], that of the base if not set; turning costs forward speed.
        turn_speed: highest yaw rate [rad/s].
        settle_s: a heading error is corrected in about this time [s].
        margin_m: room that a path leaves beside the robot, where there is any [m].
        stop_m: a path must be free for this much more than its turn, so that the robot can turn around in time [m].
        horizon_m: paths are judged up to this length [m].
        range_min_m: a reading below this is not valid [m]; the lidar's shortest range if not set.
        range_max_m: a reading above this is not valid [m]; a beam without a return reads exactly this, the lidar's
            longest range if not set.
    """

    forward_speed: Positive | None = None
    rim_speed: Positive | None = None
    turn_speed: Positive = 2.0
    settle_s: Positive = 0.35
    margin_m: NotNegative = 0.05
    stop_m: Share = 0.35
    horizon_m: Annotated[float, Range(f"[{PLACE_SPACING}, {LONGEST}]")] = 3.4
    range_min_m: NotNegative | None = None
    range_max_m: Positive | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.forward_speed or 0.0) > (self.rim_speed or math.inf):
            raise ConfigError(
                f"brain.forward_speed is {self.forward_speed}; the wheels reach brain.rim_speed, {self.rim_speed}."
            )
        if (self.range_min_m or 0.0) >= (self.range_max_m or math.inf):
            raise ConfigError(
                f"brain.range_min_m is {self.range_min_m}; it must be below brain.range_max_m, {self.range_max_m}."
            )

    def of(self, drive: Drive, lidar: LidarSpec) -> Self:
        """Return the parameters for a base: what is not set is what its body says.

        Raises:
            ConfigError: what is set does not fit that.
        """
        rim = self.rim_speed or round(drive.max_wheel_speed * drive.wheel_radius, 6)
        return replace(
            self,
            forward_speed=self.forward_speed or min(drive.limits.velocity[0], rim),
            rim_speed=rim,
            range_min_m=lidar.range_min if self.range_min_m is None else self.range_min_m,
            range_max_m=self.range_max_m or lidar.range_max,
        )


def resting(robot: RobotFeatures, who: str) -> Array:
    """Return the action of a base that stands, with its arm over it if it has one, shape (actions,)."""
    action = np.zeros(len(robot.action_names))
    if robot.body is not None and (arm := robot.body.arm) is not None:
        action[find_columns(robot.action_names, arm.limits.names, who, "action")] = arm.home
    return action


class DrivingBrain(Brain):
    """Reads a scan and the measured twist, and commands a twist along one of `_paths`, for `_n` robots."""

    needs = (Drive, LidarSpec)
    has_narrow = True
    """Whether it drives through places with less room than usual, which needs a table of its own."""
    config: Any
    bound: Any = None
    """The parameters for the robot that it is bound to."""
    _paths: Paths
    _n: int

    def bind(self, robot: RobotFeatures) -> None:
        """Find the scan and the twist, and prepare the look-up table for this shape and this number of beams."""
        if robot.body is None or robot.body.drive is None or robot.body.lidar is None:
            raise ConfigError(
                f"The brain {self.name!r} needs to know the shape of its robot; it drives simulated bases with a lidar."
            )
        config = self.bound = self.config.of(robot.body.drive, robot.body.lidar)
        self._paths = make_paths(config.forward_speed, config.rim_speed, Footprint.of(robot.body))
        self._prepare(self._paths)
        self._reader = ScanReader(robot.observation_names, self.name, (config.range_min_m, config.range_max_m))
        self._measured = find_columns(robot.observation_names, _TWIST, self.name, "observation")
        self._commanded = find_columns(robot.action_names, _TWIST, self.name, "action")
        self._rest, self._dt = resting(robot, self.name), 1.0 / robot.fps
        self._steering = Steering(
            self._paths,
            self._reader,
            margin=config.margin_m,
            stop=config.stop_m,
            limits=(config.forward_speed, config.rim_speed, config.turn_speed),
            settle=config.settle_s,
            range_max=config.range_max_m,
            has_narrow=self.has_narrow,
        )

    def parameters(self) -> dict[str, Any]:
        """Return the type and the parameters; once it is bound, as they are for its robot."""
        return {"type": self.name, **asdict(self.bound or self.config)}

    def _prepare(self, paths: Paths) -> None:
        """Compute what follows from the paths alone."""

    def _check_count(self, observation: Observation) -> None:
        if len(observation.state) != self._n:
            raise ConfigError(
                f"The brain {self.name!r} was reset for {self._n} robots and sees {len(observation.state)}."
            )

    def _twist(self, blind: NDArray[np.bool_], forward: Array, turn: Array) -> Array:
        """Return the action, shape (n, actions): a twist, each part of shape (n,), or rest where a robot is blind."""
        action = np.tile(self._rest, (len(blind), 1))
        action[:, self._commanded] = np.where(blind, 0.0, (forward, turn)).T
        return action
