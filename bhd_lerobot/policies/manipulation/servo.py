"""Position-based servoing: what the tool is to do next, from nothing but where it is and where the objects are.

The brains `reach` and `pick` give goals, each of which is planned once. These give a tool pose in every frame, whatever
brought the arm where it is: what they would do is known in states that someone else got the arm into, so that a policy
can learn it there (`dataset.expert_action`). They remember nothing, so a network without a memory can learn all of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, GripperSpec, Handling
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS, check_camera_error
from bhd_lerobot.control.commands import Pose
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Positive, Range
from bhd_lerobot.policies.brain import Brain, BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.manipulation.grasp import Grasp, SeenObject, plan_grasp, pointing_down, read_objects
from bhd_lerobot.policies.manipulation.pick import SQUEEZE
from bhd_lerobot.policies.manipulation.reach import TARGET

Array = NDArray[np.float64]

_TOOL = tuple(f"tool_{name}.pos" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
_GRIPPER = "gripper.pos"
_DOWN = (0.008, 0.02)  # [m] from the object to the tool's axis: so near it goes all the way down, and so far not at all
_TURNED = (0.15, 0.4)  # [rad] from the grasp, likewise
_AROUND, _TURNED_AROUND = 0.025, 0.4  # [m], [rad] within which the fingers close, if they are low enough
_ROOM = 0.008  # [m] beside the fingers is enough
_GAIN = 0.5  # share of the way to the target that one frame asks for: what follows with a delay does not overshoot
_REACHED = 0.015  # [m] above the height of the grasp, at which the fingers close
_OVER = 0.035  # [m] above an object's top the fingers, which reach 14 mm farther than the tool, pass over it
_BRAKE = 0.05  # [m] above that height it slows down
_HELD = (-0.012, 0.004)  # [m] by which the opening differs from the object that is between the closed fingers
_OPEN = 0.006  # [m] an opening at most this much smaller than what is wanted lets the object in
_CLEAR = 0.02  # [m] below the height of travel, from which on the tool moves sideways
_ABOVE = 0.03  # [m] above it the tool is sent, because it sags when it starts and stops


@dataclass
class ServoConfig(BrainConfig):
    """Parameters of brains that servo the tool to a pose.

    Attributes:
        lead_m: the next tool pose is at most this far from the present one [m]; over the delay with which the arm
            follows, that is its speed.
        lead_rad: and turned by at most this [rad].
        camera_error_m: known error of the positions that the task reports, x, y, z in the base frame [m]; it is
            subtracted.
    """

    lead_m: Positive = 0.025
    lead_rad: Annotated[float, Range(f"(0, {math.pi})")] = 0.2
    camera_error_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        check_camera_error("brain.camera_error_m", self.camera_error_m)


@BrainConfig.register_subclass("reach_servo")
@dataclass
class ReachServoConfig(ServoConfig):
    """Parameters of the brain that servos the tool to the target pose of the task `reach`."""


@BrainConfig.register_subclass("pick_servo")
@dataclass
class PickServoConfig(ServoConfig):
    """Parameters of the brain that servos the tool to an object, around it, and up.

    Attributes:
        lift_m: height that it lifts to [m].
        down_m: like `lead_m`, near the object [m].
        wider_m: the gripper is opened by this much wider than it needs to know exactly where the object is, where other
            objects leave room for that [m]; for policies that learn from it and know it less exactly.
    """

    lift_m: Positive = 0.15
    down_m: Positive = 0.01
    wider_m: NotNegative = 0.0


class _ServoBrain(Brain):
    """Finds its inputs, and makes a tool pose of where the tool is to go."""

    needs = (Arm, GripperSpec)

    def __init__(self, config: ServoConfig) -> None:
        super().__init__(config)
        self._tool: NDArray[np.intp] = np.zeros(0, np.intp)
        self._gripper, self._max_opening, self._handling = 0, 0.0, Handling()
        self._error = np.asarray(config.camera_error_m, np.float64)

    def bind(self, robot: RobotFeatures) -> None:
        """Find tool pose and gripper, among the observations and among the actions."""
        names = (*_TOOL, _GRIPPER)
        if tuple(robot.action_names) != names or not set(names) <= set(robot.observation_names):
            raise ConfigError(
                f"The brain {self.name!r} sees and gives tool poses; this robot has the actions "
                f"{', '.join(robot.action_names[:3])}, …. Set --robot.action_space=tool --robot.tool_pose=true."
            )
        self._max_opening = robot.need(GripperSpec).max_opening
        self._handling = robot.need(Arm).workspace.handling
        if (wider := getattr(self.config, "wider_m", 0.0)) > self._max_opening:
            raise ConfigError(f"brain.wider_m is {wider}; the gripper opens by {self._max_opening} m at the most.")
        self._tool = find_columns(robot.observation_names, _TOOL, self.name, "observation")
        self._gripper = int(find_columns(robot.observation_names, [_GRIPPER], self.name, "observation")[0])

    def _towards(self, observation: Observation, target: Array, lead: Array, opening: Array) -> Array:
        """Return actions, shape (n, 8), that lead to tool poses, shape (n, 7), by at most `lead` [m] from the tool."""
        now = observation.state[:, self._tool]
        way = target[:, :3] - now[:, :3]
        share = np.minimum(_GAIN, lead / np.maximum(np.linalg.norm(way, axis=1), 1e-9))
        rotation = scipy.spatial.transform.Rotation  # imported when it is first used
        turned = rotation.from_quat(now[:, 3:], scalar_first=True)
        turn = (rotation.from_quat(target[:, 3:], scalar_first=True) * turned.inv()).as_rotvec()
        part = np.minimum(_GAIN, self.config.lead_rad / np.maximum(np.linalg.norm(turn, axis=1), 1e-9))
        quaternion = (rotation.from_rotvec(turn * part[:, None]) * turned).as_quat(scalar_first=True)
        # Of the two quaternions of an orientation the one that is nearer to what is seen.
        quaternion *= np.where((quaternion * now[:, 3:]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        return np.concatenate([now[:, :3] + share[:, None] * way, quaternion, opening[:, None]], axis=1)


class ReachServoBrain(_ServoBrain):
    """Servos the tool to the target pose."""

    name = "reach_servo"

    def __init__(self, config: ReachServoConfig | None = None) -> None:
        super().__init__(config or ReachServoConfig())
        self._target: NDArray[np.intp] = np.zeros(0, np.intp)

    def bind(self, robot: RobotFeatures) -> None:
        """Find the target."""
        super().bind(robot)
        self._target = find_columns(robot.environment_names, TARGET, self.name, "environment")

    def act(self, observation: Observation) -> Array:
        """Return the next tool poses, shape (n, 8); where no target is told, that of now."""
        if observation.environment_state is None:
            raise AssertionError("The brain was bound to a target.")
        target = observation.environment_state[:, self._target].astype(np.float64)
        target[:, :3] -= self._error
        length = np.linalg.norm(target[:, 3:], axis=1)
        is_told = np.isfinite(target).all(axis=1) & (length > 0.5)
        target[~is_told] = observation.state[~is_told][:, self._tool]
        lead = np.full(len(target), self.config.lead_m)
        return self._towards(observation, target, lead, observation.state[:, self._gripper].copy())


class PickServoBrain(_ServoBrain):
    """Servos the open gripper above the object that the task is about, down around it, and up with it."""

    name = "pick_servo"

    def __init__(self, config: PickServoConfig | None = None) -> None:
        super().__init__(config or PickServoConfig())
        self._objects: NDArray[np.intp] = np.zeros(0, np.intp)

    def bind(self, robot: RobotFeatures) -> None:
        """Find the objects."""
        super().bind(robot)
        wanted = [f"object_{number}_{name}" for number in range(MAX_OBJECTS) for name in OBJECT_FIELDS]
        self._objects = find_columns(robot.environment_names, wanted, self.name, "environment")

    def act(self, observation: Observation) -> Array:
        """Return the next tool poses and openings, shape (n, 8); where no object is told, those of now."""
        if observation.environment_state is None:
            raise AssertionError("The brain was bound to the objects.")
        tables = observation.environment_state[:, self._objects].reshape(-1, MAX_OBJECTS, len(OBJECT_FIELDS))
        target = observation.state[:, self._tool].astype(np.float64)
        lead = np.full(len(target), self.config.lead_m)
        opening = observation.state[:, self._gripper].astype(np.float64)
        running = np.ones(len(target), np.bool_) if observation.running is None else observation.running
        for sim in np.flatnonzero(running).tolist():
            step = self._step(target[sim], float(opening[sim]), read_objects(tables[sim]))
            if step is not None:
                pose, lead[sim], opening[sim] = step
                target[sim] = (*pose.position, *pose.quaternion)
        return self._towards(observation, target, lead, opening)

    def _step(self, tool: Array, opening: float, objects: Sequence[SeenObject]) -> tuple[Pose, float, float] | None:
        """Return where one tool is to go, in steps of which length [m], and the opening [m]; None if it cannot tell."""
        target = next((item for item in objects if item.target), None)
        grasp, yaw = None, _finger_line(tool)
        if target is not None:
            others = [item for item in objects if item.index != target.index]
            grasp = self._plan(target, others, yaw)
        if target is None or grasp is None:
            return None
        x, y = grasp.x - float(self._error[0]), grasp.y - float(self._error[1])
        # Where the object stands, or hangs: its bottom is not always on the table.
        bottom = max(0.0, target.position[2] - float(self._error[2]) - target.size[2] / 2)
        low, over = bottom + grasp.z, bottom + target.size[2] + _OVER
        apart, height = math.hypot(tool[0] - x, tool[1] - y), float(tool[2])
        turn = abs(math.remainder(yaw - grasp.yaw, math.pi))
        fast, slow, travel = self.config.lead_m, self.config.down_m, self._handling.travel
        if apart < _AROUND and abs(height - low) < _AROUND:
            width = _width(target, yaw)
            closed = max(0.0, width - SQUEEZE)
            if _HELD[0] < opening - width < _HELD[1]:
                # As it is held, and from where it is: what is between the fingers is not turned.
                pose = pointing_down(
                    float(tool[0]), float(tool[1]), grasp.z + min(self.config.lift_m, self._handling.lift), yaw
                )
                return pose, slow, closed
            if height < low + _REACHED and turn < _TURNED_AROUND:
                return pointing_down(x, y, low, yaw), slow, closed
        beside = max(0.0, grasp.wider / 2)  # fingers that are farther apart may stand so much farther off
        near = (_DOWN[0] + beside, _DOWN[1] + beside)
        if opening > grasp.opening - _OPEN and turn < _TURNED[1] and apart < near[1]:
            # A part of the way: at a threshold, one who follows this law less exactly would wait for ever.
            share = max(_part(apart, near), _part(turn, _TURNED))
            down = low + share * (over - low)
            lead = fast if height > over + _BRAKE and not share else slow
            return pointing_down(x, y, down, grasp.yaw), lead, grasp.opening
        if height < travel - _CLEAR:  # up first, turned as it is: something may stand beside it
            return pointing_down(float(tool[0]), float(tool[1]), travel, yaw), slow, grasp.opening
        return pointing_down(x, y, travel + _ABOVE, grasp.yaw), fast, grasp.opening

    def _plan(self, target: SeenObject, others: Sequence[SeenObject], yaw: float) -> Grasp | None:
        """Return the grasp of an object; the widest that there is room for.

        `yaw`: of the line through the fingers now [rad]: counted from there, a choice between two ways gets clearer
        while the tool turns.
        """
        wider, grasp = self.config.wider_m, None
        for extra, least in ((wider, wider), (wider, 0.0), (0.0, 0.0)) if wider else ((0.0, 0.0),):
            grasp = plan_grasp(
                target,
                others,
                self._max_opening,
                near=yaw,
                enough=_ROOM,
                wider=extra,
                least=least,
                handling=self._handling,
            )
            if grasp is not None and grasp.room >= _ROOM:
                break
        return grasp


def _part(value: float, between: tuple[float, float]) -> float:
    """Return 0 below the first of two bounds, 1 above the second, and a part in between."""
    return min(1.0, max(0.0, (value - between[0]) / (between[1] - between[0])))


def _finger_line(tool: Array) -> float:
    """Return the direction of the line through the fingers, seen from above [rad], of a tool pose, shape (7,)."""
    across = scipy.spatial.transform.Rotation.from_quat(tool[3:], scalar_first=True).apply((0.0, 1.0, 0.0))
    return math.atan2(across[1], across[0])


def _width(item: SeenObject, yaw: float) -> float:
    """Return how far apart fingers are that hold an object [m], on a line in the direction `yaw`."""
    is_across = item.kind == "box" and abs(math.remainder(yaw - item.yaw, math.pi)) > math.pi / 4
    return item.size[1] if is_across else item.size[0]
