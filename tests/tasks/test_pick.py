"""The pick task: tables that can be cleared, instructions that name one object, and a judge on made-up truth."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.tabletop import COLOURS, KINDS, MAX_OBJECTS, OBJECT_FIELDS, TableObject, TableScene
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import parse as parse_configuration
from bhd_lerobot.policies.language.instruction import parse
from bhd_lerobot.policies.manipulation.grasp import plan_grasp, read_objects
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.tasks.pick import HELD_OUT_INSTRUCTIONS, HELD_OUT_NAMES, INSTRUCTIONS, PickConfig, PickTask
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.tasks.variation import RandomisationConfig
from tests.cases import each_case
from tests.tasks.support import Judged

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "record"

FPS = 10
HANDLING = ur5().need(Arm).workspace.handling
WILD = RandomisationConfig(enabled=True)
SCENE = TableScene(
    name="pick",
    objects=(
        TableObject("cup", "red", 0.03, 0.03, 0.10, 0.5, 0.0),
        TableObject("box", "blue", 0.04, 0.03, 0.06, 0.4, 0.2, yaw=0.7, shade=(0.05, -0.2, 0.5)),
        TableObject("box", "green", 0.03, 0.02, 0.08, 0.6, -0.2),
    ),
    posture=ur5().arm.home,
    target_object=1,
    instruction="pick up the blue box",
)
TARGET, OTHER = 1, 0


def truth_of(scenes: list[TableScene], **flags: bool) -> ArmTruth:
    """Return the truth when everything stands where the scenes put it and nothing is touched."""
    n = len(scenes)
    poses = np.zeros((n, MAX_OBJECTS, 7))
    poses[..., 3] = 1.0
    for sim, scene in enumerate(scenes):
        for number, one in enumerate(scene.objects):
            poses[sim, number] = (one.x, one.y, one.height / 2, math.cos(one.yaw / 2), 0, 0, math.sin(one.yaw / 2))
    return ArmTruth(
        tool_pose=np.tile([0.5, 0.1, 0.3, 0, 1, 0, 0], (n, 1)),
        object_poses=poses,
        opening=np.full(n, MAX_OPENING),
        fingers_on_object=np.zeros((n, MAX_OBJECTS), np.bool_),
        **{name: np.full(n, flags.get(name, False)) for name in ("arm_on_table", "arm_on_object", "self_contact")},
    )


class Run(Judged):
    def __init__(self, config: PickConfig | None = None, n: int = 1) -> None:
        super().__init__(PickTask(config or PickConfig(), n, FPS), [SCENE] * n)

    def frame(
        self,
        lift: float | np.ndarray = 0.0,
        gripped: bool = True,
        other: float = 0.0,
        at: tuple[float, float] | None = None,
        **flags: bool,
    ) -> np.ndarray:
        """Judge a frame with the target and another object lifted by so much [m]."""
        truth = truth_of(self.scenes, **flags)
        truth.object_poses[:, TARGET, 2] += lift
        truth.object_poses[:, OTHER, 2] += other
        if at is not None:
            truth.object_poses[:, TARGET, :2] = at
        truth.fingers_on_object[:, TARGET] = gripped
        return self.judge(truth)


def corners(one: TableObject) -> np.ndarray:
    """Return points on the outline of an object, shape (k, 2)."""
    if one.kind == "cup":
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        points = one.size_x * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        side = np.linspace(-1, 1, 15)
        edges = [np.stack([side, np.full(15, s)], 1) for s in (-1, 1)]
        edges += [np.stack([np.full(15, s), side], 1) for s in (-1, 1)]
        points = np.concatenate(edges) * (one.size_x, one.size_y)
        c, s = math.cos(one.yaw), math.sin(one.yaw)
        points = points @ np.array([[c, s], [-s, c]])
    return points + np.array([one.x, one.y])


HUGE = RandomisationConfig(enabled=True, size=0.6)
NARROW_TABLE = (0.2, -0.4, 0.7, 0.5)
_ARM = ur5().arm
NARROW = replace(
    ur5(),
    arm=replace(
        _ARM,
        gripper=replace(_ARM.gripper, widest=0.06),
        workspace=replace(_ARM.workspace, table=(NARROW_TABLE[:2], NARROW_TABLE[2:])),
    ),
)


@each_case("randomisation", [RandomisationConfig(), WILD, HUGE])
@each_case(
    ("body", "table", "fits"), [(ur5(), (0.35, -0.3, 0.65, 0.3), MAX_OPENING - 0.008), (NARROW, NARROW_TABLE, 0.06)]
)
def test_objects_stand_apart_in_reach_differ_and_fit_the_gripper(body, table, fits, randomisation):
    task = PickTask(PickConfig(randomisation=randomisation), 1, FPS, body)
    counts = set()
    for seed in range(150):
        scene = task.sample(seed)
        counts.add(len(scene.objects))
        assert len({one.name for one in scene.objects}) == len(scene.objects)
        for one in scene.objects:
            assert table[0] <= one.x <= table[2]
            assert table[1] <= one.y <= table[3]
            assert 2 * min(one.size_x, one.size_y) <= fits
            if one.kind == "cup":
                assert one.size_x == one.size_y
        for one, two in itertools.combinations(scene.objects, 2):
            apart = np.linalg.norm(corners(one)[:, None] - corners(two)[None], axis=2).min()
            assert apart >= 0.05 - 1e-9
    assert counts == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("randomisation", [RandomisationConfig(), WILD], ids=["nominal", "randomised"])
def test_every_object_can_be_grasped_without_touching_another(randomisation: RandomisationConfig) -> None:
    task = PickTask(PickConfig(randomisation=randomisation), 1, FPS)
    for seed in range(80):
        task.begin(np.array([0]), [task.sample(seed)])
        state = task.environment_state(truth_of([task.sample(seed)]))
        objects = read_objects(state.reshape(MAX_OBJECTS, len(OBJECT_FIELDS)))
        for one in objects:
            grasp = plan_grasp(
                one, [other for other in objects if other.index != one.index], MAX_OPENING, handling=HANDLING
            )
            assert grasp is not None
            assert grasp.room > 0


@each_case(("least", "most"), [(1, 1), (3, 3), (2, 5)])
def test_the_number_of_objects_is_that_of_the_configuration(least: int, most: int) -> None:
    task = PickTask(PickConfig(min_objects=least, max_objects=most), 1, FPS)
    assert {len(task.sample(seed).objects) for seed in range(60)} == set(range(least, most + 1))


def test_a_smaller_table_leaves_nothing_of_a_larger_one() -> None:
    used, fresh = PickTask(PickConfig(), 1, FPS), PickTask(PickConfig(), 1, FPS)
    small = TableScene("pick", SCENE.objects[2:], SCENE.posture, target_object=0)
    used.begin(np.array([0]), [SCENE])
    for task in (used, fresh):
        task.begin(np.array([0]), [small])
    assert np.array_equal(used.environment_state(truth_of([small])), fresh.environment_state(truth_of([small])))


def test_what_was_up_and_is_down_again_was_dropped() -> None:
    run = Run()
    for lift in (0.0, 0.03, 0.051, 0.03, 0.016):
        run.frame(lift)
        assert run.running[0]  # on its way down it may be carried
    run.frame(0.014)
    assert run.running[0]  # put down, but not let go
    run.frame(0.014, gripped=False)
    assert run.events[0] == Event.DROPPED
    assert run.outcome().score == pytest.approx(0.9 * 0.51)
    assert not run.outcome().success


def test_what_was_hardly_lifted_may_be_put_down_to_try_again() -> None:
    run = Run()
    for lift in (0.0, 0.049, 0.0, 0.049, 0.0):
        run.frame(lift)
    assert run.events[0] == Event.NOTHING


def test_to_lift_another_object_is_wrong_whatever_else_happens_and_to_brush_it_is_not() -> None:
    run = Run()
    run.frame(0.0, other=0.029)
    assert run.running[0]
    run.frame(0.0, other=0.031)
    assert run.events[0] == Event.WRONG_OBJECT
    both = Run(PickConfig(hold_s=0.1))
    both.frame(0.2, other=0.2)
    assert both.events[0] == Event.WRONG_OBJECT
    assert not both.outcome().success


@each_case("at", [(0.81, 0.0), (0.58, 0.58), (-0.4, -0.7)])
def test_pushed_out_of_reach_is_unreachable(at: tuple[float, float]) -> None:
    run = Run()
    run.frame(at=(0.79, 0.0))
    assert run.running[0]
    run.frame(at=at)
    assert run.events[0] == Event.UNREACHABLE


@given(st.lists(st.tuples(st.floats(-0.02, 0.2), st.booleans(), st.integers(0, 30)), max_size=40))
def test_the_rewards_sum_to_the_score_and_never_take_away(frames: list[tuple[float, bool, int]]) -> None:
    run = Run(PickConfig(hold_s=0.3, duration_s=3.0))
    for lift, gripped, luck in frames:
        reward = run.frame(lift, gripped, other=0.1 if luck == 0 else 0.0, arm_on_table=luck == 1)
        assert reward[0] >= 0
    assert run.rewards[0] == pytest.approx(run.outcome().score, abs=1e-12)
    assert 0 <= run.outcome().score <= 1
    assert (run.outcome().score == 1) == run.outcome().success


def test_places_without_an_object_lie_at_the_origin_and_are_nobody_s_business() -> None:
    run = Run()
    truth = truth_of(run.scenes)
    truth.object_poses[:, 3:, 2] = 5.0
    _, event = run.task.judge(truth, run.running)
    assert event[0] == Event.NOTHING


def scenes(count: int = 60, **options) -> list[TableScene]:
    task = PickTask(PickConfig(**options), 1, FPS)
    return [task.sample(seed) for seed in range(count)]


def test_another_order_is_the_same_table_and_the_target_is_anywhere() -> None:
    usual, other = scenes(), scenes(order="random")
    for one, shuffled in zip(usual, other, strict=True):
        assert set(one.objects) == set(shuffled.objects)
        assert one.objects[one.target_object] == shuffled.objects[shuffled.target_object]
        assert (one.instruction, one.variation) == (shuffled.instruction, shuffled.variation)
    assert {scene.target_object for scene in usual} == {0}
    assert {scene.target_object for scene in other} == set(range(5))


def test_a_swap_asks_for_another_object_of_the_same_table() -> None:
    for one, other in zip(scenes(min_objects=2), scenes(min_objects=2, swap=True), strict=True):
        assert set(one.objects) == set(other.objects)
        before, after = one.objects[one.target_object], other.objects[other.target_object]
        assert before.name != after.name
        assert before.name in one.instruction
        assert after.name in other.instruction
    with pytest.raises(ConfigError, match=r"task.swap is true and task.min_objects is 1"):
        PickConfig(swap=True)
    with pytest.raises(ConfigError, match=r"task.swap is true and task.names is 'held_out'"):
        PickConfig(swap=True, names="held_out", min_objects=2)


def test_names_that_are_held_out_occur_there_only_and_each_of_their_words_elsewhere() -> None:
    known = {(one.colour, one.kind) for scene in scenes(200, names="known") for one in scene.objects}
    assert not known & set(HELD_OUT_NAMES)
    assert len(known) == 12
    assert {colour for colour, _ in known} >= {colour for colour, _ in HELD_OUT_NAMES}
    asked = [scene.objects[scene.target_object] for scene in scenes(200, names="held_out")]
    assert {(one.colour, one.kind) for one in asked} == set(HELD_OUT_NAMES)


@pytest.mark.parametrize("recipe", ["ur5_look", "ur5_pick_pixels", "ur5_pick_pixels_dagger"])
def test_what_is_learned_from_leaves_out_what_is_held_out(recipe: str) -> None:
    task = parse_configuration(RecordConfig, [f"--config_path={CONFIGS}/{recipe}.yaml"]).task
    assert isinstance(task, PickConfig)
    assert (task.names, task.wording, task.objects, task.swap) == ("known", "known", "known", False)


def test_sentences_that_are_held_out_are_others_and_the_rules_understand_them() -> None:
    known = {scene.instruction.replace(scene.objects[0].name, "{}") for scene in scenes(200)}
    held_out = scenes(200, wording="held_out", language="any")
    assert not known & {scene.instruction.replace(scene.objects[0].name, "{}") for scene in held_out}
    assert not set(INSTRUCTIONS["zh"]) & set(HELD_OUT_INSTRUCTIONS["zh"])
    for scene in held_out:
        request = parse(scene.instruction)
        assert (request.what.colour, request.what.kind) == (scene.objects[0].colour, scene.objects[0].kind)


def test_objects_that_were_not_seen_are_of_no_size_style_or_shade_that_was() -> None:
    varied = RandomisationConfig(enabled=True, plain=0.3, across=0.1, marked=0.3)
    known = [one for scene in scenes(400, randomisation=varied) for one in scene.objects]
    unseen = [one for scene in scenes(100, randomisation=varied, objects="unseen") for one in scene.objects]
    styles = [one.style for one in known]
    for style, share in {"usual": 0.3, "plain": 0.3, "across": 0.1, "marked": 0.3}.items():
        assert abs(styles.count(style) / len(styles) - share) < 0.06
    assert {*styles} == {"usual", "plain", "across", "marked"}
    assert {one.style for one in unseen} == {"other"}
    for kind in KINDS:
        heights = [one.height for one in known if one.kind == kind]
        assert all(not min(heights) <= one.height <= max(heights) for one in unseen if one.kind == kind)
    shades = max(abs(value) for one in known for value in one.shade)
    assert all(min(map(abs, one.shade)) > shades for one in unseen)
    for one in unseen:
        assert 2 * min(one.size_x, one.size_y) <= 0.076, "it fits between the fingers"
        seen = np.clip(np.add(COLOURS[one.colour], one.shade), 0, 1)
        assert min(COLOURS, key=lambda name: math.dist(seen, COLOURS[name])) == one.colour
