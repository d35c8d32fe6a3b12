"""The brain that does what an instruction says: language to a plan of skills, skills to goals."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import BrainCommand, CommandResult
from bhd_lerobot.errors import ConfigError, InstructionError, NothingFitsError, PerceptionError
from bhd_lerobot.policies.brain import BrainConfig, Observation, RobotFeatures
from bhd_lerobot.policies.language.instruction import RulePlanner
from bhd_lerobot.policies.manipulation.grasp import Grasp, SeenObject, plan_grasp
from bhd_lerobot.policies.manipulation.pick import SQUEEZE, PickBrain, PickBrainConfig
from bhd_lerobot.policies.manipulation.skills import Plan, Planner, scene_object
from bhd_lerobot.policies.perception.perceiver import PerceivedObject, Perceiver, PerceptionOptions

_HOME_SPEED, _HOME_CHANGE = 1.5, 4.0  # [rad/s], [rad/s^2]
_WIDER = 0.008  # [m] by which sizes are seen wrongly
_ROOM = 0.01  # [m] beside the fingers that is enough
_FIT = 0.009  # [m] by which the gripper opens wider than what fits between the fingers
_CLOSED = 0.006  # [m] fingers that are this near to where they were sent came there


@BrainConfig.register_subclass("language")
@dataclass
class LanguageBrainConfig(PickBrainConfig):
    """Parameters of the language brain.

    Attributes:
        instruction: what to do, in English or Chinese; the task's instruction if empty.
        perception: how it sees the objects; without, it asks the task, which in simulation knows the truth.
    """

    instruction: str = ""
    perception: PerceptionOptions = field(default_factory=PerceptionOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.perception.path and any(self.camera_error_m):
            raise ConfigError(
                f"brain.camera_error_m is {list(self.camera_error_m)}, an error added to the task's poses, but with "
                "brain.perception.path the brain does not use these poses. Leave one of them out."
            )


@dataclass
class _Sight:
    """What was seen in one simulation.

    Attributes:
        objects: the objects, None until it is looked for them.
        first: those that it saw first in this episode.
        chosen: which of them it went for, None if for none.
        image: what the camera showed when the brain looked last; None if it has not looked.
        is_alive: whether the camera has shown something else since the last look.
    """

    objects: Sequence[SeenObject] | None = None
    first: Sequence[PerceivedObject] | None = None
    chosen: int | None = None
    image: NDArray[np.uint8] | None = None
    is_alive: bool = False


class LanguageBrain(PickBrain):
    """Finds the object that an instruction means by its name and its place, and carries the instruction out.

    It does not use which object the task marks. An instruction that it does not understand, or that fits no object
    or several, is not carried out: its subtask reports why.

    With `config.perception` it uses nothing that the task tells. It looks once before it moves; that the camera lives
    it sees by the arm, which has moved before the tool goes down; and after a grasp that failed it goes home and looks
    again. What it is not sure enough of, it does not touch. `planner` turns instructions into plans, by rules if None:
    a language model goes here.
    """

    name = "language"

    def __init__(self, config: LanguageBrainConfig | None = None, planner: Planner | None = None) -> None:
        self.settings = config or LanguageBrainConfig()
        super().__init__(self.settings)
        self._planner = planner or RulePlanner()
        self.perceiver = Perceiver(self.settings.perception) if self.settings.perception.path else None
        self._sights: dict[int, _Sight] = {}
        self._home: tuple[float, ...] = ()

    @property
    def uses_images(self) -> bool:  # type: ignore[override]
        """Whether it sees for itself."""
        return self.perceiver is not None

    @property
    def uses_privileged_state(self) -> bool:  # type: ignore[override]
        """Whether it is told where the objects are, because it does not see for itself."""
        return self.perceiver is None

    def bind(self, robot: RobotFeatures) -> None:
        """Find the gripper, and the objects or the camera that shows them."""
        super().bind(robot)
        arm = robot.need(Arm)
        self._home = arm.home[: len(arm.chain.joints)]
        if self.perceiver is not None and robot.cameras is not None:
            self.perceiver.check(robot.cameras)
            self.perceiver.check_arm(robot.robot_type, arm.workspace)

    def needs_images(self, results: Mapping[int, Sequence[CommandResult]]) -> NDArray[np.bool_]:
        """Return in which simulations it is about to look at something, shape (n,)."""
        return np.array([self._is_looking(sim, results.get(sim, ())) for sim in range(len(self._pending))], np.bool_)

    def _is_looking(self, sim: int, results: Sequence[CommandResult]) -> bool:
        sight, pending = self._sights.get(sim), self._pending[sim]
        if self.perceiver is None or sight is None or self._done[sim]:
            return False
        decides = pending is None or any(result.task_id == pending for result in results)
        return decides and (sight.objects is None or not sight.is_alive)

    def begin_episode(self, sim: int, seed: int, instruction: str) -> None:
        """Take the instruction of the episode, or that of the configuration."""
        super().begin_episode(sim, seed, self.settings.instruction or instruction)
        self._sights[sim] = _Sight()

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the plan of one simulation, how far it got, what was in the way, and what was seen first."""
        plan = super().plan(sim)
        if self.perceiver is not None:
            sight = self._sights[sim]
            plan |= {"seen": [_plain(one) for one in sight.first or ()], "chosen": sight.chosen}
        return plan

    def parameters(self) -> dict[str, Any]:
        """Return the parameters, and which weights it sees with."""
        values = super().parameters()
        if self.perceiver is not None:
            seen = self.perceiver
            values["perception"] |= {"path": seen.path, "weights": seen.weights, "dataset": seen.dataset}
        return values

    def decide(self, sim: int, seen: Observation, result: CommandResult | None) -> BrainCommand | None:
        """Return the next goal of the plan."""
        if self.perceiver is not None and result is not None:
            sight = self._sights[sim]
            if not result.success and self._work[sim].stage == "home":
                return self._give_up(
                    sim, f"the arm, which is in the way of another look, stays there: {result.message}"
                )
            # Also before another look, from home, whatever the camera has shown on the way.
            if result.success and (not sight.is_alive or sight.objects is None):
                image = seen.images[self.perceiver.camera][sim]
                if sight.image is not None and np.array_equal(sight.image, image):
                    camera = self.perceiver.camera
                    return self._give_up(sim, f"the camera {camera!r} shows the same image although the arm has moved")
                sight.image, sight.is_alive = image.copy(), True
        command = super().decide(sim, seen, result)
        plan = self._work[sim].plan
        if result is None and plan is not None:
            self._sights[sim].chosen = plan.target
        return command

    def _find_objects(self, robot: RobotFeatures) -> None:
        if self.perceiver is None:
            super()._find_objects(robot)

    def _objects(self, sim: int, seen: Observation) -> Sequence[SeenObject]:
        if self.perceiver is None:
            return super()._objects(sim, seen)
        sight = self._sights[sim]
        if sight.objects is None:
            found = self.perceiver.look(seen.images, sim)
            sight.objects = found
            sight.image, sight.is_alive = seen.images[self.perceiver.camera][sim].copy(), False
            if sight.first is None:
                sight.first = found
        return sight.objects

    def _make_plan(self, sim: int, objects: Sequence[SeenObject]) -> tuple[Plan, Sequence[SeenObject]]:
        """Return the plan for what is on the table, and what it takes the objects for.

        Who asks for a thing mostly knows that it is there. Where nothing fits, one object is taken for what it may be
        instead, the likeliest such change first.
        """
        instruction = self._work[sim].instruction
        try:
            plan = self._planner.plan(instruction, [scene_object(item) for item in objects])
        except NothingFitsError as error:
            for others in _otherwise(objects):
                with contextlib.suppress(InstructionError):
                    plan, objects = self._planner.plan(instruction, [scene_object(one) for one in others]), others
                    break
            else:
                raise error
        for one in objects:
            if one.index == plan.target and isinstance(one, PerceivedObject):
                self._check(one)
        if self.perceiver is not None:
            self._sights[sim].objects = objects
        return plan, objects

    def _check(self, target: PerceivedObject) -> None:
        options, name = self.settings.perception, scene_object(target).name
        if not target.certainty >= options.min_certainty:
            raise PerceptionError(
                f"It is not certain that there is a {name}: {100 * target.certainty:.0f} %, which is less than "
                f"perception.min_certainty ({100 * options.min_certainty:.0f} %)."
            )
        if not target.error_90_m <= options.max_error_m:
            raise PerceptionError(
                f"The position of the {name} is known to {1000 * target.error_90_m:.0f} mm only, which is more than "
                f"perception.max_error_m ({1000 * options.max_error_m:.0f} mm)."
            )

    def _choose_grasp(self, target: SeenObject, others: Sequence[SeenObject]) -> Grasp | None:
        if not isinstance(target, PerceivedObject):
            return super()._choose_grasp(target, others)
        grasp = super()._choose_grasp(target, others)
        # A side that leaves room for errors, unless other objects are in the way there.
        careful = plan_grasp(target, others, self._max_opening - 2 * _WIDER, handling=self._handling)
        if careful is not None and grasp is not None and careful.room >= min(grasp.room, _ROOM):
            grasp = careful
        if grasp is None:  # what seems a little too wide may fit after all
            length, width, height = target.size
            least = min(length, width)
            if least < self._max_opening + _WIDER:
                factor = (self._max_opening - _FIT) / least
                grasp = super()._choose_grasp(replace(target, size=(factor * length, factor * width, height)), others)
        # The fingers need more room beside what is not known exactly.
        if grasp is None:
            return None
        return grasp.opened(min(self._max_opening, grasp.opening + 2 * target.error_90_m), self._handling)

    def _is_held(self, opening: float, grasp: Grasp) -> bool:
        if self.perceiver is None:
            return super()._is_held(opening, grasp)
        # Its width is not known exactly: nothing is held if the fingers came to where they were sent.
        return opening >= max(0.0, grasp.width - SQUEEZE) + _CLOSED

    def _is_lifted(self, opening: float, grasp: Grasp, target: SeenObject) -> bool:
        if self.perceiver is None:
            return super()._is_lifted(opening, grasp, target)
        return self._is_held(opening, grasp)  # what slipped out is not between the fingers

    def _next(self, sim: int, target: SeenObject, objects: Sequence[SeenObject]) -> BrainCommand | None:
        work = self._work[sim]
        if self.perceiver is None or work.stage != "back":
            return super()._next(sim, target, objects)
        # The object may stand elsewhere now, and the arm hides it: go home, look again, and plan anew.
        work.stage, work.plan, work.grasp, self._sights[sim].objects = "home", None, None, None
        return BrainCommand(
            self.new_id(sim, "home"),
            joint_target=self._home,
            max_velocity=_HOME_SPEED,
            max_acceleration=_HOME_CHANGE,
        )


def _otherwise(objects: Sequence[SeenObject]) -> Iterator[Sequence[SeenObject]]:
    """Yield the objects with one of them as what it may be instead, the likeliest first."""
    changes = [
        (other.certainty / max(one.certainty, 1e-9), place, other)
        for place, one in enumerate(objects)
        if isinstance(one, PerceivedObject)
        for other in one.alternatives
    ]
    for _, place, other in sorted(changes, key=lambda change: -change[0]):
        yield [*objects[:place], other, *objects[place + 1 :]]


def _plain(one: PerceivedObject) -> dict[str, Any]:
    return {
        "name": scene_object(one).name,
        "position": [round(value, 5) for value in one.position],
        "yaw": round(one.yaw, 4),
        "size": [round(value, 4) for value in one.size],
        "error_50_m": round(one.error_50_m, 5),
        "error_90_m": round(one.error_90_m, 5),
        "certainty": round(one.certainty, 4),
    }
