"""The scripted brain of the fetch task: drive to the object, take it, drive to its place, lay it down."""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Drive, GripperSpec, LidarSpec
from bhd_lerobot.bodies.tabletop import OBJECT_FIELDS
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain, GoalBrainConfig
from bhd_lerobot.policies.manipulation.grasp import SeenObject, pointing_ahead, read_objects
from bhd_lerobot.policies.manipulation.pick import MISSED, SQUEEZE
from bhd_lerobot.policies.navigation.navigator import GOAL, NavigatorBrain

_OBJECT = tuple(f"object_0_{name}" for name in OBJECT_FIELDS)
_ENDS = (
    "object_0_ahead_cos",
    "object_0_ahead_sin",
    "place_x",
    "place_y",
    "place_z",
    "place_ahead_cos",
    "place_ahead_sin",
)
_BEFORE = 0.42  # [m] from the spot to where the base comes to by its scans
_ASLANT = 0.3  # [rad] by which it looks aslant at a stand at the most
_FROM = 0.085  # [m] before the object, the tool begins its line: the fingers' tips are not at it yet
_ROOM = 0.012  # [m] under the hand: servos sag
_RELEASE = 0.004  # [m] above where it stood, an object is let go of
_THERE_M, _THERE_RAD = 0.06, 0.06  # off a pose at which the navigator rests
_NEAR_M = 0.005  # [m] off a spot, the base stands before it
_LOOK_M, _LOOK_MOST = 0.10, 0.5  # [m] ahead it looks at the line to the spot, and [rad] aslant at the most
_SLOW_S = 0.5  # [s] a distance is driven as fast as it could be covered in this time
_TURN, _TURN_MOST = 2.0, 0.5  # [1/s] a heading is turned to that fast, and [rad/s] at the most
_REST = 0.05  # [m/s and rad/s] slower than this the base is at rest
_REST_S = 0.4  # [s] the base stands before the arm moves
_PICK, _PLACE = 0, 1

type _Steps = Generator[BrainCommand | NDArray[np.float64], None, bool]


@BrainConfig.register_subclass("fetch")
@dataclass
class FetchBrainConfig(GoalBrainConfig):
    """Parameters of the scripted fetch brain.

    Attributes:
        line_velocity: speed of the tool to and from objects [m/s].
        line_acceleration: acceleration of it [m/s^2].
        lift_m: height that it lifts to before it moves away [m].
        near_speed: speed of the base before a stand [m/s].
    """

    max_velocity: Positive = 1.5
    max_acceleration: Positive = 3.0
    line_velocity: Positive = 0.10
    line_acceleration: Positive = 0.5
    lift_m: Positive = 0.05
    near_speed: Positive = 0.10


class _View(NamedTuple):
    """What is seen of one simulation: the object, where it and its place are and how one looks at them; and the arm."""

    thing: SeenObject
    spots: tuple[tuple[float, float, float], ...]
    ahead: tuple[tuple[float, float], ...]
    opening: float
    is_at_rest: bool
    result: CommandResult | None


class FetchBrain(GoalBrain):
    """Drives by setpoints, as the navigator does; takes and lays down by goals, the tool pointing ahead."""

    name = "fetch"
    needs = (Drive, Arm, GripperSpec, LidarSpec)

    def __init__(self, config: FetchBrainConfig | None = None) -> None:
        super().__init__(config or FetchBrainConfig())
        self._navigator = NavigatorBrain()
        self._steps: dict[int, _Steps] = {}
        self._views: dict[int, _View] = {}
        self._problems: dict[int, str] = {}
        self._above: dict[int, float] = {}  # the tool over the middle of the object that it has taken [m]
        self._rows: dict[int, NDArray[np.float64]] = {}  # the setpoint that holds the arm while the base drives
        self._to: NDArray[np.int64] = np.zeros(0, np.int64)  # where the navigator drives; -1 for nowhere
        self._twists: NDArray[np.float64] = np.zeros((0, 2))

    def bind(self, robot: RobotFeatures) -> None:
        """Find what is told, and how far and how high the hand has to be for what it takes."""
        super().bind(robot)
        self._navigator.bind(replace(robot, environment_names=GOAL))
        arm, self._gripper, name = robot.need(Arm), robot.need(GripperSpec), self.name
        self._home, chain = np.array(arm.home), arm.chain
        names = (*_OBJECT, *_ENDS)
        self._environment = find_columns(robot.environment_names, names, name, "environment")
        self._positions = [names.index(f"{what}_{axis}") for what in ("object_0", "place") for axis in "xyz"]
        self._error = np.tile(self.config.camera_error_m, 2)
        self._opening = int(find_columns(robot.observation_names, ["gripper.pos"], name, "observation")[0])
        self._held = find_columns(robot.action_names, arm.limits.names, name, "action")
        twist = robot.need(Drive).limits.names
        self._driven = find_columns(robot.action_names, twist, name, "action")
        self._speeds = find_columns(robot.observation_names, twist, name, "observation")
        self._width, self._fps, self._turns_at = len(robot.action_names), robot.fps, chain.base.position[:2]
        (near, _), (far, _) = arm.workspace.table
        self._reach = (near + far) / 2
        down = -np.array(chain.tool.rotation)[:, 0]  # of a tool that points ahead, in the flange frame
        self._over = _ROOM + max(
            float(down @ (np.array(end) - chain.tool.position)) + capsule.radius
            for capsule in chain.capsules
            if capsule.frame == chain.dof
            for end in (capsule.start, capsule.end)
        )

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes in some simulations."""
        if len(self._to) != n:
            self._to, self._twists = np.full(n, -1), np.zeros((n, 2))
        self._navigator.reset(ids, seeds, n)
        super().reset(ids, seeds, n, instructions)

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Begin with the first step."""
        self._steps[sim], self._problems[sim], self._to[sim] = self._fetch(sim), "", -1
        self._rows[sim] = np.zeros(self._width)
        self._rows[sim][self._held] = self._home

    def plan(self, sim: int) -> dict[str, Any]:
        """Return what it does, and what was in the way."""
        return {"doing": self.doing[sim], "problem": self._problems[sim]}

    def act(self, observation: Observation) -> Goals:
        """Return goals of the arms, and setpoints of the robots that drive."""
        if observation.environment_state is None:
            raise ConfigError(f"The brain {self.name!r} was bound to an object and its place, and received none.")
        if (self._to >= 0).any():
            goals = np.full((len(self._to), len(GOAL)), math.nan)
            for sim in np.flatnonzero(self._to >= 0).tolist():
                goals[sim] = self._before(self._look(sim, observation, None), self._to[sim])
            running = (self._to >= 0) & (True if observation.running is None else observation.running)
            seen = replace(observation, environment_state=goals, images={}, results={}, running=running)
            self._twists = self._navigator.act(seen)[:, self._driven]
        return super().act(observation)

    def decide(
        self, sim: int, seen: Observation, result: CommandResult | None
    ) -> BrainCommand | NDArray[np.float64] | None:
        """Return the next goal, or the setpoint of this frame."""
        self._views[sim] = self._look(sim, seen, result)
        return next(self._steps[sim], None)

    def _look(self, sim: int, seen: Observation, result: CommandResult | None) -> _View:
        assert seen.environment_state is not None
        row = seen.environment_state[sim, self._environment]
        row[self._positions] -= self._error
        found = read_objects(row[None, : len(_OBJECT)])
        if not found:  # where it was last
            return self._views[sim]._replace(result=result)
        thing, (ahead_cos, ahead_sin, x, y, z, cos, sin) = found[0], row[len(_OBJECT) :].tolist()
        spots, ahead = (thing.position, (x, y, z)), ((ahead_cos, ahead_sin), (cos, sin))
        is_at_rest = bool((np.abs(seen.state[sim, self._speeds]) < _REST).all())
        return _View(thing, spots, ahead, float(seen.state[sim, self._opening]), is_at_rest, result)

    @staticmethod
    def _before(view: _View, end: int) -> tuple[float, float, float, float]:
        """Return the pose before one of the two stands, in the robot's frame: x, y, cosine and sine.

        Before the nearest side of a box: fingers that meet it aslant jam on its corners.
        """
        (x, y, _), (cos, sin) = view.spots[end], view.ahead[end]
        if end == _PICK and view.thing.kind == "box":
            aslant = (view.thing.yaw - math.atan2(sin, cos) + math.pi / 4) % (math.pi / 2) - math.pi / 4
            yaw = math.atan2(sin, cos) + min(max(aslant, -_ASLANT), _ASLANT)
            cos, sin = math.cos(yaw), math.sin(yaw)
        return x - _BEFORE * cos, y - _BEFORE * sin, cos, sin

    # --- the plan, a step after the other; each goes on with the next observation, or when its goal has ended ---------

    def _fetch(self, sim: int) -> _Steps:
        """Fetch the object."""
        name = self._views[sim].thing.kind
        for _ in range(self.config.attempts):
            yield from self._drive(sim, _PICK, f"drive to the {name}")
            has_it = yield from self._take(sim)
            yield from self._back(sim)
            if has_it:
                break
        else:
            self.doing[sim] = f"cannot: {self._problems[sim]}"
            return False
        yield from self._drive(sim, _PLACE, "drive to its place")
        if (yield from self._lay_down(sim)):
            self.doing[sim] = "done"
        return True

    def _drive(self, sim: int, end: int, text: str) -> _Steps:
        """Drive before a stand by the scans, and then near to the spot."""
        self.doing[sim], self._to[sim], self._twists[sim] = text, end, 0.0
        self._navigator.reset(np.array([sim]), [0], len(self._to))
        yield self._setpoint(sim)
        while True:
            x, y, cos, sin = self._before(self._views[sim], end)
            is_there = math.hypot(x, y) <= _THERE_M and abs(math.atan2(sin, cos)) <= _THERE_RAD
            if is_there and not self._twists[sim].any() and self._views[sim].is_at_rest:
                break
            yield self._setpoint(sim, *self._twists[sim])
        self._to[sim] = -1
        while True:
            x, y, cos, sin = self._before(self._views[sim], end)
            left = x * cos + y * sin + _BEFORE - self._reach
            if abs(left) <= _NEAR_M:
                break
            most, beside = self.config.near_speed, x * sin - y * cos  # of the line to the spot, the robot to its left
            turn = math.atan2(sin, cos) - min(max(beside / _LOOK_M, -_LOOK_MOST), _LOOK_MOST)
            turn = min(max(_TURN * turn, -_TURN_MOST), _TURN_MOST)
            yield self._setpoint(sim, min(max(left / _SLOW_S, -most), most), turn)
        for _ in range(math.ceil(_REST_S * self._fps)):
            yield self._setpoint(sim)
        return True

    def _back(self, sim: int) -> _Steps:
        """Drive back from a stand."""
        self.doing[sim] = "back off"
        for _ in range(math.ceil((_BEFORE - self._reach) / self.config.near_speed * self._fps)):
            yield self._setpoint(sim, -self.config.near_speed)
        yield self._setpoint(sim)
        return True

    def _take(self, sim: int) -> _Steps:
        """Take the object; return whether it is in the gripper."""
        self.doing[sim] = "take it"
        thing = self._views[sim].thing
        x, y, z = thing.position
        tool = np.array((x, y, z - thing.size[2] / 2 + max(thing.size[2] / 2, self._over)))
        across = abs(math.cos(thing.yaw - self._yaw(tool))) >= math.sqrt(0.5)
        width = thing.size[1 if across and thing.kind == "box" else 0]
        closed = max(0.0, width - SQUEEZE)
        self._above[sim] = float(tool[2] - z)
        lifted = np.add(tool, (0.0, 0.0, self.config.lift_m))
        for command in (
            {"target_pose": self._ahead(tool, -_FROM), "gripper": self._gripper.max_opening},
            self._line(self._ahead(tool)),
            {"gripper": closed},
            self._line(self._ahead(lifted)),
            {"joint_target": tuple(self._home[:-1].tolist())},
        ):
            if not (yield from self._goal(sim, **command)):
                break
            is_closed = command.get("gripper") == closed or "joint_target" in command
            if is_closed and self._views[sim].opening < width - MISSED:
                self._problems[sim] = "the gripper holds nothing"
                break
        else:
            self._rows[sim][self._held[-1]] = closed
            return True
        yield from self._let_go(sim, tool)
        return False

    def _lay_down(self, sim: int) -> _Steps:
        """Lay the object down on its place; return whether that went as planned."""
        self.doing[sim] = "lay it down"
        view = self._views[sim]
        x, y, top = view.spots[_PLACE]
        tool = np.array((x, y, top + view.thing.size[2] / 2 + self._above[sim] + _RELEASE))
        over = np.add(tool, (0.0, 0.0, self.config.lift_m))
        for command in (
            {"target_pose": self._ahead(over, -_FROM)},
            self._line(self._ahead(over)),
            self._line(self._ahead(tool)),
        ):
            if not (yield from self._goal(sim, **command)):
                return False
        yield from self._let_go(sim, tool)
        return True

    def _let_go(self, sim: int, tool: NDArray[np.float64]) -> _Steps:
        """Open the gripper, and bring the arm home, away from what stands before it."""
        yield from self._goal(sim, gripper=self._gripper.max_opening)
        yield from self._goal(sim, **self._line(self._ahead(tool, -_FROM)))
        self._rows[sim][self._held] = self._home
        return (yield from self._goal(sim, joint_target=tuple(self._home[:-1].tolist())))

    def _goal(self, sim: int, **fields: Any) -> _Steps:
        """Follow a goal; return whether it succeeded."""
        limits = {"max_velocity": self.config.max_velocity, "max_acceleration": self.config.max_acceleration}
        yield BrainCommand(self.new_id(sim, "fetch"), **limits | fields)
        result = self._views[sim].result
        if result is None or not result.success:
            self._problems[sim] = result.message if result else "a goal had no result"
            return False
        return True

    def _line(self, target: Any) -> dict[str, Any]:
        config = self.config
        limits = {"max_velocity": config.line_velocity, "max_acceleration": config.line_acceleration}
        return {"target_pose": target, "motion": "line", **limits}

    def _yaw(self, tool: NDArray[np.float64]) -> float:
        """Return in which direction the arm is turned when the tool is there [rad]."""
        return math.atan2(tool[1] - self._turns_at[1], tool[0] - self._turns_at[0])

    def _ahead(self, tool: NDArray[np.float64], farther: float = 0.0) -> Any:
        """Return the pose of a tool that points ahead, moved along its direction by some distance [m]."""
        yaw = self._yaw(tool)
        x, y = tool[:2] + farther * np.array((math.cos(yaw), math.sin(yaw)))
        return pointing_ahead(float(x), float(y), float(tool[2]), yaw)

    def _setpoint(self, sim: int, forward: float = 0.0, turn: float = 0.0) -> NDArray[np.float64]:
        """Return the setpoint that holds the arm and drives the base."""
        row = self._rows[sim].copy()
        row[self._driven] = forward, turn
        return row
