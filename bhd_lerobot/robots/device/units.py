"""What the readings of a LeRobot robot mean: each is a joint's position by two of its values."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bhd_lerobot.errors import ConfigError, unknown_name

_WORDS = {"deg": math.pi / 180, "rad": 1.0}
_MODES = {"DEGREES": "degrees", "RANGE_M100_100": "-100 to 100", "RANGE_0_100": "0 to 100"}
_HOW = "'deg', 'rad', or two readings with the positions [rad, m] that they mean: [[0.0, 0.0], [100.0, 1.57]]"


@dataclass(frozen=True)
class Motor:
    """What a robot's bus says of a feature.

    Attributes:
        mode: LeRobot's normalisation; empty if it is not known.
        half: half of its calibrated range [rad]; None if it is not known.
    """

    mode: str = ""
    half: float | None = None


@dataclass(frozen=True)
class Unit:
    """A feature of the device, of which position = scale * reading + offset; its calibrated range, if it is known."""

    feature: str
    scale: float
    offset: float = 0.0
    range: tuple[float, float] = (-math.inf, math.inf)


def unit_of(name: str, row: Any, motors: Mapping[str, Motor], features: Sequence[str], device: str) -> Unit:
    """Return what a joint's readings mean.

    Args:
        name: of the joint.
        row: what `robot.units` has for it; None if nothing.
        motors: what is known of the device's features.
        features: that the device both observes and takes.
        device: what it is called.

    Raises:
        ConfigError: the device has no such feature, or it is not known what its readings mean.
    """
    key, feature = f"robot.units.{name}", f"{name}.pos"
    if isinstance(row, Mapping):
        if extra := [one for one in row if one not in ("from", "is")]:
            raise ConfigError(unknown_name(key, extra[0], ("from", "is")))
        feature, row = str(row.get("from", feature)), row.get("is")
    if feature not in features:
        raise ConfigError(
            f"The device {device} has no {feature!r} among what it observes and takes: "
            f"{', '.join(features) or 'nothing'}. The joint {name} needs it: name it with --{key}='{{from: NAME}}', or "
            "choose another device or robot.type."
        )
    motor = motors.get(feature, Motor())
    scale, offset = _line(key, row, motor, device)
    ends = {"RANGE_M100_100": 100.0, "DEGREES": math.degrees(motor.half or math.inf)}
    high = ends.get(motor.mode, math.inf)
    low = 0.0 if motor.mode == "RANGE_0_100" else -high
    both = sorted(scale * end + offset for end in (low, 100.0 if motor.mode == "RANGE_0_100" else high))
    return Unit(feature, scale, offset, (both[0], both[1]))


def _line(key: str, row: Any, motor: Motor, device: str) -> tuple[float, float]:
    """Return the slope of positions over readings, and the position at 0."""
    if row is None and motor.mode == "DEGREES":
        return _WORDS["deg"], 0.0
    if row is None and motor.mode == "RANGE_M100_100" and motor.half:
        return motor.half / 100, 0.0
    if row is None:
        reads = f"reads {_MODES.get(motor.mode, 'numbers of an unknown unit')}"
        raise ConfigError(f"{key} is not set, and {device} {reads} there: say what that means, {_HOW}.")
    if isinstance(row, str) and row in _WORDS:
        if motor.mode and (motor.mode == "DEGREES") != (row == "deg"):
            raise ConfigError(f"{key} is {row!r}, and {device} reads {_MODES[motor.mode]} there. Leave it out.")
        return _WORDS[row], 0.0
    try:
        [(first, start), (second, end)] = [tuple(map(float, pair)) for pair in row]
    except (TypeError, ValueError):
        raise ConfigError(f"{key} is {row!r}; it must be {_HOW}.") from None
    if not all(map(math.isfinite, (first, start, second, end))) or first == second or start == end:
        raise ConfigError(f"{key} is {row!r}; its two readings and their positions must be finite, and differ.")
    scale = (end - start) / (second - first)
    return scale, start - scale * first
