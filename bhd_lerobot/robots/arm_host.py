"""n arms under one cerebellum, whatever is below it: what they observe, and how their actions become setpoints."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, without_jerk_limits
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, TableScene
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.messages import Mode, Reason
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.host.host import Host

if TYPE_CHECKING:  # it imports LeRobot, which the real-time process does without
    from bhd_lerobot.robots.config_arm import ArmConfig

TOOL_NAMES = (
    "tool_x.pos",
    "tool_y.pos",
    "tool_z.pos",
    "tool_qw.pos",
    "tool_qx.pos",
    "tool_qy.pos",
    "tool_qz.pos",
    "gripper.pos",
)
"""Position [m] and orientation (unit quaternion) of the tool frame in the base frame, and the gripper's opening [m]."""


def tool_names(body: Body) -> tuple[str, ...]:
    """Return the names of actions that are tool poses, with the gripper's opening if there is a gripper."""
    return TOOL_NAMES if body.need(Arm).gripper else TOOL_NAMES[:-1]


_SLACK = 0.2  # how far a policy's quaternion may be from unit length; it is normalised


def pose_matrices(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], str | None]:
    """Return the homogeneous transform of a position and a quaternion wxyz, and what is wrong with them, if anything.

    Args:
        values: x, y, z [m], w, x, y, z, shape (7,). The quaternion is normalised, as a network's output is only nearly
            of unit length.
    """
    length = float(np.sqrt((values[3:] * values[3:]).sum()))
    if not abs(length - 1) <= _SLACK:
        return np.eye(4), f"the quaternion {values[3:].tolist()} has the length {length:g}; it must be near 1"
    x, y, z, *quaternion = values.tolist()
    return Pose((x, y, z), (quaternion[0], quaternion[1], quaternion[2], quaternion[3])).matrix(), None


_TO_START = 0.5  # [rad/s] so fast does a joint turn at the most on the way to the start of an episode
_LARGEST_TURN = 1.0  # [rad] of a joint from one tool pose to the next: a second at a third of the largest speed
_JUMP = (
    "{} would have to turn by {:.2f} rad at once; {} rad is the most. Come nearer to the pose in smaller steps, or "
    "send it as a goal, which is planned"
)
_LARGEST_STEP = 0.1  # [m] of the tool to the first pose that is taken after refusals; at 1 m/s 0.1 s
_FAR = (
    "The poses before were refused, and this one is {:.3f} m from where the tool waits; {} m is the most. Come back to "
    "the tool, or send the pose as a goal, which is planned"
)


class ArmHost(Host):
    """n arms.

    Attributes:
        plant: the joints.
        controller: an `ArmController`, or with ``control = "impedance"`` an `ImpedanceController`, whose compliance and
            feed-forward wrench may be set and whose estimate of the contact wrench may be read.
        kinematics: the arm's.

    Args:
        config: the robot.
        plant: the joints.
        planning: who plans goals; they are planned in the tick that they start in if None.
        options: those of `Host`.
    """

    knows: frozenset[str] | None = frozenset({"tool_pose", "opening"})

    def __init__(self, config: "ArmConfig", plant: Plant, planning: Planning | None = None, **options: Any) -> None:
        body = config.body() if config.jerk_limits else without_jerk_limits(config.body())
        arm = body.need(Arm)
        self.plant = plant
        self.kinematics = ArmKinematics(arm.chain, arm.limits)
        self._joints = len(arm.chain.joints)
        ticks = config.rates.ticks_per_frame
        self.controller: ArmController | ImpedanceController
        if config.control == "impedance":
            self.controller = ImpedanceController(body, plant.n, config.control_hz, ticks, config.max_force)
        else:
            if config.wrench and not body.mjcf:
                raise ConfigError(
                    f"robot.wrench is true, and the body {body.name!r} says nothing of its inertias (Body.mjcf): what "
                    "its surroundings put on it cannot be told from its motors' efforts. Leave robot.wrench false."
                )
            self.controller = ArmController(
                body,
                plant.n,
                config.control_hz,
                ticks,
                planning,
                holds=config.held_clearance,
                # Without inertias it is not known what torques a motion needs.
                max_force=config.max_force if body.mjcf else None,
                wrench=config.wrench,
            )
            self.controller.set_latency(np.arange(plant.n), plant.latency_s)
        self._taken = np.zeros((plant.n, 3))  # where the tool was to be by the last action that was not refused [m]
        self._refused = np.zeros(plant.n, np.bool_)  # the last action
        super().__init__(
            config,
            Cerebellum(body, plant, config.control_hz, controller=self.controller),
            action_names=tool_names(body) if config.action_space == "tool" else body.limits.names,
            observation_names=observation_names(body, tool_pose=config.tool_pose),
            **options,
        )

    def _newest(self) -> PlantReading:
        """Return the newest reading of the joints."""
        return self.cerebellum.reading

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""
        reading = self._newest()
        return self._observed(np.concatenate([reading.position, reading.velocity], axis=1)), np.full(self.n, self.tick)

    def _observed(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return observations of positions and speeds, shape (n, 2 joints): with the tool's pose if asked for."""
        if not self.config.tool_pose:
            return state
        return np.concatenate([state, pose_vectors(self.kinematics.tool(state[:, : self._joints]))], axis=1)

    def truth(self) -> ArmTruth:
        """Return what the joints say: where the tools are. Of objects and touches nothing is known."""
        position = self._newest().position
        return ArmTruth(
            tool_pose=pose_vectors(self.kinematics.tool(position[:, : self._joints])),
            object_poses=np.zeros((self.n, MAX_OBJECTS, 7)),
            opening=self._opening(position),
            arm_on_table=np.zeros(self.n, np.bool_),
            arm_on_object=np.zeros(self.n, np.bool_),
            self_contact=np.zeros(self.n, np.bool_),
            fingers_on_object=np.zeros((self.n, MAX_OBJECTS), np.bool_),
        )

    def _opening(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the openings of the grippers [m], shape (n,); 0 without one."""
        return np.asarray(position[:, self._joints :].sum(axis=1))

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start episodes."""
        initial = super().reset(ids, scenes, seeds)
        self._refused[ids] = False
        return initial

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the tool in recorded observations, shape (frames, 7)."""
        return pose_vectors(self.kinematics.tool(np.asarray(states, np.float64)[:, : self._joints]))

    def start_goal(self, scene: TableScene | None) -> BrainCommand | None:
        """Return the goal that brings an arm to the start of a scene; it stays where it is if there is none."""
        if scene is None or self.config.control == "impedance":
            return None
        joints, opening = scene.posture[: self._joints], (*scene.posture[self._joints :], None)[0]
        return BrainCommand("start", joint_target=joints, gripper=opening, max_velocity=_TO_START, timeout_s=60.0)

    # --- tool space ---------------------------------------------------------------------------------------------------

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return joint positions and openings as actions: as they are, or as tool poses."""
        if self.config.action_space == "joint" or self.config.control == "impedance":
            return command.copy()
        tool = pose_vectors(self.kinematics.tool(command[:, : self._joints]))
        return np.concatenate([tool, command[:, self._joints :]], axis=1)

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], dict[int, tuple[Reason, str]]]:
        """Turn actions into setpoints, shape (n, width), and say which cannot be, and why.

        The posture of a tool pose is the one nearest to that before it. Near a singular posture, at the end of a
        joint's range and where the workspace folds, the nearest one may be far away, and the tool would leave its
        path on the way there: that is refused. A stream may have moved on while its poses were refused, and what it
        comes back with would be a jump: it is taken again near to where the tool waits.
        """
        if self.config.action_space == "joint":
            return action, {}
        command, dof = self.cerebellum.command if before is None else before, self._joints
        setpoints, refused = command.copy(), {}
        for sim in np.flatnonzero(mask).tolist():
            posture, problem = self._posture(sim, action[sim, :7], command[sim, :dof])
            if problem is None:
                setpoints[sim] = (*posture, *action[sim, 7:])  # of an impedance the pose itself
                self._taken[sim] = action[sim, :3]
            else:
                refused[sim] = (Reason.NO_POSTURE, problem)
            self._refused[sim] = problem is not None
        return setpoints, refused

    def _posture(
        self, sim: int, pose: NDArray[np.float64], before: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], str | None]:
        """Return what takes an arm to a tool pose, shape (7,), from the posture before; or why it is refused."""
        matrix, problem = pose_matrices(pose)
        if problem is not None or self.config.control == "impedance":
            return pose, problem  # where the spring pulls to; whether the arm gets there is for the spring to find out
        result = self.kinematics.solve(matrix, before)
        if result.code != ResultCode.SUCCEEDED:
            return before, result.message
        posture = result.postures[0]
        turn = np.abs(posture - before)
        if turn.max() > _LARGEST_TURN:
            return before, _JUMP.format(self.kinematics.chain.joints[int(turn.argmax())], turn.max(), _LARGEST_TURN)
        if self._refused[sim]:
            # In a fast stream the arm is far behind: a single refusal must not end it.
            follows = self.cerebellum.mode[sim] == Mode.TRACKING
            places = [self.kinematics.tool(before)[:3, 3], *self._taken[sim : sim + follows]]
            step = min(float(np.linalg.norm(pose[:3] - place)) for place in places)
            if step > _LARGEST_STEP:
                return before, _FAR.format(step, _LARGEST_STEP)
        return posture, None


def observation_names(body: Body, *, tool_pose: bool) -> tuple[str, ...]:
    """Return the names of the observation's floats, in order."""
    positions = body.limits.names
    return (*positions, *(f"{name.removesuffix('.pos')}.vel" for name in positions), *TOOL_NAMES[:-1] * tool_pose)
