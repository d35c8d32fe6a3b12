"""n arms, whatever is below them: what they observe, and how their actions become setpoints."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, TableScene
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.messages import Mode, Reason
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.parts.names import arm_action_names, arm_observation_names
from bhd_lerobot.robots.parts.part import Ids, Part, Refused

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


class ArmPart(Part):
    """n arms.

    Attributes:
        controller: an `ArmController`, or with ``control = "impedance"`` an `ImpedanceController`, whose compliance and
            feed-forward wrench may be set and whose estimate of the contact wrench may be read.
        kinematics: the arm's.

    Args:
        config: the robot.
        body: its hardware.
        plant: what moves the joints.
        planning: who plans goals; they are planned in the tick that they start in if None.
    """

    knows = frozenset({"tool_pose", "opening"})

    def __init__(self, config: Any, body: Body, plant: Plant, planning: Planning | None = None) -> None:
        arm = body.need(Arm)
        self.config, self.kinematics = config, ArmKinematics(arm.chain, arm.limits)
        self.action_names, self.observation_names = arm_action_names(config, body), arm_observation_names(config, body)
        self._joints, self._values = len(arm.chain.joints), len(arm.limits.names)
        self.derived = len(self.observation_names) - 2 * self._values
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

    def sense(self, reading: PlantReading, out: NDArray[np.float64]) -> None:
        """Write positions and speeds of the joints."""
        values = self._values
        out[:, :values], out[:, values : 2 * values] = reading.position[:, :values], reading.velocity[:, :values]

    def derive(self, out: NDArray[np.float64]) -> None:
        """Write the tool's pose if asked for."""
        if self.derived:
            out[:, 2 * self._values :] = pose_vectors(self.kinematics.tool(out[:, : self._joints]))

    def truth(self, reading: PlantReading) -> dict[str, Any]:
        """Return what the joints say: where the tools are. Of objects and touches nothing is known."""
        n, position = len(reading.position), reading.position
        return {
            "tool_pose": pose_vectors(self.kinematics.tool(position[:, : self._joints])),
            "object_poses": np.zeros((n, MAX_OBJECTS, 7)),
            "opening": self._opening(position),
            "arm_on_table": np.zeros(n, np.bool_),
            "arm_on_object": np.zeros(n, np.bool_),
            "self_contact": np.zeros(n, np.bool_),
            "fingers_on_object": np.zeros((n, MAX_OBJECTS), np.bool_),
        }

    def _opening(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the openings of the grippers [m], shape (n,); 0 without one."""
        return np.asarray(position[:, self._joints : self._values].sum(axis=1))

    def begin(self, ids: Ids) -> None:
        """Begin episodes."""
        self._refused[ids] = False

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the tool in recorded observations, shape (frames, 7)."""
        return pose_vectors(self.kinematics.tool(np.asarray(states, np.float64)[:, : self._joints]))

    def start_goal(self, scene: Any) -> BrainCommand | None:
        """Return the goal that brings an arm to the start of a scene; it stays where it is if there is none."""
        if scene is None or self.config.control == "impedance":
            return None
        posture = table_of(scene, ()).posture
        joints, opening = posture[: self._joints], (*posture[self._joints :], None)[0]
        return BrainCommand("start", joint_target=joints, gripper=opening, max_velocity=_TO_START, timeout_s=60.0)

    # --- tool space ---------------------------------------------------------------------------------------------------

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return joint positions and openings as actions: as they are, or as tool poses."""
        if self.config.action_space == "joint" or self.config.control == "impedance":
            return command.copy()
        tool = pose_vectors(self.kinematics.tool(command[:, : self._joints]))
        return np.concatenate([tool, command[:, self._joints :]], axis=1)

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Refused]:
        """Turn actions into setpoints, shape (n, width), and say which cannot be, and why.

        The posture of a tool pose is the one nearest to that before it. Near a singular posture, at the end of a
        joint's range and where the workspace folds, the nearest one may be far away, and the tool would leave its
        path on the way there: that is refused. A stream may have moved on while its poses were refused, and what it
        comes back with would be a jump: it is taken again near to where the tool waits.
        """
        if self.config.action_space == "joint":
            return action, {}
        dof = self._joints
        setpoints, refused = before.copy(), {}
        for sim in np.flatnonzero(mask).tolist():
            posture, problem = self._posture(sim, action[sim, :7], before[sim, :dof])
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
        result = self.kinematics.continued(matrix, before)
        if result.code != ResultCode.SUCCEEDED:
            return before, result.message
        posture = result.postures[0]
        turn = np.abs(posture - before)
        if turn.max() > _LARGEST_TURN:
            return before, _JUMP.format(self.kinematics.chain.joints[int(turn.argmax())], turn.max(), _LARGEST_TURN)
        if self._refused[sim]:
            # In a fast stream the arm is far behind: a single refusal must not end it.
            follows = self.host.cerebellum.mode[sim] == Mode.TRACKING
            places = [self.kinematics.tool(before)[:3, 3], *self._taken[sim : sim + follows]]
            step = min(float(np.linalg.norm(pose[:3] - place)) for place in places)
            if step > _LARGEST_STEP:
                return before, _FAR.format(step, _LARGEST_STEP)
        return posture, None


def table_of(scene: Any, home: tuple[float, ...]) -> TableScene:
    """Return the tabletop of a scene, which is one, or has one; an empty one with the arm at home otherwise."""
    table = getattr(scene, "table", scene)
    return table if isinstance(table, TableScene) else TableScene("empty", (), home)
