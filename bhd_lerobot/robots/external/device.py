"""A LeRobot robot's two calls, with the time at which each device answered."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError, RealtimeError

_READS = ("read", "async_read", "read_latest")  # the calls by which LeRobot's robots get an image of a camera


@dataclass(frozen=True)
class Reading:
    """What a robot observed.

    Attributes:
        state: the observation's floats, shape (features,).
        images: by camera name, shape (height, width, 3).
        state_ns: when the observation was taken: the motors had answered; monotonic [ns].
        image_ns: when each image was taken, or had come, monotonic [ns].
        reading_ns: when each of the robot's readings was measured, by name, if it states that; monotonic [ns].
    """

    state: NDArray[np.float64]
    images: dict[str, NDArray[np.uint8]]
    state_ns: int
    image_ns: dict[str, int] = field(default_factory=dict)
    reading_ns: dict[str, int] = field(default_factory=dict)

    @property
    def oldest_ns(self) -> int:
        """When the oldest number or image was measured."""
        return min([self.state_ns, *self.image_ns.values(), *self.reading_ns.values()])


class _Stamp:
    """When a camera was asked last, and when its image was taken; monotonic [ns]."""

    def __init__(self) -> None:
        self.asked_ns = self.taken_ns = 0


class Device:
    """Calls a robot by names, and checks what it returns.

    Args:
        robot: a LeRobot robot.

    Attributes:
        observation_names: names of the observation's floats, in order.
        action_names: names of the action's floats, in order.
        camera_shapes: image shapes (height, width, 3) by camera name.
        reading_names: names of the readings of which the robot states when they were measured.
        camera_period_s: time between two images of the slowest camera [s]; 0 if it is not known.

    Raises:
        ConfigError: it has features that cannot be recorded.
    """

    def __init__(self, robot: Any) -> None:
        self.robot = robot
        self.name = str(getattr(robot, "name", type(robot).__name__))
        observed, acted = dict(robot.observation_features), dict(robot.action_features)
        self.observation_names = tuple(name for name, kind in observed.items() if not isinstance(kind, tuple))
        self.camera_shapes = {name: shape for name, shape in observed.items() if isinstance(shape, tuple)}
        self.action_names = tuple(acted)
        for name, shape in self.camera_shapes.items():
            if len(shape) != 3 or shape[2] != 3:
                raise ConfigError(
                    f"The camera {name!r} of {self.name} has images of shape {shape}; images of shape (height, width, "
                    "3) can be recorded. Switch depth off in its configuration."
                )
        if not self.action_names:
            raise ConfigError(f"The robot {self.name} has no action features: there is nothing to drive.")
        self.reading_names = tuple(getattr(robot, "reading_names", ()))
        self.camera_period_s = 0.0
        self._stamps = {name: _Stamp() for name in self.camera_shapes}
        cameras = getattr(robot, "cameras", None)
        for name, camera in cameras.items() if isinstance(cameras, Mapping) else ():
            if name in self._stamps:
                _stamp_reads(camera, self._stamps[name])
                if rate := getattr(camera, "fps", None):
                    self.camera_period_s = max(self.camera_period_s, 1 / float(rate))

    @property
    def sensor_period_s(self) -> float:
        """Time between two readings of the slowest sensor or camera [s]; 0 if it is not known."""
        return max(self.camera_period_s, float(getattr(self.robot, "reading_period_s", 0.0)))

    def begin_episode(self) -> None:
        """Tell a robot that wants to know that an episode begins."""
        if callable(begin := getattr(self.robot, "begin_episode", None)):
            begin()

    def keep_torque(self) -> bool:
        """Leave the motors on when the robot is disconnected; return whether they would have been switched off."""
        parts = (self.robot, *vars(self.robot).values())  # the arms of a robot with two have options of their own
        configs = [config for part in parts if (config := getattr(part, "config", None)) is not None]
        off = [config for config in configs if getattr(config, "disable_torque_on_disconnect", False)]
        for config in off:
            config.disable_torque_on_disconnect = False
        return bool(off)

    def observe(self) -> Reading:
        """Return what the robot observes now; it may take as long as the robot takes.

        Raises:
            RealtimeError: a key is missing, a value is not finite, or an image has another shape.
        """
        started = time.monotonic_ns()
        got = self.robot.get_observation()
        ended = time.monotonic_ns()
        state = self._floats(got, self.observation_names, "get_observation")
        images: dict[str, NDArray[np.uint8]] = {}
        for name, shape in self.camera_shapes.items():
            # A copy: robots may use the array again for the next image, while this one waits for its encoder.
            image = np.array(got[name]) if name in got else None
            if image is None or image.shape != tuple(shape) or image.dtype != np.uint8:
                what = "no image" if image is None else f"an image of {image.dtype} {image.shape}"
                raise RealtimeError(f"The camera {name!r} of {self.name} gave {what}; it must be uint8 {tuple(shape)}")
            images[name] = image
        asked = [stamp.asked_ns for stamp in self._stamps.values() if stamp.asked_ns >= started]
        taken = {name: stamp.taken_ns or ended for name, stamp in self._stamps.items()}
        measured = getattr(self.robot, "reading_timestamps", {})  # as the cameras' `latest_timestamp`
        readings = {name: round(measured[name] * 1e9) for name in self.reading_names}
        return Reading(state, images, min(asked, default=ended), taken, readings)

    def send(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Send an action, shape (actions,); return what the robot says that it applied.

        Raises:
            RealtimeError: that is not finite.
        """
        wanted = dict(zip(self.action_names, action.tolist(), strict=True))
        # A copy: robots may return, or change, the very dictionary that they are given.
        returned = self.robot.send_action(dict(wanted))
        if not isinstance(returned, Mapping):
            return action.copy()
        return self._floats({**wanted, **returned}, self.action_names, "send_action")

    def measured(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an observation's floats in the order of the actions, shape (actions,); NaN where it has none."""
        by_name = dict(zip(self.observation_names, state.tolist(), strict=True))
        return np.array([by_name.get(name, math.nan) for name in self.action_names])

    def _floats(self, values: Mapping[str, Any], names: tuple[str, ...], call: str) -> NDArray[np.float64]:
        if missing := [name for name in names if name not in values]:
            raise RealtimeError(f"{call} of {self.name} returned no {missing[0]!r}; it must return {', '.join(names)}")
        try:
            floats = np.array([float(values[name]) for name in names])
        except (TypeError, ValueError) as error:
            raise RealtimeError(f"{call} of {self.name} returned what is not a number: {error}") from error
        if not np.isfinite(floats).all():
            name = names[int(np.flatnonzero(~np.isfinite(floats))[0])]
            raise RealtimeError(
                f"{call} of {self.name} returned {values[name]!r} for {name!r}, which is not a finite number"
            )
        return floats

    def known_ranges(self) -> dict[str, tuple[float, float]]:
        """Return the ranges of actions that follow from the robot's motors and their calibration, by name."""
        ranges: dict[str, tuple[float, float]] = {}
        bus, calibration = getattr(self.robot, "bus", None), getattr(self.robot, "calibration", None) or {}
        for motor, about in (getattr(bus, "motors", None) or {}).items():
            mode = str(getattr(getattr(about, "norm_mode", None), "name", ""))
            if mode == "RANGE_M100_100":
                ranges[f"{motor}.pos"] = (-100.0, 100.0)
            elif mode == "RANGE_0_100":
                ranges[f"{motor}.pos"] = (0.0, 100.0)
            elif mode == "DEGREES" and motor in calibration:
                resolution = (getattr(bus, "model_resolution_table", None) or {}).get(getattr(about, "model", ""))
                if resolution:
                    # LeRobot's degrees are counted from the middle of the calibrated range.
                    half = (calibration[motor].range_max - calibration[motor].range_min) / 2 * 360 / (resolution - 1)
                    ranges[f"{motor}.pos"] = (-half, half)
        return {name: pair for name, pair in ranges.items() if name in self.action_names}


def _stamp_reads(camera: Any, stamp: _Stamp) -> None:
    """Note when a camera is asked and when its image was taken, whichever of its calls the robot uses."""

    def stamped(call: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(call)
        def read(*arguments: Any, **options: Any) -> Any:
            stamp.asked_ns = time.monotonic_ns()
            image = call(*arguments, **options)
            taken = getattr(camera, "latest_timestamp", None)  # of `time.perf_counter`, the same clock on Linux
            stamp.taken_ns = round(taken * 1e9) if isinstance(taken, float) else time.monotonic_ns()
            return image

        return read

    for name in _READS:
        if callable(call := getattr(camera, name, None)):
            setattr(camera, name, stamped(call))
