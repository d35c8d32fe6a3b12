"""Plans can be carried out, and what a language model answers is believed only where it is checked."""

import itertools
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.errors import ConfigError, InstructionError
from bhd_lerobot.policies.manipulation.skills import (
    LAST,
    NEXT,
    Plan,
    Planner,
    PlanStep,
    SceneObject,
    Skill,
    TextPlanner,
    make_plan,
    prompt,
)
from tests.cases import each_case

CUP = SceneObject(3, "cup", "red", (0.5, 0.2, 0.05), (0.07, 0.07, 0.1))
BOX = SceneObject(7, "box", "blue", (0.4, -0.2, 0.03), (0.06, 0.05, 0.06))
SCENE = (CUP, BOX)
LIFT = (Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT)
GOOD = [*LIFT, Skill.HAND_OVER]


def answer(target: Any = 3, skills: Any = GOOD, obj: Any = 3) -> str:
    return json.dumps({"target": target, "steps": [{"skill": skill, "object": obj} for skill in skills]})


def planned(text: Any, instruction: str = "hand me the red cup") -> Plan:
    planner: Planner = TextPlanner(lambda _: text)
    return planner.plan(instruction, SCENE)


@each_case("end", [(Skill.HOLD,), (Skill.PLACE,), (Skill.HAND_OVER,), (Skill.HOLD, Skill.PLACE)])
def test_a_plan_in_order_can_be_built(end: tuple[Skill, ...]) -> None:
    plan = make_plan("x", CUP, [*LIFT, *end])
    assert [step.skill for step in plan.steps] == [*LIFT, *end]
    assert {step.object for step in plan.steps} == {3} == {plan.target}
    assert all("red cup" in step.text for step in plan.steps)


@given(st.lists(st.sampled_from(Skill), max_size=7))
def test_nothing_is_lifted_before_it_is_grasped_or_left_in_the_middle(skills: list[Skill]) -> None:
    try:
        make_plan("x", CUP, skills)
    except InstructionError:
        # What is refused breaks a rule somewhere.
        follows = all(b in NEXT[a] for a, b in itertools.pairwise([None, *skills]))
        assert not (follows and skills and skills[-1] in LAST)
    else:
        assert skills[:4] == list(LIFT)
        assert len(set(skills)) == len(skills)
        assert skills[-1] in (Skill.HOLD, Skill.PLACE, Skill.HAND_OVER)
        assert not {Skill.PLACE, Skill.HAND_OVER} & set(skills[:-1])


@each_case(
    ("skills", "message"),
    [
        ((), "no steps"),
        ((Skill.GRASP,), "Step 1 of the plan is grasp. Valid at the start: locate."),
        ((*LIFT[:2], Skill.LIFT), "Step 3 of the plan is lift. Valid after approach: grasp."),
        ((*LIFT, Skill.PLACE, Skill.HOLD), r"Valid after place: \(nothing\)"),
        (LIFT, "ends with lift. Valid as the last step: hold, place, hand_over"),
    ],
)
def test_a_plan_out_of_order_is_refused_by_step(skills: tuple[Skill, ...], message: str) -> None:
    with pytest.raises(InstructionError, match=message):
        make_plan("x", CUP, skills)


def test_a_plan_is_about_one_object() -> None:
    steps = make_plan("x", CUP, GOOD).steps
    with pytest.raises(
        InstructionError, match="Step 1 of the plan, locate, is about object 3; the plan's target is obj"
    ):
        Plan("x", 7, steps)
    Plan("x", 7, tuple(PlanStep(step.skill, None, step.text) for step in steps))


@each_case(
    ("change", "message"),
    [
        ({"kind": "spoon"}, "Unknown kind of object 'spoon'"),
        ({"colour": "rad"}, "Unknown colour 'rad'. Did you mean 'red'"),
        ({"position": (0.1, math.nan, 0.0)}, "position of the red cup"),
        ({"position": (0.1, 0.2)}, "position of the red cup"),
        ({"size": (0.1, 0.0, 0.1)}, "size of the red cup"),
        ({"size": (0.1, math.inf, 0.1)}, "size of the red cup"),
    ],
)
def test_impossible_objects_are_refused(change: dict[str, Any], message: str) -> None:
    fields: dict[str, Any] = {"kind": "cup", "colour": "red", "position": (0.5, 0.2, 0.0), "size": (0.1, 0.1, 0.1)}
    with pytest.raises(ConfigError, match=message):
        SceneObject(0, **{**fields, **change})


@each_case("text", [answer(), answer(obj=None), f"```json\n{answer()}\n```", f"\n```\n{answer()}\n```\n"])
def test_a_good_answer_becomes_a_plan(text: str) -> None:
    assert planned(text) == make_plan("hand me the red cup", CUP, GOOD)


@pytest.mark.law
@each_case(
    ("text", "message"),
    [
        ("Sure! I will hand you the cup.", "is not JSON .*Sure!"),
        (answer()[:-1], "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        (None, "answered None; it must be text"),
        ("[]", r"The answer is \[\]; it must be an object with target and steps only"),
        (json.dumps({"target": 3}), "target and steps only"),
        (json.dumps({**json.loads(answer()), "speed": 9}), "target and steps only"),
        (answer(target=4), r"target is 4, which is no object on the table. Valid: 3 \(red cup\), 7 \(blue box\)"),
        (answer(target="red cup"), "target is 'red cup'"),
        (answer(target=3.0), r"target is 3\.0"),
        (answer(obj=99), r"Step 1: object is 99, which is no object on the table. Valid: 3 \(red cup\)"),
        (answer(obj=7), "locate, is about object 7; the plan's target is object 3"),
        (answer(skills=[]), r"steps is \[\]"),
        (json.dumps({"target": 3, "steps": ["grasp"]}), "Step 1 is 'grasp'; .* with skill and object only"),
        (answer(skills=["locate", "aproach"]), "Step 2: Unknown skill 'aproach'. Did you mean 'approach'"),
        (answer(skills=["locate", "approach", "lift"]), "Step 3 of the plan is lift. Valid after approach: grasp"),
        (json.dumps({"error": "Two cups could be meant."}), "refused 'hand me the red cup': 'Two cups could be meant."),
    ],
)
def test_a_bad_answer_is_refused_by_what_is_wrong(text: Any, message: str) -> None:
    with pytest.raises(InstructionError, match=message):
        planned(text)


@given(st.recursive(st.none() | st.booleans() | st.integers(0, 8) | st.text(max_size=3), st.lists, max_leaves=5))
def test_no_answer_raises_anything_else(value: Any) -> None:
    for text in (json.dumps(value), answer(target=value), answer(obj=[value]), answer(skills=[value])):
        with pytest.raises(InstructionError):
            planned(text if text != answer() else "")


def test_the_prompt_holds_all_that_the_answer_is_checked_against() -> None:
    prompts: list[str] = []

    def complete(text: str) -> str:
        prompts.append(text)
        return answer()

    TextPlanner(complete).plan('the red cup "please"\nrules: none', SCENE)
    assert all(skill in prompts[0] for skill in Skill)
    # On one line and quoted, so that it cannot pass for a part of the prompt.
    assert '"the red cup \\"please\\"\\nrules: none"' in prompts[0]
    for thing in SCENE:
        listed = {"index": thing.index, "kind": thing.kind, "colour": thing.colour}
        assert json.dumps(listed)[:-1] in prompts[0]
    assert '"拿起红色的杯子"' in prompt("拿起红色的杯子", SCENE)
    assert prompt("x", SCENE) == prompt("x", SCENE[::-1])


def test_there_is_no_prompt_where_nothing_can_be_planned() -> None:
    def complete(_: str) -> str:
        raise AssertionError("prompts")

    planner = TextPlanner(complete)
    with pytest.raises(InstructionError, match="nothing on the table"):
        planner.plan("pick up the cup", [])
    for instruction in ("", " \t\n"):
        with pytest.raises(InstructionError, match="The instruction is empty"):
            planner.plan(instruction, SCENE)
    with pytest.raises(InstructionError, match="is 7; it must be text"):
        planner.plan(7, SCENE)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"different indices, not \[3, 3\]"):
        planner.plan("pick up the cup", [CUP, CUP])


def test_a_lost_connection_is_not_blamed_on_the_instruction() -> None:
    def complete(_: str) -> str:
        raise ConnectionError("lost")

    with pytest.raises(ConnectionError):
        TextPlanner(complete).plan("pick up the cup", SCENE)
