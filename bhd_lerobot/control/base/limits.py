"""From what was requested to what is applied, with the reasons. No clock, no plant; see `control.kernels`."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import clamp, kernel, largest_change

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARRIVED = 1e-12  # nearer than this it is there


@kernel()
def limit_velocity(requested: Array, limit: Array, out: Array, changed: Mask) -> None:
    """Clip commands to the velocity limits.

    Args:
        requested: shape (n, width).
        limit: largest magnitudes, shape (width,).
        out: where the result goes, shape (n, width).
        changed: set to True where a value was clipped and left alone elsewhere, shape (n, width).
    """
    for sim in range(len(requested)):
        for k in range(len(limit)):
            out[sim, k] = clamp(requested[sim, k], -limit[k], limit[k])
            changed[sim, k] |= out[sim, k] != requested[sim, k]


@kernel()
def limit_change(requested: Array, previous: Array, largest: Array, out: Array, changed: Mask) -> bool:
    """Keep commands within the largest change from the previous ones, which is the acceleration limit.

    Args:
        requested: shape (n, width).
        previous: what was applied a tick ago, shape (n, width).
        largest: largest change in one tick, shape (n, width).
        out: where the result goes, shape (n, width); may be `previous`, may not be `requested`.
        changed: set to True where a value was held back and left alone elsewhere, shape (n, width).
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
def limit_jerk(
    requested: Array, previous: Array, rate: Array, largest: Array, jerk: Array, out: Array, changed: Mask
) -> Mask:
    """Bring commands to what was requested with changes that change gradually, and arrive without overshoot.

    The change of each tick is the largest from which the changes can still fall, by `jerk` from tick to tick, so that
    their sum ends at what was requested.

    Args:
        requested: shape (n, width).
        previous: what was applied a tick ago, shape (n, width).
        rate: the last change, shape (n, width); replaced by this one.
        largest: largest change in one tick, shape (width,).
        jerk: largest difference of two changes, shape (width,).
        out: where the result goes, shape (n, width); may be `previous`, may not be `requested`.
        changed: set to True where `largest` alone would have held a value back, and left alone elsewhere, shape (n,
            width).

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
    "void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8[::1], "
    "f8, f8, f8, b1[::1], b1[:,::1], b1[:,::1], b1[::1])"
)
def limit_command(
    target: Array,
    command: Array,
    before: Array,
    rate: Array,
    hard: Mask,
    clipped: Array,
    velocity: Array,
    change: Array,
    stop_change: Array,
    jerk: Array,
    per_speed: float,
    per_yaw: float,
    wheel_limit: float,
    not_finite: Mask,
    limited_velocity: Mask,
    limited_change: Mask,
    limited_wheels: Mask,
) -> None:
    """Bring commands nearer to their targets, as near as one tick may.

    Args:
        target: shape (n, 2); what is not finite becomes rest.
        command: what was applied a tick ago and becomes what is applied now, shape (n, 2).
        before: becomes what was applied a tick ago, shape (n, 2).
        rate: the last change, shape (n, 2); replaced by this one.
        hard: which robots brake as hard as they can, shape (n,).
        clipped: becomes the targets within the limits, shape (n, 2).
        velocity: largest magnitudes, shape (2,).
        change: largest changes in one tick, shape (2,).
        stop_change: those of robots that brake hard, shape (n, 2).
        jerk: largest differences of two changes, shape (2,).
        per_speed: see `limit_wheel_speed`, as the next two.
        per_yaw: wheel speed of a yaw rate [rad/rad].
        wheel_limit: largest wheel speed [rad/s].
        not_finite: set to True where a target was not finite, shape (n,).
        limited_velocity: see `limit_velocity`.
        limited_change: see `limit_change`.
        limited_wheels: see `limit_wheel_speed`.
    """
    for sim in range(len(target)):
        # Commands are checked when they are sent; a queue in shared memory is written by another process.
        if not (math.isfinite(target[sim, 0]) and math.isfinite(target[sim, 1])):
            target[sim, 0], target[sim, 1], not_finite[sim] = 0.0, 0.0, True
        for k in range(2):
            before[sim, k] = command[sim, k]
    limit_velocity(target, velocity, clipped, limited_velocity)
    limit_wheel_speed(clipped, per_speed, per_yaw, wheel_limit, limited_wheels)
    limit_jerk(clipped, before, rate, change, jerk, command, limited_change)
    braking, held, limited = np.empty_like(command), np.zeros(command.shape, np.bool_), np.zeros(len(hard), np.bool_)
    limit_change(clipped, before, stop_change, braking, held)
    for sim in range(len(target)):
        for k in range(2):
            if hard[sim]:
                command[sim, k] = braking[sim, k]
                limited_change[sim, k] |= held[sim, k]
    # Both ends of a change can be within the wheels' limit and the way between them not: the two dimensions change at
    # different rates.
    limit_wheel_speed(command, per_speed, per_yaw, wheel_limit, limited)
    for sim in range(len(target)):
        limited_wheels[sim] |= limited[sim]
        for k in range(2):
            if hard[sim] or limited[sim]:
                rate[sim, k] = command[sim, k] - before[sim, k]
