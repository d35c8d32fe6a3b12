"""Instructions in two languages: what is understood is meant, and what could be misread is refused."""

import itertools
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.bodies.tabletop import COLOURS, KINDS
from bhd_lerobot.errors import ConfigError, InstructionError
from bhd_lerobot.policies.language.grounding import DISTANCE_MARGIN, Description
from bhd_lerobot.policies.language.instruction import (
    MAX_LENGTH,
    RulePlanner,
    chinese,
    describe,
    instructions_for,
    parse,
)
from bhd_lerobot.policies.manipulation.skills import Plan, Planner, SceneObject, Skill
from tests.cases import each_case

COMMA, STOP, ASK, SHOUT = "\uff0c", "\u3002", "\uff1f", "\uff01"  # full width


def thing(index: int, name: str, x: float = 0.5, y: float = 0.0, edge: float = 0.05) -> SceneObject:
    colour, kind = name.split()
    return SceneObject(index, kind, colour, (x, y, edge / 2), (edge, edge, edge))


RED_CUP, BIG_BOX, SMALL_BOX, GREEN_BOX = 0, 1, 2, 3
SCENE = [
    thing(RED_CUP, "red cup", x=0.5, y=0.2, edge=0.07),
    thing(BIG_BOX, "blue box", x=0.4, y=-0.2, edge=0.06),
    thing(SMALL_BOX, "blue box", x=0.7, y=0.3, edge=0.04),
    thing(GREEN_BOX, "green box", x=0.6, y=0.1, edge=0.05),
]


def plan(instruction: Any, scene: list[SceneObject] | None = None) -> Plan:
    planner: Planner = RulePlanner()
    return planner.plan(instruction, SCENE if scene is None else scene)


def refusal(instruction: Any, scene: list[SceneObject] | None = None) -> str:
    with pytest.raises(InstructionError) as caught:
        plan(instruction, scene)
    return str(caught.value)


def coordinate() -> st.SearchStrategy[float]:
    return st.integers(-20, 20).map(lambda step: step * 0.025)


@st.composite
def scenes(draw: Callable[..., Any], smallest: int = 1) -> list[SceneObject]:
    indices = draw(st.lists(st.integers(0, 99), min_size=smallest, max_size=5, unique=True))
    kinds, colours = st.sampled_from(KINDS), st.sampled_from(list(COLOURS)[:3])
    names = [f"{draw(colours)} {draw(kinds)}" for _ in indices]
    edge = st.sampled_from((0.03, 0.04, 0.041, 0.06))
    return [
        thing(i, name, draw(coordinate()) + 0.5, draw(coordinate()), draw(edge))
        for i, name in zip(indices, names, strict=True)
    ]


HOLD, GIVE = Skill.HOLD, Skill.HAND_OVER


@pytest.mark.law
@each_case(
    ("instruction", "target", "last"),
    [
        ("pick up the red cup", RED_CUP, HOLD),
        ("hand me the red cup", RED_CUP, GIVE),
        ("hand over the cup", RED_CUP, GIVE),
        ("please bring me the cup", RED_CUP, GIVE),
        ("grab the box on the left side of the table", SMALL_BOX, HOLD),
        ("take the leftmost block from the table", SMALL_BOX, HOLD),
        ("pick up the box to the left", SMALL_BOX, HOLD),
        ("hand me the box to your right", BIG_BOX, GIVE),
        ("bring the blue box to the left to me", SMALL_BOX, GIVE),
        ("lift the biggest blue box", BIG_BOX, HOLD),
        ("grasp the box nearest to you", BIG_BOX, HOLD),
        ("pick up the farthest thing", SMALL_BOX, HOLD),
        ("  PICK   up\tthe Red CUP!!! ", RED_CUP, HOLD),
        ("“Pick up the red cup.”", RED_CUP, HOLD),
        ("pick up the r\u200bed cup", RED_CUP, HOLD),
        ("请把桌上的红色杯子拿给我", RED_CUP, GIVE),
        ("把左边的杯子递给我", RED_CUP, GIVE),
        ("给我那个水杯", RED_CUP, GIVE),
        (f"不好意思{COMMA}红杯子递给我", RED_CUP, GIVE),
        ("拿红杯子给我", RED_CUP, GIVE),
        ("拿起绿色的盒子", GREEN_BOX, HOLD),
        ("抓住最大的蓝色方块", BIG_BOX, HOLD),
        ("拿起左边那个盒子", SMALL_BOX, HOLD),
        ("拿起蓝色的最右边的盒子", BIG_BOX, HOLD),
        ("拿起离你最近的盒子", BIG_BOX, HOLD),
        (f"你好{COMMA}请 把 红色的 杯子 递给我{COMMA}谢谢{SHOUT}", RED_CUP, GIVE),
        (f"拿起红色的杯子{STOP}", RED_CUP, HOLD),
    ],
)
def test_it_means_this_object_and_this_action(instruction: str, target: int, last: Skill) -> None:
    made = plan(instruction)
    assert (made.instruction, made.target) == (instruction, target)
    assert [step.skill for step in made.steps] == [Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT, last]
    assert {step.object for step in made.steps} == {target}


@settings(max_examples=40)
@given(scenes(), st.data())
def test_every_generated_instruction_means_its_target(scene: list[SceneObject], data: st.DataObject) -> None:
    target = data.draw(st.sampled_from(scene)).index
    shuffled = data.draw(st.permutations(scene))
    made = instructions_for(scene, target)
    assert len(set(made)) == len(made)
    for instruction in made:
        made_of_it = plan(instruction, scene)
        assert made_of_it.target == target
        assert plan(instruction, shuffled) == made_of_it
    assert instructions_for(shuffled, target) == made


@given(scenes(smallest=2), st.data())
def test_plans_and_messages_do_not_depend_on_the_order(scene: list[SceneObject], data: st.DataObject) -> None:
    instruction = data.draw(
        st.sampled_from(["grab the box", "拿起左边的杯子", "hand me the nearest thing", "take the red cup"])
    )

    def outcome(objects: list[SceneObject]) -> Plan | str:
        try:
            return plan(instruction, objects)
        except InstructionError as error:
            return str(error)

    assert len({outcome(data.draw(st.permutations(scene))) for _ in range(3)}) == 1


@pytest.mark.parametrize(("language", "words"), [("en", "the red cup"), ("zh", "红色杯子")])
def test_instructions_can_be_narrowed_to_a_language_and_a_goal(language: str, words: str) -> None:
    both = [instructions_for(SCENE, RED_CUP, language, goal) for goal in (HOLD, GIVE)]
    assert sum(both, ()) == instructions_for(SCENE, RED_CUP, language)
    for goal, made in zip((HOLD, GIVE), both, strict=True):
        assert words in made[0]
        assert all(plan(instruction).steps[-1].skill is goal for instruction in made)
        assert all(instruction.isascii() == (language == "en") for instruction in made)
    assert set(both[0]) < set(instructions_for(SCENE, RED_CUP))


def test_objects_that_no_words_distinguish_have_no_instruction() -> None:
    twins = [thing(0, "red cup"), thing(1, "red cup", y=DISTANCE_MARGIN / 2)]
    assert instructions_for(twins, 0) == ()
    assert "No known words distinguish them" in refusal("pick up the left cup", twins)


@each_case(
    ("arguments", "message"),
    [
        ((9,), r"target is 9; the scene has objects \[0, 1, 2, 3\]"),
        ((0, "fr"), "'fr'.*en, zh"),
        ((0, "en", "lift"), "hold"),
    ],
)
def test_impossible_requests_for_instructions_are_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        instructions_for(SCENE, *arguments)


@each_case(("colour", "kind"), list(itertools.product(COLOURS, KINDS)))
def test_every_colour_and_kind_has_words_in_both_languages(colour: str, kind: str) -> None:
    one = thing(0, f"{colour} {kind}")
    what = Description(kind, colour)
    for each in (f"pick up the {describe(one)}", f"拿起{chinese(one)}", f"拿起{chinese(one).replace('色', '')}"):
        assert parse(each).what == what
    assert describe(one) == f"{colour} {kind}"


@pytest.mark.law
@each_case(
    ("instruction", "message"),
    [
        ("not the red cup", "Negations are not known: 'not'"),
        ("don\u2019t pick up the red cup", 'Negations are not known: "don\'t"'),
        ("pick up anything but the red cup", "Negations"),
        ("不要拿起红色的杯子", "Negations are not known: '不要'"),
        ("别拿红色的杯子", "Negations are not known: '别'"),
        ("pick up the red and the blue cup", "Only one action with one object"),
        ("pick up the red cup or the green box", "Only one action with one object can be asked for, not with 'or'"),
        ("pick up both boxes", "not with 'both', 'boxes'"),
        ("pick up the red cup and give me the green box", "not with 'and'"),
        ("拿起两个盒子", "not with '两'"),
        ("pick up the red cup, the green box", "names more than one thing: 'cup', 'box'"),
        ("grab the red cup, lift the green box", "names more than one action: 'grab', 'lift'"),
        ("pick up the red, green box", "names more than one colour: 'red', 'green'"),
        ("take the big box on the left", "names more than one place or size: 'big', 'on the left'"),
        ("pick up the red cup/green box", "Unknown: '/'"),
        ("pick up the cup to the left of the box", "Unknown: 'of'"),
        ("take the red cup to the left", "'to the left' may be where it stands or where it is to go. Say 'on the …'"),
        ("bring the red cup to your left", "'to your left' may be where it stands or where it is to go"),
        ("hand over the box to the right", "'to the right' may be where it stands or where it is to go"),
        ("the red cup", "names no action. Known: pick up"),
        ("红色的杯子", "names no action. Known: 拿起"),
        ("pick up", "names no thing. Known: cup, box"),
        ("cup the red pick up", "order of its words is not known"),
        ("take the cup nearest to me", "is not understood"),  # where the person is, nobody knows
        ("put the red cup down", "Unknown: 'put', 'down'"),
        ("nimm die rote Tasse", "not understood"),
        ("赤いカップを取って", "not understood"),
        ("hand me the second biggest box", "Unknown colour or property 'second'"),
        ("拿起杯子里的东西", "Unknown: '里'"),
        ("pick up the pink cup", "Unknown colour or property 'pink'. Known: red, green, blue, yellow"),
        ("pick up the non-red cup", "Unknown colour or property 'non-red'"),
        ("pick up the re\u0338d cup", "Unknown"),
        ("hand me the spoon", "Unknown thing 'spoon'. Known: cup, box."),
        ("throw the red cup", "Unknown action 'throw'. Known: pick up, lift"),
        ("拿起大红色的杯子", "Unknown colour or property '大红色'. Known: 红色, 绿色"),
        ("给我红茶杯", "'红茶'"),
        ("", "The instruction is empty"),
        (None, "The instruction is None; it must be text"),
        (b"pick up the red cup", "it must be text"),
        ("pick up the red cup " * 20, f"has 400 characters; at most {MAX_LENGTH}"),
    ],
)
def test_what_could_be_misread_is_refused(instruction: Any, message: str) -> None:
    assert message in refusal(instruction)


def test_nothing_fits() -> None:
    assert refusal("pick up the yellow cup") == (
        "Nothing on the table is 'yellow cup'. On the table: red cup, blue box, blue box, green box."
    )
    assert refusal("拿起黄色的杯子") == (
        "Nothing on the table is '黄色杯子'. On the table: 红色杯子, 蓝色盒子, 蓝色盒子, 绿色盒子."
    )
    assert refusal("pick up the cup", []).endswith("On the table: (nothing).")


@each_case(("instruction", "count"), [("pick up the blue box", 2), ("把盒子递给我", 3), ("take the thing", 4)])
def test_an_ambiguous_instruction_is_answered_with_exact_ones(instruction: str, count: int) -> None:
    message = refusal(instruction)
    assert f"fits {count} objects: " in message
    advice = message.partition("Say one of: ")[2].rstrip(".").split(", ")
    targets = [plan(each.strip("'")).target for each in advice]
    assert len(set(targets)) == len(targets) == count
    goals = {plan(each.strip("'")).steps[-1].skill for each in advice}
    assert goals == {parse(instruction).goal}


@settings(max_examples=50)
@given(st.text(max_size=30))
def test_any_text_is_planned_or_refused(text: str) -> None:
    for instruction in (text, f"pick up the {text} cup", f"拿起{text}杯子"):
        try:
            plan(instruction)
        except InstructionError:
            continue


@given(st.sampled_from(["pick up the red cup", "把红色的杯子递给我"]), st.data())
def test_a_strange_letter_anywhere_is_never_overlooked(instruction: str, data: st.DataObject) -> None:
    place = data.draw(st.integers(0, len(instruction)))
    letter = data.draw(st.sampled_from("qж7&/~#猫"))
    refusal(instruction[:place] + letter + instruction[place:])


@pytest.mark.parametrize(
    ("words", "blank", "colour"),
    [
        (["please", "hand", "me", "the", "green", "box", "on", "the", "right"], " ", "green"),
        (list("请把右边的绿色盒子递给我"), "", "绿"),
    ],
)
def test_a_word_dropped_or_doubled_never_changes_the_target(words: list[str], blank: str, colour: str) -> None:
    scene = [*SCENE[:3], thing(GREEN_BOX, "green box", y=-0.1)]
    for place, word in enumerate(words):
        for changed in (words[:place] + words[place + 1 :], [*words[:place], word, *words[place:]]):
            try:
                made = plan(blank.join(changed), scene)
            except InstructionError:
                continue
            # Without its colour it means another box; nothing else may.
            assert made.target == GREEN_BOX or colour not in changed
