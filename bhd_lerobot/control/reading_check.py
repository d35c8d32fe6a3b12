"""Whether a reading can be a measurement of the present: finite, of this time, and no faster than joints can turn."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.record import put

# Times the largest speed of a joint. In collisions of a simulated UR5 (`python -m benchmarks.contact`) no joint
# exceeded 1.01 times its limit.
_FASTER = 2.0
_SLACK_PERIODS = 3  # by so much may stamps be off
_TURN = 2 * math.pi
_MEMORY_S = 0.3  # over which the ways of joints are compared with their speeds
_CONTRADICTION_RAD, _CONTRADICTION_SHARE = 0.01, 0.05  # so far they may differ: at least, and of the way
_LONGEST_GAP_PERIODS = 10
_FROZEN_S = 0.02  # a reading that is the same for so long
LARGEST = 1e9  # [rad, rad/s] nothing turns as far, or as fast
_FARTHEST_NS = 1 << 61  # of a stamp from 0: differences of such stamps are numbers of 64 bits
_FROZEN_SHARE = 0.01  # while the torque changed by more than this share of the largest does not measure
_MOST_OUTSIDE = 0.1  # [rad] a joint may be found so far out of its range: the first command brings it back


_HOLD, _STOPPING = int(Mode.HOLD), int(Mode.STOPPING)
_TOO_FAR, _CONTRADICTS, _FROZEN, _AHEAD, _OUTSIDE = 1, 2, 3, 4, 5  # what `problem` of a record says


@kernel()
def are_positions_wrong(state: Any, limits: Any) -> bool:
    """Follow positions no faster than joints can turn; return whether they are not finite, or changed too fast.

    They may be as far from earlier ones as joints can turn in the time between the two, by their stamps. A robot in a
    stop of its own may be moved by hand and is not checked for that; neither is a gripper, whose fingers a collision
    throws. Wrong positions become the last that were measurements.
    """
    state.stamp_ns = min(max(state.stamp_ns, -_FARTHEST_NS), _FARTHEST_NS)
    state.elapsed_ns, state.read_ns = max(state.stamp_ns - state.read_ns, 0), state.stamp_ns
    is_finite = is_known = is_still = True
    for k in range(limits.joints):
        is_finite &= abs(state.position[k]) < LARGEST
        is_known &= math.isfinite(state.near[k])
        is_still &= abs(state.position[k] - state.near[k]) <= limits.step[k]
    is_wrong, is_new = not is_finite, is_finite and (is_still or not is_known or state.safety != 0)
    elapsed = max(state.elapsed_ns, 1)
    for k in range(limits.joints):
        if is_new:
            state.near[k] = state.position[k]
        way, most = state.position[k] - state.near[k], limits.fastest[k] * elapsed
        if is_finite and abs(way - clamp(way, -most, most)) > limits.slack[k]:
            is_wrong = True
            if state.problem == 0:
                state.problem, state.problem_joint, state.problem_value = _TOO_FAR, k, way
                state.problem_ns = state.elapsed_ns
    for k in range(limits.joints):
        if is_wrong:
            state.position[k] = state.last[k]
        elif not is_new:
            most = limits.fastest[k] * elapsed
            state.near[k] += clamp(state.position[k] - state.near[k], -most, most)
        state.last[k] = state.position[k]
    return is_wrong


@kernel()
def are_motions_wrong(state: Any, limits: Any) -> bool:
    """Return whether positions and speeds of joints with torque motors contradict each other, or follow no torque.

    A torque controller damps with the speeds that it reads: where these are wrong it drives the arm.
    """
    is_driven = _HOLD <= state.mode <= _STOPPING  # elsewhere the brakes are closed
    elapsed_s = max((state.stamp_ns - state.seen_ns) / NANOSECONDS, 0.0)
    state.seen_ns = state.stamp_ns
    is_fresh = elapsed_s > _LONGEST_GAP_PERIODS * limits.period_s  # what happened in a longer gap is not known
    for k in range(limits.joints - 1):
        is_fresh |= math.isnan(state.seen_position[k]) or math.isnan(state.seen_velocity[k])
    kept, wrong = max(1.0 - elapsed_s / _MEMORY_S, 0.0), False
    for k in range(limits.joints - 1):
        position, velocity, effort = state.position[k], state.velocity[k], state.written[k]
        way = 0.0 if is_fresh else position - state.seen_position[k]
        turned = 0.0 if is_fresh else 0.5 * (velocity + state.seen_velocity[k]) * elapsed_s
        state.off[k] = state.off[k] * kept + (way - turned)
        state.way[k] = state.way[k] * kept + max(abs(way), abs(turned))
        contradicts = abs(state.off[k]) > _CONTRADICTION_RAD + _CONTRADICTION_SHARE * state.way[k]
        is_same = is_driven and position == state.seen_position[k]
        state.same_ticks[k] = state.same_ticks[k] + 1 if is_same else 0
        if not is_same:
            state.same_effort[k] = effort
        is_frozen = abs(effort - state.same_effort[k]) > limits.least_torque[k]
        is_frozen &= state.same_ticks[k] >= limits.frozen_ticks
        state.seen_position[k], state.seen_velocity[k] = position, velocity
        if contradicts or is_frozen:
            wrong = True
            if state.problem == 0:
                state.problem, state.problem_joint = _CONTRADICTS if contradicts else _FROZEN, k
    return wrong


@kernel()
def is_time_wrong(state: Any, limits: Any, sensors_ns: int, now_ns: int) -> bool:
    """Return whether a reading is too old to be one of the present, or from the future."""
    now = now_ns + limits.origin_ns
    newest = max(state.stamp_ns, sensors_ns) if limits.has_sensors else state.stamp_ns
    is_early, is_old = newest > now + limits.ahead_ns, state.stamp_ns < now - limits.oldest_ns
    if is_early and state.problem == 0:
        state.problem, state.problem_ns = _AHEAD, newest - now
    elif is_old and not is_early and state.silence_ns == 0:
        state.silence_ns = now - state.stamp_ns
    return is_early or is_old


class ReadingCheck:
    """What finds readings of n robots that are no measurements of the present: its numbers, and what it found.

    Args:
        body: the robot.
        control_hz: ticks a second [Hz].
        states: the records of the robots.
        limits: the record of their limits.
    """

    def __init__(self, body: Body, control_hz: int, states: NDArray, limits: NDArray) -> None:
        period = NANOSECONDS // control_hz
        self._names, self._states, self._limits = body.joints, states, limits[0]
        limits["oldest_ns"], limits["ahead_ns"], limits["period_s"] = _SLACK_PERIODS * period, period, 1.0 / control_hz
        limits["joints"] = len(body.joints)
        self._range: NDArray[np.float64] = np.zeros((2, 0))  # of joints that are commanded positions [rad]
        speeds: list[float] = []
        if body.arm is not None:
            dof = len(body.arm.chain.joints)
            speeds += [*body.arm.limits.velocity[:dof], *([np.inf] if body.arm.gripper else [])]
            if body.arm.actuation == "position":
                self._range = np.array([body.arm.limits.lower[:dof], body.arm.limits.upper[:dof]])
            if body.arm.actuation == "torque":
                limits["is_torque"], limits["frozen_ticks"] = True, round(_FROZEN_S * control_hz)
                put(limits[0], "least_torque", _FROZEN_SHARE * np.asarray(body.arm.limits.effort[:dof]))
        speeds += [body.drive.max_wheel_speed] * 2 if body.drive is not None else []
        fastest = _FASTER * np.array(speeds) / NANOSECONDS  # [rad/ns]
        for name, values in (("fastest", 1.0), ("step", period), ("slack", _SLACK_PERIODS * period)):
            put(limits[0], name, fastest * values)

    def accept_until(self, old_ns: int, ahead_ns: int) -> None:
        """Set the largest age of a reading, and by how much a stamp may be ahead of the tick's time [ns]."""
        self._limits["oldest_ns"], self._limits["ahead_ns"] = old_ns, ahead_ns

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Accept the next readings of some robots, whatever they are."""
        for name in ("near", "seen_position", "seen_velocity"):
            self._states[name][ids] = np.nan
        for name in ("same_ticks", "off", "way", "problem", "silence_ns"):
            self._states[name][ids] = 0

    def refuse_outside(self, ids: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the robots of which a joint is found far out of its range: the first command would be a jump."""
        low, high = self._range
        found = self._states["position"][ids, : len(low)]
        beyond = np.maximum(low - found, found - high)
        rows = np.flatnonzero((beyond > _MOST_OUTSIDE).any(axis=1))
        for row in rows.tolist():
            state, joint = self._states[ids[row]], int(beyond[row].argmax())
            state["near"] = np.nan  # it is not known from where to go on
            state["problem"], state["problem_joint"], state["problem_value"] = _OUTSIDE, joint, found[row, joint]
        return ids[rows]

    @property
    def problem(self) -> str:
        """Why the first reading that was refused was no measurement, as text."""
        for state in self._states[self._states["problem"] > 0]:
            return self._explain(state)
        return ""

    @property
    def silence(self) -> str:
        """How old the reading was that was refused for its age, as text."""
        for age in self._states["silence_ns"][self._states["silence_ns"] > 0]:
            most = int(self._limits["oldest_ns"]) / NANOSECONDS
            return f"the newest reading was {age / NANOSECONDS:.3f} s old, more than {most:g} s"
        return ""

    def _explain(self, state: Any) -> str:
        name, way, elapsed_ns = self._names[state["problem_joint"]], float(state["problem_value"]), state["problem_ns"]
        match int(state["problem"]):
            case 4:
                return ahead_of_time(int(elapsed_ns))
            case 2:
                return (
                    f"{name} reads a speed that its positions contradict: no measurement. Check its encoder, and the "
                    "unit, the sign and the filter of its speed in the plant"
                )
            case 3:
                return (
                    f"{name} reads the same for {_FROZEN_S:g} s while its torque changes: no measurement. Check its "
                    "encoder"
                )
            case 5:
                low, high = self._range[:, state["problem_joint"]]
                return (
                    f"{name} is found at {way:.3f} rad, and its limits are {low:.3f} and {high:.3f}: the first command "
                    "would be a jump. Move it between them by hand, or calibrate its zero again"
                )
        text = f"{name} reads a change of {way:.3f} rad within {elapsed_ns / 1e6:.1f} ms"
        turns = round(way / _TURN)
        if turns and abs(way - turns * _TURN) < 0.5:
            return (
                f"{text}: its angles are wrapped. Let the plant count turns, so that angles go on continuously beyond "
                "their range of one turn"
            )
        return f"{text}, faster than it can turn: no measurement. Check its encoder and the plant's conversion"


def ahead_of_time(ahead_ns: int) -> str:
    """Return as text that a stamp is from the future."""
    return (
        f"a stamp is {ahead_ns / NANOSECONDS:.3f} s ahead of now: of another clock. Stamps are of the monotonic clock "
        "of this machine (time.monotonic_ns)"
    )
