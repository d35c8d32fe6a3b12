"""The controller of arms with position servos: setpoints and goals to servo positions."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.arm.clearance import SetpointClearance
from bhd_lerobot.control.arm.force_limit import ForceLimit
from bhd_lerobot.control.arm.held import HeldObjects
from bhd_lerobot.control.arm.relief import ContactRelief, Sensed
from bhd_lerobot.control.arm.setpoints import SetpointFilter
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, GoalPhase, ResultCode
from bhd_lerobot.control.controller import SteppedController
from bhd_lerobot.control.geometry.dynamics import acceleration_share
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.guard import WireLimits
from bhd_lerobot.control.kernels import kernel, largest_change
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.control.motion.goals import GoalManager
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]

_CONVERTING, _EXECUTING = int(GoalPhase.CONVERTING), int(GoalPhase.EXECUTING)  # numpy compares plain numbers faster
_EFFORT = int(Limit.EFFORT)
_SLOW = 0.2  # [rad/s] the joints' speed below which they are held where they are
_BACK, _BACK_TOOL = 0.5, 0.25  # [rad/s, m/s] of joints and tool that a stop brings back, unless they were faster
_SETTLED_S = 0.04  # [s] what was stopped may swing back once
_YIELD_S = 0.2  # [s] for which joints that do not come to rest are waited for where they were: something pushes them
_PRESSED_N = 30.0  # [N] an arm that presses more is neither reset nor activated
_GIVES = 0.5  # the least share of its largest torque that the servo of a blocked joint gives
_ARRIVED_RAD = 2e-4  # [rad]
_SURE = 8.0  # times its largest torque that a servo would have to give: 0.03 rad of a joint at rest
_TINY = 1e-9
_STANDS = 0.01  # [rad, m] a joint that moved by less has not moved
_LOST = (
    "The efforts that the plant reads are 0 while the motors carry the arm: they are not measured, and without them "
    "there is no limit of force. Repair them, or let the plant leave PlantReading.has_effort false."
)
_DEAF = "The arm has not moved since it was activated: it takes no commands, its brakes are on, or something holds it."
_REST = 1e-6  # [rad/s, m/s] a reference slower than this is at rest


@kernel("b1(f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], f8[::1], f8[::1], f8[:,:], f8[:,:])")
def lead_commands(  # noqa: PLR0917
    reference: Array,
    speed: Array,
    actuators: Array,
    limits: NDArray[np.int64],
    lead: Array,
    largest_error: Array,
    position: Array,
    velocity: Array,
) -> bool:
    """Lead the servos' commands by their damping; return whether any servo gives its largest effort."""
    any_limited = False
    for sim in range(len(reference)):
        for k in range(len(lead)):
            actuators[sim, k] = speed[sim, k] * lead[k] + reference[sim, k]
            # A servo beyond its effort gives its largest: that is flagged, and the command stays as it is. Holding the
            # command near the joint, to ask for no more, would be a second loop around the servo, which a few
            # milliseconds of latency turn into a brake.
            if abs(velocity[sim, k] * lead[k] + position[sim, k] - actuators[sim, k]) > largest_error[k]:
                limits[sim] |= _EFFORT
                any_limited = True
    return any_limited


class ArmController(SteppedController):
    """Joint positions and the gripper's opening, from setpoints or from goals.

    A command is the position of each joint [rad] and the gripper's opening [m]. What goes to the servos is the
    reference plus the lead that makes up for the servos' damping, so that they follow a moving reference without a lag.

    Attributes:
        force: what stops an arm that presses too hard, if the plant measures efforts; nothing does if None.
        held: finds out what the grippers hold, which is then kept away from things like the arm; nothing does if None.

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
        planning: who plans goals; they are planned in the tick that they start in if None.
    """

    def __init__(  # noqa: PLR0915
        self, body: Body, n: int, control_hz: int, frame_ticks: int, planning: Planning | None = None
    ) -> None:
        super().__init__(n)
        self._cause = ""
        arm, limits = body.need(Arm), body.limits
        self.arm = arm
        self.width = self.joints = width = len(limits.names)
        self.goals = GoalManager(body, n, control_hz, planning)
        share = acceleration_share(body)  # setpoints are not planned: their torques have to suffice in any posture
        calm = replace(limits, acceleration=tuple(share * value for value in limits.acceleration))
        clearance = SetpointClearance(replace(arm, limits=calm), n, control_hz, frame_ticks)
        self.setpoints = SetpointFilter(calm, n, control_hz, frame_ticks, clearance)
        self.held: HeldObjects | None = HeldObjects(arm, n, control_hz)
        self.command = np.tile(np.asarray(arm.home), (n, 1))
        self.velocity: NDArray[np.float64] = np.zeros((n, width))
        self.acceleration: NDArray[np.float64] = np.zeros((n, width))
        self.actuators = self.command.copy()
        self.protective_stop = np.zeros(n, np.int64)
        self._any_stopped = False
        self.force: ForceLimit | None = None
        self.contact_wrench = np.zeros((n, 0))
        self.busy = self.goals.busy  # the same array
        self._half_tick = 0.5 / control_hz  # [s]
        # Ticks for which a joint has been too far from its reference.
        self._off_ticks: NDArray[np.int64] = np.zeros(n, np.int64)
        self._settled_ticks, self._most_yield_ticks = round(_SETTLED_S * control_hz), round(_YIELD_S * control_hz)
        self._stopped = np.zeros(n, np.bool_)  # hard, since it was last reset
        self._rest_ticks: NDArray[np.int64] = np.zeros(n, np.int64)  # for which its reference has followed nothing
        self._blind = np.zeros(n, np.bool_)  # it is not known where it is
        self._wrong = np.zeros((n, width - 1), np.bool_)  # joints whose encoders were found wrong since the stop
        self._driven = np.zeros(n, np.bool_)  # their motors are on: before, and after SAFE_OFF, that is not known
        self._relief = ContactRelief(arm, n, control_hz)
        self._yields, self._any_yields = np.zeros(n, np.bool_), False  # stops at once, against what is in its way
        self._yield_ticks: NDArray[np.int64] = np.zeros(n, np.int64)
        # Where a protective stop brings the servos' commands, and how fast. Both are fixed when it begins: a reading
        # that is wrong moves an arm no farther.
        self._aim, self._top = (np.zeros((n, width - 1)) for _ in range(2))
        self._forward = ForwardKinematics(arm.chain)
        self._lower, self._upper = np.asarray(limits.lower), np.asarray(limits.upper)
        self._speed = np.asarray(limits.velocity)
        self._bend = 0.9 * WireLimits.of(body, control_hz).bend[:-1]
        self._most_off_ticks = max(1, round(arm.blocked_s * control_hz))
        self._stamp_ns, self._silent_ticks, self._late_s = 0, 0, self._relief.late_s  # the same array
        self._first = np.full((n, width), np.nan)  # where the arms were when they were activated
        self._blocked = f"The arm stayed more than {arm.blocked_rad} rad from its reference: something is in its way."
        self._misread = (
            f"The arm was read more than {arm.blocked_rad} rad from its reference, and its motors do not press: an "
            "encoder is wrong."
        )
        self._lead = np.asarray(arm.lead_s)
        # [rad] so far a joint may be from its reference when it is found that it does not follow
        self._reach = (arm.blocked_rad + self._speed * (arm.blocked_s + self._lead + 1.0 / control_hz))[:-1]
        self._stiffness, self._damping = np.asarray(arm.servo_stiffness), np.asarray(arm.servo_damping)
        self._effort = np.asarray(limits.effort)
        self._lowest_effort = -self._effort
        self._largest_error = self._effort / self._stiffness
        self._largest_error[-1] = np.inf  # a gripping gripper is always commanded more than its effort
        self.limits = self.setpoints.limits  # the same array
        self._work, self._before = np.zeros((2, n, width))  # the latter: the servos' commands of the tick before
        state = self.command, self.velocity, self.actuators, self.limits
        self._lead_commands = lead_commands.bind(*state, self._lead, self._largest_error)

    def limit_force(self, force: ForceLimit) -> None:
        """Stop an arm that presses too hard, from now on."""
        self.force, self.contact_wrench = force, force.wrench

    def set_latency(self, ids: NDArray[np.intp], latency_s: ArrayLike) -> None:
        """Set by how much the servos of some arms are late, beyond the body's latency [s].

        An arm that is behind by so much is not blocked. Commands are not led by it.
        """
        self._late_s[ids] = latency_s
        self.goals.limit.set_latency(ids, latency_s)

    def _wait_for_readings(self, stamp_ns: int) -> None:
        """Count for how long nothing has been read: an arm that follows is behind what is read by so much more."""
        silent, self._silent_ticks = self._silent_ticks, 0 if stamp_ns != self._stamp_ns else self._silent_ticks + 1
        self._stamp_ns = stamp_ns
        if silent or self._silent_ticks:
            late = self._late_s + 2 * self._half_tick * self._silent_ticks
            self.goals.limit.set_latency(np.arange(len(late)), late)

    # --- motion ------------------------------------------------------------------------------------------------------

    def set_setpoint(self, values: NDArray[np.float64], mask: NDArray[np.bool_]) -> None:
        """Head for new setpoints; goals that are still followed end, because the newer command counts."""
        # Commands are checked when they are sent; a queue in shared memory is written by another process.
        if not np.isfinite(values).all() and (bad := mask & ~np.isfinite(values).all(axis=1)).any():
            self.limits[bad] |= int(Limit.NON_FINITE)
            self.stop(bad, Mode.FAULT)
            mask = mask & ~bad
        if np.count_nonzero(self.busy & mask):
            left = mask & self.goals.following & ~self.setpoints.active
            # A trajectory's command is where a smooth motion is at the end of a tick; a setpoint's goes a tick at one
            # speed. Going on from the speed at the end would change the command's own by half a tick's acceleration
            # on top of what is allowed.
            self.velocity -= np.where(left[:, None], self.acceleration * self._half_tick, 0.0)
            message = "A setpoint came, and the newer command counts."
            self.goals.end_all(mask, ResultCode.REPLACED_BY_SETPOINT, message)
        self.setpoints.set_setpoint(values, mask, self.command)

    def stop(self, mask: NDArray[np.bool_], cause: Mode) -> None:
        """Decelerate to rest; all goals of these arms end, with the cause as their result."""
        if cause not in _STOP_CODES:
            self._stopped &= ~mask
            self._relief.restart(mask)
            self._wrong &= ~mask[:, None]
            self._driven[mask] = cause == Mode.HOLD
            return  # HOLD, INACTIVE and SAFE_OFF are entered at rest
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        if hard:
            self._rest_ticks[mask & ~self._stopped] = 0
            self._stopped |= mask
            mask = mask & ~self._yields  # they stop already, and goals have ended
        self._leave_setpoints(mask)
        self.goals.stop(mask, _STOP_CODES[cause], hard, (self.command, self.velocity, self.acceleration))

    def go_back(self, mask: NDArray[np.bool_], actuators: NDArray[np.float64], rate: NDArray[np.float64]) -> None:
        """Make the reference again what the servos have, at the speed of their commands; play nothing any more."""
        where = mask[:, None]
        self.setpoints.drop(mask)
        self.goals.let_go(mask)
        self._yields &= ~mask
        speed = rate / (2 * self._half_tick)
        np.copyto(self.velocity, np.minimum(np.maximum(speed, -self._speed), self._speed), where=where)
        np.copyto(self.acceleration, 0.0, where=where)
        reference = actuators - self.velocity * self._lead
        np.copyto(self.command, np.minimum(np.maximum(reference, self._lower), self._upper), where=where)

    def distrust(self, mask: NDArray[np.bool_]) -> None:
        """Take some arms, as long as they are stopped, to be where their servos were commanded to hold them."""
        self._blind |= mask
        if self.force is not None:
            self.force.restart(np.flatnonzero(mask & ~self._wrong.all(axis=1)))

    def run(self, reading: PlantReading) -> None:
        """Advance by one tick."""
        for sim, held in self.held.update(reading, self.command) if self.held is not None else ():
            self.goals.hold(sim, held)
            if self.setpoints.clearance is not None:
                self.setpoints.clearance.hold(sim, held)
        if reading.stamp_ns is not None:
            self._wait_for_readings(int(reading.stamp_ns[0]))
        reference = self.command, self.velocity, self.acceleration
        if np.count_nonzero(self.setpoints.active):
            # A goal that came after them takes over; both in one tick would move the reference twice.
            if np.count_nonzero(self.busy):
                self._leave_setpoints(self.busy)
            self.setpoints.run(*reference)
        self.goals.tick(reference, (reading.position, reading.velocity))
        if np.count_nonzero(self._stopped):
            if self._any_yields:
                self._yield(reading)
            self._give_way(reading)
        if self._any_stopped:
            self.protective_stop[:] = self._any_stopped = False
        np.copyto(self._before, self.actuators)
        if self._lead_commands(reading.position, reading.velocity):
            self._watch(reading)
        elif np.count_nonzero(self._off_ticks):
            self._off_ticks[:] = 0
        if self.force is not None and self._feel(self.force, reading):
            # One that gives way does what it can.
            hard = self.force.exceeded & ~self._yields & (~self._stopped | self.goals.following)
            misread = hard & self._misread_joints(reading).any(axis=1)  # it is the force in another posture
            self._protect(misread, reading, Watchdog.BLOCKED, self._misread, follows=True)
            self._protect(hard & ~misread, reading, Watchdog.FORCE, self.force.explain())
            lost = self.force.lost & self._driven & ~self._stopped
            self._protect(lost, reading, Watchdog.PLANT, _LOST, follows=True)

    def _feel(self, force: ForceLimit, reading: PlantReading) -> bool:
        """Estimate with what the arms press; return whether any presses too hard, or is not known to press."""
        position = self._where(reading) if np.count_nonzero(self._wrong) else None
        return force.update(reading, self._rest_ticks > 0, position) or bool(np.count_nonzero(force.lost))

    def _where(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return where the joints are, shape (n, dof): the servo of a wrong encoder holds what it was commanded to."""
        dof = self.width - 1
        return np.where(self._wrong, self.command[:, :dof], reading.position[:, :dof])

    def _give_way(self, reading: PlantReading) -> None:
        """Let go of what stopped arms press on, once they have come to rest."""
        self._rest_ticks += self._stopped
        self._rest_ticks *= ~self._stopped | ~(self._yields | self.goals.following)
        settled = self._stopped & (self._rest_ticks > self._settled_ticks)
        position, force = reading.position[:, : self.width - 1], self.force
        if force is None:
            none = np.zeros(len(settled), np.bool_)
            sensed = Sensed(position, np.zeros_like(position), np.zeros(len(settled)), none, none)
        else:
            measured = self._measured(reading)
            wrong = self._misread_joints(reading) | self._blind[:, None]
            wrong &= (settled & measured)[:, None] & ~self._wrong
            if np.count_nonzero(wrong):
                self._wrong |= wrong
                force.restart(np.flatnonzero(wrong.any(axis=1)))  # what was felt was felt in another posture
            doubtful = np.asarray(self._wrong.any(axis=1))
            sensed = Sensed(self._where(reading), force.torque, force.pressing, measured, doubtful)
        known = settled & (sensed.measured | ~self._blind)
        self._blind[:] = False
        self._relief.run(self._stopped & (self._rest_ticks > 0), known, sensed, self.command, self.velocity)

    def _watch(self, reading: PlantReading) -> None:
        """Find arms that do not go where they are commanded to, and stop pressing on with them.

        A servo goes on with its full torque for as long as its command is out of reach. The command is brought back to
        where the arm is: what it pressed against is let go of.
        """
        dof = self.width - 1
        away = np.abs(self.command[:, :dof] - reading.position[:, :dof])
        limit = self.goals.limit.of(self.velocity[:, :dof])
        off = (away > limit).any(axis=1)
        self._off_ticks = (self._off_ticks + 1) * (off & ~self._stopped)
        blocked = self._off_ticks >= self._most_off_ticks
        if np.count_nonzero(blocked):
            # Without efforts nothing says whether it is the joint or the encoder that stays behind.
            measured = self._measured(reading)
            unsure = blocked & (((away > limit) & self._misread_joints(reading)).any(axis=1) | ~measured)
            deaf = blocked & (np.abs(reading.position - self._first) < _STANDS).all(axis=1)
            self._protect(deaf & unsure, reading, Watchdog.BLOCKED, _DEAF, follows=True)
            self._protect(deaf & ~unsure, reading, Watchdog.BLOCKED, _DEAF)
            self._protect(unsure & ~deaf & measured, reading, Watchdog.BLOCKED, self._misread, follows=True)
            self._protect(unsure & ~deaf & ~measured, reading, Watchdog.BLOCKED, self._blocked, follows=True)
            self._protect(blocked & ~deaf & ~unsure, reading, Watchdog.BLOCKED, self._blocked)

    def _misread_joints(self, reading: PlantReading) -> NDArray[np.bool_]:
        """Return the joints that are far from where they are commanded to, and not pulled there, shape (n, dof).

        A servo gives all it has then. If it does not, the encoder is wrong.
        """
        dof = self.width - 1
        wanted = self._stiffness * (self.actuators - reading.position) - self._damping * reading.velocity
        torque = reading.effort[:, :dof] if self.force is None else self.force.torque
        wrong = torque * np.sign(wanted[:, :dof]) < _GIVES * self._effort[:dof]
        wrong &= np.abs(wanted[:, :dof]) > _SURE * self._effort[:dof]
        return wrong & self._measured(reading)[:, None]

    def _measured(self, reading: PlantReading) -> NDArray[np.bool_]:
        """Return whether the efforts of each arm are measurements, shape (n,)."""
        if self.force is None or not reading.has_effort:
            return np.full(len(self.busy), reading.has_effort)
        return self.force.measured

    def _protect(
        self, mask: NDArray[np.bool_], reading: PlantReading, cause: Watchdog, message: str, *, follows: bool = False
    ) -> None:
        """Begin a protective stop: at once, or if it `follows` the reference as any other hard stop does."""
        if not mask.any():
            return
        self.protective_stop[mask] = int(cause)
        self._any_stopped, self._cause = True, message
        self._off_ticks[mask] = 0
        self._rest_ticks[mask & ~self._stopped] = 0
        self._stopped |= mask
        self._leave_setpoints(mask)
        if follows:
            reference = self.command, self.velocity, self.acceleration
            self.goals.stop(mask, ResultCode.PATH_TOLERANCE, True, reference, message)
            return
        self.goals.end_all(mask, ResultCode.PATH_TOLERANCE, message)
        dof = self.width - 1
        now, speed = self.actuators[mask, :dof], self.velocity[mask, :dof]
        off = np.minimum(np.maximum(reading.position[mask, :dof] - now, -self._reach), self._reach)
        self._aim[mask] = now + off
        # On a straight line, on which no joint is faster than it was, nor the tool.
        fast, way = (self._forward.tool_speed(self.command[mask, :dof], one) for one in (speed, off))
        joints = (np.maximum(np.abs(speed), _BACK) / np.maximum(np.abs(off), _TINY)).min(axis=1)
        rate = np.minimum(joints, np.maximum(fast, _BACK_TOOL) / np.maximum(way, _TINY))
        self._top[mask] = np.abs(off) * rate[:, None]
        self._yields |= mask
        self._yield_ticks[mask] = 0
        self._any_yields = True

    def _yield(self, reading: PlantReading) -> None:
        """Bring the servos' commands to where the joints were, until these are at rest.

        The reference would take its way to brake, against what the joints cannot go through. A servo that is so far
        from its command that it gives its largest torque gives no other on the way back, and one that is where it is
        commanded to brakes with all that it has.
        """
        dof, mask = self.width - 1, self._yields
        off = self._aim - self.actuators[:, :dof]
        step = largest_change(np.abs(off) / self._bend) * self._bend
        step = np.copysign(np.minimum(step, self._top * 2 * self._half_tick), off)
        # Towards where a joint is it may go at once. A joint that bounces back is on the other side of its command.
        rate, way = self.actuators[:, :dof] - self._before[:, :dof], reading.position[:, :dof] - self.actuators[:, :dof]
        gradual = np.minimum(np.maximum(step, rate - self._bend), rate + self._bend)
        step = np.where((step * way > 0.0) & (np.abs(step) <= np.abs(way)), step, gradual)
        np.copyto(self.command[:, :dof], self.actuators[:, :dof] + step, where=mask[:, None])
        np.copyto(self.velocity, 0.0, where=mask[:, None])
        np.copyto(self.acceleration, 0.0, where=mask[:, None])
        there = (np.abs(off) <= self._largest_error[:dof]) & (np.abs(reading.velocity[:, :dof]) < _SLOW)
        there &= np.abs(step) <= self._bend  # then it may stand still in the next tick
        self._yield_ticks += 1
        waits = (self._yield_ticks < self._most_yield_ticks) | (np.abs(off) > _ARRIVED_RAD).any(axis=1)
        self._yields &= ~there.all(axis=1) & waits
        self._any_yields = bool(self._yields.any())
        inside = np.minimum(np.maximum(self.command, self._lower), self._upper)
        np.copyto(self.command, inside, where=(mask & ~self._yields)[:, None])

    def _leave_setpoints(self, mask: NDArray[np.bool_]) -> None:
        """Follow no setpoints any more; what comes next starts without speeding up.

        Goals and brakes change their acceleration more gradually than setpoints: one that went on from the acceleration
        of a setpoint near the limit of speed would exceed it.
        """
        left = mask & self.setpoints.active
        if left.any():
            self.goals.leave_setpoints(left)
            self.setpoints.drop(left)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each arm is commanded to be at rest, shape (n,)."""
        still: NDArray[np.bool_] = np.all(np.abs(self.velocity) < _REST, axis=1)
        still &= ~self._stopped | (self._rest_ticks > self._settled_ticks)  # and it is known what it presses with
        return still & ~self.busy & ~self._yields & ~self._relief.active()

    def pressed(self) -> NDArray[np.float64]:
        """Return the forces on the tools [N] that are above 30 N, shape (n,), see `Controller.pressed`."""
        if self.force is None:
            return np.zeros(len(self.busy))
        return np.where(self.force.force > _PRESSED_N, self.force.force, 0.0)

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from the posture that the arms are in."""
        self.command[ids] = np.minimum(np.maximum(reading.position[ids], self._lower), self._upper)
        self.actuators[ids], self._first[ids] = self.command[ids], reading.position[ids]
        self.velocity[ids] = self.acceleration[ids] = 0.0

    def resume(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Continue from the posture that the arms are in; what they grip is not let go of."""
        opening = self.command[ids, -1]
        self.configure(ids, reading)
        self.command[ids, -1] = self.actuators[ids, -1] = opening

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about arms that were put somewhere else."""
        self.goals.restart(ids)
        self.setpoints.restart(ids)
        self.velocity[ids] = self.acceleration[ids] = 0.0
        self._off_ticks[ids] = 0
        self._yields[ids] = self._stopped[ids] = self._wrong[ids] = self._driven[ids] = False
        self._rest_ticks[ids] = 0
        self._relief.restart(ids)
        self.protective_stop[ids] = 0
        if self.force is not None:
            self.force.restart(ids)
        if self.held is not None:
            self.held.restart(ids)

    # --- reports -----------------------------------------------------------------------------------------------------

    @property
    def cause(self) -> str:
        """Why the last stop of its own was, as text."""
        return self._cause

    @property
    def following(self) -> NDArray[np.bool_]:
        """Whether each arm follows a goal, shape (n,)."""
        phase = self.goals.phase
        return np.asarray((phase == _CONVERTING) | (phase == _EXECUTING))

    def efforts(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return the torques that the servos give beyond gravity [N m], the gripper's force last [N]."""
        effort = np.subtract(self.actuators, reading.position)
        effort *= self._stiffness
        effort -= np.multiply(reading.velocity, self._damping, out=self._work)
        np.maximum(effort, self._lowest_effort, out=effort)
        return np.minimum(effort, self._effort, out=effort)

    # --- goals -------------------------------------------------------------------------------------------------------

    def submit(self, sim: int, command: BrainCommand, blocked: ResultCode | None = None) -> CommandResult | None:
        """Take a goal; None if it was accepted, otherwise the refusal."""
        return self.goals.submit(sim, command, blocked)

    def cancel(self, sim: int, task_id: str) -> ResultCode:
        """Cancel a goal: decelerate, then hold."""
        return self.goals.cancel(sim, task_id)

    def take_results(self, sim: int) -> list[CommandResult]:
        """Return the results of one arm that were not taken yet."""
        return self.goals.take_results(sim)

    def feedback(self, sim: int) -> Feedback | None:
        """Return how far the goal is that one arm follows, or None."""
        return self.goals.feedback(sim)


_STOP_CODES = {
    Mode.STOPPING: ResultCode.CANCELLED,
    Mode.ESTOP: ResultCode.ESTOP,
    Mode.FAULT: ResultCode.FAULT,
}
