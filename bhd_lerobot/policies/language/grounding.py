"""Which of the objects on the table a description fits."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bhd_lerobot.policies.language.lexicon import Relation
from bhd_lerobot.policies.manipulation.skills import SceneObject

# Estimates of what a person would still call different.
DISTANCE_MARGIN = 0.02  # [m]
SIZE_MARGIN = 0.1  # of the volume


@dataclass(frozen=True)
class Description:
    """What an instruction says about its object; None where it says nothing.

    Attributes:
        kind: ``"cup"`` or ``"box"``.
        colour: a name from `COLOURS`.
        relation: how it differs from the others that kind and colour fit.
    """

    kind: str | None = None
    colour: str | None = None
    relation: Relation | None = None


def _distance(thing: SceneObject) -> float:
    return math.hypot(thing.position[0], thing.position[1])


def _log_volume(thing: SceneObject) -> float:
    return math.fsum(math.log(v) for v in thing.size)


# What is highest for the object meant, and by how much it must be higher than for any other.
_MOST: dict[Relation, tuple[Callable[[SceneObject], float], float]] = {
    Relation.LEFT: (lambda thing: thing.position[1], DISTANCE_MARGIN),
    Relation.RIGHT: (lambda thing: -thing.position[1], DISTANCE_MARGIN),
    Relation.NEAREST: (lambda thing: -_distance(thing), DISTANCE_MARGIN),
    Relation.FARTHEST: (_distance, DISTANCE_MARGIN),
    Relation.BIGGEST: (_log_volume, math.log1p(SIZE_MARGIN)),
    Relation.SMALLEST: (lambda thing: -_log_volume(thing), math.log1p(SIZE_MARGIN)),
}


def fitting(description: Description, scene: Sequence[SceneObject]) -> list[SceneObject]:
    """Return the objects that a description fits, lowest index first.

    A relation compares those that kind and colour fit, and several remain where it does not decide by a margin. Where
    kind and colour fit one object only, it is on the left if it is in the robot's left half of the table.
    """
    found = [
        thing
        for thing in sorted(scene, key=lambda thing: thing.index)
        if description.kind in (None, thing.kind) and description.colour in (None, thing.colour)
    ]
    if description.relation is None or not found:
        return found
    measure, margin = _MOST[description.relation]
    if len(found) == 1 and description.relation in (Relation.LEFT, Relation.RIGHT):
        return found if measure(found[0]) > 0 else []
    most = max(measure(thing) for thing in found)
    return [thing for thing in found if measure(thing) >= most - margin]


def descriptions(scene: Sequence[SceneObject], target: SceneObject) -> list[Description]:
    """Return the descriptions with a kind that fit the target and nothing else, the plainest first."""
    relations: tuple[Relation | None, ...] = (None, *Relation)
    drafts = [Description(target.kind, colour, relation) for relation in relations for colour in (target.colour, None)]
    return [draft for draft in drafts if fitting(draft, scene) == [target]]
