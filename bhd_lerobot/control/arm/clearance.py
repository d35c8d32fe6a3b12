"""Setpoints that would bring an arm too near to itself or to the table: it slows down, and stops before contact."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Capsule
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.kernels import clamp, kernel

Array = NDArray[np.float64]

_LOOKS = 2  # a frame: between two, an arm continues at the speed that the first permitted
_SAMPLES = 4  # of a stop at which distances are checked
# An arm that approaches has to stay so much further away than the least distance, for each metre that it needs to stop:
# directions change between two checks, and two samples of a fast stop are far apart.
_WIDER = 0.015
_ROUNDING = 1e-9  # [m] a distance that shrinks by less does not shrink
_TRIED = np.array([1.0, 0.5, 0.25])[:, None]  # of the speed from which there should be room enough to stop
_TINY = 1e-12
_ONE = np.ones(1, np.bool_)
_NEVER = np.iinfo(np.int64).max


@kernel("void(f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8)")
def stopping_ways(  # noqa: PLR0917
    ways: Array,
    length: Array,
    reached: Array,
    velocity: Array,
    speed: Array,
    acceleration: Array,
    ramp: Array,
    reach: Array,
    period: float,
) -> None:
    """Write how far joints turn that continue until the next check, and then stop.

    Args:
        ways: how far joints have turned at the next check and at times after it [rad], shape (samples, k, dof).
        length: how far that takes any point of the arm at the most [m], shape (samples, k).
        reached: the speed at the next check [rad/s], shape (k, dof).
        velocity: of the joints [rad/s], shape (k, dof or more).
        speed: what is wanted [rad/s], shape (k, dof or more).
        period: until the next check [s].
    """
    for arm in range(len(reached)):
        longest = 0.0  # of the joints' stops: every joint brakes by itself, as hard as it may
        for k in range(len(acceleration)):
            change = acceleration[k] * period
            reached[arm, k] = clamp(speed[arm, k], velocity[arm, k] - change, velocity[arm, k] + change)
            longest = max(longest, ramp[k] + abs(reached[arm, k]) / acceleration[k])
        for sample in range(len(ways)):
            time = sample / (len(ways) - 1) * longest
            length[sample, arm] = 0.0
            for k in range(len(acceleration)):
                fast = abs(reached[arm, k])
                braking = min(max(time - ramp[k], 0.0), fast / acceleration[k])
                way = fast * (min(time, ramp[k]) + braking) - acceleration[k] * braking * braking / 2
                ways[sample, arm, k] = reached[arm, k] * period + math.copysign(way, reached[arm, k])
                length[sample, arm] += abs(ways[sample, arm, k]) * reach[k]


@kernel(
    "i8(f8[:,::1], f8[:,::1], f8[:,::1], f8, i8, i8[::1], f8[::1], b1[::1], f8[:,:,::1], f8[:,::1], f8[:,::1], "
    "b1[::1], i8)"
)
def find_near(  # noqa: PLR0917
    distances: Array,
    known: Array,
    slopes: Array,
    least: float,
    ticks: int,
    due: NDArray[np.int64],
    share: Array,
    near: NDArray[np.bool_],
    ways: Array,
    length: Array,
    position: Array,
    active: NDArray[np.bool_],
    tick: int,
) -> int:
    """Find which of the arms whose turn it is may come near to something on the ways on which they would stop.

    Of those `share` becomes 1, `due` the tick of their next turn, and `near` whether they may; of others it is False.

    Returns:
        The tick in which it is an arm's turn again.
    """
    soonest = _NEVER
    for arm in range(len(known)):
        near[arm] = False
        if active[arm] and due[arm] <= tick:
            due[arm] = tick + ticks
            share[arm] = 1.0
            # What lies between here and where distances are known must not have used them up.
            far = np.zeros(slopes.shape[1])
            for joint in range(len(far)):
                far[joint] = abs(position[arm, joint] - known[arm, joint]) + abs(ways[-1, arm, joint])
            for k in range(len(slopes)):
                used = 0.0
                for joint in range(len(far)):
                    used += slopes[k, joint] * far[joint]
                near[arm] |= distances[arm, k] - (used + _WIDER * length[-1, arm]) < least
        if active[arm]:
            soonest = min(soonest, due[arm])
    return soonest


class SetpointClearance:
    """Finds for n arms which share of the wanted speed lets them stop before they come too near.

    Setpoints pass the check that goals pass: with `ArmChain.min_distance` as the least distance, on the way on which
    the arm would come to rest if it was stopped at the next check. An arm that is too near already may move away. What
    the check does not know, such as objects, is for the force limit.

    Far from everything, no distances are computed: no point of the arm moves further than its joints turn times their
    reach.

    Attributes:
        share: of the wanted speed that is permitted, shape (n,).
        slows: whether it is below 1 for any of them.

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame.
    """

    def __init__(self, arm: Arm, n: int, control_hz: int, frame_ticks: int) -> None:
        self._options = arm, control_hz, frame_ticks
        self._holding: dict[int, SetpointClearance] = {}  # what checks an arm that holds something
        chain, limits = arm.chain, arm.limits
        self._model, self._least = CollisionModel(chain), chain.min_distance
        self.dof = dof = len(chain.joints)
        self._ticks = max(1, frame_ticks // _LOOKS)
        self._period = self._ticks / control_hz
        self._acceleration = np.asarray(limits.acceleration[:dof])
        # A brake that changes its acceleration gradually begins so much later [s]; what speeds an arm up ends first.
        self._ramp = self._acceleration / (2 * np.asarray(limits.jerk[:dof]))
        self._ramp += 2 * self._acceleration / np.asarray(limits.setpoint_jerk[:dof])
        pairs, heights = self._model.slopes()
        self._pairs, self._slopes = len(pairs), np.concatenate((pairs, heights))
        # [m] no point moves further when a joint turns by 1 rad
        self._reach = self._slopes.max(axis=0)
        self.share: Array = np.ones(n)
        self.slows = False
        self._due = np.zeros(n, np.int64)
        self._next = 0
        # Where distances were computed last, and these; below 0 where none is known.
        self._known, self._distances = np.zeros((n, dof)), np.full((n, len(self._slopes)), -1.0)
        self._near = np.zeros(n, np.bool_)
        self._ways = self._new_ways(n)
        self._brake = self._acceleration, self._ramp, self._reach, self._period
        self._stopping_ways = stopping_ways.bind()
        known = self._distances, self._known, self._slopes, self._least
        turns = self._ticks, self._due, self.share, self._near
        self._find_near = find_near.bind(*known, *turns, *self._ways[:2])

    def hold(self, sim: int, held: Capsule | None) -> None:
        """Keep what an arm holds away from things as well; nothing any more if None."""
        arm, control_hz, frame_ticks = self._options
        self._holding.pop(sim, None)
        if held is not None:
            arm = replace(arm, chain=arm.chain.holding(held))
            self._holding[sim] = SetpointClearance(arm, 1, control_hz, frame_ticks)

    def check_soon(self, mask: NDArray[np.bool_]) -> None:
        """Check arms in the next tick, because they have new setpoints; `mask` has shape (n,)."""
        self._due[mask] = 0
        self._next = 0

    def release(self, mask: NDArray[np.bool_]) -> None:
        """Forget what slowed arms down that follow setpoints no more; `mask` has shape (n,)."""
        self.share[mask] = 1.0
        self.slows = bool((self.share < 1.0).any())

    def run(self, tick: int, position: Array, velocity: Array, speed: Array, active: NDArray[np.bool_]) -> None:
        """Check the arms whose turn it is.

        Args:
            position: the reference, shape (n, width).
            velocity: its speed, shape (n, width).
            speed: what is wanted within its limits, shape (n, width).
            active: which follow setpoints, shape (n,).
        """
        if tick < self._next:
            return
        self._stopping_ways(*self._ways, velocity, speed, *self._brake)
        self._next = self._find_near(position, active, tick)
        near = np.flatnonzero(self._near)
        if len(near):
            joints = (array[near, : self.dof] for array in (position, velocity, speed))
            self.share[near] = self._shares(near, *joints)
        for sim, check in self._holding.items():
            if active[sim] and self._due[sim] == tick + self._ticks:
                one = slice(sim, sim + 1)
                check.check_soon(_ONE)
                check.run(tick, position[one], velocity[one], speed[one], _ONE)
                self.share[sim] = check.share[0]
        self.slows = bool((self.share < 1.0).any())

    def _shares(self, ids: NDArray[np.intp], q: Array, velocity: Array, speed: Array) -> Array:
        """Return the permitted shares of arms that may be near to something, of which each array has a row."""
        shares = np.ones(len(ids))
        ways, length, reached = self._ways[0][:, ids], self._ways[1][:, ids], self._ways[2][ids]
        every = self._model.each(np.concatenate((q, (q + ways).reshape(-1, self.dof))))
        self._known[ids], self._distances[ids] = q, every[:, : len(ids)].T
        kinds = every[: self._pairs], every[self._pairs :]  # from itself, and from the table
        least = np.stack([kind.min(axis=0, initial=np.inf) for kind in kinds]).reshape(2, 1 + len(ways), len(ids))
        here = least[:, 0]
        free = self._free(here, least[:, 1:] - _WIDER * length)
        slow = np.flatnonzero(free < 1.0)
        if not len(slow):
            return shares
        # To stop takes the square of the speed, the time until the next check the speed itself.
        fast = np.abs(reached[slow])
        square = (self._reach * fast * fast / (2 * self._acceleration)).sum(axis=1)
        linear = (self._reach * fast * (self._period + self._ramp)).sum(axis=1)
        room = free[slow] * (square + linear)
        share = np.minimum(2 * room / np.maximum(linear + np.sqrt(linear**2 + 4 * square * room), _TINY), 1.0)
        # Joints do not slow down in step, so that the way becomes another one: it is checked as well. If none is free,
        # the arm stops: it can, because that is how the way ended that was found free before.
        tried = _TRIED * share
        again = np.tile(slow, len(_TRIED))
        ways, length, _ = made = self._new_ways(len(again))
        slowly = (tried[:, :, None] * speed[slow]).reshape(-1, self.dof)
        self._stopping_ways(*made, velocity[again], slowly, *self._brake)
        slower = np.stack(self._model.distances(q[again] + ways)) - _WIDER * length
        good = self._free(here[:, again], slower).reshape(tried.shape) >= 1.0
        shares[slow] = np.where(good.any(axis=0), tried[good.argmax(axis=0), np.arange(len(slow))], 0.0)
        return shares

    def _new_ways(self, k: int) -> tuple[Array, Array, Array]:
        """Return room for what `stopping_ways` writes about k arms."""
        return np.zeros((1 + _SAMPLES, k, self.dof)), np.zeros((1 + _SAMPLES, k)), np.zeros((k, self.dof))

    def _free(self, here: Array, distances: Array) -> Array:
        """Return which shares of ways are free, shape (k,).

        Args:
            here: distances where the arms are [m], shape (2, k).
            distances: on their ways [m], shape (2, samples, k).
        """
        before, least = np.concatenate((here[:, None], distances[:, :-1]), axis=1), self._least
        bad = (distances < least) & (distances < before - _ROUNDING)
        inside = (before - least) / np.where(bad, before - distances, 1.0)
        inside = np.minimum(np.maximum(inside, 0.0), 1.0)
        count = distances.shape[1]
        at = np.where(bad, (np.arange(count)[:, None] + inside) / count, 1.0)
        return np.asarray(at.min(axis=(0, 1)))

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget arms that were put somewhere else."""
        self.share[ids], self._distances[ids] = 1.0, -1.0
        self._due[ids] = self._next = 0
        for sim in np.asarray(ids).tolist():
            self._holding.pop(sim, None)
        self.slows = bool((self.share < 1.0).any())
