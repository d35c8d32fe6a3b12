"""LeRobot's contract for robots, as a function that anyone can call on any `Robot`.

    findings = check_robot(lambda: MyRobot(MyConfig()))

raises `ConformanceError` with the first breach it finds; otherwise it returns what a caller should know all the same.
"""

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from bhd_lerobot.errors import BhdError, ConfigError

_NOT_FINITE = (math.nan, math.inf, -math.inf)


class ConformanceError(BhdError, AssertionError):
    """A robot that breaks LeRobot's contract."""


def check_robot(
    make_robot: Callable[[], Robot],
    action: Mapping[str, float] | None = None,
    *,
    frames: int = 3,
    adversarial: bool = False,
) -> tuple[str, ...]:
    """Check a robot against LeRobot's contract.

    What a real robot goes through: it is connected twice by `connect()`, which starts a calibration if it is not
    calibrated, and connected once more while it is connected. In between it gets one and the same action `frames` + 2
    times, without a pause, and is observed. Then it is disconnected; an arm that switches its motors off
    then falls, so support it. A robot that takes actions without a connection gets this action then, too. Nothing else
    is sent, and nothing that the robot handed out is written to.

    Args:
        make_robot: makes a new, unconnected robot.
        action: an action that the robot may safely carry out from wherever it is. If None, the one that leaves it where
            it is: the positions that it observes when it is connected, and speeds of zero.
        frames: how many observations and actions are tried.
        adversarial: also write into what the robot handed out, and send it NaN and infinities, which it must refuse
            with an exception or replace. For simulations: a real robot that fails this moves somewhere unintended.

    Returns:
        Findings that are no breach, since robots of LeRobot have them as well.

    Raises:
        ConformanceError: names the breach. The robot was disconnected; if that failed, a note of the error says so.
        ConfigError: the action is not finite, or there is none and the robot does not observe all that it is commanded.
    """
    robot = make_robot()
    observation_features = dict(robot.observation_features)
    action_features = dict(robot.action_features)
    _check_features("observation_features", observation_features)
    _check_features("action_features", action_features)
    if action is not None:
        _check_given(action, action_features)
    _require(hasattr(robot, "cameras"), "The robot has no attribute 'cameras'; lerobot-record needs one, {} if none.")
    # Nothing is sent before it is known where the robot is.
    _check_not_connected(robot)
    with _disconnected_after_error(robot):
        robot.connect()
        _require(robot.is_connected, "is_connected is False after connect().")
        _require(robot.is_calibrated, "is_calibrated is False after connect(), which calibrates by default.")
        _check_features_stay(robot, observation_features, action_features, "after connect()")
        _expect(DeviceAlreadyConnectedError, robot.connect, "connect() on a connected robot")
        seen = _check_observation(robot, observation_features)
        chosen = _stay(seen, action_features) if action is None else dict(action)
        for _ in range(frames):
            _check_observation(robot, observation_features)
            _check_action(robot, action_features, chosen)
        findings = _dropped({**observation_features, **action_features}) + _check_not_shared(robot, chosen)
        if adversarial:
            _check_writes(robot, chosen)
            _check_not_finite(robot, chosen)
        robot.disconnect()
        _require(not robot.is_connected, "is_connected is True after disconnect().")
    findings += _check_second_disconnect(robot)
    _check_features_stay(robot, observation_features, action_features, "after disconnect()")
    fresh = make_robot()
    for unconnected in (robot, fresh):
        _check_not_connected(unconnected)
        send = functools.partial(unconnected.send_action, dict(chosen))
        with _disconnected_after_error(unconnected):
            _expect(DeviceNotConnectedError, send, "send_action() without a connection")
    with _disconnected_after_error(fresh):
        _check_context_manager(fresh)
    return tuple(findings)


@contextlib.contextmanager
def _disconnected_after_error(robot: Robot) -> Iterator[None]:
    """Disconnect a robot after an error, which stays the error that is reported."""
    try:
        yield
    except BaseException as error:
        try:
            robot.disconnect()
        except DeviceNotConnectedError:
            pass
        except Exception as other:
            error.add_note(f"disconnect() after this raised {other!r}; the robot may still be on.")
        raise


def _check_given(action: Mapping[str, float], features: Mapping[str, Any]) -> None:
    _require(
        list(action) == list(features),
        f"The action to try has the keys {list(action)}, the robot's action features are {list(features)}.",
    )
    wrong = {name: value for name, value in action.items() if not math.isfinite(value)}
    if wrong:
        raise ConfigError(
            f"The action to try has {wrong}; its values must be finite. Whether the robot refuses others is tried by "
            "adversarial=True."
        )


def _stay(observation: Mapping[str, Any], features: Mapping[str, Any]) -> dict[str, float]:
    """Return the action that leaves a robot where it is."""
    unknown = [name for name in features if not name.endswith(".vel") and name not in observation]
    if unknown:
        raise ConfigError(
            f"The robot does not observe {', '.join(map(repr, unknown))}, so the action that leaves it where it is, is "
            "not known. Give one that it may safely carry out: check_robot(make_robot, action={…})."
        )
    return {name: 0.0 if name.endswith(".vel") else float(observation[name]) for name in features}


def _check_features(where: str, features: Mapping[str, Any]) -> None:
    _require(len(features) > 0, f"{where} is empty.")
    for name, kind in features.items():
        _require(isinstance(name, str) and "/" not in name, f"{where} has the key {name!r}; keys are str without '/'.")
        is_image = isinstance(kind, tuple) and len(kind) == 3 and all(isinstance(k, int) and k > 0 for k in kind)
        _require(
            kind is float or (is_image and where.startswith("observation")),
            f"{where}[{name!r}] is {kind!r}; LeRobot knows float, and for observations an image shape (H, W, C).",
        )


def _dropped(features: Mapping[str, Any]) -> list[str]:
    """Return the finding on what stock policies on the robot do not get or give, if there is such."""
    names = [name for name, kind in features.items() if kind is float and not name.endswith((".pos", ".vel"))]
    if not names:
        return []
    return [
        f"lerobot-rollout drops {', '.join(map(repr, names))}, whose names end in neither '.pos' nor '.vel'; recording "
        "keeps them, so a policy that is trained on them does not run there."
    ]


def _check_features_stay(robot: Robot, observation: dict, action: dict, when: str) -> None:
    for name, before in (("observation_features", observation), ("action_features", action)):
        now = dict(getattr(robot, name))
        _require(
            list(now.items()) == list(before.items()),
            f"{name} changed {when}: {_difference(list(before), list(now))}.",
        )


def _check_observation(robot: Robot, features: dict[str, Any]) -> dict[str, Any]:
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
    return observation


def _check_action(robot: Robot, features: dict[str, Any], action: dict[str, float]) -> None:
    given = dict(action)
    applied = robot.send_action(given)
    _require(given == action, "send_action() changed the dict that it was given.")
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


def _check_not_shared(robot: Robot, action: dict[str, float]) -> list[str]:
    """Check without writing that returned values belong to the caller; return findings."""
    first = robot.get_observation()
    before = {name: np.copy(value) for name, value in first.items()}
    # A robot may return the very dict that it was given, as some of LeRobot's do, so it gets two.
    applied = [robot.send_action(dict(action)) for _ in range(2)]
    second = robot.get_observation()
    _require(first is not second, "get_observation() returns the same dict every time.")
    _require(applied[0] is not applied[1], "send_action() returns the same dict every time: the robot's own state.")
    for name, value in first.items():
        _require(
            np.array_equal(value, before[name]),
            f"Observation {name!r} changed after it was returned: it is not a copy.",
        )
    shared = [name for name, value in first.items() if np.ndim(value) and np.shares_memory(value, second[name])]
    if not shared:
        return []
    return [
        f"Two observations shared the memory of {', '.join(map(repr, shared))}: copy an image before writing to it."
    ]


def _check_writes(robot: Robot, action: dict[str, float]) -> None:
    """Check that what a caller writes into what it got comes back from nowhere."""
    first = robot.get_observation()
    before = {name: np.copy(value) for name, value in first.items()}
    for name, value in first.items():
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value[...] = 0
        else:
            first[name] = 0.0
    for name, value in robot.get_observation().items():
        # On a real robot readings are noisy, so what may not happen is that they become what the caller wrote.
        written_over = not np.array_equal(before[name], 0 * before[name]) and np.array_equal(value, 0 * before[name])
        _require(not written_over, f"Observation {name!r} shares memory with the robot: a caller's write came back.")
    applied = robot.send_action(dict(action))
    for name in list(applied):
        applied[name] = math.nan
    _check_finite(robot, "What a caller wrote into the action that send_action() returned came back in an observation.")
    again = robot.send_action(dict(action))
    _require(all(map(math.isfinite, again.values())), "What send_action() returned is the robot's own state.")


def _check_not_finite(robot: Robot, action: dict[str, float]) -> None:
    for name in action:
        for bad in _NOT_FINITE:
            try:
                applied = robot.send_action({**action, name: bad})
            except Exception:
                applied = {}
            _require(
                all(map(math.isfinite, applied.values())),
                f"send_action() took {bad} for {name!r} and returned {applied}; what is not finite must be refused.",
            )
            _check_finite(
                robot, f"An observation is not finite after the action {name!r} was {bad}: it reached the robot."
            )
    robot.send_action(dict(action))


def _check_finite(robot: Robot, message: str) -> None:
    _require(all(np.isfinite(value).all() for value in robot.get_observation().values()), message)


def _check_not_connected(robot: Robot) -> None:
    _require(not robot.is_connected, "is_connected is True without connect().")
    _expect(DeviceNotConnectedError, robot.get_observation, "get_observation() without a connection")


def _check_second_disconnect(robot: Robot) -> list[str]:
    try:
        robot.disconnect()
    except DeviceNotConnectedError:
        return ["disconnect() a second time raises DeviceNotConnectedError: ask is_connected before, when cleaning up."]
    except Exception as error:
        raise ConformanceError(
            f"disconnect() a second time raised {error!r}; it may do nothing or raise DeviceNotConnectedError."
        ) from error
    return []


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
