"""Twist to wheel speeds and back, and odometry, for a base with two driven wheels on one axis."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.kernels import kernel

Array = NDArray[np.float64]


@kernel()
def wheels_from_twist(twist: Array, per_speed: float, per_yaw: float, out: Array) -> None:
    """Write the wheel speeds of twists [rad/s], shape (n, 2).

    Args:
        per_speed: a wheel's speed for each forward speed [rad/m].
        per_yaw: and for each yaw rate [rad/rad].
    """
    for sim in range(len(twist)):
        straight, turn = twist[sim, 0] * per_speed, twist[sim, 1] * per_yaw
        out[sim, 0], out[sim, 1] = straight - turn, straight + turn


@kernel("void(f8[:,:], f8[:,::1], f8[:,::1], f8, f8, f8)")
def integrate(  # noqa: PLR0917
    angles: Array, encoder: Array, odometry: Array, count: float, per_count: float, yaw_per_count: float
) -> None:
    """Add the motion since the last update to `odometry`, and take the encoders' counts over into `encoder`."""
    for sim in range(len(angles)):
        left, right = np.floor(angles[sim, 0] * count), np.floor(angles[sim, 1] * count)
        moved_left, moved_right = left - encoder[sim, 0], right - encoder[sim, 1]
        encoder[sim, 0], encoder[sim, 1] = left, right
        distance, turn = (moved_left + moved_right) * per_count, (moved_right - moved_left) * yaw_per_count
        heading = turn * 0.5 + odometry[sim, 2]
        odometry[sim, 0] += np.cos(heading) * distance
        odometry[sim, 1] += np.sin(heading) * distance
        odometry[sim, 2] += turn


class DiffDrive:
    """Kinematics and odometry of n bases.

    A twist is the forward speed [m/s] and the yaw rate [rad/s]; wheels are left, right.
    """

    def __init__(self, drive: Drive, n: int) -> None:
        self.drive = drive
        self._count = drive.encoder_ticks / (2 * np.pi)  # [1/rad]
        self.odometry: Array = np.zeros((n, 3))
        metres = drive.wheel_radius / self._count  # [m] that a wheel rolls in one encoder count
        self._per_count = self._count, metres / 2, metres / drive.wheel_separation
        self._encoder: Array = np.zeros((n, 2))
        self._integrate = integrate.bind()

    def twist_from_wheels(self, wheels: Array) -> Array:
        """Return the twist of bases whose wheels turn at these speeds [rad/s] without slip, shape (n, 2)."""
        twist = np.empty_like(wheels)
        twist[:, 0] = (wheels[:, 0] + wheels[:, 1]) * (self.drive.wheel_radius / 2)
        twist[:, 1] = (wheels[:, 1] - wheels[:, 0]) * (self.drive.wheel_radius / self.drive.wheel_separation)
        return twist

    def reset_odometry(self, ids: NDArray[np.intp], angles: Array) -> None:
        """Start odometry at the origin.

        Args:
            angles: their wheel angles now [rad], shape (len(ids), 2).
        """
        self.odometry[ids] = 0.0
        self._encoder[ids] = np.floor(angles * self._count)

    def update_odometry(self, angles: Array) -> None:
        """Integrate the motion since the last update, from encoder counts, along the chord of the arc.

        The encoders' resolution and the tyres' slip make it drift, as odometry does.

        Args:
            angles: wheel angles [rad], shape (n, 2).
        """
        self._integrate(angles, self._encoder, self.odometry, *self._per_count)

    def odometry_at(self, angles: Array) -> Array:
        """Return the odometry with the motion since the last update added, without updating it.

        Args:
            angles: wheel angles [rad], shape (n, 2).

        Returns:
            x [m], y [m] and yaw [rad] since the last reset, shape (n, 3).
        """
        odometry = self.odometry.copy()
        self._integrate(angles, self._encoder.copy(), odometry, *self._per_count)
        return odometry
