"""Left, right, near, far, big and small: among which objects they choose, and when they do not decide."""

import math
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.tabletop import KINDS
from bhd_lerobot.policies.language.grounding import DISTANCE_MARGIN, SIZE_MARGIN, Description, descriptions, fitting
from bhd_lerobot.policies.language.lexicon import Relation
from bhd_lerobot.policies.manipulation.skills import SceneObject
from tests.cases import each_case
from tests.policies.language.test_instruction import scenes, thing

SIDES = (Relation.LEFT, Relation.RIGHT)
MOST: dict[Relation, Callable[[SceneObject], float]] = {
    Relation.LEFT: lambda o: o.position[1],
    Relation.RIGHT: lambda o: -o.position[1],
    Relation.NEAREST: lambda o: -math.dist((0, 0), o.position[:2]),
    Relation.FARTHEST: lambda o: math.dist((0, 0), o.position[:2]),
    Relation.BIGGEST: lambda o: math.prod(o.size),
    Relation.SMALLEST: lambda o: -math.prod(o.size),
}


@given(scenes(smallest=0), st.sampled_from(Relation), st.sampled_from([None, *KINDS]))
def test_a_relation_chooses_the_most_extreme_of_those_that_fit_without_it(scene, relation, kind):
    without = fitting(Description(kind), scene)
    found = fitting(Description(kind, None, relation), scene)
    assert all(each in without for each in found)
    if len(without) > 1 or (without and relation not in SIDES):
        assert max(without, key=MOST[relation]) in found


@given(scenes(smallest=0))
def test_mirroring_the_table_swaps_left_and_right_and_nothing_else(scene: list[SceneObject]) -> None:
    swap = {Relation.LEFT: Relation.RIGHT, Relation.RIGHT: Relation.LEFT}
    mirrored = [
        SceneObject(o.index, o.kind, o.colour, (o.position[0], -o.position[1], o.position[2]), o.size) for o in scene
    ]
    for relation in Relation:
        before = fitting(Description(relation=relation), scene)
        after = fitting(Description(relation=swap.get(relation, relation)), mirrored)
        assert [o.index for o in before] == [o.index for o in after]


@each_case(
    ("measure", "relation", "further"),
    [
        ("y", Relation.LEFT, 1),
        ("y", Relation.RIGHT, 0),
        ("x", Relation.FARTHEST, 1),
        ("x", Relation.NEAREST, 0),
        ("edge", Relation.BIGGEST, 1),
        ("edge", Relation.SMALLEST, 0),
    ],
)
@each_case(("factor", "decided"), [(0.0, False), (0.99, False), (1.01, True)])
def test_a_difference_counts_from_the_margin_on(measure, relation, further, factor, decided):
    change = {
        "x": 0.5 + factor * DISTANCE_MARGIN,
        "y": factor * DISTANCE_MARGIN,
        "edge": 0.05 * (1 + factor * SIZE_MARGIN) ** (1 / 3),
    }
    found = fitting(
        Description(relation=relation), [thing(0, "red cup"), thing(1, "red cup", **{measure: change[measure]})]
    )
    assert [o.index for o in found] == ([further] if decided else [0, 1])


def test_an_only_object_is_not_on_the_other_side() -> None:
    for y, expected in ((0.1, [1, 0]), (-0.1, [0, 1]), (0.0, [0, 0])):
        assert [len(fitting(Description("cup", None, side), [thing(0, "red cup", y=y)])) for side in SIDES] == expected


@given(scenes(smallest=0))
def test_descriptions_fit_their_target_only_and_begin_with_the_plainest(scene: list[SceneObject]) -> None:
    for target in scene:
        made = descriptions(scene, target)
        assert all(fitting(what, scene) == [target] for what in made)
        namesakes = [o for o in scene if o.name == target.name]
        if len(namesakes) == 1:
            assert made[0] == Description(target.kind, target.colour)
