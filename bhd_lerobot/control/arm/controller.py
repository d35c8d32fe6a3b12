"""The controller of arms with position servos: setpoints and goals to servo positions."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.arm.clearance import SetpointClearance
from bhd_lerobot.control.arm.force_limit import ForceLimit
from bhd_lerobot.control.arm.held import HeldObjects
from bhd_lerobot.control.arm.setpoints import SetpointFilter
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, GoalPhase, ResultCode
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.geometry.dynamics import acceleration_share
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
_STILL = 0.05  # [rad/s] the joints' speed below which a hard stop is over
_SETTLED_S = 0.04  # [s] what was stopped may swing back once
_GIVES_WAY_RAD = 2e-4  # [rad] nearer to its reference than this a joint presses with 8 N m at the most
_MOST_GIVING = 3
_GIVING_S = 3.0  # [s] after which an arm gives way no longer: five times what it took in `python -m benchmarks.contact`
_BACK_RAD = 0.02  # [rad] the way that an arm first goes back after a protective stop, of the joint that turned most
_MOST_BACK_RAD = 0.25  # [rad] and in all: 0.2 in `python -m benchmarks.contact`
_SPRINGS_RAD = 0.05  # [rad] by which what an arm leans on may push it on when it has given way
LIGHT_N = 20.0  # [N] an arm that presses less has given way
_TRAIL_S, _TRAIL_PERIOD_S = 1.0, 0.01
_REST = 1e-6  # [rad/s, m/s] a reference slower than this is at rest


@kernel("b1(f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], f8[::1], f8[::1], f8[:,::1], f8[:,::1])")
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


class ArmController(Controller):
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

    def __init__(self, arm: Arm, n: int, control_hz: int, frame_ticks: int, planning: Planning | None = None) -> None:
        limits = arm.limits
        self.arm = arm
        self.width = self.joints = width = len(limits.names)
        self.goals = GoalManager(arm, n, control_hz, planning)
        share = acceleration_share(arm)  # setpoints are not planned: their torques have to suffice in any posture
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
        self._unwatched: NDArray[np.bool_] = np.zeros(n, np.bool_)  # stopped hard, or on the way back already
        # For so many ticks has an arm that was stopped hard been still.
        self._still_ticks: NDArray[np.int64] = np.zeros(n, np.int64)
        self._settled_ticks = round(_SETTLED_S * control_hz)
        # How often an arm that was stopped hard may still give way to what it touches.
        self._gives_way: NDArray[np.int64] = np.zeros(n, np.int64)
        self._any_gives_way = False
        self._giving_ticks: NDArray[np.int64] = np.zeros(n, np.int64)
        self._most_giving_ticks = round(_GIVING_S * control_hz)
        self._stopped = np.zeros(n, np.bool_)  # hard, since it was last reset
        self._yields, self._any_yields = np.zeros(n, np.bool_), False  # stops at once, against what is in its way
        # Where a protective stop brings the joints, or where the reference was when another hard stop began; and how
        # far from `_centre` the reference may be brought after it. All are fixed when the stop begins, or has come to
        # rest: a reading that is wrong moves an arm no farther.
        self._aim, self._centre, self._room = (np.zeros((n, width - 1)) for _ in range(3))
        self._back_rad = np.zeros(n)  # so far it then goes back
        self._trail = _Trail(n, width - 1, control_hz)
        self._lower, self._upper = np.asarray(limits.lower), np.asarray(limits.upper)
        self._speed = np.asarray(limits.velocity)
        self._bend = 0.9 * WireLimits.of(arm, control_hz).bend[:-1]
        self._most_off_ticks = max(1, round(arm.blocked_s * control_hz))
        self._blocked = f"The arm stayed more than {arm.blocked_rad} rad from its reference: something is in its way."
        self._lead = np.asarray(arm.lead_s)
        # [rad] so far a joint may be from its reference when it is found that it does not follow
        self._reach = (arm.blocked_rad + self._speed * (arm.blocked_s + self._lead + 1.0 / control_hz))[:-1]
        self._stiffness, self._damping = np.asarray(arm.servo_stiffness), np.asarray(arm.servo_damping)
        self._effort = np.asarray(limits.effort)
        self._lowest_effort = -self._effort
        self._largest_error = self._effort / self._stiffness
        self._largest_error[-1] = np.inf  # a gripping gripper is always commanded more than its effort
        self.limits = self.setpoints.limits  # the same array
        self._work = np.zeros((n, width))
        state = self.command, self.velocity, self.actuators, self.limits
        self._lead_commands = lead_commands.bind(*state, self._lead, self._largest_error)

    def limit_force(self, force: ForceLimit) -> None:
        """Stop an arm that presses too hard, from now on."""
        self.force, self.contact_wrench = force, force.wrench

    def set_latency(self, ids: NDArray[np.intp], latency_s: ArrayLike) -> None:
        """Set by how much the servos of some arms are late, beyond the body's latency [s].

        An arm that is behind by so much is not blocked. Commands are not led by it.
        """
        self.goals.limit.set_latency(ids, latency_s)

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
        self._gives_way[mask] = 0
        self._unwatched &= ~mask
        self.setpoints.set_setpoint(values, mask, self.command)

    def stop(self, mask: NDArray[np.bool_], cause: Mode) -> None:
        """Decelerate to rest; all goals of these arms end, with the cause as their result."""
        if cause not in _STOP_CODES:
            self._stopped &= ~mask
            return  # HOLD, INACTIVE and SAFE_OFF are entered at rest
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        if hard:
            mask = mask & (self.protective_stop == 0)  # they are on their way back, and goals have ended
            self._begin_giving_way(mask & ~self._stopped)
            np.copyto(self._aim, self.command[:, :-1], where=mask[:, None] & ~self._yields[:, None])
        self._leave_setpoints(mask)
        self.goals.stop(mask, _STOP_CODES[cause], hard, (self.command, self.velocity, self.acceleration))

    def _begin_giving_way(self, mask: NDArray[np.bool_]) -> None:
        self._stopped |= mask
        self._unwatched |= mask
        self._gives_way[mask] = _MOST_GIVING
        self._giving_ticks[mask] = self._still_ticks[mask] = 0
        self._any_gives_way = True

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
        """Give way to nothing: where the arms are is not known."""
        self._gives_way[mask] = 0
        if self.force is not None:
            self.force.restart(np.flatnonzero(mask))

    def run(self, reading: PlantReading) -> None:  # noqa: PLR0912  what a tick does, in its order
        """Advance by one tick."""
        for sim, held in self.held.update(reading, self.command) if self.held is not None else ():
            self.goals.hold(sim, held)
            if self.setpoints.clearance is not None:
                self.setpoints.clearance.hold(sim, held)
        reference = self.command, self.velocity, self.acceleration
        if np.count_nonzero(self.setpoints.active):
            # A goal that came after them takes over; both in one tick would move the reference twice.
            if np.count_nonzero(self.busy):
                self._leave_setpoints(self.busy)
            self.setpoints.run(*reference)
        self.goals.tick(reference, (reading.position, reading.velocity))
        if np.count_nonzero(self._unwatched):
            self._unwatched &= ~self.following
        self._trail.note(reading, self._gives_way)
        if self._any_gives_way:
            self._giving_ticks += self._gives_way > 0
            if np.count_nonzero(self._giving_ticks > self._most_giving_ticks):
                self._gives_way[self._giving_ticks > self._most_giving_ticks] = 0
        if self._any_yields:
            self._yield(reading)
        if self._any_gives_way:
            self._give_way(reading)
        if self._any_stopped:
            self.protective_stop[:] = self._any_stopped = False
        if self._lead_commands(reading.position, reading.velocity):
            self._watch(reading)
        elif np.count_nonzero(self._off_ticks):
            self._off_ticks[:] = 0
        if self.force is not None and self.force.update(reading):
            self._protect(self.force.exceeded & ~self._unwatched, reading, Watchdog.FORCE, self.force.explain())

    def _give_way(self, reading: PlantReading) -> None:
        """After a hard stop, bring the reference to where the arm came to rest: what it presses on is let go of."""
        dof = self.width - 1
        still = (np.abs(reading.velocity[:, :dof]) < _STILL).all(axis=1)
        resting = (np.abs(self.velocity[:, :dof]) < _REST).all(axis=1)
        waiting = (self._gives_way > 0) & ~self._yields & still & resting & ~self.following
        self._still_ticks = (self._still_ticks + 1) * waiting
        ready = self._still_ticks >= self._settled_ticks
        if not ready.any():
            return
        self._still_ticks[ready] = 0
        where = self._retreat_from(reading)
        first = ready & (self._gives_way == _MOST_GIVING) & (self._back_rad == 0.0)
        if first.any():
            # It may have been away from its reference when the stop began, and have met something on the way to rest.
            np.copyto(self._centre, self.command[:, :dof], where=first[:, None])
            np.copyto(self._room, self._reach + np.abs(self.command[:, :dof] - self._aim), where=first[:, None])
        for sim in np.flatnonzero(ready & (self._back_rad > 0.0)).tolist():
            positions = reading.position[sim, :dof], self.command[sim, :dof]
            where[sim, :dof] = self._trail.back(sim, *positions, self._back_rad[sim], where[sim, :dof])
            # Whatever it slid along on the way here holds it until it is back at where that began.
            presses = self.force is not None and self.force.force[sim] > LIGHT_N
            self._back_rad[sim] = 2 * self._back_rad[sim] if presses else 0.0
        inside = np.minimum(np.maximum(where[:, :dof], self._centre - self._room), self._centre + self._room)
        np.copyto(where[:, :dof], inside, where=ready[:, None])
        np.copyto(self._centre, inside, where=first[:, None])
        np.copyto(self._room, _SPRINGS_RAD, where=first[:, None])
        off = ready & (np.abs(where - self.command) > _GIVES_WAY_RAD).any(axis=1)
        # What it leans on springs back, and pushes the arm on: it takes a few times. A load, which makes the arm sag a
        # little further each time, must not make it sink for ever.
        self._gives_way[off] -= 1
        self._gives_way[ready & ~off] = 0
        self._any_gives_way = bool(self._gives_way.any())
        if off.any():
            self.goals.retreat(off, (self.command, self.velocity, self.acceleration), where)

    def _watch(self, reading: PlantReading) -> None:
        """Find arms that do not go where they are commanded to, and stop pressing on with them.

        A servo goes on with its full torque for as long as its command is out of reach. The command is brought back to
        where the arm is: what it pressed against is let go of.
        """
        dof = self.width - 1
        away = np.abs(self.command[:, :dof] - reading.position[:, :dof])
        off = (away > self.goals.limit.of(self.velocity[:, :dof])).any(axis=1)
        self._off_ticks = (self._off_ticks + 1) * (off & ~self._unwatched)
        self._protect(self._off_ticks >= self._most_off_ticks, reading, Watchdog.BLOCKED, self._blocked)

    def _protect(self, mask: NDArray[np.bool_], reading: PlantReading, cause: Watchdog, message: str) -> None:
        """Begin a protective stop."""
        if not mask.any():
            return
        self.protective_stop[mask] = int(cause)
        self._any_stopped = True
        self._off_ticks[mask] = 0
        self._leave_setpoints(mask)
        self.goals.end_all(mask, ResultCode.PATH_TOLERANCE, message)
        self._begin_giving_way(mask)
        off = reading.position[:, :-1] - self.actuators[:, :-1]
        aim = self.actuators[:, :-1] + np.minimum(np.maximum(off, -self._reach), self._reach)
        for array, value in ((self._aim, aim), (self._centre, aim), (self._room, _MOST_BACK_RAD)):
            np.copyto(array, value, where=mask[:, None])
        self._yields |= mask
        self._back_rad[mask] = _BACK_RAD
        self._any_yields = True

    def _yield(self, reading: PlantReading) -> None:
        """Bring the servos' commands to where the joints were, as fast as joints may turn, until these are at rest.

        The reference would take its way to brake, against what the joints cannot go through. A servo that is so far
        from its command that it gives its largest torque gives no other on the way back, and one that is where it is
        commanded to brakes with all that it has.
        """
        dof, mask = self.width - 1, self._yields
        off = self._aim - self.actuators[:, :dof]
        step = largest_change(np.abs(off) / self._bend) * self._bend
        step = np.copysign(np.minimum(step, self._speed[:dof] * 2 * self._half_tick), off)
        np.copyto(self.command[:, :dof], self.actuators[:, :dof] + step, where=mask[:, None])
        np.copyto(self.velocity, 0.0, where=mask[:, None])
        np.copyto(self.acceleration, 0.0, where=mask[:, None])
        there = (np.abs(off) <= self._largest_error[:dof]) & (np.abs(reading.velocity[:, :dof]) < _SLOW)
        there &= np.abs(step) <= self._bend  # then it may stand still in the next tick
        # One that never comes to rest, by what it reads, is not waited for.
        self._yields &= ~there.all(axis=1) & ((self._gives_way > 0) | (np.abs(off) > _GIVES_WAY_RAD).any(axis=1))
        self._any_yields = bool(self._yields.any())
        inside = np.minimum(np.maximum(self.command, self._lower), self._upper)
        np.copyto(self.command, inside, where=(mask & ~self._yields)[:, None])

    def _retreat_from(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return where references are to be, so that arms press on nothing, shape (n, width).

        What an arm pressed on springs back: with a reference where the joints are it goes on pressing with about half.
        So each joint is to be as far on the other side of where it is as its servo pulled on this one; in the end it is
        to be where it is.
        """
        pull = np.minimum(np.maximum(self.command - reading.position, -self._largest_error), self._largest_error)
        pull[self._gives_way <= 1] = 0.0
        where = np.minimum(np.maximum(reading.position - pull, self._lower), self._upper)
        where[:, -1] = self.command[:, -1]  # what is gripped is not let go of
        return where

    def _leave_setpoints(self, mask: NDArray[np.bool_]) -> None:
        """Follow no setpoints any more; what comes next starts without speeding up.

        Goals and brakes change their acceleration gradually, setpoints do not: one that went on from the acceleration
        of a setpoint near the limit of speed would exceed it.
        """
        left = mask & self.setpoints.active
        if left.any():
            np.copyto(self.acceleration, 0.0, where=left[:, None] & (self.acceleration * self.velocity > 0))
            self.setpoints.drop(left)

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each arm is commanded to be at rest, shape (n,)."""
        still: NDArray[np.bool_] = np.all(np.abs(self.velocity) < _REST, axis=1)
        return still & ~self.busy & ~self._yields & (self._gives_way == 0)

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from the posture that the arms are in."""
        self.command[ids] = np.minimum(np.maximum(reading.position[ids], self._lower), self._upper)
        self.actuators[ids] = self.command[ids]
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
        self._unwatched[ids], self._gives_way[ids] = False, 0
        self._yields[ids], self._stopped[ids], self._back_rad[ids] = False, False, 0.0
        self._trail.restart(ids)
        self.protective_stop[ids] = 0
        if self.force is not None:
            self.force.restart(ids)
        if self.held is not None:
            self.held.restart(ids)

    # --- reports -----------------------------------------------------------------------------------------------------

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
        refusal = self.goals.submit(sim, command, blocked)
        if refusal is None:
            self._gives_way[sim] = 0
        return refusal

    def cancel(self, sim: int, task_id: str) -> ResultCode:
        """Cancel a goal: decelerate, then hold."""
        return self.goals.cancel(sim, task_id)

    def take_results(self, sim: int) -> list[CommandResult]:
        """Return the results of one arm that were not taken yet."""
        return self.goals.take_results(sim)

    def feedback(self, sim: int) -> Feedback | None:
        """Return how far the goal is that one arm follows, or None."""
        return self.goals.feedback(sim)


class _Trail:
    """Where the joints of n arms were in the last second, as long as nothing was in their way."""

    def __init__(self, n: int, dof: int, control_hz: int) -> None:
        self._period = max(1, round(_TRAIL_PERIOD_S * control_hz))
        self._rows = np.full((round(_TRAIL_S / _TRAIL_PERIOD_S), n, dof), np.nan)
        self._ticks = 0
        self._count, self._gone_back = np.zeros(n, np.int64), np.zeros(n, np.int64)  # rows

    def note(self, reading: PlantReading, gives_way: NDArray[np.int64]) -> None:
        """Take one tick into account; arms that give way leave no trail."""
        self._ticks += 1
        if self._ticks % self._period:
            return
        ids = np.flatnonzero(gives_way == 0)
        self._rows[self._count[ids] % len(self._rows), ids] = reading.position[ids, : self._rows.shape[2]]
        self._count[ids] += 1
        self._gone_back[ids] = 0

    def back(
        self,
        sim: int,
        position: NDArray[np.float64],
        command: NDArray[np.float64],
        least: float,
        otherwise: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return where an arm was last when a joint was `least` [rad] from where it is now, or `otherwise`.

        What it hit may have thrown it back: it was then also away from its reference. One that has gone back already
        continues from there.
        """
        ages = np.arange(self._gone_back[sim], len(self._rows))
        rows = self._rows[(self._count[sim] - 1 - ages) % len(self._rows), sim]
        away = np.abs(rows - position).max(axis=1) >= least  # never so where there is no row yet
        away &= np.abs(rows - command).max(axis=1) >= _BACK_RAD
        if not away.any():
            return otherwise
        self._gone_back[sim] += int(away.argmax())
        return rows[int(away.argmax())]

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget arms that were put somewhere else."""
        self._rows[:, ids], self._gone_back[ids] = np.nan, 0


_STOP_CODES = {
    Mode.STOPPING: ResultCode.CANCELLED,
    Mode.ESTOP: ResultCode.ESTOP,
    Mode.FAULT: ResultCode.FAULT,
}
