"""Whether a reading can be a measurement of the present: finite, of this time, and no faster than joints can turn."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Times = NDArray[np.int64]

# Times the largest speed of a joint. In collisions of a simulated UR5 (`python -m benchmarks.contact`) no joint
# exceeded 1.01 times its limit.
_FASTER = 2.0
_SLACK_PERIODS = 3  # by so much may stamps be off
_TURN = 2 * math.pi
_MEMORY_S = 0.3  # over which the ways of joints are compared with their speeds
_CONTRADICTION_RAD, _CONTRADICTION_SHARE = 0.01, 0.05  # so far they may differ: at least, and of the way
_LONGEST_GAP_PERIODS = 10
_FROZEN_S = 0.02  # a reading that is the same for so long
_FROZEN_SHARE = 0.01  # while the torque changed by more than this share of the largest does not measure


@kernel(
    "b1(f8[:,::1], f8[:,::1], i8[::1], i8[::1], b1[::1], f8[:,::1], f8[::1], f8[::1], f8[::1], f8[:,::1], i8[::1], "
    "i1[::1])"
)
def follow_positions(  # noqa: PLR0917
    near: Array,
    last: Array,
    time_ns: Times,
    elapsed_ns: Times,
    wrong: Mask,
    beyond: Array,
    speed: Array,
    step: Array,
    slack: Array,
    position: Array,
    stamp_ns: Times,
    safety: NDArray[np.int8],
) -> bool:
    """Follow positions no faster than joints can turn; return whether any robot's are `wrong`.

    Those become the `last` that were measurements. `beyond` becomes the ways of joints that changed too fast, else 0.
    """
    any_wrong = False
    for sim in range(len(near)):
        elapsed_ns[sim], time_ns[sim] = max(stamp_ns[sim] - time_ns[sim], 0), stamp_ns[sim]
        is_finite = is_known = is_still = True
        for k in range(len(speed)):
            is_finite &= math.isfinite(position[sim, k])
            is_known &= math.isfinite(near[sim, k])
            is_still &= abs(position[sim, k] - near[sim, k]) <= step[k]
        wrong[sim], anew = not is_finite, is_finite and (is_still or not is_known or safety[sim] != 0)
        for k in range(len(speed)):
            if anew:
                near[sim, k] = position[sim, k]
            way, most = position[sim, k] - near[sim, k], speed[k] * max(elapsed_ns[sim], 1)
            is_far = is_finite and abs(way - clamp(way, -most, most)) > slack[k]
            beyond[sim, k] = way if is_far else 0.0
            wrong[sim] |= is_far
        any_wrong |= wrong[sim]
        for k in range(len(speed)):
            if wrong[sim]:
                position[sim, k] = last[sim, k]
            elif not anew:
                most = speed[k] * max(elapsed_ns[sim], 1)
                near[sim, k] += clamp(position[sim, k] - near[sim, k], -most, most)
            last[sim, k] = position[sim, k]
    return any_wrong


class MotionCheck:
    """Finds joints with torque motors whose positions and speeds contradict each other, or follow no torque.

    A torque controller damps with the speeds that it reads: where these are wrong it drives the arm.
    """

    def __init__(self, arm: Arm, n: int, control_hz: int) -> None:
        self.problem = ""
        self._names, dof = arm.chain.joints, len(arm.chain.joints)
        self._period_s = 1.0 / control_hz
        self._last, self._since_ns = np.full((2, n, dof), np.nan), np.zeros(n, np.int64)
        self._same, self._torque = np.zeros((n, dof), np.int64), np.zeros((n, dof))
        self._off, self._way = np.zeros((2, n, dof))
        self._frozen_ticks = round(_FROZEN_S * control_hz)
        self._least_torque = _FROZEN_SHARE * np.asarray(arm.limits.effort[:dof])

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Take the next readings of some arms for the first ones."""
        self._last[:, ids], self._same[ids] = np.nan, 0
        self._off[ids] = self._way[ids] = 0.0

    def find(self, reading: PlantReading, torque: Array, mode: NDArray[np.int8], now_ns: int) -> Mask | None:
        """Return the arms whose reading is no measurement, shape (n,); None if there are none.

        Args:
            torque: that the motors were commanded last [N m], shape (n, dof).
            mode: the `Mode` of each arm, shape (n,).
            now_ns: the tick's time [ns].
        """
        driven = (mode >= Mode.HOLD) & (mode <= Mode.STOPPING)  # elsewhere the brakes are closed
        new = reading.values[:2, :, : len(self._names)]
        stamp_ns = now_ns if reading.stamp_ns is None else reading.stamp_ns
        elapsed: Array = np.maximum((stamp_ns - self._since_ns) / NANOSECONDS, 0.0)
        self._since_ns[:] = stamp_ns
        before = self._last
        # What happened in a longer gap is not known.
        fresh = np.isnan(before).any(axis=(0, 2)) | (elapsed > _LONGEST_GAP_PERIODS * self._period_s)
        step = np.where(fresh[:, None], 0.0, new[0] - before[0])
        turned = np.where(fresh[:, None], 0.0, 0.5 * (new[1] + before[1]) * elapsed[:, None])
        kept = np.maximum(1.0 - elapsed / _MEMORY_S, 0.0)[:, None]
        self._off *= kept
        self._off += step - turned
        self._way *= kept
        self._way += np.maximum(np.abs(step), np.abs(turned))
        contradicts = np.abs(self._off) > _CONTRADICTION_RAD + _CONTRADICTION_SHARE * self._way
        same = (new[0] == before[0]) & driven[:, None]
        self._same += 1
        self._same *= same
        np.copyto(self._torque, torque, where=~same)
        frozen = (self._same >= self._frozen_ticks) & (np.abs(torque - self._torque) > self._least_torque)
        self._last[:] = new
        wrong = contradicts | frozen
        if not np.count_nonzero(wrong):
            return None
        if not self.problem:
            sim, joint = np.argwhere(wrong)[0]
            self.problem = self._explain(self._names[joint], bool(contradicts[sim, joint]))
        return np.asarray(wrong.any(axis=1))

    def _explain(self, name: str, contradicts: bool) -> str:
        if contradicts:
            return (
                f"{name} reads a speed that its positions contradict: no measurement. Check its encoder, and the unit, "
                "the sign and the filter of its speed in the plant"
            )
        return f"{name} reads the same for {_FROZEN_S:g} s while its torque changes: no measurement. Check its encoder"


class ReadingCheck:
    """Finds readings of n robots that are no measurements of the present.

    A position may be as far from an earlier one as the joint can turn in the time between the two, by their stamps
    where the plant gives any. Robots in a stop of their own may be moved by hand and are not checked for that; neither
    are grippers, whose fingers a collision throws.

    Attributes:
        oldest_ns: largest age of a reading [ns].
        ahead_ns: by how much a stamp may be ahead of the tick's time [ns].
        problem: why the last reading that was refused was no measurement, as text.
        silence: how old the last reading was that was refused for its age, as text.

    Args:
        control_hz: ticks a second [Hz].
    """

    def __init__(self, body: Body, n: int, control_hz: int) -> None:
        period = NANOSECONDS // control_hz
        self.oldest_ns, self.ahead_ns = _SLACK_PERIODS * period, period
        self.problem = self.silence = ""
        self._motion: MotionCheck | None = None
        self._names = body.joints
        speeds = [body.drive.max_wheel_speed] * 2 if body.drive is not None else []
        if body.arm is not None:
            if body.arm.actuation == "torque":
                self._motion = MotionCheck(body.arm, n, control_hz)
            speeds += [*body.arm.limits.velocity[:-1], np.inf]
        speed = _FASTER * np.array(speeds) / NANOSECONDS  # [rad/ns]
        self._near = np.full((n, len(speed)), np.nan)  # follows the positions no faster than joints can turn
        self._elapsed, self._stamp = np.zeros((2, n), np.int64)
        self._wrong, self._beyond = np.zeros(n, np.bool_), np.zeros_like(self._near)
        self._follow = follow_positions.bind(
            self._near,
            np.zeros_like(self._near),
            np.zeros(n, np.int64),
            self._elapsed,
            self._wrong,
            self._beyond,
            speed,
            speed * period,
            _SLACK_PERIODS * speed * period,
        )

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Accept the next positions of some robots, whatever they are."""
        self._near[ids] = np.nan
        self.problem = self.silence = ""
        if self._motion is not None:
            self._motion.forget(ids)
            self._motion.problem = ""

    def wrong_positions(self, reading: PlantReading, now_ns: int) -> Mask | None:
        """Return the robots whose positions are not finite or changed too fast, shape (n,), until the next call.

        None if there are none. Their positions in `reading` become the last that were measurements.
        """
        self._stamp[:] = now_ns if reading.stamp_ns is None else reading.stamp_ns
        if not self._follow(reading.position, self._stamp, reading.safety):
            return None
        if np.count_nonzero(self._beyond) and not self.problem:
            sim, joint = (int(index) for index in np.argwhere(self._beyond)[0])
            self.problem = self._explain(joint, float(self._beyond[sim, joint]), int(self._elapsed[sim]))
        return self._wrong

    def wrong_motions(
        self, reading: PlantReading, actuators: Array, mode: NDArray[np.int8], now_ns: int
    ) -> Mask | None:
        """Return the arms with torque motors whose readings contradict each other, shape (n,); None if there are none.

        Args:
            actuators: what was written last, shape (n, actuators).
            mode: the `Mode` of each arm, shape (n,).
            now_ns: the tick's time [ns].
        """
        if self._motion is None:
            return None
        wrong = self._motion.find(reading, actuators[:, :-1], mode, now_ns)
        self.problem = self.problem or self._motion.problem
        return wrong

    def _explain(self, joint: int, way: float, elapsed_ns: int) -> str:
        turns = round(way / _TURN)
        text = f"{self._names[joint]} reads a change of {way:.3f} rad within {elapsed_ns / 1e6:.1f} ms"
        if turns and abs(way - turns * _TURN) < 0.5:
            return (
                f"{text}: its angles are wrapped. Let the plant count turns, so that angles go on continuously beyond "
                "their range of one turn"
            )
        return f"{text}, faster than it can turn: no measurement. Check its encoder and the plant's conversion"

    def wrong_times(self, stamp_ns: NDArray[np.int64], newest_ns: NDArray[np.int64], now_ns: int) -> Mask | None:
        """Return the robots whose reading is too old, or from the future, shape (n,); None if there are none.

        Args:
            stamp_ns: of the joints' readings [ns], shape (n,).
            newest_ns: the larger of these and the stamps of the further sensors [ns], shape (n,).
            now_ns: the time, on the clock of the stamps [ns].
        """
        early = newest_ns > now_ns + self.ahead_ns
        wrong: Mask = (stamp_ns < now_ns - self.oldest_ns) | early
        if not np.count_nonzero(wrong):
            return None
        if np.count_nonzero(early) and not self.problem:
            self.problem = ahead_of_time(int(newest_ns.max()) - now_ns)
        elif not self.silence:
            age, most = (now_ns - int(stamp_ns.min())) / NANOSECONDS, self.oldest_ns / NANOSECONDS
            self.silence = f"the newest reading was {age:.3f} s old, more than {most:g} s"
        return wrong


def ahead_of_time(ahead_ns: int) -> str:
    """Return as text that a stamp is from the future."""
    return (
        f"a stamp is {ahead_ns / NANOSECONDS:.3f} s ahead of now: of another clock. Stamps are of the monotonic clock "
        "of this machine (time.monotonic_ns)"
    )
