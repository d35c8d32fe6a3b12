"""An expert that gives goals, started in the middle of an episode, from whatever state someone else left."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.bodies.ur5 import MAX_OPENING, ur5
from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.policies.brain import Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain
from bhd_lerobot.policies.manipulation.grasp import SeenObject, read_objects

_LOW = 0.14  # [m] above the table; lower, some part of the arm is among what stands on it
_CLEAR = 0.20  # [m] above the table, that it is raised to
_RAISE = 0.15  # [m] what is held is raised by this
_UP_SPEED, _UP_CHANGE = 0.25, 1.0  # [m/s], [m/s^2]
_HOME_SPEED, _HOME_CHANGE = 1.5, 4.0  # [rad/s], [rad/s^2]
_HELD_LIFT, _HELD_APART = 0.006, 0.05  # [m] an object this far up and this near the tool's tip is in the gripper
_ODD = np.array([1.5, 0.9, 0.9, 1.2, 0.9, 3.2])  # [rad] joints farther than this from home
_UPRIGHT = np.array([-np.pi / 2, 0.0])  # [rad] shoulder lift and elbow of an arm that is stretched upwards
_IDLE_S = 2.5  # [s] after which an expert that has nothing to do any more begins again
_FAST = 0.3  # [rad/s] an arm that is faster comes to rest first: then its position is known
_STOPS = 5  # how often that is tried
_HOMES = 3  # how often it is brought home, in one intervention, because it finds no way

STOP, OPEN, UP, RAISE, UPRIGHT, HOME = "stop", "open", "up", "raise", "upright", "home"
_DESCRIPTIONS = {
    STOP: "come to rest",
    OPEN: "open the gripper",
    UP: "raise the arm",
    RAISE: "raise what is held",
    UPRIGHT: "stretch upwards",
    HOME: "go home",
}


@dataclass
class _Turn:
    """How far the expert is in one simulation.

    Attributes:
        own: what to do before it begins, in order.
        pending: name of the goal of ours that is under way.
        raw: that of the expert's last goal, as the expert calls it.
        is_first: whether that is the first since it began.
        is_new: whether the turn has just begun, or begins again.
        is_holding: whether it holds what the task is about, and waits for that to be enough.
        idle: frames in which it had nothing to do.
    """

    number: int = 0
    own: list[str] = field(default_factory=list)
    pending: str | None = None
    raw: str | None = None
    is_first: bool = False
    is_new: bool = False
    is_holding: bool = False
    stops: int = 0
    homes: int = 0
    idle: int = 0
    count: int = 0
    doing: str = ""
    seed: int = 0
    instruction: str = ""


class GoalExpert:
    """Lets a brain that gives goals take over, as often as someone asks.

    Before it begins, an arm with objects around it comes to rest and gets out of what it is among: it opens the gripper
    and goes straight up; what it holds, if that is what the task is about, it raises. From an odd posture, and where
    the expert's first goal has no way, it goes home first. An expert that has given up begins again from there.
    """

    def __init__(self, brain: GoalBrain) -> None:
        self.brain = brain
        arm = ur5()
        self._kinematics, self._home = ArmKinematics(arm.chain, arm.limits), np.array(arm.home[:-1])
        self._lower, self._upper = np.array(arm.limits.lower[:-1]), np.array(arm.limits.upper[:-1])
        self._names = arm.limits.names
        self._joints: NDArray[np.intp] = np.zeros(0, np.intp)
        self._speeds: NDArray[np.intp] = np.zeros(0, np.intp)
        self._opening = 0
        self._objects: NDArray[np.intp] | None = None
        self._turns: list[_Turn] = []
        self._most_idle = 1

    def bind(self, robot: RobotFeatures) -> None:
        """Find the joints, and the objects if there are any."""
        self.brain.bind(robot)  # type: ignore[attr-defined]
        *joints, gripper = self._names
        self._joints = find_columns(robot.observation_names, joints, self.brain.name, "observation")
        speeds = [name.replace(".pos", ".vel") for name in joints]
        self._speeds = find_columns(robot.observation_names, speeds, self.brain.name, "observation")
        self._opening = int(find_columns(robot.observation_names, [gripper], self.brain.name, "observation")[0])
        wanted = [f"object_{number}_{name}" for number in range(MAX_OBJECTS) for name in OBJECT_FIELDS]
        self._objects = None
        if set(wanted) <= set(robot.environment_names):
            self._objects = find_columns(robot.environment_names, wanted, self.brain.name, "environment")
        self._most_idle = max(1, round(_IDLE_S * robot.fps))

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes."""
        if len(self._turns) != n:
            self._turns = [_Turn() for _ in range(n)]
        for place, sim in enumerate(ids.tolist()):
            self._turns[sim] = _Turn(seed=seeds[place], instruction=instructions[place] if instructions else "")
        self.brain.reset(ids, seeds, n, instructions)

    def take_over(self, sim: int) -> None:
        """Begin a turn in one simulation with what is seen next."""
        turn = self._turns[sim]
        self._turns[sim] = _Turn(turn.number + 1, is_new=True, seed=turn.seed, instruction=turn.instruction)

    def subtasks(self) -> Sequence[str]:
        """Return what is being done, as text."""
        return [turn.doing or text for turn, text in zip(self._turns, self.brain.subtasks(), strict=True)]

    def act(self, seen: Observation, driving: NDArray[np.bool_]) -> dict[int, list[BrainCommand]]:
        """Return the new goals, by simulation."""
        commands: dict[int, list[BrainCommand]] = {}
        results: dict[int, list[CommandResult]] = {}
        active = driving.copy()
        for sim in np.flatnonzero(driving).tolist():
            turn = self._turns[sim]
            own, ended = self._results(turn, seen.results.get(sim, ()))
            if turn.is_new and (turn.pending is None or own is not None):
                turn.pending, own, ended = None, None, []
                is_fast = self._objects is not None and np.abs(seen.state[sim, self._speeds]).max() > _FAST
                if is_fast and turn.stops < _STOPS:
                    turn.own, turn.stops = [STOP], turn.stops + 1
                else:
                    turn.is_new, turn.own = False, self._before(sim, seen)
                    self._restart(sim)
            elif turn.is_first and any(not result.success for result in ended) and turn.homes < _HOMES:
                turn.own, turn.homes = [UPRIGHT, HOME], turn.homes + 1
                self._restart(sim)
                ended = []
            if turn.pending is not None:
                if own is None:
                    active[sim] = False
                    continue
                turn.pending = None
                turn.is_holding = own.success and own.task_id.endswith(RAISE)
                if not own.success and not own.task_id.endswith((UPRIGHT, HOME)):
                    turn.own = [UPRIGHT, HOME]
            if turn.own:
                commands[sim] = [self._own_goal(sim, turn.own.pop(0), seen)]
                active[sim] = False
                continue
            if turn.is_holding:
                active[sim] = False
                self._idle(turn)
                continue
            turn.doing = ""
            if ended:
                results[sim] = ended
        if active.any():
            self._ask(replace(seen, running=active, results=results), commands)
        return commands

    def _ask(self, seen: Observation, commands: dict[int, list[BrainCommand]]) -> None:
        """Add the expert's own goals."""
        given = self.brain.act(seen).commands
        if seen.running is None:
            raise AssertionError("GoalExpert always sets `running`.")
        for sim in np.flatnonzero(seen.running).tolist():
            turn = self._turns[sim]
            ended = {one.task_id for one in seen.results.get(sim, ())}
            for one in given.get(sim, ()):
                turn.is_first, turn.raw, turn.idle = turn.raw is None, one.task_id, 0
                commands.setdefault(sim, []).append(replace(one, task_id=f"{turn.number}.{turn.homes}.{one.task_id}"))
            if not given.get(sim) and (turn.raw is None or turn.raw in ended or turn.idle):
                self._idle(turn)

    def _idle(self, turn: _Turn) -> None:
        """Let a frame go by in which there is nothing to do; begin again if there were many."""
        turn.idle += 1
        if turn.idle > self._most_idle:
            turn.idle, turn.is_new, turn.is_holding = 0, True, False
            turn.homes += 1

    def _results(
        self, turn: _Turn, results: Sequence[CommandResult]
    ) -> tuple[CommandResult | None, list[CommandResult]]:
        """Return the result of our own goal, and those of the expert's, under the names that it gave."""
        prefix = f"{turn.number}.{turn.homes}."
        own = [result for result in results if result.task_id == turn.pending]
        ended = [result for result in results if result.task_id.startswith(prefix)]
        return (own[-1] if own else None), [replace(one, task_id=one.task_id.removeprefix(prefix)) for one in ended]

    def _restart(self, sim: int) -> None:
        turn = self._turns[sim]
        turn.raw, turn.is_first, turn.idle = None, False, 0
        self.brain.reset(np.array([sim]), [turn.seed], len(self._turns), [turn.instruction])

    # --- getting out of where it is -----------------------------------------------------------------------------------

    def _before(self, sim: int, seen: Observation) -> list[str]:
        """Return what to do before the expert begins."""
        if self._objects is None or seen.environment_state is None:
            return []  # nothing stands in the way; reaching a target needs no more room than a goal keeps
        q = seen.state[sim, self._joints]
        held = self._held(sim, q, seen)
        if held is not None and held.target and not self._turns[sim].homes:
            return [RAISE]
        _, height = self._kinematics.collision.distances(q)
        before = [OPEN, UP] if height < _LOW else []
        # Folded in another way than usual, it would sweep over the table, or find no straight way down.
        is_odd = bool((np.abs(q - self._home_near(q)) > _ODD).any())
        return [*before, UPRIGHT, HOME] if is_odd or self._turns[sim].homes else before

    def _held(self, sim: int, q: NDArray[np.float64], seen: Observation) -> SeenObject | None:
        """Return the object that is in the gripper and off the table, if any."""
        if self._objects is None or seen.environment_state is None:
            return None
        table = seen.environment_state[sim, self._objects].reshape(MAX_OBJECTS, len(OBJECT_FIELDS))
        tip = self._kinematics.tool(q)[:3, 3]
        for item in read_objects(table):
            bottom = item.position[2] - item.size[2] / 2
            apart = np.hypot(tip[0] - item.position[0], tip[1] - item.position[1])
            if bottom > _HELD_LIFT and apart < _HELD_APART and abs(tip[2] - item.position[2]) < item.size[2] / 2 + 0.03:
                return item
        return None

    def _home_near(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the home posture whose joints need not make a full turn more than necessary [rad], shape (6,)."""
        turns = np.round((q - self._home) / (2 * np.pi)) * 2 * np.pi
        near = self._home + turns
        return np.where((near >= self._lower) & (near <= self._upper), near, self._home)

    def _own_goal(self, sim: int, step: str, seen: Observation) -> BrainCommand:
        turn = self._turns[sim]
        turn.count += 1
        turn.pending, turn.doing = f"{turn.number}-{turn.homes}-{turn.count}-{step}", _DESCRIPTIONS[step]
        if step == STOP:
            opening = float(np.clip(seen.state[sim, self._opening], 0.0, MAX_OPENING))
            return BrainCommand(turn.pending, gripper=opening)
        if step == OPEN:
            return BrainCommand(turn.pending, gripper=MAX_OPENING)
        q = seen.state[sim, self._joints]
        if step in (UPRIGHT, HOME):
            target = self._home_near(q)
            if step == UPRIGHT:  # from nearly everywhere it leads up
                target[[0, 3, 4, 5]] = q[[0, 3, 4, 5]]
                target[1:3] += _UPRIGHT - self._home[1:3]
            joints = tuple(np.clip(target, self._lower, self._upper).tolist())
            return BrainCommand(
                turn.pending, joint_target=joints, max_velocity=_HOME_SPEED, max_acceleration=_HOME_CHANGE
            )
        _, height = self._kinematics.collision.distances(q)
        x, y, z, *quaternion = pose_vectors(self._kinematics.tool(q)).tolist()
        by = _RAISE if step == RAISE else _CLEAR - float(height)
        w, i, j, k = quaternion
        return BrainCommand(
            turn.pending,
            target_pose=Pose((x, y, z + by), (w, i, j, k)),
            motion="line",
            max_velocity=_UP_SPEED,
            max_acceleration=_UP_CHANGE,
        )
