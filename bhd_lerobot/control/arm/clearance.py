"""Setpoints that would bring an arm too near to itself or to the table: it slows down, and stops before contact."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Capsule
from bhd_lerobot.control.geometry.collision import CollisionModel

Array = NDArray[np.float64]

_LOOKS = 2  # a frame: between two, an arm continues at the speed that the first permitted
_SAMPLES = 4
_TIMES = (np.arange(1, _SAMPLES + 1) / _SAMPLES)[:, None, None]  # of a stop at which distances are checked
# An arm that approaches has to stay so much further away than the least distance, for each metre that it needs to stop:
# directions change between two checks, and two samples of a fast stop are far apart.
_WIDER = 0.015
_ROUNDING = 1e-9  # [m] a distance that shrinks by less does not shrink
_TRIED = np.array([1.0, 0.5, 0.25])[:, None]  # of the speed from which there should be room enough to stop
_TINY = 1e-12
_FIRST = np.zeros(1, np.intp)


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
        ids = np.flatnonzero(active & (self._due <= tick))
        self._due[ids] = tick + self._ticks
        self._next = int(np.min(self._due, where=active, initial=np.iinfo(np.int64).max))
        if len(ids):
            dof = self.dof
            self.share[ids] = self._shares(ids, position[ids, :dof], velocity[ids, :dof], speed[ids, :dof])
            for sim, check in self._holding.items():
                if sim in ids:
                    rows = (array[sim : sim + 1, :dof] for array in (position, velocity, speed))
                    self.share[sim] = check._shares(_FIRST, *rows)[0]
            self.slows = bool((self.share < 1.0).any())

    def _shares(self, ids: NDArray[np.intp], q: Array, velocity: Array, speed: Array) -> Array:
        """Return the permitted shares of some arms; `q`, `velocity` and `speed` have shape (k, dof)."""
        shares = np.ones(len(ids))
        reached, ways, length = self._ways(velocity, speed)
        # What lies between here and where distances are known must not have used them up.
        far = np.abs(q - self._known[ids]) + np.abs(ways[-1])
        used = (self._slopes * far[:, None]).sum(axis=2) + _WIDER * length[-1][:, None]
        near = np.flatnonzero((self._distances[ids] - used < self._least).any(axis=1))
        if not len(near):
            return shares
        q, velocity, speed, reached = q[near], velocity[near], speed[near], reached[near]
        every = self._model.each(np.concatenate((q, (q + ways[:, near]).reshape(-1, self.dof))))
        self._known[ids[near]], self._distances[ids[near]] = q, every[:, : len(near)].T
        kinds = every[: self._pairs], every[self._pairs :]  # from itself, and from the table
        least = np.stack([kind.min(axis=0, initial=np.inf) for kind in kinds]).reshape(2, 1 + len(ways), len(near))
        here = least[:, 0]
        free = self._free(here, least[:, 1:] - _WIDER * length[:, near])
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
        _, ways, length = self._ways(velocity[again], (tried[:, :, None] * speed[slow]).reshape(-1, self.dof))
        slower = np.stack(self._model.distances(q[again] + ways)) - _WIDER * length
        good = self._free(here[:, again], slower).reshape(tried.shape) >= 1.0
        shares[near[slow]] = np.where(good.any(axis=0), tried[good.argmax(axis=0), np.arange(len(slow))], 0.0)
        return shares

    def _ways(self, velocity: Array, speed: Array) -> tuple[Array, Array, Array]:
        """Return how far joints turn that continue until the next check, and then stop.

        Args:
            velocity: of the joints [rad/s], shape (k, dof).
            speed: what is wanted [rad/s], shape (k, dof).

        Returns:
            The speed at the next check [rad/s], shape (k, dof); the way so far at sampled times [rad], shape (samples,
            k, dof), and how far that takes any point of the arm at the most [m], shape (samples, k).
        """
        change = self._acceleration * self._period
        reached = np.minimum(np.maximum(speed, velocity - change), velocity + change)
        on = reached * self._period
        ways = np.concatenate((on[None], on + self._stop(reached)))
        return reached, ways, (np.abs(ways) * self._reach).sum(axis=2)

    def _stop(self, speed: Array) -> Array:
        """Return how far joints have turned at times on their way to rest [rad], shape (samples, k, dof).

        Every joint brakes by itself, as hard as it may: those that were slower are at rest earlier.
        """
        fast = np.abs(speed)
        duration = fast / self._acceleration
        time = _TIMES * (self._ramp + duration).max(axis=1)[:, None]
        braking = np.minimum(np.maximum(time - self._ramp, 0.0), duration)
        way = fast * (np.minimum(time, self._ramp) + braking) - self._acceleration * braking * braking / 2
        return np.copysign(way, speed)

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
