"""Twist to wheel speeds and back, and odometry, for a base with two driven wheels on one axis."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import WheelDrive


class DiffDrive:
    """Kinematics and odometry of n bases.

    A twist is the forward speed [m/s] and the yaw rate [rad/s]; wheels are left, right.

    Args:
        drive: the wheels.
        n: number of simulations.
    """

    def __init__(self, drive: WheelDrive, n: int) -> None:
        self.drive = drive
        self._per_speed = 1.0 / drive.wheel_radius  # [rad/m]
        self._per_yaw = drive.wheel_separation / 2 / drive.wheel_radius  # [rad/rad]
        self._count = drive.encoder_ticks / (2 * np.pi)  # [1/rad]
        self.odometry: NDArray[np.float64] = np.zeros((n, 3))
        self._encoder: NDArray[np.float64] = np.zeros((n, 2))

    def wheels_from_twist(self, twist: NDArray[np.float64], out: NDArray[np.float64]) -> NDArray[np.float64]:
        """Write the wheel speeds of a twist.

        Args:
            twist: shape (n, 2).
            out: wheel speeds [rad/s], shape (n, 2).

        Returns:
            `out`.
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
            ids: the simulations.
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
        self.odometry = self.odometry_at(angles)
        self._encoder = np.floor(angles * self._count)

    def odometry_at(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the odometry with the motion since the last update added, without updating it.

        Args:
            angles: wheel angles [rad], shape (n, 2).

        Returns:
            x [m], y [m] and yaw [rad] since the last reset, shape (n, 3).
        """
        moved = np.floor(angles * self._count)
        moved -= self._encoder
        moved *= self.drive.wheel_radius / self._count
        left, right = moved[:, 0], moved[:, 1]
        odometry = self.odometry.copy()
        distance = (left + right) * 0.5
        turn = (right - left) * (1.0 / self.drive.wheel_separation)
        heading = odometry[:, 2] + turn * 0.5
        odometry[:, 0] += distance * np.cos(heading)
        odometry[:, 1] += distance * np.sin(heading)
        odometry[:, 2] += turn
        return odometry
