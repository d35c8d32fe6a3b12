"""The cerebellum: turns commands into safe actuator commands, one tick at a time. It owns the modes."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.estop_word import EstopWord
from bhd_lerobot.control.fifo import CommandFifo
from bhd_lerobot.control.guard import Guard, WireLimits
from bhd_lerobot.control.messages import (
    HORIZON_NS,
    NANOSECONDS,
    SEQUENCE_STEP,
    CerebellumState,
    Mode,
    Reason,
    Request,
    SendResult,
    Setpoint,
    Watchdog,
    mode_reason,
)
from bhd_lerobot.control.plant import Plant, PlantReading, SafetyStatus
from bhd_lerobot.control.reading_check import ReadingCheck

_TRACKING = int(Mode.TRACKING)  # numpy compares plain numbers faster
MOVING = 0.01  # [rad/s] a joint faster than this moves: `CerebellumState.is_moving`

# Requests and the modes that they apply in; resets lead to INACTIVE only, motion needs a separate activation.
_TRANSITIONS = {
    Request.CONFIGURE: ({Mode.UNCONFIGURED}, Mode.INACTIVE),
    Request.ACTIVATE: ({Mode.INACTIVE}, Mode.HOLD),
    Request.DEACTIVATE: ({Mode.HOLD, Mode.TRACKING, Mode.STOPPING}, Mode.STOPPING),
    Request.RESET: ({Mode.ESTOP, Mode.FAULT, Mode.SAFE_OFF}, Mode.INACTIVE),
}


class Cerebellum:
    """The fixed-rate controller of n simulations, or of one real robot (n = 1).

    `tick` never sleeps, never blocks and never logs: in lockstep it is called by the simulation's clock, in real time
    by a thread on an absolute grid, and does the same in both. Everything that depends on time comes in as `now_ns`.

    Args:
        body: the robot.
        plant: the joints.
        control_hz: ticks a second [Hz].
        controller: what turns commands into actuator commands.
        fifo: where commands come from; a new one if None.
        estop: the word of the emergency stop, which any process may press; a new one if None.
        sensors: number of values that the plant reads beside those of the joints.

    Attributes:
        guard: the last check of what is written to the plant.
        stamp_origin_ns: time 0 of the ticks, on the clock of the plant's stamps [ns].
        readings: checks that what the plant reads can be a measurement of the present.
        requested: the setpoint that was last taken, before all limits, shape (n, width).
        setpoints_taken: how many have been taken.
    """

    def __init__(
        self,
        body: Body,
        plant: Plant,
        control_hz: int,
        controller: Controller,
        *,
        fifo: CommandFifo | None = None,
        estop: EstopWord | None = None,
        sensors: int = 0,
    ) -> None:
        self.body, self.plant, self.control_hz = body, plant, control_hz
        self.n = n = plant.n
        self.controller = controller
        self.width = width = self.controller.width
        self.command = self.controller.command
        self.fifo = CommandFifo(n, width) if fifo is None else fifo
        self.estop = EstopWord(n) if estop is None else estop
        self.mode = np.full(n, Mode.UNCONFIGURED, np.int8)
        self.guard = Guard(WireLimits.of(body, control_hz, plant.takes), n)
        self.guard.restart(np.arange(n), controller.actuators)
        self.refusals = np.zeros((len(Reason), n), np.int64)
        self.reading = PlantReading(n, self.controller.joints, sensors)
        self.requested = np.zeros((n, width))
        self.setpoints_taken = 0
        self._now_ns = 0
        self.stamp_origin_ns = 0
        self.readings = ReadingCheck(body, n, control_hz)
        self._timeout_ns = round(body.limits.command_timeout_s * NANOSECONDS)
        # The sum of 0 * x is 0 if and only if every x is finite; unlike a plain sum it neither overflows nor warns.
        self._flat_reading = self.reading.values.reshape(-1)
        self._zeros = np.zeros_like(self._flat_reading)
        self._configured, self._may_write = np.zeros(n, np.bool_), False
        self._mode_is_new = True  # the plant has not been told it
        self._last_due = np.zeros(n, np.int64)
        self._sent_sequence, self._taken_sequence = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
        self._sent_due = np.full(n, np.iinfo(np.int64).min, np.int64)
        self._deactivating = np.zeros(n, np.bool_)
        self._deadline: int | None = None  # when the first command of a moving robot becomes too old [ns]
        self._stopping = False
        self._popped, self._popped_mask = np.zeros((n, width)), np.zeros(n, np.bool_)
        self._by_goal = np.zeros(n, np.bool_)  # moves because of a goal, not because of setpoints
        self._watchdog = np.zeros(n, np.int64)

    # --- one tick ----------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Run one tick.

        The reference advances by one period, also after ticks that were skipped: it is late then, and what is written
        to the plant does not jump to where it would be by now.

        Args:
            now_ns: the time that the tick is for [ns].
        """
        self.plant.read(self.reading)
        self._supervise(now_ns)
        self._take_commands(now_ns)
        self.controller.run(self.reading)
        self._follow_controller()
        unsafe = self.guard.check(self.controller.actuators, self.reading.position)
        if unsafe is not None:
            self._refuse_to_write(unsafe)
        if self._mode_is_new:
            self._mode_is_new = False
            self.plant.set_mode(self.mode)
        if self._may_write:
            self.plant.write(self.guard.written)

    def _supervise(self, now_ns: int) -> None:
        """Emergency stop, plant faults and watchdogs: changes of mode that were not requested."""
        # This runs several times a tick: counting is several times cheaper than `any`.
        pressed = self.estop.see()
        if np.count_nonzero(pressed):
            self._set_mode(pressed & (self.mode != Mode.ESTOP), Mode.ESTOP)
        self._now_ns = now_ns
        self._judge_reading()
        if self.reading.stamp_ns is not None:
            self._check_times(self.reading.stamp_ns, now_ns)
        if self._deadline is not None and now_ns > self._deadline:
            old = (self.mode == Mode.TRACKING) & ~self._by_goal & (now_ns - self._last_due > self._timeout_ns)
            if old.any():
                self._watchdog[old] |= Watchdog.COMMAND_AGE
                ids = np.flatnonzero(old)  # what a brain left behind that fell silent moves nothing later
                self.refusals[Reason.STALE, ids] += self.fifo.drop(ids)
                self._set_mode(old, Mode.STOPPING)
            self._update_deadline()
        if self._stopping:
            stopping = self.mode == Mode.STOPPING
            rest = stopping & self.controller.at_rest()
            if rest.any():
                self._set_mode(rest & ~self._deactivating, Mode.HOLD)
                self._set_mode(rest & self._deactivating, Mode.SAFE_OFF)
            self._stopping = bool((self.mode == Mode.STOPPING).any())

    def _judge_reading(self) -> None:
        """Stop robots that report a stop of their own, or whose readings are no measurements."""
        reading = self.reading
        wrong = self.readings.wrong_positions(reading, self._now_ns)
        odd = self.readings.wrong_motions(reading, self.guard.written, self.mode, self._now_ns)
        if odd is not None:
            wrong = odd if wrong is None else wrong | odd
        if wrong is None and self._flat_reading.dot(self._zeros) == 0.0 and not np.count_nonzero(reading.safety):
            return
        bad: NDArray[np.bool_] = np.asarray(~np.isfinite(reading.values).all(axis=(0, 2)))
        if wrong is not None:
            bad |= wrong
        # What is no measurement must not spread: it is treated as a joint at rest where the encoder last was. Efforts
        # do not depend on encoders.
        misread = bad & ~np.isfinite(reading.effort).all(axis=1)
        reading.velocity[bad] = reading.effort[misread] = 0.0
        self._set_mode((reading.safety == SafetyStatus.EMERGENCY_STOP) & (self.mode != Mode.ESTOP), Mode.ESTOP)
        faulty = bad | (reading.safety != SafetyStatus.NORMAL)
        faulty &= (self.mode != Mode.ESTOP) & (self.mode != Mode.FAULT)
        self._watchdog[faulty] |= Watchdog.PLANT
        self._set_mode(faulty, Mode.FAULT)
        if bad.any():
            self.controller.distrust(bad)

    def _check_times(self, stamp_ns: NDArray[np.int64], now_ns: int) -> None:
        """Stop robots whose reading is too old to be a measurement of the present, or from the future."""
        newest = stamp_ns
        if self.reading.sensors.shape[1]:
            newest = np.maximum(stamp_ns, self.reading.sensors_ns)
        wrong = self.readings.wrong_times(stamp_ns, newest, now_ns + self.stamp_origin_ns)
        if wrong is None:
            return
        wrong &= (self.mode != Mode.ESTOP) & (self.mode != Mode.FAULT) & (self.mode != Mode.UNCONFIGURED)
        self._watchdog[wrong] |= Watchdog.PLANT
        self._set_mode(wrong, Mode.FAULT)

    def _refuse_to_write(self, unsafe: NDArray[np.bool_]) -> None:
        """Stop robots whose actuator commands are not safe: as hard as possible, from the last that were."""
        self._watchdog[unsafe] |= Watchdog.GUARD
        self.controller.go_back(unsafe, self.guard.written, self.guard.rate)
        latched = (self.mode == Mode.ESTOP) | (self.mode == Mode.FAULT)
        self.controller.stop(unsafe & latched, Mode.FAULT)  # the present stop is not safe either
        self._set_mode(unsafe & ~latched, Mode.FAULT)

    def _take_commands(self, now_ns: int) -> None:
        """Take what is due from the queue; the newest that is due wins, and at most one for each robot counts."""
        due = self.fifo.next_due()
        if due is not None and due - now_ns > HORIZON_NS:
            # By a sender whose clock is another one.
            self.refusals[Reason.BEYOND_HORIZON] += self.fifo.drop(np.arange(self.n))
            return
        popped = None
        while due is not None and due <= now_ns:
            if popped is not None:
                last = self._taken_sequence
                self.refusals[Reason.OUT_OF_ORDER] += self.fifo.drop_outside(last + 1, last + SEQUENCE_STEP)
                self.fifo.keep_newest(now_ns)  # however many are due, a tick takes its time for one
            popped = self.fifo.pop(self._popped, self._popped_mask)
            if popped is None:
                return
            take = self._in_order(popped[0], self._popped_mask)
            # What was sent before and is due later belongs to an action chunk that a newer one took the place of.
            self.fifo.drop_older(popped[0], take)
            self._taken_sequence[take] = popped[0]
            # Modes may have changed since the command was sent.
            if now_ns - due > self._timeout_ns or not self._all_track:
                take = self._sift(take, now_ns - due)
                self._last_due[take] = due
                self._set_mode(take & (self.mode != _TRACKING), Mode.TRACKING)
            np.copyto(self._last_due, due, where=take)
            np.copyto(self.requested, self._popped, where=take[:, None])
            self.setpoints_taken += int(np.count_nonzero(take))
            self._by_goal &= ~take
            self.controller.set_setpoint(self._popped, take)
            self._update_deadline()
            due = self.fifo.next_due()

    def _in_order(self, sequence: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Count the robots that refuse a sequence number; return those that take it.

        None is taken twice, and none is so far ahead that all that follow would be refused.
        """
        ahead = sequence - self._taken_sequence  # where that overflows it is out of the range, too
        right = (ahead > 0) & (ahead <= SEQUENCE_STEP)
        if np.count_nonzero(mask > right):
            self.refusals[Reason.OUT_OF_ORDER] += mask > right
        return mask & right

    @property
    def _all_track(self) -> bool:
        """Whether every robot follows commands, and none is to stop."""
        if np.count_nonzero(self.mode == _TRACKING) < self.n:
            return False
        return not (np.count_nonzero(self.estop.pressed) or np.count_nonzero(self._deactivating))

    def _sift(self, mask: NDArray[np.bool_], age_ns: int) -> NDArray[np.bool_]:
        """Count the robots that refuse a command of this age; return those that take it."""
        reasons = self._mode_reasons()
        reasons[(reasons == Reason.ACCEPTED) & (age_ns > self._timeout_ns)] = Reason.STALE
        self._count_refusals(np.where(mask, reasons, Reason.ACCEPTED))
        return mask & (reasons == Reason.ACCEPTED)

    def _follow_controller(self) -> None:
        """Keep the modes in step with the controller.

        TRACKING while a goal is followed, HOLD when all are done, FAULT for an arm that something is in the way of.
        """
        stopped = self.controller.protective_stop
        if np.count_nonzero(stopped):
            # Whatever moved it there would keep pressing.
            self._watchdog |= stopped
            self._set_mode((stopped != 0) & (self.mode != Mode.ESTOP) & (self.mode != Mode.FAULT), Mode.FAULT)
        busy = self.controller.busy
        if not np.count_nonzero(busy != self._by_goal):
            return
        starting = busy & (self.mode == Mode.HOLD)
        if self._stopping:
            starting |= self.controller.following & (self.mode == Mode.STOPPING) & ~self._deactivating
        if np.count_nonzero(starting):
            self._by_goal |= starting
            self._set_mode(starting, Mode.TRACKING)
        done = self._by_goal > busy
        if np.count_nonzero(done):
            self._by_goal &= ~done
            self._set_mode(done & (self.mode == Mode.TRACKING), Mode.HOLD)

    def interrupt(self, cause: Watchdog, mode: Mode) -> None:
        """Stop moving robots because a watchdog outside of the tick noticed something, and note the cause.

        Args:
            cause: what it noticed.
            mode: `STOPPING` (robots that move decelerate, then hold) or `FAULT` (all stop hard and latch it).
        """
        if mode == Mode.FAULT:
            hit = (self.mode != Mode.ESTOP) & (self.mode != Mode.FAULT)
            held = hit
        else:
            hit = self.mode == Mode.TRACKING
            held = hit | (self.mode == Mode.STOPPING) | (self.mode == Mode.HOLD)
        if len(self.fifo) and np.count_nonzero(held):
            ids = np.flatnonzero(held)  # what still waits would start motion again
            self.refusals[Reason.STALE, ids] += self.fifo.drop(ids)
        if not np.count_nonzero(hit):
            return
        self._watchdog[hit] |= cause
        self._set_mode(hit, mode)

    # --- commands ----------------------------------------------------------------------------------------------------

    def submit(self, sim: int, command: BrainCommand) -> CommandResult | None:
        """Take a goal for one simulation; it is planned and started with the next tick, or waits for its turn.

        Returns:
            None if it was accepted, otherwise the refusal, which is then the goal's one result.
        """
        refusal = self.controller.submit(sim, command, _GOAL_REFUSAL.get(int(self._mode_reasons()[sim])))
        if refusal is None:
            # The newer command counts: setpoints that still wait are dropped, and the age of the last means nothing.
            self.fifo.drop(np.array([sim]))
            self._by_goal[sim] |= self.mode[sim] == Mode.TRACKING
            self._update_deadline()
        return refusal

    def offer(self, setpoint: Setpoint, mask: NDArray[np.bool_] | None = None) -> SendResult:
        """Check a setpoint and put it into the queue.

        A setpoint that one simulation refuses still reaches the others. Every refusal is counted in `refusals`.

        Args:
            setpoint: the command; `values` has shape (n, width).
            mask: the simulations it is for, shape (n,); all if None.
        """
        wanted = np.ones(self.n, np.bool_) if mask is None else mask
        values = np.asarray(setpoint.values)
        if values.shape != (self.n, self.width) or values.dtype.kind not in "fiu":
            reasons = np.where(wanted, Reason.WRONG_WIDTH, Reason.ACCEPTED).astype(np.int8)
            self._count_refusals(reasons)
            return SendResult(reasons)
        reasons = self._mode_reasons()
        last = self._sent_sequence
        late = (setpoint.sequence <= last) | (setpoint.sequence > last + SEQUENCE_STEP)
        if not setpoint.replaces:
            late |= setpoint.due_ns < self._sent_due
        reasons[(reasons == Reason.ACCEPTED) & late] = Reason.OUT_OF_ORDER
        if not np.isfinite(values).all():
            reasons[~np.isfinite(values).all(axis=1)] = Reason.NON_FINITE
        reasons[~wanted] = Reason.ACCEPTED
        accepted = wanted & (reasons == Reason.ACCEPTED)
        if accepted.any():
            if self.fifo.push(setpoint.sequence, setpoint.due_ns, values, accepted):
                self._sent_sequence[accepted] = setpoint.sequence
                self._sent_due[accepted] = setpoint.due_ns
            else:
                reasons[accepted] = Reason.FIFO_FULL
        self._count_refusals(reasons)
        return SendResult(reasons)

    def refuse(self, reason: Reason, mask: NDArray[np.bool_] | None = None) -> SendResult:
        """Count a setpoint that is refused before it gets here; `mask` as for `offer`."""
        reasons = np.full(self.n, reason, np.int8)
        if mask is not None:
            reasons[~mask] = Reason.ACCEPTED
        self._count_refusals(reasons)
        return SendResult(reasons)

    def request(self, request: Request, ids: NDArray[np.intp] | None = None, press: int | None = None) -> SendResult:
        """Ask for a change of mode; it happens before the next tick or is refused with a reason.

        `RESET` of a latched emergency stop also acknowledges the presses that a tick has seen, or, of another process,
        the one `press` that it has seen latched; the next tick latches those that came later. `ACTIVATE` drops what
        still waits in the queue: no command from before it can start motion. Neither is accepted while a robot presses
        on something (`Controller.pressed`).
        """
        wanted = np.zeros(self.n, np.bool_)
        wanted[slice(None) if ids is None else ids] = True
        if request == Request.CONFIGURE:
            self._read_anew(wanted)
        sources, result = _TRANSITIONS[request]
        applies = wanted & np.isin(self.mode, [int(source) for source in sources])
        allowed = applies.copy()
        reasons = np.where(wanted & ~allowed, Reason.WRONG_MODE, Reason.ACCEPTED).astype(np.int8)
        reasons[wanted & ~allowed & ((self.mode == Mode.ESTOP) | self.estop.pressed)] = Reason.ESTOP
        reasons[wanted & ~allowed & (self.mode == Mode.FAULT)] = Reason.FAULT
        if request == Request.RESET:
            # A stop that is not over yet must not become a gentler one.
            moving = allowed & ~self.controller.at_rest()
            reasons[moving] = Reason.NOT_AT_REST
            allowed &= ~moving
        if request in (Request.RESET, Request.ACTIVATE):
            # Whatever is in its way would be pressed further, and nobody would know why.
            pressed = applies & (self.controller.pressed() > 0.0)
            reasons[pressed] = Reason.PRESSED
            allowed &= ~pressed
        if request == Request.CONFIGURE:
            self._configure(allowed)
        if request == Request.ACTIVATE:
            active = np.flatnonzero(allowed)
            self.refusals[Reason.NOT_ACTIVE, active] += self.fifo.drop(active)
            self._sent_due[active] = np.iinfo(np.int64).min
        if request == Request.RESET:
            # A press after another latch has not been seen yet: the next tick will.
            self.estop.acknowledge(allowed & (self.mode == Mode.ESTOP), press)
            if np.count_nonzero(allowed):
                self._recover(allowed)
        self._set_mode(allowed, result)
        if request == Request.DEACTIVATE:
            self._deactivating |= allowed
        self._count_refusals(reasons)
        return SendResult(reasons)

    def _recover(self, mask: NDArray[np.bool_]) -> None:
        """Leave stops of the robots' own, and take where they are now."""
        moved = self.plant.recover()
        self._read_anew(mask)
        self._configure(mask & ~self._configured)
        if moved:
            # It stopped elsewhere than the reference came to rest: to go there would be a jump.
            ids = np.flatnonzero(mask)
            self.controller.resume(ids, self.reading)
            self.guard.restart(ids, self.controller.actuators)

    def _read_anew(self, mask: NDArray[np.bool_]) -> None:
        """Take where robots are now, wherever they were before; `mask` has shape (n,)."""
        reading, others = self.reading, ~mask
        values, safety = reading.values[:, others], reading.safety[others]
        self.plant.read(reading)
        reading.values[:, others], reading.safety[others] = values, safety  # theirs are of the last tick
        self.readings.forget(np.flatnonzero(mask))
        self._judge_reading()

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about simulations that were put somewhere else: they are unconfigured again.

        All but an emergency stop that no tick has seen yet, or that another process may have pressed: the next tick
        latches it.
        """
        self.fifo.drop(ids)
        chosen = np.zeros(self.n, np.bool_)
        chosen[ids] = True
        if not self.estop.is_shared:
            self.estop.acknowledge(chosen & (self.mode == Mode.ESTOP))
        self.mode[ids] = Mode.UNCONFIGURED
        self._mode_is_new = True
        self.controller.restart(ids)
        self.readings.forget(ids)
        self.guard.restart(ids, self.controller.actuators)
        self._configured[ids] = False
        self._sent_sequence[ids] = self._taken_sequence[ids] = -1
        self._sent_due[ids] = np.iinfo(np.int64).min
        self._last_due[ids] = 0
        self._deactivating[ids] = False
        self._by_goal[ids] = False
        self.refusals[:, ids] = 0
        self._watchdog[ids] = 0
        self._update_deadline()

    # --- reports -----------------------------------------------------------------------------------------------------

    def take_flags(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the `Limit` and `Watchdog` flags raised since the last call, each of shape (n,), and clear them."""
        watchdog = self._watchdog.copy()
        self._watchdog[:] = 0
        return self.controller.take_limits(), watchdog

    def efforts(self) -> NDArray[np.float64]:
        """Return the torques of the joints [N m], a gripper's force [N], shape (n, joints).

        As they were measured; where the plant does not measure them, what its servos are commanded to give.
        """
        return self.reading.effort.copy() if self.reading.has_effort else self.controller.efforts(self.reading)

    def command_age_ns(self, now_ns: int) -> NDArray[np.int64]:
        """Return how long ago the command in force was due [ns], shape (n,); 0 for a robot that follows none."""
        by_setpoint = (self.mode == _TRACKING) & ~self._by_goal
        return np.where(by_setpoint, now_ns - self._last_due, 0)

    def command_age_of(self, sim: int, now_ns: int) -> int:
        """Return `command_age_ns` of one simulation [ns]."""
        if self.mode[sim] != _TRACKING or self._by_goal[sim]:
            return 0
        return now_ns - int(self._last_due[sim])

    def state(self, now_ns: int) -> CerebellumState:
        """Return a copy of the present state."""
        velocity = self.reading.velocity.copy()
        return CerebellumState(
            stamp_ns=now_ns,
            joint_positions=self.reading.position.copy(),
            joint_velocities=velocity,
            joint_efforts=self.efforts(),
            contact_wrench=self.controller.contact_wrench.copy(),
            pressed=self.controller.pressed(),
            command=self.command.copy(),
            odometry=self.controller.odometry(),
            measured=self.controller.measured(self.reading),
            mode=self.mode.copy(),
            is_moving=np.asarray((np.abs(velocity) > MOVING).any(axis=1)),
            emergency_stop=self.mode == Mode.ESTOP,
        )

    # --- modes -------------------------------------------------------------------------------------------------------

    def _set_mode(self, mask: NDArray[np.bool_], mode: Mode) -> None:
        if not mask.any():
            return
        self.mode[mask] = mode
        self._mode_is_new = True
        if mode != Mode.TRACKING:
            self.controller.stop(mask, mode)
        self._deactivating[mask] = False
        self._stopping |= mode == Mode.STOPPING
        self._update_deadline()

    def _mode_reasons(self) -> NDArray[np.int8]:
        """Return why each mode would refuse a setpoint, shape (n,)."""
        reasons = _MODE_REASON[self.mode]
        reasons[self._deactivating] = Reason.NOT_ACTIVE
        # The word counts from the moment that it is set, the mode from the next tick.
        reasons[self.estop.pressed] = Reason.ESTOP
        return reasons

    def _count_refusals(self, reasons: NDArray) -> None:
        if reasons.any():
            self.refusals[reasons, np.arange(self.n)] += reasons != Reason.ACCEPTED

    def _update_deadline(self) -> None:
        tracking = (self.mode == _TRACKING) > self._by_goal
        if np.count_nonzero(tracking):
            self._deadline = int(self._last_due[tracking].min()) + self._timeout_ns
        else:
            self._deadline = None

    def _configure(self, mask: NDArray[np.bool_]) -> None:
        ids = np.flatnonzero(mask)
        self.controller.configure(ids, self.reading)
        self.guard.restart(ids, self.controller.actuators)
        self._configured |= mask
        self._may_write = True  # before, it was not known where the robots are
        np.copyto(self.requested, self.command, where=mask[:, None])


_MODE_REASON = np.array([mode_reason(mode) for mode in Mode], np.int8)
_GOAL_REFUSAL = {
    int(Reason.NOT_ACTIVE): ResultCode.NOT_ACTIVE,
    int(Reason.ESTOP): ResultCode.ESTOP,
    int(Reason.FAULT): ResultCode.FAULT,
}
