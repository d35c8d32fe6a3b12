"""Twist to wheel speeds and back, and odometry, for a base with two driven wheels on one axis."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import WheelDrive


class DiffDrive:
    """Kinematics and odometry of n bases.

    A twist is the forward speed [m/s] and the yaw rate [rad/s]; wheels are left, right.
    """

    def __init__(self, drive: WheelDrive, n: int) -> None:
        self.drive = drive
        self._per_speed = 1.0 / drive.wheel_radius  # [rad/m]
        self._per_yaw = drive.wheel_separation / 2 / drive.wheel_radius  # [rad/rad]
        self._count = drive.encoder_ticks / (2 * np.pi)  # [1/rad]
        self.odometry: NDArray[np.float64] = np.zeros((n, 3))
        self._metres = drive.wheel_radius / self._count  # [m] that a wheel rolls in one encoder count
        self._encoder: NDArray[np.float64] = np.zeros((n, 2))
        self._counts, self._moved, self._work = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((4, n))

    def wheels_from_twist(self, twist: NDArray[np.float64], out: NDArray[np.float64]) -> NDArray[np.float64]:
        """Write the wheel speeds of a twist.

        Args:
            twist: shape (n, 2).
            out: wheel speeds [rad/s], shape (n, 2).
        """
        straight = twist[:, 0] * self._per_speed
        turn = twist[:, 1] * self._per_yaw
        np.subtract(straight, turn, out=out[:, 0])
        np.add(straight, turn, out=out[:, 1])
        return out

    def twist_from_wheels(self, wheels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the twist of bases whose wheels turn at these speeds [rad/s] without slip, shape (n, 2)."""
        twist = np.empty_like(wheels)
        twist[:, 0] = (wheels[:, 0] + wheels[:, 1]) * (self.drive.wheel_radius / 2)
        twist[:, 1] = (wheels[:, 1] - wheels[:, 0]) * (self.drive.wheel_radius / self.drive.wheel_separation)
        return twist

    def reset_odometry(self, ids: NDArray[np.intp], angles: NDArray[np.float64]) -> None:
        """Start odometry at the origin.

        Args:
            angles: their wheel angles now [rad], shape (len(ids), 2).
        """
        self.odometry[ids] = 0.0
        self._encoder[ids] = np.floor(angles * self._count)

    def update_odometry(self, angles: NDArray[np.float64]) -> None:
        """Integrate the motion since the last update, from encoder counts, along the chord of the arc.

        The encoders' resolution and the tyres' slip make it drift, as odometry does.

        Args:
            angles: wheel angles [rad], shape (n, 2).
        """
        self._integrate(angles, self.odometry)
        self._encoder, self._counts = self._counts, self._encoder

    def odometry_at(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the odometry with the motion since the last update added, without updating it.

        Args:
            angles: wheel angles [rad], shape (n, 2).

        Returns:
            x [m], y [m] and yaw [rad] since the last reset, shape (n, 3).
        """
        odometry = self.odometry.copy()
        self._integrate(angles, odometry)
        return odometry

    def _integrate(self, angles: NDArray[np.float64], odometry: NDArray[np.float64]) -> None:
        """Add the motion since the last update to `odometry`. Runs every tick: nothing is allocated."""
        counts, moved, (distance, turn, heading, part) = self._counts, self._moved, self._work
        np.multiply(angles, self._count, out=counts)
        np.floor(counts, out=counts)
        np.subtract(counts, self._encoder, out=moved)
        left, right = moved.T
        np.add(left, right, out=distance)
        distance *= self._metres / 2
        np.subtract(right, left, out=turn)
        turn *= self._metres / self.drive.wheel_separation
        x, y, yaw = odometry.T
        np.multiply(turn, 0.5, out=heading)
        heading += yaw
        np.cos(heading, out=part)
        part *= distance
        x += part
        np.sin(heading, out=part)
        part *= distance
        y += part
        yaw += turn
