"""The tool of an arm, or its joints, moved from a terminal."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.bodies.registry import body_with
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.robot import connected_robots
from bhd_lerobot.teleoperators.config_bhd_keyboard_arm import MAX_SPEED, MAX_TURN_SPEED, BhdKeyboardArmConfig
from bhd_lerobot.teleoperators.keyboard import FASTER, SLOWER, KeyboardTeleoperator, say
from bhd_lerobot.teleoperators.plain import TeleoperatorConfigError
from bhd_lerobot.teleoperators.targets import POSE_NAMES, JointTarget, Target, ToolTarget, joint_names

GRIPPER = "gripper.pos"
_GRIPPER_SPEED = 0.1  # [m/s] of the opening; an estimate, slow enough for a gripper of 0.15 m/s to follow
_GRIP_M = 0.01  # [m] that a gripper is closed further than what it may hold is wide
_LONGEST_STEP_S = 0.1  # [s] that one action moves the target for: a program that was held up does not catch up

# Which of the six coordinates, or of seven joints, a key moves, and in which direction.
_TOOL_KEYS = {
    **{"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "r": (2, 1), "f": (2, -1)},
    **{"u": (3, 1), "o": (3, -1), "i": (4, 1), "k": (4, -1), "j": (5, 1), "l": (5, -1)},
}
_ROWS = (1, "asdfhjk"), (-1, "zxcvnm,")
_JOINT_KEYS = {key: (joint, sign) for sign, row in _ROWS for joint, key in enumerate(row)}
_HELP = {
    "tool": """\
Keys of bhd_keyboard_arm, lower case, held down; any other key stops. Axes are those of the base:
w/s forward or back (x), a/d left or right (y), r/f up or down (z);
u/o, i/k, j/l turn the tool about x, y, z, counter-clockwise or clockwise;""",
    "joint": """\
Keys of bhd_keyboard_arm, lower case, held down; any other key stops:
a s d f h j k turn the joints from the base on forward, z x c v n m , below them back;""",
}


class BhdKeyboardArm(KeyboardTeleoperator):
    """A person at the keys of a terminal moves the tool of an arm, or its joints.

    Actions are absolute: keys move a target, which starts where the robot is and stays near to it. Where that is, says
    who calls `start_from` and `observe`; otherwise the robot of this package that is connected in the same process.

    Args:
        config: the configuration.
        clock: the time [s].
    """

    config_class = BhdKeyboardArmConfig
    name = "bhd_keyboard_arm"
    config: BhdKeyboardArmConfig

    def __init__(self, config: BhdKeyboardArmConfig, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(config, _TOOL_KEYS if config.action_space == "tool" else _JOINT_KEYS, clock)
        self._speed, self._turn_speed = config.speed, config.turn_speed
        self._host: Any = None  # of the robot that it has found
        self._arm = body_with(Arm).need(Arm)  # until it is known
        self._observation: Mapping[str, Any] | None = None  # that someone has passed
        self._target: Target | None = None
        self._opening, self._opening_target = 0.0, 0.0
        self._last = 0.0

    @property
    def help(self) -> str:
        """What the keys do, in lines."""
        return f"{_HELP[self.config.action_space]}\ng closes or opens the gripper, +/- speed. {self._shown}"

    @property
    def _shown(self) -> str:
        moves = f"{self._speed:.3f} m/s, " if self.config.action_space == "tool" else ""
        return f"Now {moves}{self._turn_speed:.3f} rad/s."

    @property
    def _grips(self) -> bool:
        return self._arm.gripper is not None

    @property
    def _widest(self) -> float:
        gripper = self._arm.gripper
        largest = gripper.max_opening if gripper else 0.0
        return largest if self.config.opening is None else self.config.opening

    @property
    def action_features(self) -> dict[str, type]:
        """A pose of the tool, or joint positions, and the opening of a gripper."""
        names = POSE_NAMES if self.config.action_space == "tool" else joint_names(self._arm)
        return dict.fromkeys((*names, *[GRIPPER] * self._grips), float)

    def adjust(self, key: str) -> bool:
        """Apply a key of the gripper or of the speeds."""
        if key == "g":
            self._opening_target = 0.0 if self._opening_target > self._widest / 2 else self._widest
        elif key in "+=-":
            factor = SLOWER if key == "-" else FASTER
            self._speed = min(self._speed * factor, MAX_SPEED)
            self._turn_speed = min(self._turn_speed * factor, MAX_TURN_SPEED)
            say(self._shown)
        else:
            return False
        return True

    def learn(self, body: Body) -> None:
        """Learn what robot is moved, of which its joints and its gripper count."""
        self._arm = body.arm or self._arm

    def start_from(self, observation: Mapping[str, Any], body: Body | None = None) -> None:
        """Begin where the robot is.

        Args:
            observation: the gripper's opening, and the tool's pose or the joint positions, by feature name.
            body: the robot; if None, the first type of robot that has an arm.

        Raises:
            ConfigError: the observation lacks them.
        """
        self._observation = observation
        if body is not None:
            self._arm = body.need(Arm)
        self._begin(observation)

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Take the newest observation: the target stays near to it."""
        self._observation = observation

    def _begin(self, observation: Mapping[str, Any]) -> None:
        if self._grips and GRIPPER not in observation:
            raise ConfigError(f"The observation has {', '.join(observation)}; bhd_keyboard_arm needs {GRIPPER}, too.")
        if self.config.action_space == "tool":
            self._target = ToolTarget(observation, self._arm, say)
        else:
            self._target = JointTarget(observation, self._arm)
        self._opening = self._opening_target = float(observation.get(GRIPPER, 0.0))
        if self._opening < self._widest - _GRIP_M:  # it may hold something, and is not to let it go
            self._opening_target = max(0.0, self._opening - _GRIP_M)
        self._last = self._clock()
        self._held = ""

    def get_action(self) -> dict[str, float]:
        """Return the target after the time since the last call.

        Raises:
            DeviceNotConnectedError: `connect` was not called.
            TeleoperatorConfigError: it is not known where the robot is, or that takes other actions.
        """
        self.check_connected()
        try:
            observation = self._newest()
        except ConfigError as error:
            raise TeleoperatorConfigError(str(error)) from error
        assert self._target is not None
        now = self._clock()
        step, self._last = min(now - self._last, _LONGEST_STEP_S), now
        change = np.zeros(7)
        if key := self.held(now):
            coordinate, sign = self.motions[key]
            is_length = self.config.action_space == "tool" and coordinate < 3
            change[coordinate] = sign * step * (self._speed if is_length else self._turn_speed)
        self._target.move(change, observation)
        reach = _GRIPPER_SPEED * step
        self._opening += min(max(self._opening_target - self._opening, -reach), reach)
        return dict(zip(self.action_features, (*self._target.values(), self._opening), strict=False))

    def _newest(self) -> Mapping[str, Any]:
        """Return the newest observation; begin with it if it is another robot's than before."""
        if self._observation is not None:
            if self._target is None:
                self._begin(self._observation)
            return self._observation
        robots = connected_robots()
        if len(robots) != 1:
            found = ", ".join(str(robot) for robot in robots) or "none"
            raise ConfigError(
                "bhd_keyboard_arm has to know where the arm is, and asks the robot of this package that is connected "
                f"in its process; connected are: {found}. Use --robot.type=ur5 with it, and no other robot."
            )
        (robot,) = robots
        if robot.host is not self._host:
            arm = robot.host.body.arm
            self._arm = arm or self._arm
            if list(robot.action_names) != list(self.action_features) or arm is None:
                raise ConfigError(
                    f"bhd_keyboard_arm gives {', '.join(self.action_features)}; the {robot.name} takes "
                    f"{', '.join(robot.action_names)}. An arm and its keys have one action space, tool or joint: give "
                    "--robot.action_space and --teleop.action_space. A base needs --teleop.type=bhd_keyboard_base."
                )
            self._begin(robot.last_observation)
            self._host = robot.host
        return robot.last_observation

    def disconnect(self) -> None:
        """Give the terminal back, and forget the robot. May be called twice."""
        super().disconnect()
        self._host = self._observation = self._target = None
