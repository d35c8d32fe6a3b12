"""One tick of one robot: read, supervise, take the command, run the controller, guard what is written.

It never sleeps, blocks, logs or allocates. It runs as plain Python, and as the machine code that numba makes of it.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.equilibrium import is_spring_at_rest
from bhd_lerobot.control.arm.spring import move_spring, report_spring, tell_spring
from bhd_lerobot.control.arm.step import Stage, has_to_be_told, is_arm_at_rest, move_arm, report_arm
from bhd_lerobot.control.drive import drive, drive_back, is_base_at_rest, report_drive, tell_drive
from bhd_lerobot.control.fifo import drop, find_next, keep_newest
from bhd_lerobot.control.guard import guard
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.messages import HORIZON_NS, SEQUENCE_STEP, Limit, Mode, Reason, Watchdog
from bhd_lerobot.control.plant import SafetyStatus
from bhd_lerobot.control.reading_check import LARGEST, are_motions_wrong, are_positions_wrong, is_time_wrong
from bhd_lerobot.control.record import NEVER, ArmRecords, RobotRecords, SpringRecords

_HOLD, _TRACKING, _STOPPING, _SAFE_OFF = (int(Mode[name]) for name in ("HOLD", "TRACKING", "STOPPING", "SAFE_OFF"))
_UNCONFIGURED, _ESTOP, _FAULT = int(Mode.UNCONFIGURED), int(Mode.ESTOP), int(Mode.FAULT)
_ACCEPTED, _STALE, _NOT_ACTIVE = int(Reason.ACCEPTED), int(Reason.STALE), int(Reason.NOT_ACTIVE)
_OUT_OF_ORDER, _BEYOND_HORIZON = int(Reason.OUT_OF_ORDER), int(Reason.BEYOND_HORIZON)
_ESTOP_REASON, _FAULT_REASON = int(Reason.ESTOP), int(Reason.FAULT)
_COMMAND_AGE, _PLANT, _GUARD = int(Watchdog.COMMAND_AGE), int(Watchdog.PLANT), int(Watchdog.GUARD)
_NON_FINITE = int(Limit.NON_FINITE)
_NONE, _BEGUN, _ENDED = int(Stage.NONE), int(Stage.BEGUN), int(Stage.ENDED)
_NORMAL, _EMERGENCY_STOP = int(SafetyStatus.NORMAL), int(SafetyStatus.EMERGENCY_STOP)
_LEAST, _MOST = np.iinfo(np.int64).min, np.iinfo(np.int64).max
_MOST_TAKEN = 3  # commands in one tick, while another process fills the queue

Numbers = NDArray[np.float64]
Counts = NDArray[np.int64]
Trajectories = NDArray[np.float64]


@kernel()
def tick(  # noqa: PLR0912, PLR0917
    state: Any,
    queue: Any,
    estop: Counts,
    monitor: Any,
    arm: Any,
    spring: Any,
    limits: Any,
    arm_limits: Any,
    geometry: Any,
    rows: Any,
    sensors: Any,
    sensors_ns: int,
    now_ns: int,
) -> bool:
    """Run one tick of a robot, between reading its plant and writing to it.

    The reference advances by one period, also after ticks that were skipped: it is late then, and what is written to
    the plant does not jump to where it would be by now.

    Args:
        state: the robot's record.
        queue: its commands.
        estop: the word of its emergency stop, see `EstopWord`.
        monitor: the collision monitor of its drive; one without beams if there is none; None of a robot that does not
            drive, as are `sensors`.
        arm: its arm with position servos; None of other robots, as are the following.
        spring: its impedance.
        limits: the numbers of its body.
        arm_limits: the numbers of its arm.
        geometry: what its arm is kept clear with.
        rows: the trajectories that arms play.
        sensors: further values that its plant measures.
        sensors_ns: when the oldest of them was measured [ns].
        now_ns: the time that the tick is for [ns].

    Returns:
        False if the tick waits for `Controller.serve`, and is to be continued by the same call.
    """
    if arm is None:  # noqa: SIM102 (numba leaves out what is for other robots where None alone is asked for)
        if monitor is not None:
            begin_tick(state, queue, estop, limits, sensors_ns, now_ns)
            tell_drive(state, limits)
            state.entered, state.has_setpoint = 0, False
            drive(state, limits, monitor, sensors, sensors_ns)
            end_tick(state, limits)
    if arm is not None:
        if arm.stage == _NONE:
            if state.mode == _STOPPING:
                state.is_at_rest = is_arm_at_rest(state, arm, arm_limits)
            begin_tick(state, queue, estop, limits, sensors_ns, now_ns)
            arm.stage = _BEGUN
            if monitor is not None and state.entered == 0:
                tell_drive(state, limits)
            if has_to_be_told(state, arm, arm_limits):
                return False
        if arm.stage < _ENDED:
            if monitor is not None and arm.stage == _BEGUN:
                drive(state, limits, monitor, sensors, sensors_ns)
            if not move_arm(state, arm, arm_limits, geometry, rows, limits.has_stamps):
                return False
            end_tick(state, limits)
            arm.stage = _ENDED
            if state.entered != 0 or state.goes_back:
                return False
        arm.stage = _NONE
    if spring is not None:
        if state.mode == _STOPPING:
            state.is_at_rest = is_spring_at_rest(spring)
        begin_tick(state, queue, estop, limits, sensors_ns, now_ns)
        tell_spring(state, spring, arm_limits)
        move_spring(state, spring, arm_limits)
        end_tick(state, limits)
        tell_spring(state, spring, arm_limits)
    report(state, monitor, arm, spring, limits, arm_limits)
    return True


@kernel()
def report(state: Any, monitor: Any, arm: Any, spring: Any, limits: Any, arm_limits: Any) -> None:  # noqa: PLR0917
    """Write what is known of a robot beside what its ticks go by, for whoever reads the record."""
    if arm is not None:
        report_arm(state, arm, arm_limits)
    if spring is not None:
        report_spring(state, spring, arm_limits)
    if monitor is not None:
        report_drive(state, limits)


@kernel()
def begin_tick(  # noqa: PLR0917
    state: Any, queue: Any, estop: Counts, limits: Any, sensors_ns: int, now_ns: int
) -> None:
    """Do what comes before the controller: judge the reading, supervise, take what is due."""
    state.protective_stop = 0
    supervise(state, queue, estop, limits, sensors_ns, now_ns)
    take_command(state, queue, estop, limits, now_ns)


@kernel()
def end_tick(state: Any, limits: Any) -> None:
    """Do what comes after the controller: follow it with the mode, and guard what is written."""
    follow_controller(state, limits)
    if not guard(state, limits):
        # As hard as possible, from the last that was safe.
        state.watchdog |= _GUARD
        if state.mode >= _ESTOP:
            state.entered |= 1 << _FAULT  # the present stop is not safe either
        else:
            set_mode(state, _FAULT)
        if limits.is_drive:
            drive_back(state, limits)
        state.goes_back = limits.arm_values > 0


@kernel()
def set_mode(state: Any, mode: int) -> None:
    """Enter a mode; the controller learns of it before it runs next."""
    state.mode, state.mode_is_new, state.is_deactivating = mode, True, False
    state.is_at_rest = False  # of a robot that a stop has just begun for it is known in the next tick
    if mode != _TRACKING:
        state.entered |= 1 << mode
        state.has_setpoint = False  # one that was taken before the stop and not followed yet moves nothing after it


@kernel()
def supervise(  # noqa: PLR0917
    state: Any, queue: Any, estop: Counts, limits: Any, sensors_ns: int, now_ns: int
) -> None:
    """Change the mode for what nobody requested: emergency stop, plant faults, watchdogs, the end of a stop."""
    press = estop[0]
    if press != estop[1]:
        estop[2] = press
        if state.mode != _ESTOP:
            set_mode(state, _ESTOP)
    judge_reading(state, limits)
    if limits.has_stamps and is_time_wrong(state, limits, sensors_ns, now_ns) and state.mode != _UNCONFIGURED:
        fail(state, _PLANT)
    if state.mode == _TRACKING and not state.by_goal and now_ns - state.due_ns > limits.timeout_ns:
        state.watchdog |= _COMMAND_AGE
        # What a brain left behind that fell silent moves nothing later.
        state.refusals[_STALE] += drop(state, queue, _LEAST, _MOST)
        set_mode(state, _STOPPING)
    if state.mode == _STOPPING and is_robot_at_rest(state, limits):
        set_mode(state, _SAFE_OFF if state.is_deactivating else _HOLD)


@kernel()
def is_robot_at_rest(state: Any, limits: Any) -> bool:
    """Return whether a robot is commanded to be at rest; of its arm that was found when the tick began."""
    if limits.arm_values > 0 and not state.is_at_rest:
        return False
    return not limits.is_drive or is_base_at_rest(state, limits)


@kernel()
def fail(state: Any, cause: int) -> None:
    """Enter FAULT for a cause, unless the robot is stopped already."""
    if state.mode < _ESTOP:
        state.watchdog |= cause
        set_mode(state, _FAULT)


@kernel()
def judge_reading(state: Any, limits: Any) -> None:
    """Stop a robot that reports a stop of its own, or whose reading is no measurement."""
    is_bad = are_positions_wrong(state, limits)
    if limits.is_torque and are_motions_wrong(state, limits):
        is_bad = True
    is_finite, has_effort = True, True
    for k in range(limits.joints):
        is_finite &= abs(state.velocity[k]) < LARGEST
        has_effort &= abs(state.effort[k]) < LARGEST
    is_bad = is_bad or not is_finite or not has_effort
    state.is_distrusted = is_bad
    if is_bad:
        # What is no measurement must not spread: it is treated as a joint at rest where the encoder last was. Efforts
        # do not depend on encoders.
        for k in range(limits.joints):
            state.velocity[k] = 0.0
            if not has_effort:
                state.effort[k] = 0.0
    if state.safety == _EMERGENCY_STOP and state.mode != _ESTOP:
        set_mode(state, _ESTOP)
    if is_bad or state.safety != _NORMAL:
        fail(state, _PLANT)


@kernel()
def refusal(state: Any, estop: Counts) -> int:
    """Return why a robot takes no setpoint, or `Reason.ACCEPTED`."""
    if estop[0] != estop[1] or state.mode == _ESTOP:  # the word counts from the moment that it is set
        return _ESTOP_REASON
    if state.is_deactivating:
        return _NOT_ACTIVE
    if state.mode == _FAULT:
        return _FAULT_REASON
    return _ACCEPTED if _HOLD <= state.mode <= _STOPPING else _NOT_ACTIVE


@kernel()
def is_number(queue: Any, entry: int, limits: Any) -> bool:
    """Return whether a command of an arm is finite: what another process wrote was not checked when it was sent."""
    is_finite = True
    for k in range(limits.arm_values):  # a drive stops for what is not, see `limit_command`
        is_finite = is_finite and math.isfinite(queue.values[entry, k])
    return is_finite


@kernel()
def take_command(state: Any, queue: Any, estop: Counts, limits: Any, now_ns: int) -> None:
    """Take what is due from the queue; the newest that is due wins."""
    if queue.head != state.seen_head:
        find_next(state, queue)
    if state.next_due_ns != NEVER and state.next_due_ns > now_ns + HORIZON_NS:
        # By a sender whose clock is another one.
        state.refusals[_BEYOND_HORIZON] += drop(state, queue, _LEAST, _MOST)
    for taken in range(_MOST_TAKEN):
        if state.next_due_ns > now_ns:
            return
        last = state.taken_sequence
        if taken:
            state.refusals[_OUT_OF_ORDER] += drop(state, queue, _LEAST, last)
            state.refusals[_OUT_OF_ORDER] += drop(state, queue, last + SEQUENCE_STEP + 1, _MOST)
            keep_newest(state, queue, now_ns)  # however many are due, a tick takes its time for one
            if state.next_due_ns > now_ns:
                return
        entry = state.next_entry
        # Another process may have written to the entry since it was found due.
        sequence, due_ns = queue.sequence[entry], min(queue.due_ns[entry], now_ns)
        queue.waits[entry] = False
        # None is taken twice, and none is so far ahead that all that follow would be refused.
        if not last < sequence <= last + SEQUENCE_STEP:
            state.refusals[_OUT_OF_ORDER] += 1
            find_next(state, queue)
            continue
        state.taken_sequence = sequence
        # What was sent before and is due later belongs to an action chunk that a newer one took the place of.
        drop(state, queue, _LEAST, sequence - 1)
        reason = refusal(state, estop)  # modes may have changed since it was sent
        if reason == _ACCEPTED and due_ns < now_ns - limits.timeout_ns:
            reason = _STALE
        if reason != _ACCEPTED:
            state.refusals[reason] += 1
            continue
        if not is_number(queue, entry, limits):
            state.limits |= _NON_FINITE
            fail(state, _GUARD)
            return
        if state.mode != _TRACKING:
            set_mode(state, _TRACKING)
        for k in range(limits.width):
            state.requested[k] = queue.values[entry, k]
        state.due_ns, state.by_goal, state.has_setpoint = due_ns, False, True
        state.setpoints_taken += 1


@kernel()
def follow_controller(state: Any, limits: Any) -> None:
    """Keep the mode in step with the controller.

    TRACKING while a goal is followed, HOLD when all are done and the base is at rest, FAULT for a robot that something
    is in the way of.
    """
    if state.protective_stop:
        state.watchdog |= state.protective_stop  # whatever moved it there would keep pressing
        fail(state, state.protective_stop)
    resumes = state.follows_goal and state.mode == _STOPPING and not state.is_deactivating
    if resumes or (state.busy and state.mode == _HOLD):
        state.by_goal = True
        set_mode(state, _TRACKING)
    if state.by_goal and not state.busy and (not limits.is_drive or is_base_at_rest(state, limits)):
        state.by_goal = False
        if state.mode == _TRACKING:
            set_mode(state, _HOLD)


@kernel()
def tick_robot(  # noqa: PLR0917
    sim: int, robots: RobotRecords, monitors: Any, arms: ArmRecords | None, springs: SpringRecords | None, now_ns: int
) -> bool:
    """Run one tick of one of n robots, see `tick`; what they do not have is None.

    Args:
        sim: its number.
        monitors: those of their drives; one without beams may be one for all.
    """
    state, queue, word, own = robots.states[sim], robots.queues[sim], robots.estop[:, sim], robots.limits[0]
    seen, seen_ns, is_over = robots.sensors[sim], robots.sensors_ns[sim], True
    if arms is None:
        if monitors is not None:
            monitor = monitors[sim % len(monitors)]
            tick(state, queue, word, monitor, None, None, own, None, None, None, seen, seen_ns, now_ns)
        if springs is not None:
            spring, its = springs.records[sim], springs.limits[0]
            tick(state, queue, word, None, None, spring, own, its, None, None, None, seen_ns, now_ns)
    if arms is not None:
        arm, its, rows = arms.records[sim], arms.limits[0], arms.rows
        shapes = arms.geometries[arm.geometry % len(arms.geometries)]
        if monitors is None:
            is_over = tick(state, queue, word, None, arm, None, own, its, shapes, rows, None, seen_ns, now_ns)
        if monitors is not None:
            monitor = monitors[sim % len(monitors)]
            is_over = tick(state, queue, word, monitor, arm, None, own, its, shapes, rows, seen, seen_ns, now_ns)
    return is_over


@kernel()
def tick_all(  # noqa: PLR0917
    robots: RobotRecords,
    monitors: Any,
    arms: ArmRecords | None,
    springs: SpringRecords | None,
    now_ns: int,
    goes_on: bool,
) -> bool:
    """Run one tick of n robots, see `tick_robot`.

    Args:
        goes_on: continue the ticks that have waited for the controller.

    Returns:
        Whether none waits.
    """
    is_over = True
    for sim in range(len(robots.states)):
        if arms is not None:
            if goes_on and arms.records[sim].stage == _NONE:
                continue
            if not goes_on:
                arms.records[sim].stage = _NONE
        is_over &= tick_robot(sim, robots, monitors, arms, springs, now_ns)
    return is_over


ROBOTS = "RobotRecords(state[::1], queue[::1], i8[:,::1], limits[::1], f8[:,::1], i8[::1])"
MONITORS = "monitor[::1]"
ARMS = "ArmRecords(arm[::1], arm_limits[::1], geometry[::1], f8[:,:,::1])"
SPRINGS = "SpringRecords(spring[::1], arm_limits[::1])"
tick_bases = tick_all.of("tick_bases", f"b1({ROBOTS}, {MONITORS}, none, none, i8, b1)")
tick_arms = tick_all.of("tick_arms", f"b1({ROBOTS}, none, {ARMS}, none, i8, b1)")
tick_mobile_arms = tick_all.of("tick_mobile_arms", f"b1({ROBOTS}, {MONITORS}, {ARMS}, none, i8, b1)")
tick_springs = tick_all.of("tick_springs", f"b1({ROBOTS}, none, none, {SPRINGS}, i8, b1)")


@kernel("void(state[::1], limits[::1], b1[:])")
def judge_all(states: Any, limits: Any, mask: NDArray[np.bool_]) -> None:
    """Judge the readings of some robots."""
    for sim in range(len(states)):
        if mask[sim]:
            judge_reading(states[sim], limits[0])


@kernel("void(state[::1], queue[::1], i8[::1], b1[:])")
def drop_all(states: Any, queues: Any, dropped: Counts, mask: NDArray[np.bool_]) -> None:
    """Drop what waits for some robots; write how many commands that were."""
    for sim in range(len(states)):
        dropped[sim] = drop(states[sim], queues[sim], _LEAST, _MOST) if mask[sim] else 0
