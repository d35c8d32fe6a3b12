"""The controller of arms with position servos: what a tick leaves to it, see `move_arm`."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.arm.clearance import LOOKS, fill_geometry, new_geometries
from bhd_lerobot.control.arm.force_limit import explain_force, forget_force, put_force_limit
from bhd_lerobot.control.arm.held import held_capsule
from bhd_lerobot.control.arm.relief import ContactRelief, Sensed
from bhd_lerobot.control.arm.setpoints import leave_setpoints, put_setpoint_limits, take_setpoint
from bhd_lerobot.control.arm.step import SURE, Stage, is_arm_at_rest, move_arm
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Feedback, ResultCode
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.geometry.dynamics import acceleration_share
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.guard import WireLimits
from bhd_lerobot.control.kernels import as_objects, largest_change
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.control.motion.goals import GoalManager
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.motion.supervision import most_away, put_goal_limits
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import ARM_LIMITS, new_arms, put

Array = NDArray[np.float64]

_SLOW = 0.2  # [rad/s] the joints' speed below which they are held where they are
_BACK, _BACK_TOOL = 0.5, 0.25  # [rad/s, m/s] of joints and tool that a stop brings back, unless they were faster
_SETTLED_S = 0.04  # [s] what was stopped may swing back once
_YIELD_S = 0.2  # [s] for which joints that do not come to rest are waited for where they were: something pushes them
_GIVES = 0.5  # the least share of its largest torque that the servo of a blocked joint gives
_ARRIVED_RAD = 2e-4  # [rad]
_TINY = 1e-9
_STANDS = 0.01  # [rad, m] a joint that moved by less has not moved
_LOOK_S = 0.02  # between two checks of clearance at the most, however long a frame is: an arm turns aside meanwhile
_LOST = (
    "The efforts that the plant reads are 0 while the motors carry the arm: they are not measured, and without them "
    "there is no limit of force. Repair them, or let the plant leave PlantReading.has_effort false."
)
_DEAF = "The arm has not moved since it was activated: it takes no commands, its brakes are on, or something holds it."
_STOP_CODES = {
    Mode.STOPPING: ResultCode.CANCELLED,
    Mode.ESTOP: ResultCode.ESTOP,
    Mode.FAULT: ResultCode.FAULT,
}
_ENTERED = (Mode.STOPPING, Mode.INACTIVE, Mode.HOLD, Mode.SAFE_OFF, Mode.ESTOP, Mode.FAULT)


class ArmController(Controller):
    """Joint positions and the gripper's opening, from setpoints or from goals.

    A command is the position of each joint [rad] and the gripper's opening [m]. What goes to the servos is the
    reference plus the lead that makes up for the servos' damping, so that they follow a moving reference without a lag.

    Attributes:
        goals: the goals.

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
        planning: who plans goals; they are planned in the tick that they start in if None.
        holds: find out what the grippers hold, which is then kept away from things like the arm.
        keeps_clear: slow setpoints down that would bring the arm too near to itself or the table.
        max_force: force with which a tool may press, if the plant measures efforts [N]; any if None.
        wrench: estimate what the surroundings put on the tools; with `max_force`.
    """

    def __init__(
        self,
        body: Body,
        n: int,
        control_hz: int,
        frame_ticks: int,
        planning: Planning | None = None,
        *,
        holds: bool = True,
        keeps_clear: bool = True,
        max_force: float | None = None,
        wrench: bool = False,
    ) -> None:
        super().__init__(n)
        self._cause, self._body = "", body
        arm = body.need(Arm)
        limits = arm.limits
        self.arm, self.width = arm, len(limits.names)
        self.joints, self._dof = self.width, len(arm.chain.joints)
        width, dof = self.width, self._dof
        self.numbers["arm_values"] = width
        self.arms, self.arm_limits = new_arms(n), np.zeros(1, ARM_LIMITS)
        self.geometries = new_geometries(arm.chain, n)
        self._limits = self.arm_limits[0]
        share = acceleration_share(body)  # setpoints are not planned: their torques have to suffice in any posture
        calm = replace(limits, acceleration=tuple(share * value for value in limits.acceleration))
        put_setpoint_limits(self._limits, calm, control_hz, frame_ticks)
        put_goal_limits(self._limits, arm, control_hz)
        self._put_limits(calm, control_hz, frame_ticks)
        self._limits["holds"], self._limits["keeps_clear"] = holds and arm.gripper is not None, keeps_clear
        if max_force is not None:
            put_force_limit(self._limits, body, control_hz, max_force, wrench=wrench)
        states, arms = self.states, self.arms
        self.command: Array = states["command"][:, :width]
        self.command[:] = arm.home
        self.actuators: Array = states["actuators"][:, :width]
        self.actuators[:] = self.command
        self.velocity: Array = arms["speed"][:, :width]
        self.acceleration: Array = arms["change"][:, :width]
        self.busy, self.protective_stop, self.limits = (states[k] for k in ("busy", "protective_stop", "limits"))
        self.force: NDArray[np.float64] = arms["force"]
        self.goals = GoalManager(body, states, arms, control_hz, planning)
        self._hz, self._forward = control_hz, ForwardKinematics(arm.chain)
        self._most_yield_ticks = round(_YIELD_S * control_hz)
        self._reliefs = [self._new_relief(sim) for sim in range(n)]
        self._limits["relief_period"] = self._reliefs[0].period
        self._yield_ticks: NDArray[np.int64] = np.zeros(n, np.int64)
        self._blind: NDArray[np.bool_] = arms["is_blind"]
        # Where a protective stop brings the servos' commands, and how fast. Both are fixed when it begins: a reading
        # that is wrong moves an arm no farther.
        self._aim, self._top = np.zeros((2, n, dof))
        self._first = np.full((n, width), np.nan)  # where the arms were when they were activated
        self._most_bend = WireLimits.of(body, control_hz).bend[:width]
        self._bend = 0.9 * self._most_bend
        self._blocked = f"The arm stayed more than {arm.blocked_rad} rad from its reference: something is in its way."
        self._misread = (
            f"The arm was read more than {arm.blocked_rad} rad from its reference, and its motors do not press: an "
            "encoder is wrong."
        )
        self._lead, self._stiffness = np.asarray(arm.lead_s), np.asarray(arm.servo_stiffness)
        # [rad] so far a joint may be from its reference when it is found that it does not follow
        speed = np.asarray(limits.velocity)
        self._reach = (arm.blocked_rad + speed * (arm.blocked_s + self._lead + 1.0 / control_hz))[:dof]
        self._damping, self._effort = np.asarray(arm.servo_damping), np.asarray(limits.effort)
        self._lower, self._upper, self._speed = np.asarray(limits.lower), np.asarray(limits.upper), speed
        # As the functions of a tick take them.
        self._state_of, self._arm_of = as_objects(states), as_objects(arms)
        self._geometry_of, [self._limits_of] = as_objects(self.geometries), as_objects(self.arm_limits)
        self.set_latency(np.arange(n), 0.0)

    def _put_limits(self, limits: Any, control_hz: int, frame_ticks: int) -> None:
        """Write what clearance, servos and stops go by."""
        row, arm, dof = self._limits, self.arm, self._dof
        row["look_ticks"] = max(1, min(frame_ticks // LOOKS, round(_LOOK_S * control_hz)))
        row["look_s"], row["least"] = row["look_ticks"] / control_hz, arm.chain.min_distance
        acceleration = np.asarray(limits.acceleration[:dof])
        # A brake that changes its acceleration gradually begins so much later; what speeds an arm up ends first.
        row["ramp_s"][:dof] = acceleration / (2 * np.asarray(limits.jerk[:dof]))
        row["ramp_s"][:dof] += 2 * acceleration / np.asarray(limits.setpoint_jerk[:dof])
        put(row, "lead", arm.lead_s)
        for name, values in (
            ("stiffness", arm.servo_stiffness),
            ("damping", arm.servo_damping),
            ("effort", limits.effort),
        ):
            put(row, name, values)
        put(row, "largest_error", np.asarray(limits.effort) / arm.servo_stiffness)
        row["largest_error"][dof] = np.inf  # a gripping gripper is always commanded more than its effort
        row["blocked_ticks"] = max(1, round(arm.blocked_s * control_hz))
        row["settled_ticks"] = round(_SETTLED_S * control_hz)

    def _new_relief(self, sim: int) -> ContactRelief:
        return ContactRelief(self.arm, 1, self._hz, self.arms["relief_ticks"][sim : sim + 1])

    @property
    def rows(self) -> Array:
        """What is played."""
        return self.goals.player.rows

    def set_latency(self, ids: NDArray[np.intp], latency_s: ArrayLike) -> None:
        """Set by how much the servos of some arms are late, beyond the body's latency [s].

        An arm that is behind by so much is not blocked. Commands are not led by it.
        """
        self.arms["late_s"][ids] = latency_s
        self.arms["latency_s"][ids] = self.arms["late_s"][ids] + self.arm.latency_s

    # --- what a tick leaves to its controller ------------------------------------------------------------------------

    def advance(self) -> None:
        """Advance the references by a tick, outside of a cerebellum."""
        for sim in range(len(self.states)):
            state, arm = self._state_of[sim], self._arm_of[sim]
            arm.stage, state.protective_stop = Stage.NONE, 0
            while not move_arm(state, arm, self._limits_of, self._geometry_of[arm.geometry], self.rows, False):
                self.serve(sim)
            arm.stage = Stage.NONE

    def serve(self, sim: int) -> None:
        """Do what the tick of an arm waits for."""
        stage = self.arms["stage"][sim]
        if stage in (Stage.BEGUN, Stage.ENDED):
            self.tell(sim)
        elif stage == Stage.HELD:
            self._hold(sim)
        elif stage == Stage.GOALS:
            self.goals.serve(sim)
        elif stage == Stage.STOPPED:
            if self.arms["yields"][sim]:
                self._yield(sim)
            self._give_way(sim)
        else:
            self._look(sim)

    def tell(self, sim: int) -> None:
        """Take the modes that a robot has entered, and its setpoint."""
        state = self.states[sim]
        if state["goes_back"]:
            self._go_back(sim)
            state["goes_back"] = False
        if entered := int(state["entered"]):
            for mode in _ENTERED:
                if entered & (1 << mode):
                    self._stop(sim, mode)
            state["entered"] = 0  # now: a stop that is interrupted is begun again by the next tick
        if state["is_distrusted"]:
            state["is_distrusted"] = False
            self._blind[sim] = True
            if self._limits["feels"] and not self.arms["wrong"][sim, : self._dof].all():
                forget_force(state, self.arms[sim])
        if state["has_setpoint"]:
            state["has_setpoint"] = False
            self._set_setpoint(sim)

    def _set_setpoint(self, sim: int) -> None:
        """Head for a new setpoint; goals that are still followed end, because the newer command counts."""
        if self.busy[sim]:
            if self.goals.following[sim] and not self.arms["follows_setpoints"][sim]:
                self.velocity[sim] = self._speed_after_trajectory(sim)
            message = "A setpoint came, and the newer command counts."
            self.goals.end_all(sim, ResultCode.REPLACED_BY_SETPOINT, message)
        take_setpoint(self._state_of[sim], self._arm_of[sim], self._limits_of)

    def _speed_after_trajectory(self, sim: int) -> Array:
        """Return the speeds that setpoints go on from after a trajectory, shape (width,).

        A trajectory's command is where a smooth motion is at the end of a tick; a setpoint's goes a tick at one speed.
        Going on from the speed at the end would change the command's own by half a tick's acceleration on top of what
        is allowed. The lead turns with it: however the next tick accelerates, what is written bends no more than the
        guard permits.
        """
        state, width = self.states[sim], self.width
        change = self._limits["hardest"][:width] / self._hz
        most, gain = 0.99 * self._most_bend, 1.0 / self._hz + self._lead  # of what is written, by the speed
        even = (state["written"][:width] + state["written_rate"][:width] - self.command[sim]) / gain
        speed = self.velocity[sim] - self.acceleration[sim] * (0.5 / self._hz)
        return np.clip(speed, even - most / gain + change, even + most / gain - change)

    def _stop(self, sim: int, cause: Mode) -> None:
        """Decelerate to rest; all goals end, with the cause as their result."""
        arm = self.arms[sim]
        if cause not in _STOP_CODES:  # HOLD, INACTIVE and SAFE_OFF are entered at rest
            arm["is_stopped"] = arm["gives_way"] = arm["wrong"] = False
            arm["is_driven"] = cause == Mode.HOLD
            self._reliefs[sim].restart(np.ones(1, np.bool_))
            return
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        if hard:
            if not arm["is_stopped"]:
                arm["rest_ticks"] = 0
            arm["is_stopped"] = True
            if arm["yields"]:
                return  # it stops already, and goals have ended
        leave_setpoints(self._arm_of[sim])
        self.goals.stop(sim, _STOP_CODES[cause], hard=hard)

    def _go_back(self, sim: int) -> None:
        """Make the reference again what the servos have, at the speed of their commands; play nothing any more."""
        arm, state = self._arm_of[sim], self.states[sim]
        arm.follows_setpoints, arm.share = False, 1.0
        self.goals.let_go(sim)
        arm.yields = False
        speed = np.clip(state["written_rate"][: self.width] * self._hz, -self._speed, self._speed)
        self.velocity[sim], self.acceleration[sim] = speed, 0.0
        reference = state["written"][: self.width] - speed * self._lead
        self.command[sim] = reference  # what is written may be a little out of range: to leave that at once is a jump

    def _hold(self, sim: int) -> None:
        """Note what a gripper holds now."""
        highest = self.arm.workspace.handling.highest
        held = held_capsule(self.arm.chain, self._forward, self.states[sim], self.arms[sim], highest)
        self.goals.hold(sim, held)
        arm = self.arms[sim]
        arm["geometry"] = 0 if held is None else 1 + sim
        arm["distances"] = -1.0  # they are of other pairs
        if held is not None:
            self.geometries[1 + sim] = 0
            fill_geometry(self.geometries[1 + sim], self.arm.chain.holding(held))

    def _where(self, sim: int) -> Array:
        """Return where the joints are, shape (dof,): the servo of a wrong encoder holds what it was commanded to."""
        dof = self._dof
        return np.where(self.arms["wrong"][sim, :dof], self.command[sim, :dof], self.states["position"][sim, :dof])

    def _give_way(self, sim: int) -> None:
        """Let go of what a stopped arm presses on, once it has come to rest."""
        arm, dof = self.arms[sim], self._dof
        arm["rest_ticks"] = 0 if arm["yields"] or self.goals.following[sim] else arm["rest_ticks"] + 1
        settled = bool(arm["rest_ticks"] > self._limits["settled_ticks"])
        if self._limits["feels"]:
            measured = self._is_measured(sim)
            wrong = (self._misread_joints(sim) | self._blind[sim]) & (settled & measured) & (arm["wrong"][:dof] == 0)
            if wrong.any():
                arm["wrong"][:dof] |= wrong
                forget_force(self.states[sim], arm)  # what was felt was felt in another posture
            torque, pressing, doubtful = arm["torque"][:dof], float(arm["pressing"]), bool(arm["wrong"].any())
            sensed = Sensed(
                self._where(sim)[None], torque[None], *(np.array([v]) for v in (pressing, measured, doubtful))
            )
        else:
            position, none = self.states["position"][sim : sim + 1, :dof], np.zeros(1, np.bool_)
            sensed = Sensed(position, np.zeros_like(position), np.zeros(1), none, none)
        known = np.array([settled & bool(sensed.measured[0] | ~self._blind[sim])])
        self._blind[sim] = False
        one, relief = slice(sim, sim + 1), self._reliefs[sim]
        relief.late_s[:] = arm["late_s"]
        relief.run(np.array([bool(arm["rest_ticks"] > 0)]), known, sensed, self.command[one], self.velocity[one])
        arm["gives_way"] = relief.active()[0]

    def _look(self, sim: int) -> None:
        """Stop an arm that does not go where it is commanded to, or that presses too hard, or is not known to press."""
        arm, dof = self.arms[sim], self._dof
        if arm["is_blocked"]:
            state, one = self._state_of[sim], self._arm_of[sim]
            away = np.abs(self.command[sim, :dof] - self.states["position"][sim, :dof])
            limit = np.array([most_away(one, self._limits_of, k) for k in range(dof)])
            # Without efforts nothing says whether it is the joint or the encoder that stays behind.
            measured = self._is_measured(sim)
            is_misread = bool(((away > limit) & self._misread_joints(sim)).any())
            moved = np.abs(np.asarray(state.position[: self.width]) - self._first[sim])
            message = self._misread if is_misread and measured else self._blocked
            message = _DEAF if (moved < _STANDS).all() else message
            self._protect(sim, Watchdog.BLOCKED, message, follows=is_misread or not measured)
        # One that gives way does what it can.
        is_new = arm["ticks"] == 0 and self.states["has_effort"][sim]
        is_free = not arm["yields"] and (not arm["is_stopped"] or self.goals.following[sim])
        if arm["presses"] and is_new and is_free:
            if self._misread_joints(sim).any():  # it is the force in another posture
                self._protect(sim, Watchdog.BLOCKED, self._misread, follows=True)
            else:
                self._protect(sim, Watchdog.FORCE, explain_force(self._body, arm, self._limits), follows=False)
        if arm["is_lost"] and arm["is_driven"] and not arm["is_stopped"]:
            self._protect(sim, Watchdog.PLANT, _LOST, follows=True)

    def _misread_joints(self, sim: int) -> NDArray[np.bool_]:
        """Return the joints that are far from where they are commanded to, and not pulled there, shape (dof,).

        A servo gives all it has then. If it does not, the encoder is wrong.
        """
        dof, state = self._dof, self.states[sim]
        off = self.actuators[sim] - state["position"][: self.width]
        wanted = (self._stiffness * off - self._damping * state["velocity"][: self.width])[:dof]
        torque = self.arms["torque"][sim, :dof] if self._limits["feels"] else state["effort"][:dof]
        wrong = torque * np.sign(wanted) < _GIVES * self._effort[:dof]
        wrong &= np.abs(wanted) > SURE * self._effort[:dof]
        return np.asarray(wrong & self._is_measured(sim))

    def _is_measured(self, sim: int) -> bool:
        """Return whether the efforts of an arm are measurements."""
        has_effort = bool(self.states["has_effort"][sim])
        return has_effort and (not self._limits["feels"] or bool(self.arms["is_measured"][sim]))

    def _protect(self, sim: int, cause: Watchdog, message: str, *, follows: bool) -> None:
        """Begin a protective stop: at once, or if it `follows` the reference as any other hard stop does."""
        arm, dof = self.arms[sim], self._dof
        self.protective_stop[sim], self._cause = int(cause), message
        arm["off_ticks"] = 0
        if not arm["is_stopped"]:
            arm["rest_ticks"] = 0
        arm["is_stopped"] = True
        leave_setpoints(self._arm_of[sim])
        if follows:
            self.goals.stop(sim, ResultCode.PATH_TOLERANCE, hard=True, message=message)
            return
        self.goals.end_all(sim, ResultCode.PATH_TOLERANCE, message)
        now, speed = self.actuators[sim, :dof], self.velocity[sim, :dof]
        off = np.clip(self.states["position"][sim, :dof] - now, -self._reach, self._reach)
        self._aim[sim] = now + off
        # On a straight line, on which no joint is faster than it was, nor the tool.
        posture = self.command[sim : sim + 1, :dof]
        fast, way = (float(self._forward.tool_speed(posture, one[None])[0]) for one in (speed, off))
        joints = float((np.maximum(np.abs(speed), _BACK) / np.maximum(np.abs(off), _TINY)).min())
        self._top[sim] = np.abs(off) * min(joints, max(fast, _BACK_TOOL) / max(way, _TINY))
        arm["yields"], self._yield_ticks[sim] = True, 0

    def _yield(self, sim: int) -> None:
        """Bring the servos' commands to where the joints were, until these are at rest.

        The reference would take its way to brake, against what the joints cannot go through. A servo that is so far
        from its command that it gives its largest torque gives no other on the way back, and one that is where it is
        commanded to brakes with all that it has.
        """
        dof, arm = self._dof, self.arms[sim]
        now, position, bend = self.actuators[sim, :dof], self.states["position"][sim, :dof], self._bend[:dof]
        off = self._aim[sim] - now
        step = largest_change(np.abs(off) / bend) * bend
        step = np.copysign(np.minimum(step, self._top[sim] / self._hz), off)
        # Towards where a joint is it may go at once. A joint that bounces back is on the other side of its command.
        rate, way = now - arm["before"][:dof], position - now
        gradual = np.minimum(np.maximum(step, rate - bend), rate + bend)
        step = np.where((step * way > 0.0) & (np.abs(step) <= np.abs(way)), step, gradual)
        self.command[sim, :dof] = now + step
        # The gripper is in nobody's way: it comes to rest.
        last = self.actuators[sim, dof:] - arm["before"][dof : self.width]
        last -= np.clip(last, -self._bend[dof:], self._bend[dof:])
        self.command[sim, dof:] = self.actuators[sim, dof:] + last
        self.velocity[sim] = self.acceleration[sim] = 0.0
        largest = self._effort[:dof] / self._stiffness[:dof]
        there = (np.abs(off) <= largest) & (np.abs(self.states["velocity"][sim, :dof]) < _SLOW)
        there &= np.abs(step) <= bend  # then it may stand still in the next tick
        self._yield_ticks[sim] += 1
        waits = self._yield_ticks[sim] < self._most_yield_ticks or (np.abs(off) > _ARRIVED_RAD).any()
        arm["yields"] = bool((np.abs(last) > self._bend[dof:]).any()) or (not there.all() and bool(waits))
        if not arm["yields"]:
            self.command[sim] = np.clip(self.command[sim], self._lower, self._upper)

    # --- between ticks -----------------------------------------------------------------------------------------------

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each arm is commanded to be at rest, shape (n,)."""
        pairs = zip(self._state_of, self._arm_of, strict=True)
        return np.array([is_arm_at_rest(state, arm, self._limits_of) for state, arm in pairs])

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start from the posture that the arms are in."""
        self.command[ids] = np.minimum(np.maximum(reading.position[ids], self._lower), self._upper)
        self.actuators[ids], self._first[ids] = self.command[ids], reading.position[ids]
        self.velocity[ids] = self.acceleration[ids] = 0.0

    def resume(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Continue from the posture that the arms are in; what they grip is not let go of."""
        opening = self.command[ids, self._dof :].copy()
        self.configure(ids, reading)
        self.command[ids, self._dof :] = self.actuators[ids, self._dof :] = opening

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about arms that were put somewhere else."""
        late_s = self.arms["late_s"][ids]
        self.goals.restart(ids)
        self.arms[ids] = new_arms(1)
        self.actuators[ids] = self.command[ids]  # at rest, without a lead
        self.set_latency(ids, late_s)
        for sim in np.asarray(ids).tolist():
            self._reliefs[sim] = self._new_relief(sim)

    # --- reports -----------------------------------------------------------------------------------------------------

    @property
    def cause(self) -> str:
        """Why the last stop of its own was, as text."""
        return self._cause

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
