"""Stopped arms that give way to what they press on, or what presses on them, for as long as it does."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LIGHT_N = 12.0  # [N] an arm of which less is felt has given way: it presses with less than 20 N
_PERIOD_S = 0.04  # between two decisions: a servo and the estimate of force have followed the last one
_SPEED, _TOOL_SPEED = 0.5, 0.25  # [rad/s, m/s] the most with which an arm gives way
_UNSURE = 0.4  # share of these where only positions tell that something presses
_FOLLOW, _EASE, _KEEP = 0.5, 0.5, 0.6  # shares of a servo's stretch, of its change, and of the speed once it is light
_VAIN_RAD = 0.05  # [rad] of all joints, by which an arm gives way though the force stays: a load, or a wrong estimate
_CREEP = 0.01  # [rad/s] an arm that is slower, and presses on nothing, stands still
_CHANGE_N = 5.0  # [N] a force that changed by less has stayed as it is; of what may be a load's weight twice as much,
_WEIGHT_N, _GENTLE = 60.0, 0.25  # because it is lighter or heavier by that when it speeds up by this share of a stop's
# A larger force [N] of which positions confirm this share is no load, nor an error: it is followed, however even it is.
_HEAVY_N, _SURELY = 150.0, 0.5
_STANDS = 2  # decisions after which an arm that has stopped giving way is known to stand
_AGAIN_RAD, _AGAIN_S, _TRIES = 0.02, 0.25, 3  # so far, after this time, and so often it is tried again
_PUSHED_RAD = 0.01  # [rad] ahead of its reference, in the direction in which it gives way, a joint is pushed
_SLIPS = 0.8  # share of its largest stretch at which a joint is pushed away, whatever its encoder reads
_SLACK_RAD = 2e-4  # [rad] nearer to its reference than this a joint presses with 8 N m at the most
_SPRINGS_RAD = 0.05  # [rad] farther than to where it was read an arm without efforts does not give way
_ALONE_RAD, _CONFIRMS = 0.15, 0.25  # [rad] of all joints by efforts alone; the share of them that positions confirm
_DOUBTFUL_RAD = 1.0  # [rad] of all joints, by which an arm whose encoders are wrong gives way
_MARGIN_RAD = 0.005  # [rad] so far from the end of its range a joint stays


class _Told(IntEnum):
    """What tells that something presses on an arm, by which its way is bounded."""

    NOTHING = 0
    EFFORTS = 1
    DOUBTFUL_EFFORTS = 2  # in a posture of which an encoder is wrong
    POSITIONS = 3


class Sensed(NamedTuple):
    """What is known of n arms.

    Attributes:
        position: of the joints [rad], shape (n, dof).
        torque: that the motors give more than the posture needs [N m], shape (n, dof).
        force: on the tools, that these amount to [N], shape (n,).
        measured: whether the efforts are measurements, shape (n,); torque and force of the others mean nothing.
        doubtful: whether an encoder was found wrong, shape (n,).
    """

    position: Array
    torque: Array
    force: Array
    measured: Mask
    doubtful: Mask


class ContactRelief:
    """Moves the references of n arms so that their servos press on nothing.

    A servo whose joint is pressed is stretched by the torque over its stiffness. The reference follows the push: its
    speed grows with the stretch and with what the stretch grew by, and falls once the force is light. An obstacle that
    goes on is followed for as long as it goes on, a soft one until it is relaxed. A force that stays as it is however
    the arm gives way, such as a load's, stops that; one that changes later begins it anew.

    The torques are those that the motors' efforts are more than the posture needs. The way is bounded if encoders were
    found wrong, and more narrowly where positions do not confirm that joints are pushed as efforts report. Of a plant
    that measures no efforts the torques follow from the positions that were read; the way is bounded as narrowly.

    Attributes:
        late_s: by how much the servos are late [s], shape (n,).

    Args:
        control_hz: ticks a second [Hz].
        ticks: for which each arm has been settled, shape (n,): where they are kept.
    """

    def __init__(self, arm: Arm, n: int, control_hz: int, ticks: NDArray[np.int64] | None = None) -> None:
        limits, dof = arm.limits, len(arm.chain.joints)
        self._dof = dof
        self._hz, self.period = control_hz, max(1, round(_PERIOD_S * control_hz))
        self._stiffness = np.asarray(arm.servo_stiffness[:dof])
        self._largest = np.asarray(limits.effort[:dof]) / self._stiffness  # stretch [rad]
        self._change = _GENTLE * np.asarray(limits.stop_deceleration[:dof]) / control_hz  # of a speed in a tick [rad/s]
        self._forward = ForwardKinematics(arm.chain)
        self._lower = np.asarray(limits.lower[:dof]) + _MARGIN_RAD
        self._upper = np.asarray(limits.upper[:dof]) - _MARGIN_RAD
        self.ticks = np.zeros(n, np.int64) if ticks is None else ticks  # since the arm came to rest
        self._wanted, self._stretch = np.zeros((n, dof)), np.zeros((n, dof))
        self._level, self._vain = np.zeros(n), np.zeros(n)  # a force that stays as it is [N], and the way since [rad]
        self._stood: NDArray[np.int64] = np.zeros(n, np.int64)  # decisions since it moved last
        self._waited, self._tries = np.zeros(n), np.zeros(n, np.int64)  # for how long [s], and how often tried again
        self.late_s = np.zeros(n)
        self._told = np.zeros(n, np.int64)  # by what, when it was decided last
        self._room = np.full(n, np.nan)  # so far an arm may still give way of which something is not known [rad]

    def active(self) -> Mask:
        """Return whether each arm gives way, shape (n,)."""
        return np.asarray(self._wanted.any(axis=1))

    def restart(self, chosen: Mask | NDArray[np.intp]) -> None:
        """Let arms that are no longer stopped give way anew at their next stop, by a mask or by their numbers."""
        self._room[chosen], self._told[chosen] = np.nan, _Told.NOTHING

    def run(self, mask: Mask, known: Mask, sensed: Sensed, command: Array, velocity: Array) -> None:
        """Advance the references of some arms by one tick, in place.

        Args:
            mask: arms that were stopped and have come to rest, shape (n,).
            known: whether anything tells what presses on them, shape (n,); the others stop giving way.
            command: the reference [rad], shape (n, dof or more).
            velocity: its speed [rad/s], shape (n, dof or more).
        """
        trusted = mask & known
        self.ticks[~trusted] = 0
        self._tries[~trusted] = 0
        self._wanted[~trusted] = self._level[~trusted] = self._vain[~trusted] = 0.0
        self.ticks[trusted] += 1
        due = trusted & (self.ticks % self.period == 0)
        if due.any():
            self._decide(np.flatnonzero(due), sensed, command, velocity)
        if not self._wanted.any() and not velocity[mask].any():
            return
        dof = self._dof
        reference, speed = command[mask, :dof], velocity[mask, :dof]
        wanted = self._wanted[mask]
        wanted[((reference <= self._lower) & (wanted < 0)) | ((reference >= self._upper) & (wanted > 0))] = 0.0
        speed += np.minimum(np.maximum(wanted - speed, -self._change), self._change)
        velocity[mask, :dof] = speed
        command[mask, :dof] = reference + speed / self._hz

    def _decide(self, ids: NDArray[np.intp], sensed: Sensed, command: Array, velocity: Array) -> None:
        """Choose the speeds of the coming period."""
        measured = sensed.measured[ids]
        off = command[ids, : self._dof] - sensed.position[ids]
        by_position = np.clip(off, -self._largest, self._largest)
        stretch: Array = np.where(measured[:, None], sensed.torque[ids] / self._stiffness, by_position)
        # What is read is a tick ahead of a moving reference, and behind it by the servos' latency.
        now = off + velocity[ids, : self._dof] * (1.0 / self._hz - self.late_s[ids, None])
        agrees, whole = (now * stretch).sum(axis=1), (stretch * stretch).sum(axis=1)
        presses = np.where(
            measured,
            self._presses(ids, off, stretch, sensed, velocity, sure=agrees > _SURELY * whole),
            (np.abs(off) > _SLACK_RAD).any(axis=1),
        )
        efforts = np.where(sensed.doubtful[ids], _Told.DOUBTFUL_EFFORTS, _Told.EFFORTS)
        told, before = np.where(measured, efforts, _Told.POSITIONS), self._told[ids]
        springs = np.abs(off).sum(axis=1) + _SPRINGS_RAD
        bound = np.select([told == _Told.EFFORTS, told == _Told.POSITIONS], [_ALONE_RAD, springs], _DOUBTFUL_RAD)
        room = np.where(told == before, self._room[ids], np.fmin(self._room[ids], bound))
        confirmed = (told == _Told.EFFORTS) & (agrees > _CONFIRMS * whole)
        confirmed &= sensed.force[ids] > _LIGHT_N  # where nothing is felt, the two agree for no reason
        stands = self._stood[ids] >= _STANDS  # in motion an inertia seems to confirm, too
        found = (told == _Told.DOUBTFUL_EFFORTS) & (before < _Told.DOUBTFUL_EFFORTS)
        room = np.where((confirmed & stands) | found, bound, room)
        self._told[ids], self._room[ids] = told, room
        presses &= room > 0.0
        moving = self._wanted[ids].any(axis=1, keepdims=True)
        push = _FOLLOW * stretch + _EASE * np.where(moving, stretch - self._stretch[ids], 0.0)
        wanted = self._wanted[ids] - push * (self._hz / self.period)
        wanted *= wanted * stretch < 0.0  # never against the push
        tools = self._forward.tool_speed(command[ids, : self._dof], wanted) / _TOOL_SPEED
        joints = np.abs(wanted).max(axis=1) / _SPEED
        share = np.where(measured, 1.0, _UNSURE)
        wanted *= (share / np.maximum(np.maximum(joints, tools), share))[:, None]
        slower = _KEEP * self._wanted[ids]
        slower[np.abs(slower).max(axis=1) < _CREEP] = 0.0
        self._wanted[ids] = np.where(presses[:, None], wanted, slower)
        self._stretch[ids] = stretch
        way = np.abs(self._wanted[ids]).sum(axis=1) * self.period / self._hz
        self._vain[ids] += way
        self._room[ids] = np.minimum(self._room[ids] + np.where(confirmed, way, -way), bound)

    def _presses(
        self, ids: NDArray[np.intp], off: Array, stretch: Array, sensed: Sensed, velocity: Array, *, sure: Mask
    ) -> Mask:
        """Return the arms on which something presses by their efforts, and is not followed in vain."""
        force = sensed.force[ids]
        most = np.where(self._level[ids] < _WEIGHT_N, 2.0, 1.0) * _CHANGE_N
        presses = np.asarray(force > _LIGHT_N)
        ahead = (off * np.sign(stretch) > _PUSHED_RAD) & (np.abs(stretch) > _SLACK_RAD)
        ahead |= sensed.doubtful[ids, None] & (np.abs(stretch) > _SLIPS * self._largest)
        same = np.abs(force - self._level[ids]) < most
        self._stood[ids] = (self._stood[ids] + 1) * ~velocity[ids, : self._dof].any(axis=1)
        same |= (self._vain[ids] >= _VAIN_RAD) & (self._stood[ids] <= _STANDS)  # what braked made it heavier
        same &= presses & ~ahead.any(axis=1) & ~(sure & (force > _HEAVY_N))
        self._level[ids] = np.where(same, self._level[ids], force)
        self._vain[ids] *= same
        waits = self._vain[ids] >= _VAIN_RAD
        self._waited[ids] = (self._waited[ids] + self.period / self._hz) * waits
        again = ids[(self._waited[ids] > _AGAIN_S) & (self._tries[ids] < _TRIES)]
        self._vain[again] = _VAIN_RAD - _AGAIN_RAD
        self._tries[again] += 1
        self._tries[ids[~same]] = 0
        return presses & ~waits
