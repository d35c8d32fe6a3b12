"""A base driven from a terminal, with the keys of ROS's `teleop_twist_keyboard`."""

import time
from collections.abc import Callable

from bhd_lerobot.teleoperators.config_bhd_keyboard_base import BhdKeyboardBaseConfig
from bhd_lerobot.teleoperators.keyboard import FASTER, SLOWER, KeyboardTeleoperator, say

_HELP = """\
Keys of bhd_keyboard_base, lower case, held down; any other key stops:
   u   i   o      forward and left     forward   forward and right
   j   k   l      turn left            stop      turn right
   m   ,   .      back, turning right  back      back, turning left
q/z both speeds 10 % up or down, w/x speed, r/v yaw rate."""

# Signs of the speed and of the yaw rate, positive to the left.
_MOTIONS = {
    **{"u": (1, 1), "i": (1, 0), "o": (1, -1)},
    **{"j": (0, 1), "l": (0, -1)},
    **{"m": (-1, -1), ",": (-1, 0), ".": (-1, 1)},
}
# Factors of the speed and of the yaw rate.
_FACTORS = {
    **{"q": (FASTER, FASTER), "w": (FASTER, 1.0), "r": (1.0, FASTER)},
    **{"z": (SLOWER, SLOWER), "x": (SLOWER, 1.0), "v": (1.0, SLOWER)},
}


class BhdKeyboardBase(KeyboardTeleoperator):
    """A person at the keys of a terminal drives a base.

    The keys are those of `teleop_twist_keyboard`, but for the yaw rate: ``r`` and ``v`` change it, because ``e`` is
    kept for the emergency stop.

    Args:
        config: the configuration.
        clock: the time [s].
    """

    config_class = BhdKeyboardBaseConfig
    name = "bhd_keyboard_base"

    def __init__(self, config: BhdKeyboardBaseConfig, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(config, _MOTIONS, clock)
        self._speeds = config.linear_speed, config.angular_speed
        self._most = config.max_linear_speed, config.max_angular_speed

    @property
    def help(self) -> str:
        """What the keys do, in lines."""
        return f"{_HELP} {self._shown}"

    @property
    def _shown(self) -> str:
        return f"Now {self._speeds[0]:.3f} m/s, {self._speeds[1]:.3f} rad/s."

    @property
    def action_features(self) -> dict[str, type]:
        """The speed forward [m/s] and the yaw rate [rad/s]."""
        return {"x.vel": float, "theta.vel": float}

    def adjust(self, key: str) -> bool:
        """Apply a key that changes speeds."""
        if key not in _FACTORS:
            return False
        linear, angular = (
            min(speed * factor, most)
            for speed, factor, most in zip(self._speeds, _FACTORS[key], self._most, strict=True)
        )
        self._speeds = linear, angular
        say(self._shown)
        return True

    def get_action(self) -> dict[str, float]:
        """Return the velocity that the held key asks for.

        Raises:
            DeviceNotConnectedError: `connect` was not called.
        """
        self.check_connected()
        linear, angular = self.motions.get(self.held(self._clock()), (0, 0))
        return {"x.vel": linear * self._speeds[0], "theta.vel": angular * self._speeds[1]}
