"""The brain `teleop`: what a person does with a teleoperator is the action."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pkgutil import resolve_name
from typing import Any

import draccus
import numpy as np
from lerobot.robots.config import RobotConfig
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Command
from bhd_lerobot.errors import ActionError, BrainStoppedError, ConfigError, as_text
from bhd_lerobot.options.dotted import flattened
from bhd_lerobot.options.parse import types_of
from bhd_lerobot.options.units import other_units
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.start_pose import StartsFromObservation
from bhd_lerobot.policies.teleop.calls import Calls
from bhd_lerobot.policies.teleop.config import TeleopConfig
from bhd_lerobot.policies.teleop.mapping import ActionMap, Pair

_OURS = "bhd_lerobot."


class TeleopBrain(Brain):
    """Drives one robot with what a person does.

    Attributes:
        teleop: the teleoperator.
    """

    name = "teleop"
    uses_privileged_state = False
    config: TeleopConfig

    def __init__(self, config: TeleopConfig) -> None:
        super().__init__(config)
        self.teleop = _made(config.teleop)
        self._process = _processor(config.processor)
        self._calls: Calls | None = None
        self._map: Callable[[Mapping[str, Any]], dict[str, float] | None] = dict
        self._robot: RobotFeatures | None = None
        self._held: dict[str, float] = {}  # actions of a part that the teleoperator gives nothing of
        self._commanded: dict[str, float] = {}  # when a person takes over
        self._is_starting = True
        self._answered_s = 0.0
        self._wait_s = 0.0

    def bind(self, robot: RobotFeatures) -> None:
        """Connect the teleoperator, and find out where each action of the robot comes from.

        Raises:
            ConfigError: the teleoperator cannot be connected, or it is not known where an action comes from.
        """
        self._robot = robot
        self._wait_s = 1.0 / robot.fps
        teleop_type = str(self.config.teleop.type)
        if not self.teleop.is_connected:
            try:
                self.teleop.connect()
            except ConfigError:
                raise
            except Exception as error:  # of another package's code
                raise ConfigError(
                    f"The teleoperator {teleop_type!r} cannot be connected: {as_text(error)}. Check its power, its "
                    "cable and its port, and that no other program uses it."
                ) from error
        is_ours = _is_ours(robot), type(self.teleop).__module__.startswith(_OURS)
        if robot.body is not None and is_ours[1] and (learn := getattr(self.teleop, "learn", None)) is not None:
            learn(robot.body)
        features = tuple(self.teleop.action_features)
        if set(features) == {"dtype", "shape", "names"}:  # the other form in which LeRobot's teleoperators say it
            features = tuple(self.teleop.action_features["names"])
        if self._process is None:
            asked = flattened(self.config.map)
            drive = robot.body.drive if robot.body else None
            pair = Pair(teleop_type, robot.robot_type, is_ours[0] == is_ours[1], drive)
            known = (*asked, *pair.shares, *(features if pair.same_project else ()))
            self._held = dict.fromkeys(_held(robot, known), 0.0)
            driven = [name for name in robot.action_names if name not in self._held]
            self._map = ActionMap(asked, pair, features, driven)
            if not asked:
                self._check_units(robot)
        self._calls = self._calls or Calls(f"bhd-{teleop_type}")

    def _check_units(self, robot: RobotFeatures) -> None:
        own = draccus.encode(self.config.teleop)
        for name, driven, leader in other_units(robot.robot, own, units_only=True):
            raise ConfigError(
                f"robot.{name} is {driven}, and teleop.{name} is {leader}: the teleoperator's numbers would be "
                "taken for others. Set both alike, or translate by --map or --processor."
            )

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start an episode: the teleoperator is given time to answer.

        Raises:
            ConfigError: there are several robots.
        """
        if n != 1:
            raise ConfigError(f"n_envs is {n}; a person drives one robot: use --n_envs=1.")
        self._answered_s = time.monotonic()
        self._is_starting = True
        self._commanded = {}
        if self._calls is not None:
            self._calls.forget()

    def hold(self, action: NDArray[np.float64] | None) -> None:
        """Hold, of the part that the teleoperator gives nothing of, what is commanded now, and not what is measured.

        A gripper that holds something is measured wider open than it is commanded to be. To be called after `reset`.

        Args:
            action: shape (1, actions); None if nothing was commanded yet.
        """
        if action is not None and self._robot is not None:
            self._commanded = dict(zip(self._robot.action_names, action[0].tolist(), strict=True))

    def act(self, observation: Observation) -> Command:
        """Return what the person does now; None if nothing.

        Raises:
            BrainStoppedError: the teleoperator raises, gives no action, or has not answered for `timeout_s`.
        """
        if self._calls is None or self._robot is None:
            raise AssertionError("The brain was not bound.")
        seen = dict(zip(observation.names, observation.state[0].tolist(), strict=True))
        teleop_type = self.config.teleop.type
        try:
            self._show(seen)
            has_answered, given = self._calls.call(self.teleop.get_action, self._wait_s)
            silent = time.monotonic() - self._answered_s
            if not has_answered:
                if silent > self.config.timeout_s:
                    raise BrainStoppedError(f"the teleoperator {teleop_type} has not answered for {silent:.1f} s")
                return None
            self._answered_s = time.monotonic()
            if self._process is not None:
                given = self._process(given, seen)
            action = self._map(given)
        except (ActionError, BrainStoppedError) as error:
            raise BrainStoppedError(str(error).removesuffix(".")) from error
        except Exception as error:  # of another package's code
            raise BrainStoppedError(f"the teleoperator {teleop_type} failed: {as_text(error)}") from error
        if action is None:
            return None
        action |= self._held
        processor, values = f"the processor {self.config.processor}", []
        for name in self._robot.action_names:
            if name not in action:
                raise BrainStoppedError(f"{processor} returned no {name!r}")
            try:
                values.append(float(action[name]))
            except (TypeError, ValueError):
                what = f"{processor} returned {action[name]!r} for {name!r}, which is not a number"
                raise BrainStoppedError(what) from None
        return np.array([values])

    def _show(self, seen: dict[str, float]) -> None:
        """Take what is observed: what is held at the start, and what the teleoperator starts from."""
        if self._is_starting:
            now = seen | self._commanded
            self._held = {name: 0.0 if name.endswith(".vel") else now[name] for name in self._held}
        if isinstance(self.teleop, StartsFromObservation):
            if self._is_starting:
                self.teleop.start_from(seen, self._robot.body if self._robot else None)
            self.teleop.observe(seen)
        self._is_starting = False

    def parameters(self) -> dict[str, Any]:
        """Return the type of the teleoperator and how its actions are used; not where it is connected."""
        config = self.config
        return {
            "type": self.name,
            "teleop": str(config.teleop.type),
            **({"map": config.map} if config.map else {}),
            **({"processor": config.processor} if config.processor else {}),
        }

    def close(self) -> None:
        """Disconnect the teleoperator. May be called twice."""
        if self._calls is not None:
            self._calls.close()
            self._calls = None
        if self.teleop.is_connected:
            try:
                self.teleop.disconnect()
            except Exception as error:  # of another package's code: what was recorded is reported all the same
                kind = self.config.teleop.type
                print(f"warning: the teleoperator {kind} could not be disconnected: {as_text(error)}", file=sys.stderr)


def _is_ours(robot: RobotFeatures) -> bool:
    """Return whether a robot is of this package: its numbers are in SI units, as those of ROS are."""
    kind = RobotConfig.get_known_choices().get(robot.robot_type)
    return robot.body is not None or (kind is not None and kind.__module__.startswith(_OURS))


def _held(robot: RobotFeatures, known: Sequence[str]) -> list[str]:
    """Return the actions of the arm, or of the base that it is on, of none of which it is known where it comes from."""
    body = robot.body
    if body is None or body.arm is None or body.drive is None:
        return []
    base = [name for name in robot.action_names if name in body.drive.limits.names]
    arm = [name for name in robot.action_names if name not in base]
    if set(arm) <= set(robot.observation_names) and not set(known) & set(arm):
        return arm
    return [] if set(known) & set(base) else base


def _made(config: Any) -> Any:
    from bhd_lerobot.stock import make_teleoperator_from_config

    try:
        return make_teleoperator_from_config(config)
    except Exception as error:  # of another package's code
        raise ConfigError(
            f"teleop.type is {types_of(config)}, which cannot be made: {as_text(error.__cause__ or error)}."
        ) from error


def _processor(name: str) -> Callable[[Any, Any], Mapping[str, Any]] | None:
    if not name:
        return None
    try:
        found = resolve_name(name)
    except Exception as error:  # whatever a module raises while it is imported
        raise ConfigError(
            f"processor is {name!r}, which cannot be imported: {as_text(error)}. Name a function as "
            "package.module:name, of a module that Python finds."
        ) from error
    if not callable(found):
        raise ConfigError(f"processor is {name!r}, which cannot be called.")
    result: Callable[[Any, Any], Mapping[str, Any]] = found
    return result
