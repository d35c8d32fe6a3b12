"""From what was requested to what is applied, with the reasons. No clock, no plant.

Commands, their changes and what is said of them have shape (n, width), limits (width,). `out` may be `previous` and not
`requested`. `changed` becomes True where a value was held back, and is left alone elsewhere.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import clamp, kernel, largest_change
from bhd_lerobot.control.messages import Limit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARRIVED = 1e-12  # nearer than this it is there
_NON_FINITE, _VELOCITY, _ACCELERATION = int(Limit.NON_FINITE), int(Limit.VELOCITY), int(Limit.ACCELERATION)


@kernel()
def limit_velocity(requested: Array, limit: Array, out: Array, changed: Mask) -> None:
    """Clip commands to their largest magnitudes."""
    for sim in range(len(requested)):
        for k in range(len(limit)):
            out[sim, k] = clamp(requested[sim, k], -limit[k], limit[k])
            changed[sim, k] |= out[sim, k] != requested[sim, k]


@kernel()
def limit_change(requested: Array, previous: Array, largest: Array, out: Array, changed: Mask) -> bool:
    """Keep commands within the largest change from the previous ones, shape (n, width): the acceleration limit.

    Returns:
        Whether all are what was requested.
    """
    arrived = True
    for sim in range(len(requested)):
        for k in range(requested.shape[1]):
            step, most = requested[sim, k] - previous[sim, k], largest[sim, k]
            if abs(step) > most:
                out[sim, k] = previous[sim, k] + clamp(step, -most, most)
                changed[sim, k], arrived = True, False
            else:
                out[sim, k] = requested[sim, k]
    return arrived


@kernel()
def limit_jerk(  # noqa: PLR0917
    requested: Array, previous: Array, rate: Array, largest: Array, jerk: Array, out: Array, changed: Mask
) -> Mask:
    """Bring commands to what was requested with changes that change gradually, and arrive without overshoot.

    The change of each tick is the largest from which the changes can still fall, by `jerk` from tick to tick, so that
    their sum ends at what was requested.

    `rate` is the last change and becomes this one. `changed` is set where `largest` alone would have held a value back.

    Returns:
        Which values arrived at what was requested, and rest there, shape (n, width).
    """
    arrived = np.zeros(requested.shape, np.bool_)
    for sim in range(len(requested)):
        for k in range(len(jerk)):
            step = requested[sim, k] - previous[sim, k]
            way = abs(step) / jerk[k]
            changed[sim, k] |= way > largest[k] / jerk[k]
            arrived[sim, k] = way <= _ARRIVED / jerk[k] and abs(rate[sim, k]) <= jerk[k]
            change = math.copysign(min(largest_change(way) * jerk[k], largest[k]), step)
            change = clamp(change, rate[sim, k] - jerk[k], rate[sim, k] + jerk[k])
            out[sim, k] = previous[sim, k] + change
            if abs(step - change) <= _ARRIVED:  # sums miss it by their rounding
                out[sim, k] = requested[sim, k]
            rate[sim, k] = 0.0 if arrived[sim, k] else change
    return arrived


@kernel()
def limit_wheel_speed(twist: Array, per_speed: float, per_yaw: float, limit: float, changed: Mask) -> bool:
    """Take away forward speed until no wheel is faster than its limit, in place; the turn is kept.

    Turning has precedence because it is what avoids an obstacle, and because the two limits cannot fight: in one tick
    the yaw rate changes by so little that the forward speed which it costs stays within its own acceleration limit.

    Args:
        twist: forward speed [m/s] and yaw rate [rad/s], shape (n, 2).
        per_speed: wheel speed of a forward speed [rad/m].
        per_yaw: wheel speed of a yaw rate [rad/rad].
        limit: largest wheel speed [rad/s].
        changed: set to True for simulations that were limited and left alone elsewhere, shape (n,).
    """
    limited = False
    for sim in range(len(twist)):
        room = max((abs(twist[sim, 1]) * -per_yaw + limit) * (1.0 / per_speed), 0.0)
        if abs(twist[sim, 0]) > room:
            twist[sim, 0] = clamp(twist[sim, 0], -room, room)
            limited = changed[sim] = True
    return limited


@kernel(
    "void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], b1[::1], i8[::1], f8[::1], f8[::1], f8[:,::1], f8[::1], f8[::1])"
)
def limit_command(  # noqa: PLR0917
    target: Array,
    command: Array,
    before: Array,
    rate: Array,
    hard: Mask,
    limits: NDArray[np.int64],
    velocity: Array,
    change: Array,
    stop_change: Array,
    jerk: Array,
    wheels: Array,
) -> None:
    """Bring commands as near to their targets as one tick may, each of shape (n, 2); note why no nearer in `limits`.

    `before` becomes what the commands were a tick ago. `hard` are the robots that brake as hard as they can, with
    `stop_change`, shape (n, 2). `wheels` are the three numbers of `limit_wheel_speed`.
    """
    for sim in range(len(target)):
        # Commands are checked when they are sent; a queue in shared memory is written by another process.
        if not (math.isfinite(target[sim, 0]) and math.isfinite(target[sim, 1])):
            target[sim, 0] = target[sim, 1] = 0.0
            limits[sim] |= _NON_FINITE
        for k in range(2):
            before[sim, k] = command[sim, k]
    clipped, braking = np.empty_like(target), np.empty_like(target)
    too_fast, turning = np.zeros(target.shape, np.bool_), np.zeros(len(hard), np.bool_)
    too_sudden, held, limited = too_fast.copy(), too_fast.copy(), turning.copy()
    limit_velocity(target, velocity, clipped, too_fast)
    limit_wheel_speed(clipped, wheels[0], wheels[1], wheels[2], turning)
    limit_jerk(clipped, before, rate, change, jerk, command, too_sudden)
    limit_change(clipped, before, stop_change, braking, held)
    for sim in range(len(target)):
        for k in range(2):
            if hard[sim]:
                command[sim, k] = braking[sim, k]
                too_sudden[sim, k] |= held[sim, k]
    # Both ends of a change can be within the wheels' limit and the way between them not: the two dimensions change at
    # different rates.
    limit_wheel_speed(command, wheels[0], wheels[1], wheels[2], limited)
    for sim in range(len(target)):
        for k in range(2):
            if hard[sim] or limited[sim]:
                rate[sim, k] = command[sim, k] - before[sim, k]
            if too_fast[sim, k] or turning[sim] or limited[sim]:
                limits[sim] |= _VELOCITY
            if too_sudden[sim, k]:
                limits[sim] |= _ACCELERATION
