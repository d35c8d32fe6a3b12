"""Pick up the object that the instruction names, and no other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, GripperSpec
from bhd_lerobot.bodies.tabletop import COLOURS, KINDS, MAX_OBJECTS, OBJECT_FIELDS, TableObject, TableScene
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf, Positive
from bhd_lerobot.tasks.sensing import Sensing, SensingConfig
from bhd_lerobot.tasks.task import ArmTask, Event, Outcome, TaskConfig
from bhd_lerobot.tasks.variation import RandomisationConfig, draw_object_changes, draw_variation

# Where objects stand, in the base frame [m]: what a tool that points down reaches with room to spare.
_APART = 0.05  # [m] free space between the circles around two objects: an open finger fits between them
_LIFTED, _FALLEN = 0.05, 0.015  # [m] above and below which an object counts as in the gripper, and as back on the table
_STRAY = 0.03  # [m] another object than the target that is lifted this far was picked up, not brushed
_TRIES = 1000

ENVIRONMENT = tuple(f"object_{number}_{name}" for number in range(MAX_OBJECTS) for name in OBJECT_FIELDS)

INSTRUCTIONS = {
    "en": ("pick up the {}", "grab the {}", "lift the {}", "take the {}", "please pick up the {}"),
    "zh": ("拿起{}", "抓住{}", "请把桌上的{}拿起来"),
}
HELD_OUT_INSTRUCTIONS = {
    "en": (
        "could you lift the {} please",
        "raise the {} from the table",
        "robot, pick the {} up",
        "grasp the {} on the table",
        "hey, can you take the {}",
    ),
    "zh": ("能不能帮我拿起桌上的{}", "请抓起那个{}", "麻烦你把{}举起来"),
}
"""Other ways to ask: what learns to read from `INSTRUCTIONS` has seen none of them."""
HELD_OUT_NAMES = (("red", "cup"), ("blue", "box"), ("yellow", "cup"), ("purple", "box"))
"""Colour and kind that are left out together where `names` is `known`; each of the words occurs with others."""
_ZH = {
    **{"red": "红色", "green": "绿色", "blue": "蓝色", "yellow": "黄色"},
    **{"orange": "橙色", "purple": "紫色", "white": "白色", "black": "黑色"},
    **{"cup": "杯子", "box": "盒子"},
}


@TaskConfig.register_subclass("pick")
@dataclass
class PickConfig(TaskConfig):
    """What the pick task asks for.

    Attributes:
        duration_s: longest duration of an episode [s].
        lift_m: height above its start that the object must be lifted to [m].
        hold_s: time that it must be held there [s].
        min_objects: smallest number of objects on the table.
        max_objects: largest number of objects on the table.
        language: language of the instructions.
        wording: how it is asked: ``"known"``, or ``"held_out"`` for other sentences.
        names: colours and kinds of the objects: ``"any"``; ``"known"``, which leaves four pairs of them out; or
            ``"held_out"``, where it is asked for one of these four.
        objects: ``"known"``; or ``"unseen"``: smaller and larger than those, of another style and of other shades.
        order: of the objects in what the task senses: ``"target"``: the target first, then the nearest to it; or
            ``"random"``, where only the column `target` tells which it is.
        swap: ask for another object of the same scene; two or more must be on the table.
        randomisation: how much one episode's world differs from the next.
        sensing: what is wrong with what the task senses of the objects.
    """

    duration_s: Positive = 20.0
    lift_m: Positive = 0.1
    hold_s: Positive = 1.0
    min_objects: int = 1
    max_objects: int = MAX_OBJECTS
    language: Annotated[str, OneOf((*INSTRUCTIONS, "any"))] = "en"
    wording: Annotated[str, OneOf(("known", "held_out"))] = "known"
    names: Annotated[str, OneOf(("any", "known", "held_out"))] = "any"
    objects: Annotated[str, OneOf(("known", "unseen"))] = "known"
    order: Annotated[str, OneOf(("target", "random"))] = "target"
    swap: bool = False
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
    sensing: SensingConfig = field(default_factory=SensingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.min_objects <= self.max_objects <= MAX_OBJECTS:
            raise ConfigError(
                f"task.min_objects is {self.min_objects} and task.max_objects is {self.max_objects}; "
                f"they must be between 1 and {MAX_OBJECTS}, in this order."
            )
        if self.swap and self.min_objects < 2:
            raise ConfigError(
                f"task.swap is true and task.min_objects is {self.min_objects}; to ask for another object there must "
                "be two. Set --task.min_objects=2."
            )
        if self.swap and self.names == "held_out":
            raise ConfigError(
                "task.swap is true and task.names is 'held_out': one object of a table has such a name, and it would "
                "not be the one that is asked for. Leave one of them out."
            )


class PickTask(ArmTask):
    """The pick task for n simulations.

    Success: the object that the instruction names, and no other, lifted by `lift_m` and held for `hold_s`. Failures:
    `collision` (the arm touches the table or itself, or a link other than the gripper an object), `wrong_object`
    (another object was picked up), `dropped` (the right one was, and fell), `unreachable` (it was pushed out of reach)
    and `timeout`. Score: the greatest height of the object as a share of `lift_m`, at most 0.9; 1 for a success. The
    reward of a frame is what it adds to the score.
    """

    name = "pick"
    needs = (Arm, GripperSpec)
    never = (Event.STUCK,)
    environment_names = ENVIRONMENT

    def __init__(self, config: PickConfig, n: int, fps: int, body: Body | None = None) -> None:
        super().__init__(config, n, fps, body)
        self._hold = self.in_frames(config.hold_s)
        self._target = np.zeros(n, np.int64)
        self._present = np.zeros((n, MAX_OBJECTS), np.bool_)
        self._start = np.zeros((n, MAX_OBJECTS))  # height of the objects' centres at the start [m]
        self._fixed = np.zeros((n, MAX_OBJECTS, len(OBJECT_FIELDS)))
        self._camera_error = np.zeros((n, 1, 3))
        self._sensing = Sensing(config.sensing, n, fps, slice(3, 6), absent=_NOTHING)
        self._best, self._height = np.zeros(n), np.zeros(n)
        self._held = np.zeros(n, np.int64)

    # --- scenes ------------------------------------------------------------------------------------------------------

    def sample(self, seed: int) -> TableScene:
        """Return the objects, the start and the instruction of the episode with this seed."""
        config = self.config
        rng = np.random.default_rng(seed)
        count = int(rng.integers(config.min_objects, config.max_objects + 1))
        chosen = _draw_names(config.names, count, rng)
        objects: list[TableObject] = []
        while len(objects) < count:
            objects = _draw_objects(config, self.arm, chosen, rng)
        target = 0 if config.names == "held_out" else int(rng.integers(count))
        objects = _target_first(objects, (target + config.swap) % count)
        languages = tuple(INSTRUCTIONS) if config.language == "any" else (config.language,)
        language = languages[int(rng.integers(len(languages)))]
        phrases = (INSTRUCTIONS if config.wording == "known" else HELD_OUT_INSTRUCTIONS)[language]
        phrase = phrases[int(rng.integers(len(phrases)))]
        name = objects[0].name
        if language == "zh":
            name = _ZH[objects[0].colour] + _ZH[objects[0].kind]
        variation = draw_variation(config.randomisation, rng)
        report_seed = config.sensing.draw_seed(rng)
        places = [int(place) for place in rng.permutation(count)] if config.order == "random" else range(count)
        return TableScene(
            name="pick",
            objects=tuple(objects[place] for place in places),
            posture=self.arm.home,
            target_object=places.index(0),
            instruction=phrase.format(name),
            variation=variation,
            report_seed=report_seed,
        )

    def instruction(self, scene: TableScene) -> str:
        """Return what a person would ask for."""
        return scene.instruction

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[TableScene]) -> None:
        """Start episodes in some simulations."""
        super().begin(ids, scenes)
        for sim, scene in zip(ids, scenes, strict=True):
            if scene.target_object is None:
                raise ConfigError(f"The scene {scene.name!r} names no object to pick up.")
            self._target[sim] = scene.target_object
            self._sensing.begin(sim, scene.report_seed)
            self._camera_error[sim] = scene.variation.camera_error
            self._present[sim] = np.arange(MAX_OBJECTS) < len(scene.objects)
            self._fixed[sim], self._start[sim] = 0.0, 0.0
            self._fixed[sim, :, 6] = 1.0
            for number, one in enumerate(scene.objects):
                self._start[sim, number] = one.height / 2
                colour = np.clip(np.array(COLOURS[one.colour]) + one.shade, 0.0, 1.0)
                is_target, is_box = number == scene.target_object, one.kind == "box"
                self._fixed[sim, number, :3] = 1.0, is_target, is_box
                self._fixed[sim, number, 10:] = 2 * one.size_x, 2 * one.size_y, one.height, *colour
        self._best[ids] = self._height[ids] = 0.0
        self._held[ids] = 0

    def environment_state(self, truth: ArmTruth) -> NDArray[np.float64]:
        """Return what is on the table, as a camera sees it: 16 numbers for each place of an object, shape (n, 80).

        Unless `config.order` is `random`, the first is the target; the others follow, at the start the nearest to it
        first. Of each: whether there is one, whether it is the target, whether it is a box; its pose in the base frame
        (x, y, z [m], quaternion wxyz); length, width and height [m]; red, green and blue. Zeros, and the identity, for
        places without one. `config.sensing` states what is wrong with it.
        """
        state = self._fixed.copy()
        state[self._present, 3:10] = truth.object_poses[self._present]
        state[:, :, 3:6] += self._camera_error * self._present[:, :, None]
        return self._sensing.sense(state, self.frame).reshape(len(state), -1)

    # --- judging -----------------------------------------------------------------------------------------------------

    def judge(self, truth: ArmTruth, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return reward and event of the frame that just ended, each of shape (n,)."""
        config, sims, target = self.config, self._sims, self._target
        lift = truth.object_poses[:, :, 2] - self._start
        lift *= self._present
        height = lift[sims, target]
        lift[sims, target] = 0.0  # from here on that of the others
        gripped = truth.fingers_on_object[sims, target]
        up = (height >= config.lift_m) & gripped
        np.copyto(self._held, (self._held + 1) * up, where=running)
        np.copyto(self._height, height, where=running)
        best = np.maximum(self._best, height)
        reward = (self._share(best) - self._share(self._best)) * running
        before = self._best.copy()
        np.copyto(self._best, best, where=running)
        at = truth.object_poses[sims, target]
        event = self.count_frame(running)
        # What must not happen counts also in the last frame of a success: the later of these takes the earlier's place.
        for name, happened in (
            (Event.UNREACHABLE, np.hypot(at[:, 0], at[:, 1]) > self.arm.workspace.reach),
            (Event.DROPPED, (self._best >= _LIFTED) & (height < _FALLEN) & ~gripped),
            (Event.SUCCESS, self._held >= self._hold),
            (Event.WRONG_OBJECT, (lift > _STRAY).any(axis=1)),
            (Event.COLLISION, truth.arm_on_table | truth.self_contact | truth.arm_on_object),
        ):
            if np.count_nonzero(happened):
                event[running & happened] = name
        success = event == Event.SUCCESS
        if np.count_nonzero(success):
            reward = np.where(success, 1.0 - self._share(before), reward)
        return reward, event

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended."""
        success = event == Event.SUCCESS
        return Outcome(
            success=success,
            event=event,
            score=1.0 if success else float(self._share(self._best)[sim]),
            details={"lifted_m": float(self._best[sim]), "objects": float(self._present[sim].sum())},
        )

    def _share(self, height: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.9 * np.minimum(np.maximum(height, 0.0) / self.config.lift_m, 1.0)


_NOTHING = np.array([float(name == "qw") for name in OBJECT_FIELDS])  # zeros, and the identity


def _target_first(objects: Sequence[TableObject], target: int) -> list[TableObject]:
    """Return the target, then the others, the nearest to it first.

    A network then finds what it has to grasp, and what stands in the way of that, always in the same inputs. The order
    reports nothing that the environment state does not report anyway.
    """
    at = objects[target]
    others = [one for number, one in enumerate(objects) if number != target]
    return [at, *sorted(others, key=lambda one: math.hypot(one.x - at.x, one.y - at.y))]


def _draw_names(which: str, count: int, rng: np.random.Generator) -> list[tuple[str, str]]:
    """Return colour and kind of the objects, no two alike, so that they name one; a held-out one is the first."""
    names: list[tuple[str, str]] = [(colour, kind) for colour in COLOURS for kind in KINDS]
    first: list[tuple[str, str]] = []
    if which == "known":
        names = [name for name in names if name not in HELD_OUT_NAMES]
    elif which == "held_out":
        first = [HELD_OUT_NAMES[int(rng.integers(len(HELD_OUT_NAMES)))]]
        names.remove(first[0])
    return first + [names[index] for index in rng.choice(len(names), count - len(first), replace=False)]


_KNOWN = {"cup": ((0.050, 0.068), (0.050, 0.068), (0.07, 0.12)), "box": ((0.045, 0.090), (0.035, 0.065), (0.05, 0.10))}
"""Ranges of length, width and height [m]. One side of each fits between the fingers, also when it is made larger."""
_UNSEEN = {
    "cup": (((0.036, 0.044), (0.036, 0.044), (0.04, 0.06)), ((0.074, 0.076), (0.074, 0.076), (0.135, 0.15))),
    "box": (((0.030, 0.040), (0.024, 0.031), (0.03, 0.044)), ((0.100, 0.130), (0.066, 0.074), (0.112, 0.13))),
}
"""Small ones and large ones outside of what `_KNOWN` and its randomisation reach."""
_OTHER_SHADE = 0.11  # added to or taken from red, green and blue; more than the randomisation's `colour`


def _draw_objects(
    task: PickConfig, arm: Arm, names: Sequence[tuple[str, str]], rng: np.random.Generator
) -> list[TableObject]:
    """Return objects of these colours and kinds that stand apart; fewer if the last found no place."""
    gripper, handling = arm.gripper, arm.workspace.handling
    assert gripper is not None
    objects: list[TableObject] = []
    unseen = task.objects == "unseen"
    for colour, kind in names:
        change = draw_object_changes(task.randomisation, rng)
        ranges = _KNOWN[kind]
        if unseen:
            ranges = _UNSEEN[kind][int(rng.integers(2))]
            change |= {"size": (1.0, 1.0, 1.0), "shade": _other_shade(colour, rng), "style": "other", "marks": ()}
        length = handling.scale * rng.uniform(*ranges[0])
        width = length if kind == "cup" else handling.scale * rng.uniform(*ranges[1])
        height = handling.scale * rng.uniform(*ranges[2])
        factor = change["size"]
        size_x = length / 2 * factor[0]
        size_y = min(width / 2 * factor[0 if kind == "cup" else 1], gripper.widest / 2)
        size_x = size_y if kind == "cup" else size_x
        place = _draw_place(math.hypot(size_x, size_y) if kind == "box" else size_x, arm, objects, rng)
        if place is None:
            break
        objects.append(
            TableObject(
                kind=kind,  # type: ignore[arg-type]
                colour=colour,
                size_x=float(size_x),
                size_y=float(size_y),
                height=float(height * factor[2]),
                x=float(place[0]),
                y=float(place[1]),
                yaw=float(rng.uniform(-math.pi, math.pi)),
                mass=float(rng.uniform(0.08, 0.30) * change["mass"] * handling.scale**2),
                friction=float(0.9 * change["friction"]),
                shade=change["shade"],
                style=change["style"],
                marks=change["marks"],
            )
        )
    return objects


def _other_shade(colour: str, rng: np.random.Generator) -> tuple[float, ...]:
    """Return what makes a shade that the randomisation does not reach, and that still has the colour's name."""
    own = np.array(COLOURS[colour])
    while True:
        shade = rng.choice((-_OTHER_SHADE, _OTHER_SHADE), 3)
        seen = np.clip(own + shade, 0.0, 1.0)
        if min(COLOURS, key=lambda name: float(np.linalg.norm(seen - COLOURS[name]))) == colour:
            return tuple(shade.tolist())


def _draw_place(
    radius: float, arm: Arm, objects: Sequence[TableObject], rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """Return a place for an object of this radius, apart from the others; None if there seems to be none."""
    for _ in range(_TRIES):
        place = rng.uniform(*arm.workspace.table)
        for item in objects:
            other = math.hypot(item.size_x, item.size_y) if item.kind == "box" else item.size_x
            if (
                math.hypot(place[0] - item.x, place[1] - item.y)
                < radius + other + _APART * arm.workspace.handling.scale
            ):
                break
        else:
            return np.asarray(place)
    return None
