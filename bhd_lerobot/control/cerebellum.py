"""The cerebellum: turns commands into safe actuator commands, one tick at a time. It owns the modes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.estop_word import EstopWord
from bhd_lerobot.control.fifo import CommandFifo
from bhd_lerobot.control.guard import WireLimits
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.messages import (
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
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.control.reading_check import ReadingCheck
from bhd_lerobot.control.record import JOINTS, RobotRecords, new_states, put
from bhd_lerobot.control.tick import drop_all, judge_all, report, tick_arms, tick_bases, tick_mobile_arms, tick_springs
from bhd_lerobot.errors import ConfigError

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
        states: the records of the robots, shape (n,): see `record`.
        robots: what ticks work on, as kernels take it; another one if `fifo` or `estop` is replaced.
        numbers: the record of their limits, shape (1,).
        written: what is written to the plant, shape (n, actuators).
        efforts: torques of the joints [N m], a gripper's force [N], as they were measured; where the plant does not
            measure them, what its servos are commanded to give; shape (n, joints).
        readings: checks that what the plant reads can be a measurement of the present.
        now_ns: the time of the last tick [ns].
        may_write: whether it is known where the robots are: before, nothing is written.
        requested: the setpoint that was last taken, before all limits, shape (n, width).
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
        if max(width, controller.joints) > JOINTS:
            raise ConfigError(
                f"The body {body.name!r} has {controller.joints} joints and commands of {width} values; a robot's "
                f"record holds {JOINTS} of each. Control it as two robots."
            )
        self.states, self.numbers = states, numbers = controller.states, controller.numbers
        self.mode: NDArray[np.int8] = states["mode"]
        self.refusals: NDArray[np.int64] = states["refusals"].T
        self.requested: NDArray[np.float64] = states["requested"][:, :width]
        self.written: NDArray[np.float64] = states["written"][:, : controller.joints]
        self._rate: NDArray[np.float64] = states["written_rate"][:, : controller.joints]
        # Fields that every tick uses: an index costs as much as a write.
        self._mode_is_new, self._stamp_ns, self._has_stamps = (
            states["mode_is_new"],
            states["stamp_ns"],
            numbers["has_stamps"],
        )
        self._has_effort, self._measured = states["has_effort"], states["measured"][:, :width]
        self.efforts = states["torque"][:, : controller.joints]
        if controller.monitors is not None:
            needed = max(int(controller.monitors["beams"].max()), int(numbers["gyro"][0]) + 1)
            if sensors < needed:  # compiled code would read beyond them
                raise ConfigError(f"The controller of {body.name!r} takes {needed} sensors; the plant reads {sensors}.")
        self.reading = PlantReading(n, self.controller.joints, sensors, states)
        self.readings = ReadingCheck(body, control_hz, states, numbers)
        wire = WireLimits.of(body, control_hz, plant.takes)
        for name in ("lower", "upper", "change", "bend"):
            put(numbers[0], name, getattr(wire, name))
        self._timeout_ns = round(body.limits.command_timeout_s * NANOSECONDS)
        numbers["timeout_ns"], numbers["width"], numbers["has_sensors"] = self._timeout_ns, width, sensors > 0
        self.now_ns = 0
        self.may_write = False
        self._dropped = np.zeros(n, np.int64)
        self._fifo = CommandFifo(n, width) if fifo is None else fifo
        self._estop = EstopWord(n) if estop is None else estop
        self._tick_all = tick_bases if controller.springs is None else tick_springs
        if controller.arms is not None:
            self._tick_all = tick_arms if controller.monitors is None else tick_mobile_arms
        self._group()
        self._start_writing(np.arange(n))

    def _group(self) -> None:
        queues, words, reading = self._fifo.queues, self._estop.words, self.reading
        self.robots = RobotRecords(self.states, queues, words, self.numbers, reading.sensors, reading.sensors_ns)

    def load(self, *, with_ticks: bool = True) -> None:
        """Load the machine code of its calls, which is compiled if the cache has none, before a loop begins.

        Args:
            with_ticks: also that of `tick`.
        """
        for one in (judge_all, drop_all, *([self._tick_all] if with_ticks else ())):
            one.load()

    @property
    def fifo(self) -> CommandFifo:
        """Where commands come from."""
        return self._fifo

    @fifo.setter
    def fifo(self, fifo: CommandFifo) -> None:
        self._fifo = fifo
        self.states["seen_head"] = -1
        self._group()

    @property
    def estop(self) -> EstopWord:
        """The word of the emergency stop."""
        return self._estop

    @estop.setter
    def estop(self, estop: EstopWord) -> None:
        self._estop = estop
        self._group()

    @property
    def stamp_origin_ns(self) -> int:
        """Time 0 of the ticks, on the clock of the plant's stamps [ns]."""
        return int(self.numbers["origin_ns"][0])

    @stamp_origin_ns.setter
    def stamp_origin_ns(self, origin_ns: int) -> None:
        self.numbers["origin_ns"] = origin_ns

    @property
    def setpoints_taken(self) -> int:
        """How many setpoints have been taken."""
        return sum(self.states["setpoints_taken"].tolist())

    # --- one tick ----------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Run one tick, see `bhd_lerobot.control.tick`.

        Args:
            now_ns: the time that the tick is for [ns].
        """
        try:
            self._tick(now_ns)
        except BaseException:
            self._keep_stops()
            raise

    def _keep_stops(self) -> None:
        """Begin stops again in the next tick: what interrupted this one may have interrupted their beginning."""
        for mode in (Mode.STOPPING, Mode.ESTOP, Mode.FAULT):
            self.states["entered"][self.mode == mode] |= 1 << mode

    def _tick(self, now_ns: int) -> None:
        self.now_ns = now_ns
        self._read()
        goes_on = False
        while not self._tick_all.run(self.robots, *self.controller.groups, now_ns, goes_on):
            self.serve()
            goes_on = True
        if np.count_nonzero(self._mode_is_new):
            self._mode_is_new[:] = False
            self.plant.set_mode(self.mode)
        if self.may_write:
            self.plant.write(self.written)

    def serve(self, ids: NDArray[np.intp] | None = None) -> None:
        """Let the controller do what the ticks of some robots wait for, of all if None."""
        waiting = np.flatnonzero(self.controller.arms["stage"]) if ids is None else ids
        try:
            for sim in waiting.tolist():
                self.controller.serve(sim)
        except BaseException:
            self._keep_stops()
            raise

    def _read(self) -> None:
        reading = self.reading
        self.plant.read(reading)
        self._stamp_ns[:] = self.now_ns if reading.stamp_ns is None else reading.stamp_ns
        self._has_stamps[0] = reading.stamp_ns is not None
        self._has_effort[:] = reading.has_effort

    def _tell_controller(self) -> None:
        """Tell the controller outside of a tick what it is to do."""
        states = self.states
        news = states["goes_back"] | (states["entered"] != 0) | states["is_distrusted"] | states["has_setpoint"]
        for sim in np.flatnonzero(news).tolist():
            self.controller.tell(sim)

    def _drop(self, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Drop what waits for some robots; return how many commands of each that were, shape (n,)."""
        drop_all.run(self.states, self._fifo.queues, self._dropped, mask)
        return self._dropped

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
            self.refusals[Reason.STALE] += self._drop(held)  # what still waits would start motion again
        self.states["watchdog"][hit] |= int(cause)
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
            self._drop(np.arange(self.n) == sim)
            self.states["by_goal"][sim] |= self.mode[sim] == Mode.TRACKING
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
        last, last_due_ns = self.fifo.sent_sequence, self.fifo.sent_due_ns
        late = (setpoint.sequence <= last) | (setpoint.sequence > last + SEQUENCE_STEP)
        if not setpoint.replaces:
            late |= setpoint.due_ns < last_due_ns
        reasons[(reasons == Reason.ACCEPTED) & late] = Reason.OUT_OF_ORDER
        if not np.isfinite(values).all():
            reasons[~np.isfinite(values).all(axis=1)] = Reason.NON_FINITE
        reasons[~wanted] = Reason.ACCEPTED
        accepted = wanted & (reasons == Reason.ACCEPTED)
        if accepted.any():
            pushed = self.fifo.push(setpoint.sequence, setpoint.due_ns, values, accepted)
            last[pushed], last_due_ns[pushed] = setpoint.sequence, setpoint.due_ns
            reasons[accepted & ~pushed] = Reason.FIFO_FULL
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
        on something (`CerebellumState.pressed`).
        """
        wanted = np.zeros(self.n, np.bool_)
        wanted[slice(None) if ids is None else ids] = True
        if request == Request.CONFIGURE:
            self._read_anew(wanted & (self.mode == Mode.UNCONFIGURED))
        sources, result = _TRANSITIONS[request]
        applies = wanted & np.isin(self.mode, [int(source) for source in sources])
        allowed = applies.copy()
        reasons = np.where(wanted & ~allowed, Reason.WRONG_MODE, Reason.ACCEPTED).astype(np.int8)
        reasons[wanted & ~allowed & ((self.mode == Mode.ESTOP) | self.estop.pressed)] = Reason.ESTOP
        reasons[wanted & ~allowed & (self.mode == Mode.FAULT)] = Reason.FAULT
        if request == Request.RESET:
            # A stop that is not over yet must not become a gentler one.
            moving = allowed & self.states["is_configured"] & ~self.controller.at_rest()
            reasons[moving] = Reason.NOT_AT_REST
            allowed &= ~moving
        if request in (Request.RESET, Request.ACTIVATE):
            # Whatever is in its way would be pressed further, and nobody would know why.
            pressed = applies & (self.states["pressed"] > 0.0)
            reasons[pressed] = Reason.PRESSED
            allowed &= ~pressed
        if request == Request.CONFIGURE:
            self._configure(allowed)
        if request == Request.ACTIVATE:
            self.refusals[Reason.NOT_ACTIVE] += self._drop(allowed)
            self.fifo.sent_due_ns[allowed] = np.iinfo(np.int64).min
        if request == Request.RESET:
            # A press after another latch has not been seen yet: the next tick will.
            latched = self.mode == Mode.ESTOP
            if np.count_nonzero(allowed):
                known = self._recover(allowed)
                reasons[allowed & ~known] = Reason.FAULT
                allowed &= known
            self.estop.acknowledge(allowed & latched, press)
        self._set_mode(allowed, result)
        if request == Request.DEACTIVATE:
            self.states["is_deactivating"] |= allowed
        self._count_refusals(reasons)
        return SendResult(reasons)

    def _recover(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Leave stops of the robots' own, and take where they are now; return of which robots that is known."""
        moved = self.plant.recover()
        self._read_anew(mask)
        known: NDArray[np.bool_] = np.isfinite(self.states["near"][:, 0])
        mask = mask & known
        self._configure(mask & ~self.states["is_configured"])
        if moved:
            # It stopped elsewhere than the reference came to rest: to go there would be a jump.
            ids = np.flatnonzero(mask)
            self.controller.resume(ids, self.reading)
            self._start_writing(ids)
        return known

    def _read_anew(self, mask: NDArray[np.bool_]) -> None:
        """Take where robots are now, wherever they were before; `mask` has shape (n,)."""
        others = ~mask
        kept = {name: self.states[name][others] for name in ("position", "velocity", "effort", "safety", "stamp_ns")}
        self._read()
        for name, values in kept.items():
            self.states[name][others] = values  # theirs are of the last tick
        self.readings.forget(np.flatnonzero(mask))
        judge_all.run(self.states, self.numbers, mask)
        outside = self.readings.refuse_outside(np.flatnonzero(mask))
        self._set_mode(np.isin(np.arange(self.n), outside) & (self.mode < Mode.ESTOP), Mode.FAULT)
        self._tell_controller()

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about simulations that were put somewhere else: they are unconfigured again.

        All but an emergency stop that no tick has seen yet, or that another process may have pressed: the next tick
        latches it.
        """
        chosen = np.zeros(self.n, np.bool_)
        chosen[ids] = True
        self._drop(chosen)
        if not self.estop.is_shared:
            self.estop.acknowledge(chosen & (self.mode == Mode.ESTOP))
        kept = ("setpoints_taken", "command", "actuators") if self.body.arm is not None else ("setpoints_taken",)
        values = [self.states[name][ids] for name in kept]  # servos that take positions stay where they are
        for value in values[1:]:
            value[:, int(self.numbers["arm_values"][0]) :] = 0.0  # wheels stand
        self.states[ids] = new_states(1)
        self.fifo.forget(ids)
        for name, value in zip(kept, values, strict=True):
            self.states[name][ids] = value
        self.controller.restart(ids)
        self.readings.forget(ids)
        self._start_writing(ids)

    # --- reports -----------------------------------------------------------------------------------------------------

    def take_flags(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the `Limit` and `Watchdog` flags raised since the last call, each of shape (n,), and clear them."""
        watchdog = self.states["watchdog"].copy()
        self.states["watchdog"] = 0
        return self.controller.take_limits(), watchdog

    def state(self, now_ns: int) -> CerebellumState:
        """Return a copy of what the records report, whether they are this cerebellum's own or another's."""
        velocity, odometry = self.reading.velocity.copy(), 0 if self.body.drive is None else 3
        return CerebellumState(
            stamp_ns=now_ns,
            joint_positions=self.reading.position.copy(),
            joint_velocities=velocity,
            joint_efforts=self.efforts.copy(),
            contact_wrench=self.controller.contact_wrench.copy(),
            pressed=self.states["pressed"].copy(),
            command=self.command.copy(),
            odometry=self.states["odometry"][:, :odometry].copy(),
            measured=self._measured.copy(),
            mode=self.mode.copy(),
            is_moving=np.asarray((np.abs(velocity) > MOVING).any(axis=1)),
            emergency_stop=self.mode == Mode.ESTOP,
        )

    # --- modes -------------------------------------------------------------------------------------------------------

    def _set_mode(self, mask: NDArray[np.bool_], mode: Mode) -> None:
        if not mask.any():
            return
        self.mode[mask] = mode
        self.states["mode_is_new"][mask] = True
        self.states["is_deactivating"][mask] = False
        self.states["entered"][mask] |= 1 << mode
        self.states["has_setpoint"][mask] = False  # as in a tick that was interrupted
        self._tell_controller()

    def _mode_reasons(self) -> NDArray[np.int8]:
        """Return why each mode would refuse a setpoint, shape (n,)."""
        reasons = _MODE_REASON[self.mode]
        reasons[self.states["is_deactivating"]] = Reason.NOT_ACTIVE
        # The word counts from the moment that it is set, the mode from the next tick.
        reasons[self.estop.pressed] = Reason.ESTOP
        return reasons

    def _count_refusals(self, reasons: NDArray) -> None:
        if reasons.any():
            self.refusals[reasons, np.arange(self.n)] += reasons != Reason.ACCEPTED

    def _configure(self, mask: NDArray[np.bool_]) -> None:
        ids = np.flatnonzero(mask)
        if not len(ids):
            return
        self.controller.configure(ids, self.reading)
        self._start_writing(ids)
        self.states["is_configured"] |= mask
        self.may_write = True  # before, it was not known where the robots are
        np.copyto(self.requested, self.command, where=mask[:, None])
        own = self.controller
        limits, its = _object(self.numbers), _object(own.arm_limits)
        for sim in ids.tolist():  # no tick has reported them yet
            state, *parts = (_object(part, sim) for part in (self.states, own.monitors, own.arms, own.springs))
            report(state, parts[0], parts[1], parts[2], limits, its)

    def _start_writing(self, ids: NDArray[np.intp]) -> None:
        """Start from commands that the next ones need not be near to: robots were put or moved somewhere else."""
        self.written[ids], self._rate[ids] = self.controller.actuators[ids], 0.0
        self.states["same_effort"][ids] = self.states["written"][ids]  # no joint has to answer to this change


def _object(records: NDArray | None, sim: int = 0) -> Any:
    """Return the record of one robot, of which there may be one for all, as kernels take it; None if there are none."""
    return None if records is None else as_objects(records[(at := sim % len(records)) : at + 1])[0]


_TRACKING = int(Mode.TRACKING)  # numpy compares plain numbers faster
_MODE_REASON = np.array([mode_reason(mode) for mode in Mode], np.int8)
_GOAL_REFUSAL = {
    int(Reason.NOT_ACTIVE): ResultCode.NOT_ACTIVE,
    int(Reason.ESTOP): ResultCode.ESTOP,
    int(Reason.FAULT): ResultCode.FAULT,
}
