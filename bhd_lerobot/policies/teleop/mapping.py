"""From a teleoperator's action to a robot's: names, units, and which pairs are known to agree."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.errors import ActionError, ConfigError, unknown_name

UNITS = {"deg_to_rad": math.pi / 180, "rad_to_deg": 180 / math.pi}
"""Named scales."""

_SHARES = {"keyboard_rover": {"x.vel": "linear_velocity", "theta.vel": "angular_velocity"}}
"""Teleoperators that give shares of a base's largest speeds: action, and what they call it."""


@dataclass(frozen=True)
class Source:
    """Where an action comes from: a feature of the teleoperator, times a scale, plus an offset."""

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Pair:
    """A teleoperator and a robot.

    Attributes:
        teleop: type of the teleoperator.
        robot: type of the robot; nothing if it is not known.
        same_project: whether both are of this package, or both of LeRobot and its plug-ins: then the same name means
            the same.
        drive: that of the robot; None if it has none, or its hardware is not known.
    """

    teleop: str
    robot: str
    same_project: bool
    drive: Drive | None = None

    @property
    def shares(self) -> Mapping[str, str]:
        """The actions that the teleoperator gives as shares of a base's largest speeds, and what it calls them."""
        return _SHARES.get(self.teleop, {}) if self.drive is not None else {}


class ActionMap:
    """Turns a teleoperator's actions into a robot's.

    Args:
        asked: the options, by the full names of the robot's actions.
        pair: the teleoperator and the robot.
        features: the teleoperator's action features.
        actions: the robot's actions, in order.

    Raises:
        ConfigError: an option names no action or no feature, or it is not known where an action comes from.
    """

    def __init__(self, asked: Mapping[str, Any], pair: Pair, features: Sequence[str], actions: Sequence[str]) -> None:
        if wrong := [name for name in asked if name not in actions]:
            raise ConfigError(unknown_name("action of --map", wrong[0], actions))
        drive, shares = pair.drive, pair.shares
        largest = dict(zip(drive.limits.names, drive.limits.velocity, strict=True)) if drive else {}
        self._sources: dict[str, Source] = {}
        for action in actions:
            if action in asked:
                self._sources[action] = _source(action, asked[action], features)
            elif action in shares:
                self._sources[action] = Source(shares[action], largest[action])
            elif action in features and pair.same_project:
                self._sources[action] = Source(action)
            else:
                raise ConfigError(_unmapped(action, pair, features))

    def __call__(self, given: Mapping[str, Any]) -> dict[str, float] | None:
        """Return the robot's action; None if the teleoperator gives nothing now.

        Raises:
            ActionError: a value is missing or is not a number.
        """
        if not given:
            return None
        action = {}
        for name, source in self._sources.items():
            if source.name not in given:
                raise ActionError(f"The teleoperator gave no {source.name!r}, from which {name!r} comes.")
            try:
                action[name] = float(given[source.name]) * source.scale + source.offset
            except (TypeError, ValueError):
                raise ActionError(
                    f"The teleoperator gave {given[source.name]!r} for {source.name!r}, which is not a number."
                ) from None
        return action


def _source(action: str, asked: Any, features: Sequence[str]) -> Source:
    entry = {"from": asked} if isinstance(asked, str) else asked
    if not isinstance(entry, Mapping) or not isinstance(entry.get("from", action), str):
        raise ConfigError(f"map.{action} is {asked!r}; give a name, or {{from: NAME, scale: NUMBER}}.")
    if wrong := [key for key in entry if key not in ("from", "scale", "offset")]:
        raise ConfigError(unknown_name(f"key of map.{action}", wrong[0], ("from", "scale", "offset")))
    name = entry.get("from", action)
    if name not in features:
        raise ConfigError(unknown_name(f"feature of the teleoperator in map.{action}", name, features))
    numbers = []
    for key, default in (("scale", 1.0), ("offset", 0.0)):
        value = entry.get(key, default)
        if key == "scale" and isinstance(value, str):
            value = UNITS.get(value, value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            valid = f"a finite number{', ' + ' or '.join(UNITS) if key == 'scale' else ''}"
            raise ConfigError(f"map.{action}.{key} is {entry.get(key)!r}; it must be {valid}.")
        numbers.append(float(value))
    return Source(name, *numbers)


def _unmapped(action: str, pair: Pair, features: Sequence[str]) -> str:
    whose = f"the action {action!r} of {pair.robot or 'the robot'}"
    listed = ", ".join(features) or "nothing"
    if action in features:
        return (
            f"{pair.teleop} and {pair.robot} both have {action!r}, which does not say that they mean the same by it "
            f"(degrees and radians, for example). Say how: --map.{action}='{{from: {action}, scale: deg_to_rad}}', or "
            "scale: 1."
        )
    return (
        f"It is not known where {whose} comes from; {pair.teleop} gives {listed}. Say it: "
        f"--map.{action}='{{from: {features[0] if features else 'NAME'}, scale: 1}}'."
    )
