"""The scripted brain of the pick task: approach, grasp, lift; once more if the gripper missed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, GripperSpec, Handling
from bhd_lerobot.bodies.tabletop import MAX_OBJECTS, OBJECT_FIELDS
from bhd_lerobot.control.commands import BrainCommand, CommandResult
from bhd_lerobot.errors import InstructionError, PerceptionError
from bhd_lerobot.options.declared import Count, Positive
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures, find_columns
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain, GoalBrainConfig
from bhd_lerobot.policies.manipulation.grasp import (
    Grasp,
    SeenObject,
    neutral_yaw,
    plan_grasp,
    pointing_down,
    read_objects,
)
from bhd_lerobot.policies.manipulation.skills import Plan, Skill, make_plan, scene_object

SQUEEZE = 0.03  # [m] how far inside the object the fingers are sent: the gripper's force limit does the rest
MISSED = 0.010  # [m] an opening this much smaller than the object means that it is not between the fingers
_LIFTED = 0.05  # [m] an object that was lifted by less slipped out
_POSITION = [OBJECT_FIELDS.index(axis) for axis in "xyz"]


@BrainConfig.register_subclass("pick")
@dataclass
class PickBrainConfig(GoalBrainConfig):
    """Parameters of the scripted pick brain.

    Attributes:
        line_velocity: speed of the tool on the way down and up [m/s].
        line_acceleration: acceleration of the tool on the way down and up [m/s^2].
        lift_m: height that it lifts to [m].
    """

    max_acceleration: Positive = 6.0
    attempts: Count = 2
    line_velocity: Positive = 0.25
    line_acceleration: Positive = 1.0
    lift_m: Positive = 0.15


@dataclass
class Work:
    """What is known and under way in one simulation."""

    instruction: str = ""
    plan: Plan | None = None
    step: int = 0
    stage: str = ""
    attempts: int = 0
    grasp: Grasp | None = None
    problem: str = ""


class PickBrain(GoalBrain):
    """Carries out a plan of skills with goals; its plan is to pick up the object that the task marks."""

    name = "pick"
    needs = (Arm, GripperSpec)

    def __init__(self, config: PickBrainConfig | None = None) -> None:
        super().__init__(config or PickBrainConfig())
        self._work: dict[int, Work] = {}
        self._columns: NDArray[np.intp] = np.zeros(0, np.intp)
        self._opening, self._max_opening, self._handling = 0, 0.0, Handling()

    def bind(self, robot: RobotFeatures) -> None:
        """Find the objects and the gripper."""
        super().bind(robot)
        self._find_objects(robot)
        self._max_opening = robot.need(GripperSpec).max_opening
        self._handling = robot.need(Arm).workspace.handling
        self._opening = int(find_columns(robot.observation_names, ["gripper.pos"], self.name, "observation")[0])

    def _find_objects(self, robot: RobotFeatures) -> None:
        wanted = [f"object_{number}_{name}" for number in range(MAX_OBJECTS) for name in OBJECT_FIELDS]
        self._columns = find_columns(robot.environment_names, wanted, self.name, "environment")

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the plan of one simulation, how far it got, and what was in the way."""
        work = self._work[sim]
        plan = work.plan
        return {
            "instruction": work.instruction,
            "target": None if plan is None else plan.target,
            "steps": [] if plan is None else [[step.skill.value, step.text] for step in plan.steps],
            "done": work.step,
            "attempts": work.attempts,
            "problem": work.problem,
        }

    def _make_plan(self, sim: int, objects: Sequence[SeenObject]) -> tuple[Plan, Sequence[SeenObject]]:
        """Return the plan for what is on the table, and what it takes the objects for."""
        for item in objects:
            if item.target:
                skills = (Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT, Skill.HOLD)
                return make_plan(self._work[sim].instruction, scene_object(item), skills), objects
        raise InstructionError("No object on the table is the one that the task is about.")

    # --- from one goal to the next -----------------------------------------------------------------------------------

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Take the instruction."""
        self._work[sim] = Work(instruction)

    def decide(self, sim: int, seen: Observation, result: CommandResult | None) -> BrainCommand | None:
        """Return the next goal of the plan."""
        work = self._work[sim]
        try:
            objects = self._objects(sim, seen)
            if work.plan is None:
                work.plan, objects = self._make_plan(sim, objects)
                work.step, work.stage = 1, ""  # the object was located when the plan was made
        except (InstructionError, PerceptionError) as error:
            return self._give_up(sim, str(error))
        target = next((item for item in objects if item.index == work.plan.target), None)
        if target is None:
            return self._give_up(sim, "the object is gone")
        if result is not None:
            if not result.success:
                return self._retry(sim, target, objects, result.message)
            missed = self._missed(sim, seen, target)
            if missed:
                return self._retry(sim, target, objects, missed)
        return self._next(sim, target, objects)

    def _next(self, sim: int, target: SeenObject, objects: Sequence[SeenObject]) -> BrainCommand | None:
        """Return the goal that follows the one that succeeded."""
        work = self._work[sim]
        if work.plan is None:
            raise AssertionError("There is a plan by now.")
        steps = work.plan.steps
        if work.stage in _LAST_STAGE.get(steps[work.step].skill, ()):
            work.step += 1
            if work.step == len(steps):
                self.doing[sim] = "done"
                return None
        if steps[work.step].skill == Skill.HOLD and work.step + 1 < len(steps):
            work.step += 1  # between two goals nothing moves: it was held
        step = steps[work.step]
        self.doing[sim] = step.text
        if step.skill == Skill.APPROACH and work.stage != "above":
            return self._approach(sim, target, objects)
        if work.grasp is None:
            raise AssertionError("A plan approaches before it grasps.")
        return self._carry_out(sim, step.skill, work.grasp)

    def _approach(self, sim: int, target: SeenObject, objects: Sequence[SeenObject]) -> BrainCommand | None:
        """Return the goal that brings the open gripper above the object."""
        work = self._work[sim]
        others = [item for item in objects if item.index != target.index]
        work.grasp = self._choose_grasp(target, others)
        if work.grasp is None:
            return self._give_up(sim, f"the {scene_object(target).name} does not fit between the fingers")
        work.attempts += 1
        return self._free(sim, "above", work.grasp, opening=work.grasp.opening)

    def _choose_grasp(self, target: SeenObject, others: Sequence[SeenObject]) -> Grasp | None:
        """Return how to grasp the object; None if it does not fit between the fingers."""
        return plan_grasp(target, others, self._max_opening, handling=self._handling)

    def _carry_out(self, sim: int, skill: Skill, grasp: Grasp) -> BrainCommand | None:
        """Return the next goal of a skill that needs the grasp."""
        work, config = self._work[sim], self.config
        command: BrainCommand | None = None  # hold: nothing moves any more
        if skill == Skill.APPROACH:
            command = self._line(sim, "down", grasp, grasp.z)
        elif skill == Skill.GRASP:
            work.stage = "close"
            command = BrainCommand(self.new_id(sim, "close"), gripper=max(0.0, grasp.width - SQUEEZE))
        elif skill == Skill.LIFT:
            command = self._line(sim, "lift", grasp, grasp.z + self._lift)
        elif skill == Skill.HAND_OVER:
            work.stage = "hand_over"
            x, y, z = self._handling.hand_over
            command = BrainCommand(
                self.new_id(sim, "hand_over"),
                target_pose=pointing_down(x, y, z, yaw=neutral_yaw(x, y, self._handling)),
                max_velocity=config.max_velocity / 2,
                max_acceleration=config.max_acceleration / 2,
            )
        elif skill == Skill.PLACE and work.stage != "put":
            command = self._line(sim, "put", grasp, grasp.z)
        elif skill == Skill.PLACE:
            work.stage = "release"
            command = BrainCommand(self.new_id(sim, "release"), gripper=grasp.opening)
        return command

    def _retry(self, sim: int, target: SeenObject, objects: Sequence[SeenObject], problem: str) -> BrainCommand | None:
        """Go back to before the grasp, or give up."""
        work = self._work[sim]
        if work.stage == "back":
            work.attempts += 1  # the way back failed: without an end it would be tried for ever
        if work.plan is None or work.attempts >= self.config.attempts:
            return self._give_up(sim, problem)
        work.problem = problem
        work.step, work.stage = 1, ""
        if work.grasp is None:
            return self._next(sim, target, objects)
        work.stage = "back"
        self.doing[sim] = "let go and try again"
        # Up first, with the fingers open, from wherever the tool is.
        return self._free(sim, "back", work.grasp, opening=self._max_opening)

    @property
    def _lift(self) -> float:
        """Height by which it lifts [m]."""
        return float(min(self.config.lift_m, self._handling.lift))

    def _missed(self, sim: int, seen: Observation, target: SeenObject) -> str:
        """Return what is wrong with the grasp, if anything."""
        work = self._work[sim]
        if work.grasp is None:
            return ""
        opening = float(seen.state[sim, self._opening])
        if work.stage == "close" and not self._is_held(opening, work.grasp):
            return f"the gripper closed to {opening * 1000:.0f} mm and holds nothing"
        if work.stage == "lift" and not self._is_lifted(opening, work.grasp, target):
            return "the object was not lifted"
        return ""

    def _is_held(self, opening: float, grasp: Grasp) -> bool:
        """Return whether something is between the fingers, which were closed and are this far apart [m]."""
        return opening >= grasp.width - MISSED

    def _is_lifted(self, opening: float, grasp: Grasp, target: SeenObject) -> bool:
        """Return whether the object came up with the gripper, whose fingers are this far apart [m]."""
        return target.position[2] >= target.size[2] / 2 + min(_LIFTED, self._lift / 2)

    def _give_up(self, sim: int, problem: str) -> BrainCommand | None:
        self._work[sim].problem = problem
        self.doing[sim] = f"cannot: {problem}"
        return None

    def _free(self, sim: int, stage: str, grasp: Grasp, opening: float) -> BrainCommand:
        work, config = self._work[sim], self.config
        work.stage = stage
        return BrainCommand(
            self.new_id(sim, stage),
            target_pose=grasp.pose(self._handling.travel),
            gripper=opening,
            max_velocity=config.max_velocity,
            max_acceleration=config.max_acceleration,
        )

    def _line(self, sim: int, stage: str, grasp: Grasp, height: float) -> BrainCommand:
        config = self.config
        self._work[sim].stage = stage
        return BrainCommand(
            self.new_id(sim, stage),
            target_pose=grasp.pose(height),
            motion="line",
            max_velocity=config.line_velocity,
            max_acceleration=config.line_acceleration,
        )

    def _objects(self, sim: int, seen: Observation) -> Sequence[SeenObject]:
        if seen.environment_state is None:
            raise AssertionError("The brain was bound to the objects.")
        table = seen.environment_state[sim, self._columns].reshape(MAX_OBJECTS, len(OBJECT_FIELDS))
        table[:, _POSITION] -= self.config.camera_error_m
        return read_objects(table)


# The stage that completes each skill.
_LAST_STAGE: dict[Skill, tuple[str, ...]] = {
    Skill.APPROACH: ("down",),
    Skill.GRASP: ("close",),
    Skill.LIFT: ("lift",),
    Skill.HAND_OVER: ("hand_over",),
    Skill.PLACE: ("release",),
}
