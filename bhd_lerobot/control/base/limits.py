"""From what was requested to what is applied, with the reasons. Pure: no clock, no state, no plant."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.gradual import largest_change

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARRIVED = 1e-12  # nearer than this it is there


def limit_velocity(requested: Array, limit: Array, out: Array, changed: Mask) -> None:
    """Clip commands to the velocity limits.

    Args:
        requested: shape (n, width).
        limit: largest magnitudes, shape (width,).
        out: where the result goes, shape (n, width).
        changed: set to True where a value was clipped and left alone elsewhere, shape (n, width).
    """
    np.maximum(requested, -limit, out=out)
    np.minimum(out, limit, out=out)
    np.logical_or(changed, out != requested, out=changed)


def limit_change(requested: Array, previous: Array, largest: Array, out: Array, changed: Mask) -> bool:
    """Keep commands within the largest change from the previous ones, which is the acceleration limit.

    Args:
        requested: shape (n, width).
        previous: what was applied a tick ago, shape (n, width).
        largest: largest change in one tick, shape (n, width).
        out: where the result goes, shape (n, width); may be `previous`, may not be `requested`.
        changed: set to True where a value was held back and left alone elsewhere, shape (n, width).
    """
    step = requested - previous
    held = np.abs(step) > largest
    if not held.any():
        np.copyto(out, requested)
        return True
    np.logical_or(changed, held, out=changed)
    np.maximum(step, -largest, out=step)
    np.minimum(step, largest, out=step)
    np.add(previous, step, out=out)
    np.copyto(out, requested, where=~held)  # previous + (requested - previous) may differ in the last bit
    return False


def limit_jerk(
    requested: Array, previous: Array, rate: Array, *, largest: Array, jerk: Array, out: Array, changed: Mask
) -> Mask:
    """Bring commands to what was requested with changes that change gradually, and arrive without overshoot.

    The change of each tick is the largest from which the changes can still fall, by `jerk` from tick to tick, so that
    their sum ends at what was requested.

    Args:
        requested: shape (n, width).
        previous: what was applied a tick ago, shape (n, width).
        rate: the last change, shape (n, width); replaced by this one.
        largest: largest change in one tick, shape (n, width).
        jerk: largest difference of two changes, shape (n, width).
        out: where the result goes, shape (n, width); may be `previous`, may not be `requested`.
        changed: set to True where `largest` alone would have held a value back, and left alone elsewhere, shape (n,
            width).

    Returns:
        Which values arrived at what was requested, and rest there, shape (n, width).
    """
    step = requested - previous
    size = np.abs(step)
    size /= jerk
    np.logical_or(changed, size > largest / jerk, out=changed)
    arrived: Mask = size <= _ARRIVED / jerk
    size = largest_change(size)
    size *= jerk
    change = np.minimum(size, largest, out=size)
    np.copysign(change, step, out=change)
    np.maximum(change, rate - jerk, out=change)
    np.minimum(change, rate + jerk, out=change)
    arrived &= np.abs(rate) <= jerk
    np.add(previous, change, out=out)
    step -= change
    np.copyto(out, requested, where=np.abs(step, out=step) <= _ARRIVED)  # sums miss it by their rounding
    np.copyto(rate, change)
    np.copyto(rate, 0.0, where=arrived)
    return arrived


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
    room = np.abs(twist[:, 1])
    room *= -per_yaw
    room += limit
    room *= 1.0 / per_speed
    np.maximum(room, 0.0, out=room)
    forward = twist[:, 0]
    over = np.abs(forward) > room
    if not over.any():
        return False
    np.logical_or(changed, over, out=changed)
    np.maximum(forward, -room, out=forward)
    np.minimum(forward, room, out=forward)
    return True
