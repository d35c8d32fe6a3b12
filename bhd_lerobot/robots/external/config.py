"""Options of what stands between a brain and another package's robot."""

import math
from dataclasses import dataclass, field
from typing import Any

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Options, Positive
from bhd_lerobot.options.dotted import flattened

FPS = 30
"""Frames a second of a robot whose configuration does not say it, as with LeRobot's recorder [Hz]."""


@dataclass
class GateConfig(Options, prefix="gate."):
    """What is let through to a robot that is not ours; ours have a cerebellum, and refuse it.

    Attributes:
        range: lowest and highest value of an action by its name, `--gate.range.x.vel='[-0.2, 0.2]'`; where there is
            none, that of the robot's calibration, if it says one.
        max_change: largest change of an action from one frame to the next, in its unit: by name, or one number for
            all positions (names that end in `.pos`); not limited if not set.
        brain_timeout_s: after so long without an action the robot holds: positions stay, speeds are 0 [s].
        end_timeout_s: after so long without an action the episode ends with a fault [s].
        call_timeout_s: after so long a call of the robot that has not returned ends the episode with a fault [s].
    """

    range: dict[str, Any] = field(default_factory=dict)
    max_change: Any = None
    brain_timeout_s: Positive = 0.5
    end_timeout_s: Positive = 5.0
    call_timeout_s: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, pair in flattened(self.range).items():
            if not (
                isinstance(pair, list | tuple) and len(pair) == 2 and all(map(_is_number, pair)) and pair[0] < pair[1]
            ):
                raise ConfigError(f"gate.range.{name} is {pair!r}; give the lowest and the highest value: [-1.0, 1.0].")
        changes = flattened(self.max_change) if isinstance(self.max_change, dict) else {"": self.max_change}
        for name, change in changes.items():
            if change is not None and not (_is_number(change) and change > 0):
                raise ConfigError(
                    f"gate.max_change{'.' * bool(name)}{name} is {change!r}; it must be a positive number, a frame's "
                    "largest change in the action's unit."
                )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
