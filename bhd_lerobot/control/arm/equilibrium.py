"""Where an impedance's spring is at rest: a tool pose and an opening that move within limits."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.rotations import rotation_vectors, turned
from bhd_lerobot.control.messages import Limit

Array = NDArray[np.float64]

# How fast an equilibrium may move beside a person: ISO 10218-1 permits 250 mm/s, the others are estimates.
SPEED, ACCELERATION = 0.25, 1.0  # [m/s, m/s^2]
TURN_SPEED, TURN_ACCELERATION = 1.0, 4.0  # [rad/s, rad/s^2]
_GAIN = 50.0  # [1/s] how eagerly a remaining error is closed
_APPROACH = 0.7  # share of the acceleration that approaching a target may count on: room for discrete time
_REST = 1e-6  # [m/s, rad/s] slower than this is at rest


class Equilibrium:
    """Follows setpoints that come once a frame, for n arms; along straight lines, however far a setpoint is.

    Over the frame that follows a setpoint the target moves evenly from where the last setpoint put it to the new one.
    The equilibrium follows the target with the target's own speed added, never faster than the limits. Without a
    setpoint it brakes to rest.

    Attributes:
        position: of the tool in the base frame [m], shape (n, 3).
        rotation: of the tool in the base frame, shape (n, 3, 3).
        opening: of the gripper [m], shape (n, 1).
        speed: velocity of the tool, linear [m/s] then angular [rad/s], in the base frame, shape (n, 6).
        active: whether a setpoint is followed, shape (n,).
        limits: the `Limit` flags raised since they were last cleared, shape (n,).

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
        opening_limits: largest speed [m/s] and acceleration [m/s^2] of the opening.
    """

    def __init__(self, n: int, control_hz: int, frame_ticks: int, opening_limits: tuple[float, float]) -> None:
        self.position, self.opening = np.zeros((n, 3)), np.zeros((n, 1))
        self.rotation = np.tile(np.eye(3), (n, 1, 1))
        self.speed = np.zeros((n, 6))
        self.active: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limits: NDArray[np.int64] = np.zeros(n, np.int64)
        self._opening_speed = np.zeros((n, 1))
        self._hz, self._frame_ticks, self._left = control_hz, frame_ticks, np.zeros(n, np.int64)
        self._limits = (SPEED, ACCELERATION), (TURN_SPEED, TURN_ACCELERATION), opening_limits
        # Target, where it is at the end of the frame, and its speed: of position, rotation and opening.
        self._target, self._goal = self.position.copy(), self.position.copy()
        self._target_rotation, self._goal_rotation = self.rotation.copy(), self.rotation.copy()
        self._target_opening, self._goal_opening = self.opening.copy(), self.opening.copy()
        self._feed, self._feed_opening = np.zeros((n, 6)), np.zeros((n, 1))

    def set_setpoint(self, position: Array, rotation: Array, opening: Array, mask: NDArray[np.bool_]) -> None:
        """Head for new setpoints.

        Args:
            position: in the base frame [m], shape (n, 3).
            rotation: in the base frame, shape (n, 3, 3).
            opening: [m], shape (n, 1).
            mask: the arms that they are for, shape (n,).
        """
        new = mask & ~self.active
        self._target[new], self._target_opening[new] = self.position[new], self.opening[new]
        self._target_rotation[new] = self.rotation[new]
        self._goal[mask], self._goal_rotation[mask], self._goal_opening[mask] = (
            position[mask],
            rotation[mask],
            opening[mask],
        )
        rate = self._hz / self._frame_ticks
        turn = rotation_vectors(rotation[mask] @ np.swapaxes(self._target_rotation[mask], 1, 2))
        self._feed[mask, :3], self._feed[mask, 3:] = (position - self._target)[mask] * rate, turn * rate
        self._feed_opening[mask] = (opening - self._target_opening)[mask] * rate
        self._left[mask] = self._frame_ticks
        self.active |= mask

    def drop(self, mask: NDArray[np.bool_]) -> None:
        """Follow no setpoint any more: brake to rest."""
        self.active &= ~mask

    def place(self, ids: NDArray[np.intp], pose: Array) -> None:
        """Put the tool's equilibrium somewhere, at rest, and follow no setpoint; `pose` has shape (len(ids), 4, 4)."""
        self.position[ids], self.rotation[ids] = pose[:, :3, 3], pose[:, :3, :3]
        self.speed[ids] = 0.0
        self.active[ids] = False

    def keep_near(self, tool: Array, share: Array) -> None:
        """Bring the equilibrium nearer to the tool, and stop it there: what is in the tool's way stops both.

        Args:
            tool: the tool's pose in the base frame, shape (n, 4, 4).
            share: of the way between them that remains, of the position and of the turn, shape (n, 2).
        """
        far, twisted = share[:, 0] < 1.0, share[:, 1] < 1.0
        if far.any():
            place = tool[far, :3, 3]
            self.position[far] = place + (self.position[far] - place) * share[far, :1]
            self.speed[far, :3] = 0.0
        if twisted.any():
            turn = rotation_vectors(self.rotation[twisted] @ np.swapaxes(tool[twisted, :3, :3], 1, 2))
            self.rotation[twisted] = turned(tool[twisted, :3, :3], turn * share[twisted, 1:])
            self.speed[twisted, 3:] = 0.0

    def place_opening(self, ids: NDArray[np.intp], opening: Array) -> None:
        """Put the opening's equilibrium somewhere [m], at rest; `opening` has shape (len(ids),)."""
        self.opening[ids, 0], self._opening_speed[ids] = opening, 0.0

    def run(self) -> None:
        """Advance by one tick."""
        if not (self.active.any() or self.speed.any() or self._opening_speed.any()):
            return
        self._move_targets()
        active, moving = self.active[:, None], (self._left > 0)[:, None] & self.active[:, None]
        self._left -= self._left > 0
        turn = rotation_vectors(self._target_rotation @ np.swapaxes(self.rotation, 1, 2))
        speeds = (self.speed[:, :3], self.speed[:, 3:], self._opening_speed)
        errors = (self._target - self.position, turn, self._target_opening - self.opening)
        feeds = (self._feed[:, :3], self._feed[:, 3:], self._feed_opening)
        for speed, error, feed, limits in zip(speeds, errors, feeds, self._limits, strict=True):
            self._approach(speed, np.where(active, error, 0.0), np.where(moving, feed, 0.0), limits)
        self.position += self.speed[:, :3] / self._hz
        self.opening += self._opening_speed / self._hz
        turning = self.speed[:, 3:].any(axis=1)
        self.rotation[turning] = turned(self.rotation[turning], self.speed[turning, 3:] / self._hz)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether nothing moves, shape (n,)."""
        return np.asarray((np.abs(self.speed) < _REST).all(axis=1) & (np.abs(self._opening_speed) < _REST)[:, 0])

    def _move_targets(self) -> None:
        """Move the targets of the arms that are within the frame after a setpoint."""
        last = self.active & (self._left == 1)
        going = self.active & (self._left > 1)
        self._target[going] += self._feed[going, :3] / self._hz
        self._target_opening[going] += self._feed_opening[going] / self._hz
        self._target_rotation[going] = turned(self._target_rotation[going], self._feed[going, 3:] / self._hz)
        if last.any():  # sums of steps miss it by their rounding
            self._target[last], self._target_opening[last] = self._goal[last], self._goal_opening[last]
            self._target_rotation[last] = self._goal_rotation[last]

    def _approach(self, speed: Array, error: Array, feed: Array, limits: tuple[float, float]) -> None:
        """Change a velocity of shape (n, k), in place, towards the one that leads to the target."""
        fastest, hardest = limits
        size = np.linalg.norm(error, axis=1, keepdims=True)
        # Faster than this it could not slow down in time to stop at the target.
        closing = np.minimum(_GAIN * size, np.sqrt(2 * _APPROACH * hardest * size))
        wanted = feed + error * (closing / np.maximum(size, 1e-12))
        change = _clip(wanted, fastest) - speed
        self.limits[np.linalg.norm(wanted, axis=1) > fastest] |= int(Limit.VELOCITY)
        hard = np.linalg.norm(change, axis=1) * self._hz > hardest
        self.limits[self.active & hard] |= int(Limit.ACCELERATION)
        speed += _clip(change, hardest / self._hz)


def _clip(vectors: Array, longest: float) -> Array:
    return vectors * (longest / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), longest))
