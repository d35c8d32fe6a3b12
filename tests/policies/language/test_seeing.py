"""The language brain that sees for itself: what it acts on, what it does not, and what it says when it cannot see."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import COLOURS, TableObject
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.errors import ConfigError, InstructionError, PerceptionError
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.policies.language.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.perception.perceiver import PerceivedObject, PerceptionOptions
from tests.cases import each_case
from tests.policies.arm_desk import BOX, CUP, OBSERVED, Bench


def seen(thing: TableObject, index: int, *, off: float = 0.0, error: float = 0.005, certainty: float = 0.95) -> Any:
    """Return how a camera shows an object, `off` beside where it is [m]."""
    return PerceivedObject(
        index=index,
        kind=thing.kind,
        position=(thing.x + off, thing.y, thing.height / 2),
        yaw=thing.yaw,
        size=(2 * thing.size_x, 2 * thing.size_y, thing.height),
        colour=COLOURS[thing.colour],
        target=False,
        error_50_m=error / 2,
        error_90_m=error,
        certainty=certainty,
    )


class Eyes:
    """Sees what a test says; every look may show something else."""

    camera = "scene"
    path, weights, dataset = "run/checkpoints/000001", "sha256:0", {"repo_id": "test"}

    def __init__(self, *looks: Any) -> None:
        self.looks, self.count = list(looks), 0

    def look(self, images: dict[str, np.ndarray], sim: int) -> list[PerceivedObject]:
        assert images[self.camera].shape == (1, 8, 8, 3)
        shown = self.looks[min(self.count, len(self.looks) - 1)]
        self.count += 1
        if isinstance(shown, Exception):
            raise shown
        return list(shown)


class Forbidden:
    """True poses, which nothing may read: whoever takes the trouble to look whether they are there fails, too."""

    def __getattribute__(self, name: str) -> Any:
        raise AssertionError(f"privileged state was read: {name}")

    def _read(self, *_: object) -> Any:
        raise AssertionError("privileged state was read")

    __getitem__ = __len__ = __iter__ = __bool__ = __array__ = __eq__ = _read  # type: ignore[assignment]
    __hash__ = None  # type: ignore[assignment]


class Table(Bench):
    """One arm, its brain, and a camera. Reading what the task tells fails."""

    def __init__(self, *looks: Any, instruction: str = "pick up the red cup", frozen: bool = False, **options: Any):
        brain = LanguageBrain(LanguageBrainConfig(perception=PerceptionOptions(**options)))
        self.eyes = brain.perceiver = Eyes(*looks)  # type: ignore[assignment]
        super().__init__(brain, np.zeros((1, 0)), ())
        self.begin([instruction])
        assert brain.uses_images
        assert not brain.uses_privileged_state
        self.opening, self.images_wanted = MAX_OPENING, []
        self.freezes_after = 1 if frozen else None
        self._random = np.random.default_rng(0)
        self._image = self._random.integers(0, 255, (1, 8, 8, 3), np.uint8)

    def look(self, results: Any = None, running: Any = None) -> dict[int, BrainCommand]:
        """Let the brain act; images are there if it asked for them."""
        wanted = bool(self.brain.needs_images(results or {})[0])
        if wanted and (self.freezes_after is None or sum(self.images_wanted) < self.freezes_after):
            self._image = self._random.integers(0, 255, (1, 8, 8, 3), np.uint8)
        self.images_wanted.append(wanted)
        self.state[:, 1] = self.opening
        truth: Any = Forbidden()
        images = {"scene": self._image} if wanted else {}
        return self.show(Observation(OBSERVED, self.state, images, truth, results or {}))

    def frame(self) -> BrainCommand | None:
        return self.look().get(0)

    def grasp(self, opening: float) -> None:
        """Go down and close on what has this width [m]."""
        for _ in range(3):
            self.end() if self.given[0] else self.frame()
        self.opening = opening

    @property
    def problem(self) -> str:
        return str(self.brain.plan(0)["problem"])


BOTH = (seen(CUP, 0), seen(BOX, 1))


@each_case(
    ("instruction", "meant"), [("pick up the red cup", CUP), ("拿起蓝色盒子", BOX), ("take the thing on the left", BOX)]
)
def test_it_goes_where_it_sees_what_is_meant_and_needs_nothing_that_the_task_tells(instruction, meant):
    table = Table([seen(CUP, 0, off=0.01), seen(BOX, 1, off=0.01)], instruction=instruction)
    goal = table.frame()
    assert goal is not None
    assert goal.target_pose is not None
    assert goal.target_pose.position[:2] == pytest.approx((meant.x + 0.01, meant.y))
    table.opening = 2 * meant.size_y
    while table.end() is not None:
        pass
    assert table.steps() == ["above", "down", "close", "lift"]
    assert table.eyes.count == 1
    assert table.brain.parameters()["perception"]["weights"] == "sha256:0"
    assert "weights" not in LanguageBrain().parameters()["perception"]
    plan = table.brain.plan(0)
    assert plan["seen"][plan["chosen"]]["name"] == meant.name


def test_it_asks_for_images_only_while_it_looks_and_until_the_camera_has_shown_that_it_lives() -> None:
    table = Table(BOTH)
    table.frame()
    table.frame()  # the first goal is under way
    table.opening = 0.06
    while table.end() is not None:
        pass
    assert table.images_wanted == [True, False, True, False, False, False]


def test_the_fingers_open_wider_for_what_is_known_less_exactly() -> None:
    openings = []
    for error in (0.0, 0.004, 0.025):
        table = Table([seen(CUP, 0, error=error)])
        table.frame()
        openings.append(table.given[0][0].gripper)
    assert openings[1] == pytest.approx(min(MAX_OPENING, openings[0] + 0.008))
    assert openings[2] == MAX_OPENING


def test_it_takes_the_side_of_a_box_that_leaves_room_for_errors_unless_something_is_in_the_way() -> None:
    narrow, wide = 0.05, 0.074
    for yaw in np.linspace(-1.5, 1.5, 13):
        box = TableObject("box", "red", wide / 2, narrow / 2, 0.06, 0.5, 0.0, yaw=float(yaw))
        across = np.array(
            [-np.sin(yaw), np.cos(yaw)]
        )  # the direction in which the fingers stand beside the narrow side
        blocked = [
            TableObject("cup", "blue", 0.03, 0.03, 0.1, 0.5 + sign * 0.085 * across[0], sign * 0.085 * across[1])
            for sign in (-1, 1)
        ]
        for others, width in (([], narrow), (blocked, wide)):
            objects = [seen(thing, number) for number, thing in enumerate([box, *others])]
            table = Table(objects, instruction="pick up the red box")
            table.frame()
            table.end()
            closing = table.end()
            assert closing is not None
            assert closing.gripper == pytest.approx(width - 0.03)


@pytest.mark.law
@each_case(
    ("looks", "options", "problem"),
    [
        ([PerceptionError("the camera 'scene' shows nothing")], {}, "the camera 'scene' shows nothing"),
        ([()], {}, "Nothing on the table is 'red cup'"),
        ([(seen(BOX, 0),)], {}, "Nothing on the table is 'red cup'. On the table: blue box"),
        ([(seen(CUP, 0), seen(CUP, 1, off=0.2))], {}, "fits 2 objects"),
        ([(seen(CUP, 0, certainty=0.4),)], {"min_certainty": 0.5}, "not certain that there is a red cup: 40 %"),
        ([(seen(CUP, 0, error=0.04),)], {}, "known to 40 mm only"),
        ([(seen(CUP, 0, error=0.01),)], {"max_error_m": 0.005}, "known to 10 mm only"),
    ],
)
def test_what_it_does_not_see_or_not_surely_enough_it_does_not_touch(looks, options, problem):
    table = Table(*looks, **options)
    assert table.brain.needs_images({}).tolist() == [True]
    assert table.frame() is None
    assert table.brain.needs_images({}).tolist() == [False]  # it gave up
    assert problem in table.problem
    assert table.brain.subtasks()[0].startswith("cannot: ")
    assert table.brain.plan(0)["chosen"] is None


def test_with_a_camera_that_does_not_change_while_the_arm_moves_it_does_not_go_down() -> None:
    table = Table(BOTH, frozen=True)
    assert table.frame() is not None
    assert table.end() is None
    assert table.steps() == ["above"]
    assert "shows the same image although the arm has moved" in table.problem


@each_case(("shown", "last"), [(2, "home"), (3, "above")])
def test_a_camera_that_freezes_later_is_noticed_before_the_tool_goes_down_again(shown: int, last: str) -> None:
    """After the image above the object, or after that of the second look; what is grasped first is missed."""
    table = Table(BOTH, BOTH)
    table.freezes_after = shown
    table.grasp(0.0)
    while table.end() is not None:
        pass
    assert table.steps() == ["above", "down", "close", "back", "home", "above"][: 5 + (last == "above")]
    assert "shows the same image although the arm has moved" in table.problem


def test_an_arm_that_did_not_move_says_nothing_of_its_camera() -> None:
    table = Table(BOTH, frozen=True)
    table.frame()
    assert table.end(success=False, message="No posture reaches the pose.") is not None
    assert table.steps() == ["above", "back"]
    assert table.problem == "No posture reaches the pose."
    assert table.end() is None  # it has moved now, and still the image is the same
    assert "shows the same image although the arm has moved" in table.problem


def test_an_arm_that_does_not_get_out_of_the_way_is_not_looked_past() -> None:
    table = Table(BOTH, BOTH)
    table.grasp(0.0)
    table.end()
    table.end()
    assert table.steps()[-1] == "home"
    assert table.end(success=False, message="The path is blocked.") is None
    assert table.steps()[-1] == "home"
    assert table.problem.endswith("stays there: The path is blocked.")
    assert table.eyes.count == 1


@each_case("width", [0.012, 0.03, 0.06])
def test_fingers_that_close_on_nothing_hold_nothing_however_thin_the_object_is(width: float) -> None:
    thing = TableObject("box", "red", 0.04, width / 2, 0.03, 0.5, 0.0)
    for opening, then in ((0.0, "back"), (width, "lift")):
        table = Table([seen(thing, 0)], instruction="pick up the red box")
        table.grasp(max(opening, width - 0.03))
        table.end()
        assert table.steps()[-1] == then


def test_after_a_miss_it_goes_home_and_looks_again() -> None:
    """The object stands elsewhere the second time, and under another number."""
    table = Table(BOTH, (seen(BOX, 0), seen(CUP, 1, off=0.05)))
    table.grasp(0.0)  # closed on nothing
    assert table.end() is not None
    assert table.steps()[-1] == "back"
    home = table.end()
    assert home is not None
    assert home.joint_target == ur5().arm.home[:-1]
    again = table.end()
    assert again is not None
    assert again.target_pose is not None
    assert again.target_pose.position[:2] == pytest.approx((CUP.x + 0.05, CUP.y))
    assert table.eyes.count == 2
    table.end()
    table.opening = 2 * CUP.size_x
    table.end()
    table.end()
    assert table.steps()[-1] == "lift"
    plan = table.brain.plan(0)
    assert plan["chosen"] == 0, "what is evaluated is the first look"
    assert plan["seen"][0]["position"][0] == pytest.approx(CUP.x)


def test_what_slips_out_while_it_is_lifted_is_noticed_by_the_fingers() -> None:
    table = Table(BOTH)
    table.grasp(2 * CUP.size_x)
    table.end()
    table.opening = 0.0
    table.end()
    assert table.steps()[-2:] == ["lift", "back"]
    assert table.problem == "the object was not lifted"


def test_what_was_taken_for_something_else_is_what_was_asked_for_if_it_may_be_that() -> None:
    """A red cup is asked for, and seen are a box and a cup that may be red ones: the likelier of the two it is."""
    red = TableObject("box", "red", BOX.size_x, BOX.size_y, BOX.height, BOX.x, BOX.y)
    unlikely = dataclasses.replace(seen(red, 0, certainty=0.8), alternatives=(seen(CUP, 0, off=0.3, certainty=0.1),))
    orange = TableObject("cup", "orange", CUP.size_x, CUP.size_y, CUP.height, CUP.x, CUP.y)
    likely = dataclasses.replace(seen(orange, 1, certainty=0.5), alternatives=(seen(CUP, 1, certainty=0.3),))
    table = Table([unlikely, likely])
    goal = table.frame()
    assert goal is not None
    assert goal.target_pose is not None
    assert goal.target_pose.position[:2] == pytest.approx((CUP.x, CUP.y))
    assert table.brain.subtasks()[0] == "move the gripper to the red cup"
    assert Table([unlikely, likely], instruction="pick up the green cup").frame() is None


def test_what_fits_twice_or_is_refused_is_not_taken_for_something_else() -> None:
    """Only of what is not there it is thought that it may have been mistaken for another thing."""
    orange = TableObject("cup", "orange", CUP.size_x, CUP.size_y, CUP.height, CUP.x, CUP.y)
    perhaps = (seen(orange, 1, certainty=0.45),)
    twice = [seen(CUP, 0), dataclasses.replace(seen(CUP, 1, off=0.2, certainty=0.5), alternatives=perhaps)]
    table = Table(twice)
    assert table.frame() is None
    assert "fits 2 objects" in table.problem
    asked: list[int] = []

    class Refusing:
        def plan(self, instruction: str, scene: Any) -> Any:
            asked.append(len(scene))
            raise InstructionError("I would rather not.")

    table = Table(twice)
    table.brain._planner = Refusing()
    assert table.frame() is None
    assert (asked, table.problem) == ([2], "I would rather not.")


def test_options_that_cannot_be_honoured() -> None:
    with pytest.raises(ConfigError, match=r"camera_error_m is \[0.01, 0, 0\].*does not use these poses"):
        LanguageBrainConfig(perception=PerceptionOptions("somewhere"), camera_error_m=[0.01, 0, 0])
