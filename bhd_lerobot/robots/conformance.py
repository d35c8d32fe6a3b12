"""LeRobot's contract for robots, as a function that anyone can call on any `Robot`.

    check_robot(lambda: MyRobot(MyConfig()))

raises `ConformanceError` with the first breach it finds, and returns quietly otherwise. It moves the robot: actions are
zeros unless others are given.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import BhdError


class ConformanceError(BhdError, AssertionError):
    """A robot that breaks LeRobot's contract."""


def check_robot(make_robot: Callable[[], Robot], action: Mapping[str, float] | None = None, *, frames: int = 3) -> None:
    """Check a robot against LeRobot's contract.

    Args:
        make_robot: makes a new, unconnected robot.
        action: an action that the robot may safely carry out; zeros if None.
        frames: how many observations and actions are tried.

    Raises:
        ConformanceError: names the breach.
    """
    robot = make_robot()
    observation_features = dict(robot.observation_features)
    action_features = dict(robot.action_features)
    _check_features("observation_features", observation_features)
    _check_features("action_features", action_features)
    chosen = dict.fromkeys(action_features, 0.0) if action is None else dict(action)
    _require(
        list(chosen) == list(action_features),
        f"The action to try has the keys {list(chosen)}, the robot's action features are {list(action_features)}.",
    )
    _require(hasattr(robot, "cameras"), "The robot has no attribute 'cameras'; lerobot-record needs one, {} if none.")
    _check_not_connected(robot, chosen)
    try:
        robot.connect()
        _require(robot.is_connected, "is_connected is False after connect().")
        _require(robot.is_calibrated, "is_calibrated is False after connect(), which calibrates by default.")
        _check_features_stay(robot, observation_features, action_features, "after connect()")
        _expect(DeviceAlreadyConnectedError, robot.connect, "connect() on a connected robot")
        for _ in range(frames):
            _check_observation(robot, observation_features)
            _check_action(robot, action_features, chosen)
        _check_not_shared(robot, chosen)
    finally:
        robot.disconnect()
    _require(not robot.is_connected, "is_connected is True after disconnect().")
    try:
        robot.disconnect()
    except Exception as error:
        raise ConformanceError(f"disconnect() a second time raised {error!r}; it must be idempotent.") from error
    _check_features_stay(robot, observation_features, action_features, "after disconnect()")
    _check_not_connected(robot, chosen)
    _check_context_manager(make_robot())


def _check_features(where: str, features: Mapping[str, Any]) -> None:
    _require(len(features) > 0, f"{where} is empty.")
    for name, kind in features.items():
        _require(isinstance(name, str) and "/" not in name, f"{where} has the key {name!r}; keys are str without '/'.")
        is_image = isinstance(kind, tuple) and len(kind) == 3 and all(isinstance(k, int) and k > 0 for k in kind)
        _require(
            kind is float or (is_image and where.startswith("observation")),
            f"{where}[{name!r}] is {kind!r}; LeRobot knows float, and for observations an image shape (H, W, C).",
        )
        if kind is float:
            _require(
                name.endswith((".pos", ".vel")),
                f"{where} has the float {name!r}; lerobot-rollout drops names that end in neither '.pos' nor '.vel'.",
            )


def _check_features_stay(robot: Robot, observation: dict, action: dict, when: str) -> None:
    for name, before in (("observation_features", observation), ("action_features", action)):
        now = dict(getattr(robot, name))
        _require(
            list(now.items()) == list(before.items()),
            f"{name} changed {when}: {_difference(list(before), list(now))}.",
        )


def _check_observation(robot: Robot, features: dict[str, Any]) -> None:
    observation = robot.get_observation()
    _require(isinstance(observation, dict), f"get_observation() returned {type(observation).__name__}, not a dict.")
    _require(
        list(observation) == list(features),
        f"get_observation() and observation_features differ: {_difference(list(features), list(observation))}.",
    )
    for name, kind in features.items():
        value = observation[name]
        if kind is float:
            _require(
                isinstance(value, float | np.floating) and math.isfinite(value),
                f"Observation {name!r} is {value!r}, not a finite float.",
            )
        else:
            _require(
                isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.shape == kind,
                f"Observation {name!r} must be uint8 of shape {kind}, got "
                f"{getattr(value, 'dtype', type(value).__name__)} of shape {getattr(value, 'shape', None)}.",
            )


def _check_action(robot: Robot, features: dict[str, Any], action: dict[str, float]) -> None:
    given = dict(action)
    applied = robot.send_action(action)
    _require(action == given, "send_action() changed the dict that it was given.")
    _require(
        isinstance(applied, dict) and list(applied) == list(features),
        "send_action() must return what was applied, with the keys of action_features in order; got "
        f"{list(applied) if isinstance(applied, dict) else applied!r}.",
    )
    for name, value in applied.items():
        _require(
            isinstance(value, float | np.floating) and math.isfinite(value),
            f"send_action() returned {value!r} for {name!r}, not a finite float.",
        )


def _check_not_shared(robot: Robot, action: dict[str, float]) -> None:
    """What is handed out is a copy, and what is taken in is copied."""
    first = robot.get_observation()
    kept = {name: np.copy(value) for name, value in first.items()}
    for name, value in first.items():
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value[...] = 0
        else:
            first[name] = 0.0
    second = robot.get_observation()
    applied = robot.send_action(action)
    third = {name: np.copy(value) for name, value in second.items()}
    for name in list(applied):
        applied[name] = math.nan
    robot.send_action(action)
    for name, value in second.items():
        # Nothing happened between the first two readings but the caller's writes. On a real robot readings are noisy,
        # so what may not happen is that they become what the caller wrote.
        written_over = not np.array_equal(kept[name], 0 * kept[name]) and np.array_equal(value, 0 * kept[name])
        _require(not written_over, f"Observation {name!r} shares memory with the robot: a caller's write came back.")
        _require(
            np.array_equal(value, third[name]), f"Observation {name!r} changed after it was returned: it is not a copy."
        )
    _require(first is not second, "get_observation() returns the same dict every time.")
    again = robot.send_action(action)
    _require(all(math.isfinite(v) for v in again.values()), "What send_action() returned is the robot's own state.")


def _check_not_connected(robot: Robot, action: dict[str, float]) -> None:
    _require(not robot.is_connected, "is_connected is True before connect().")
    _expect(DeviceNotConnectedError, robot.get_observation, "get_observation() without a connection")
    _expect(DeviceNotConnectedError, lambda: robot.send_action(action), "send_action() without a connection")


def _check_context_manager(robot: Robot) -> None:
    class _PlannedError(Exception):
        pass

    try:
        with robot as entered:
            _require(robot.is_connected, "The context manager did not connect.")
            _require(entered is None or entered is robot, "The context manager returned something else than the robot.")
            raise _PlannedError
    except _PlannedError:
        pass
    else:
        raise ConformanceError("The context manager swallowed an exception.")
    _require(not robot.is_connected, "The context manager left the robot connected after an exception.")


def _expect(error: type[Exception], call: Callable[[], Any], what: str) -> None:
    try:
        call()
    except error:
        return
    except Exception as other:
        raise ConformanceError(f"{what} raised {type(other).__name__}, not {error.__name__}: {other}") from other
    raise ConformanceError(f"{what} did not raise {error.__name__}.")


def _difference(expected: list[str], actual: list[str]) -> str:
    missing = [name for name in expected if name not in actual]
    extra = [name for name in actual if name not in expected]
    if missing or extra:
        return f"missing {missing[:5]}, extra {extra[:5]}"
    first = next((i for i, (a, b) in enumerate(zip(expected, actual, strict=False)) if a != b), 0)
    return f"the order or a type differs from position {first}: {expected[first]!r} expected, {actual[first]!r} found"


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConformanceError(message)
