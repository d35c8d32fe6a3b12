"""From a goal and the commanded state to a trajectory, or the reason why there is none. Pure: the same each time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import HELD, OBSTACLE, Arm, Body, Capsule
from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.dynamics import SWING, ArmDynamics, acceleration_share
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.motion.command_check import MAX_TOOL_ACCELERATION, MAX_TOOL_SPEED, check
from bhd_lerobot.control.motion.line import ToolLimits, along_line
from bhd_lerobot.control.motion.trajectory import (
    MotionLimits,
    PlanFailure,
    State,
    Trajectory,
    at_once,
    load_ruckig,
    to_rest,
    to_target,
)

Array = NDArray[np.float64]

_CHECK_STEP = 0.03  # [rad] no joint turns further between two postures that are checked for collisions
_ATTEMPTS = 8  # postures that reach a pose, of which so many are tried
_TORQUE_STEP_S = 0.01  # between two states of a trajectory whose torques are looked at
_SLOWER = 8  # times that a motion is planned with smaller accelerations, until its torques fit
_LEAST_SHARE = 0.05  # of the accelerations, with which a motion is still one
_MOST_HELD = 64  # things whose distances are remembered
_ROUNDING = 1e-9  # [m] a distance that shrinks by less does not shrink


@dataclass(frozen=True)
class Plan:
    """How a goal is going to be reached.

    Attributes:
        trajectory: of all command dimensions, the gripper's last.
        target: where it ends [rad], and the opening that the gripper is commanded to [m], shape (dof + 1,).
        rows: the trajectory's position, velocity and acceleration at each tick in one block, shape (T, 3, dof + 1), if
            it lies in memory that may be played from without copying it; None if it does not.
    """

    trajectory: Trajectory
    target: Array
    rows: Array | None = None


class GoalPlanner:
    """Plans goals of one arm.

    Args:
        body: limits and geometry of its arm.
        control_hz: ticks a second [Hz].

    Raises:
        VersionError: Ruckig is not installed.
    """

    def __init__(self, body: Body, control_hz: int) -> None:
        arm = body.need(Arm)
        load_ruckig()  # not in the tick that plans the first goal
        self.arm, self.hz = arm, control_hz
        self.kinematics = ArmKinematics(arm.chain, arm.limits)
        self.dof = dof = len(arm.chain.joints)
        self.width = len(arm.limits.names)
        self.limits = MotionLimits.of(arm.limits)
        self.stop_limits = MotionLimits.of(arm.limits, stop=True)
        self._arm, self._gripper = slice(0, dof), slice(dof, dof + 1)
        # Without a load the limits leave the motors room enough.
        self._dynamics = ArmDynamics(body) if arm.load and body.mjcf else None
        self._collision = self.kinematics.collision  # of the arm and what it holds, for the plan that is made
        self._holding: dict[Capsule, CollisionModel] = {}  # of what was held last
        self._calm = self.limits.scaled(1.0, acceleration_share(body))

    def check(self, command: BrainCommand) -> PlanFailure | None:
        """Return what is wrong with a goal whatever the arm's state, or None."""
        return check(command, self.arm)

    def plan(
        self,
        command: BrainCommand,
        position: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        opening: float | None = None,
        held: Capsule | None = None,
    ) -> Plan | PlanFailure:
        """Return how a goal is reached from a commanded state.

        Args:
            position: the state [rad, and m for the gripper], shape (dof + 1,).
            velocity: shape (dof + 1,).
            acceleration: shape (dof + 1,).
            opening: where the gripper was last commanded to [m], for goals that leave it as it is; where it is if
                None.
            held: what is in the gripper.
        """
        failure = self.check(command)
        if failure is not None:
            return failure
        self._collision = self.kinematics.collision
        if held is not None:
            if held not in self._holding:
                while len(self._holding) >= _MOST_HELD:
                    del self._holding[next(iter(self._holding))]
                self._holding[held] = CollisionModel(self.arm.chain.holding(held))
            self._collision = self._holding[held]
        state = State.of(position, velocity, acceleration)
        arm = self._plan_arm(command, state[self._arm])
        if isinstance(arm, PlanFailure):
            return arm
        if self.arm.gripper is None:
            return Plan(arm, arm.target.copy())
        gripper = self._plan_gripper(command.gripper if command.gripper is not None else opening, state[self._gripper])
        if isinstance(gripper, PlanFailure):
            return gripper
        trajectory = arm.beside(gripper)
        return Plan(trajectory, trajectory.target.copy())

    def brake(self, state: State, *, hard: bool) -> Trajectory:
        """Return how all dimensions come to rest, with the limits of normal motion or with those of a stop.

        Near the end of its range a joint that speeds up may need those of a stop in any case.
        """
        trajectory = to_rest(state, self.stop_limits if hard else self._calm, self.hz, self.stop_limits)
        if isinstance(trajectory, PlanFailure) and self._dynamics is not None:
            trajectory = to_rest(state, self.limits, self.hz)  # it was faster than its load permits now
        # A state that nothing can brake is not a state of a reference; what remains is to stand still.
        return at_once(state.position) if isinstance(trajectory, PlanFailure) else trajectory

    # --- the arm -----------------------------------------------------------------------------------------------------

    def _plan_arm(self, command: BrainCommand, state: State) -> Trajectory | PlanFailure:
        if command.target_pose is not None:
            if command.motion == "line":
                return self._plan_line(command, command.target_pose, state)
            return self._plan_pose(command, command.target_pose, state)
        if command.joint_target is not None:
            return self._plan_joints(command, np.asarray(command.joint_target, np.float64), state)
        if state.moving:
            brake = to_rest(state, self.limits[self._arm], self.hz, self.stop_limits[self._arm])
            return brake if isinstance(brake, PlanFailure) else self._checked(brake, state)
        return at_once(state.position)

    def _plan_joints(self, command: BrainCommand, target: Array, state: State) -> Trajectory | PlanFailure:
        limits = self.limits[self._arm]
        speed, change = command.max_velocity, command.max_acceleration
        scaled = limits.scaled(
            1.0 if speed is None else speed / limits.velocity.max(),
            1.0 if change is None else change / limits.acceleration.max(),
        )
        # An arm that is already faster than the goal permits may need more than the goal's deceleration at an end of
        # the joints' range, and one that speeds up that of a stop, see `brake`.
        brakes = limits, self.stop_limits[self._arm]
        trajectory = self._within_torque(
            lambda share: to_target(state, target, scaled.scaled(1.0, share), self.hz, *brakes)
        )
        return trajectory if isinstance(trajectory, PlanFailure) else self._checked(trajectory, state)

    def _plan_pose(self, command: BrainCommand, pose: Pose, state: State) -> Trajectory | PlanFailure:
        found = self.kinematics.solve(pose.matrix(), state.position)
        if found.code != ResultCode.SUCCEEDED:
            return PlanFailure(found.code, f"The pose cannot be taken: {found.message}")
        first: PlanFailure | None = None
        for posture in found.postures[:_ATTEMPTS]:
            trajectory = self._plan_joints(command, posture, state)
            if not isinstance(trajectory, PlanFailure):
                return trajectory
            first = first or trajectory
        return first or PlanFailure(ResultCode.UNREACHABLE, "No posture reaches the pose.")

    def _plan_line(self, command: BrainCommand, pose: Pose, state: State) -> Trajectory | PlanFailure:
        limits = self.limits[self._arm]
        tool = ToolLimits(command.max_velocity or MAX_TOOL_SPEED, command.max_acceleration or MAX_TOOL_ACCELERATION)
        # A line starts where the tool can be on it: at rest.
        brake = to_rest(state, limits, self.hz, self.stop_limits[self._arm]) if state.moving else None
        if isinstance(brake, PlanFailure):
            return brake
        start = state.position if brake is None else brake.target
        line = self._within_torque(
            lambda share: along_line(start, pose.matrix(), self.kinematics, (limits.scaled(1.0, share), tool), self.hz)
        )
        if isinstance(line, PlanFailure):
            return line
        return self._checked(line if brake is None else brake.then(line), state)

    # --- torques -----------------------------------------------------------------------------------------------------

    def _within_torque(self, plan: Callable[[float], Trajectory | PlanFailure]) -> Trajectory | PlanFailure:
        """Return a motion whose torques the motors can give, with the declared load."""
        share = 1.0
        for _ in range(_SLOWER):
            trajectory = plan(share)
            if isinstance(trajectory, PlanFailure) or self._dynamics is None:
                return trajectory
            possible = self._torque_share(self._dynamics, trajectory)
            if possible >= 1.0:
                return trajectory
            share *= min(possible, 0.97)
            if share < _LEAST_SHARE:
                break
        return PlanFailure(
            ResultCode.OVERLOAD,
            f"The motors cannot carry the declared load of {self.arm.load:g} kg on this way, however slowly.",
        )

    def _torque_share(self, dynamics: ArmDynamics, trajectory: Trajectory) -> float:
        """Return the largest share of a trajectory's accelerations for which the torques suffice."""
        every = slice(None, None, max(1, round(_TORQUE_STEP_S * self.hz)))
        position, velocity = trajectory.position[every], trajectory.velocity[every]
        still = np.zeros_like(position)
        weight = dynamics.torque(position, still, still)
        motion = dynamics.torque(position, velocity, trajectory.acceleration[every]) - weight
        room = np.asarray(self.arm.limits.effort[: self.dof]) - np.copysign(weight, weight * motion)
        return float((room / np.maximum(SWING * np.abs(motion), _ROUNDING)).min())

    # --- the gripper -------------------------------------------------------------------------------------------------

    def _plan_gripper(self, opening: float | None, state: State) -> Trajectory | PlanFailure:
        limits, stop = self.limits[self._gripper], self.stop_limits[self._gripper]
        if opening is None and state.moving:
            return to_rest(state, limits, self.hz, stop)
        target = np.clip(state.position if opening is None else opening, limits.lower, limits.upper)
        if not state.moving and (target == state.position).all():
            return at_once(target)
        return to_target(state, np.broadcast_to(target, (1,)), limits, self.hz, limits, stop)

    # --- collisions --------------------------------------------------------------------------------------------------

    def _checked(self, trajectory: Trajectory, state: State) -> Trajectory | PlanFailure:
        """Return the trajectory, or why its way is not admissible."""
        path = np.concatenate((state.position[None], trajectory.position))
        way = np.concatenate(((0.0,), np.abs(np.diff(path, axis=0)).max(axis=1).cumsum()))
        if way[-1] == 0.0:
            return trajectory
        marks = np.linspace(0.0, way[-1], int(np.ceil(way[-1] / _CHECK_STEP)) + 1)
        postures = np.stack([np.interp(marks, way, joint) for joint in path.T], axis=1)
        least = self.arm.chain.min_distance
        collision = self._collision
        for distances, code in zip(
            collision.distances(postures), (ResultCode.SELF_COLLISION, ResultCode.TABLE_COLLISION), strict=True
        ):
            inside = distances < least
            if not inside.any():
                continue
            leaves = int(inside.argmin())  # number of postures, from the start, that are too close
            escapes = leaves > 0 and not inside[leaves:].any()
            if escapes and (np.diff(distances[: leaves + 1]) >= -_ROUNDING).all():
                continue
            closest, what = postures[int(distances.argmin())], "the table"
            if code == ResultCode.SELF_COLLISION:
                other, own = collision.closest_pair(closest)
                what = other if other.startswith(OBSTACLE) else "the arm" if own.startswith(HELD) else "itself"
            else:
                own = collision.lowest(closest)
            who = "what the gripper holds" if own.startswith(HELD) else "the arm"
            where = f"{who.capitalize()} starts" if inside[0] else f"On the way {who} comes"
            advice = "; it may only move straight away" if inside[0] else ""
            if own.startswith(HELD):
                advice += "; it is taken to reach as far down as the table was when the gripper closed"
            return PlanFailure(
                code, f"{where} within {distances.min():.4f} m of {what}; {least} m is the least{advice}."
            )
        return trajectory
