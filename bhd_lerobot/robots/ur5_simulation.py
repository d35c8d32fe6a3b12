"""n simulated UR5s under one cerebellum."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur5 import JOINTS
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.force_limit import ForceLimit
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.messages import Reason
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.host.simulation import FrameReport, Simulation
from bhd_lerobot.robots.latency import LatePlant
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World
from bhd_lerobot.tasks.task import ArmTruth
from bhd_lerobot.tasks.variation import MAX_LATENCY_S

if TYPE_CHECKING:  # it imports LeRobot, which the real-time process does without
    from bhd_lerobot.robots.config_ur5 import UR5Config

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


JOINT_ACTIONS = (*(f"{joint}.pos" for joint in JOINTS), "gripper.pos")
OBSERVED = (*JOINT_ACTIONS, *(f"{joint}.vel" for joint in JOINTS), "gripper.vel")
_MAX_TORQUE_LATENCY = 0.01  # [s] the default impedance becomes unstable somewhere between 0.02 and 0.05
_LARGEST_TURN = 1.0  # [rad] of a joint from one tool pose to the next: a second at a third of the largest speed
_JUMP = (
    "{} would have to turn by {:.2f} rad at once; {} rad is the most. Come nearer to the pose in smaller steps, or "
    "send it as a goal, which is planned"
)
_SPEED_NOISE = 10.0  # [1/s] noise on speeds, as a multiple of the noise on positions


class UR5Simulation(Simulation):
    """n simulated UR5s, each on a table of its own.

    Attributes:
        controller: an `ArmController`, or with ``control = "impedance"`` an `ImpedanceController`, whose compliance and
            feed-forward wrench may be set and whose estimate of the contact wrench may be read.
        kinematics: the arm's.
        table: what lies on the tables.

    Args:
        config: the robot.
        n: how many.
        threads: threads that step the physics; all processors if None.
        planning: who plans goals; they are planned in the tick that they start in if None.
        fixtures: what stands immovable on the tables, unknown to the arms.
    """

    robot_kind = "arm"
    action_names = JOINT_ACTIONS

    def __init__(
        self,
        config: "UR5Config",
        n: int = 1,
        threads: int | None = None,
        planning: Planning | None = None,
        *,
        fixtures: Sequence[Shape] = (),
    ) -> None:
        body = config.body()
        world = World(body, n, physics_hz=config.physics_hz, threads=threads, fixtures=fixtures)
        self.table = Tabletop(world)
        self.plant = LatePlant(SimulatedPlant(world), body, round(MAX_LATENCY_S * config.control_hz))
        self.kinematics = ArmKinematics(body.chain, body.limits)
        ticks = config.rates.ticks_per_frame
        self.controller: ArmController | ImpedanceController
        if config.control == "impedance":
            self.controller = ImpedanceController(body, n, config.control_hz, ticks)
        else:
            self.controller = ArmController(body, n, config.control_hz, ticks, planning)
            self.controller.force = ForceLimit(body, n, config.control_hz, config.max_force)
        super().__init__(
            config,
            world,
            Cerebellum(body, self.plant, config.control_hz, controller=self.controller),
            action_names=TOOL_NAMES if config.action_space == "tool" else JOINT_ACTIONS,
            observation_names=observation_names(config),
            camera_names=("scene", "wrist") if config.camera else (),
        )
        self._noise = np.zeros(n)
        self._now = np.ones(n, np.int64)  # times the tick
        self._arm_on_table, self._arm_on_object, self._self_contact = (np.zeros(n, np.bool_) for _ in range(3))

    def place(self, ids: NDArray[np.intp], scenes: Sequence[TableScene]) -> None:
        """Put the arms and their objects where the scenes want them, at rest."""
        latency = [scene.variation.latency_s for scene in scenes]
        if self.config.control == "impedance" and max(latency, default=0.0) > _MAX_TORQUE_LATENCY:
            raise ConfigError(
                f"latency_s is {max(latency)}; with robot.control = impedance the torque loop is stable with at most "
                f"{_MAX_TORQUE_LATENCY} s."
            )
        self.table.place(scenes, ids)
        self._noise[ids] = [scene.variation.sensor_noise for scene in scenes]
        self.plant.set_latency(ids, [round(late * self.rates.control_hz) for late in latency])
        for flags in self.touches:
            flags[ids] = False

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the tool in recorded states, shape (frames, 7)."""
        joints, _ = self.world.joint_slice(JOINTS)
        return pose_vectors(self.kinematics.tool(states[:, joints]))

    def truth(self, report: FrameReport | None = None) -> ArmTruth:
        """Return where tool and objects are, and what the arms touched since the start of the last frame."""
        self.plant.read(self._reading)
        return ArmTruth(
            tool_pose=self.table.tool_pose,
            object_poses=self.table.object_poses,
            opening=self._reading.position[:, -1].copy(),
            arm_on_table=self._arm_on_table.copy(),
            arm_on_object=self._arm_on_object.copy(),
            self_contact=self._self_contact.copy(),
            fingers_on_object=np.array(self.table.finger_on_object),
        )

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""
        reading = self._reading
        self.plant.read(reading)
        state = np.concatenate([reading.position, reading.velocity], axis=1)
        if np.count_nonzero(self._noise):
            joints = len(JOINTS)
            for sim in np.flatnonzero((self._noise > 0) & self.running):
                noise = self._rngs[sim].normal(0.0, self._noise[sim], (2, joints))
                state[sim, :joints] += noise[0]
                state[sim, joints + 1 : -1] += noise[1] * _SPEED_NOISE
        if self.config.tool_pose:
            state = np.concatenate([state, pose_vectors(self.kinematics.tool(state[:, : len(JOINTS)]))], axis=1)
        return state, self._now * self.tick

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """Touches of the table, of objects with a link of the arm, and of the arm with itself, each of shape (n,)."""
        return self._arm_on_table, self._arm_on_object, self._self_contact

    def _after_tick(self) -> None:
        # Contacts of an arm last longer than a physics step: once a tick is often enough.
        table = self.table
        if not table.is_touching_more:
            return
        np.logical_or(self._arm_on_table, table.arm_on_table, out=self._arm_on_table)
        np.logical_or(self._arm_on_object, table.arm_on_object, out=self._arm_on_object)
        np.logical_or(self._self_contact, table.self_contact, out=self._self_contact)

    # --- tool space ---------------------------------------------------------------------------------------------------

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return joint positions and openings as actions: as they are, or as tool poses."""
        if self.config.action_space == "joint" or self.config.control == "impedance":
            return command.copy()
        tool = pose_vectors(self.kinematics.tool(command[:, :-1]))
        return np.concatenate([tool, command[:, -1:]], axis=1)

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], dict[int, tuple[Reason, str]]]:
        """Turn actions into setpoints, shape (n, width), and say which cannot be, and why.

        The posture of a tool pose is the one nearest to that before it. Near a singular posture, at the end of a
        joint's range and where the workspace folds, the nearest one may be far away, and the tool would leave its
        path on the way there: that is refused.
        """
        if self.config.action_space == "joint":
            return action, {}
        command = self.cerebellum.command if before is None else before
        setpoints, refused = command.copy(), {}
        impedance = self.config.control == "impedance"
        for sim in np.flatnonzero(mask).tolist():
            matrix, problem = pose_matrices(action[sim, :7])
            if problem is not None:
                refused[sim] = (Reason.NO_POSTURE, problem)
                continue
            if impedance:  # where the spring pulls to; whether the arm gets there is for the spring to find out
                setpoints[sim] = action[sim]
                continue
            result = self.kinematics.solve(matrix, command[sim, :-1])
            if result.code != ResultCode.SUCCEEDED:
                refused[sim] = (Reason.NO_POSTURE, result.message)
                continue
            turn = np.abs(result.postures[0] - command[sim, :-1])
            if turn.max() > _LARGEST_TURN:
                refused[sim] = (Reason.NO_POSTURE, _JUMP.format(JOINTS[int(turn.argmax())], turn.max(), _LARGEST_TURN))
                continue
            setpoints[sim, :-1], setpoints[sim, -1] = result.postures[0], action[sim, -1]
        return setpoints, refused


def observation_names(config: "UR5Config") -> tuple[str, ...]:
    """Return the names of the observation's floats, in order."""
    return OBSERVED + TOOL_NAMES[:-1] * config.tool_pose
