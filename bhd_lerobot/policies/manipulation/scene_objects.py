"""What a pick task's environment state tells, as a planner wants to hear it."""

from bhd_lerobot.bodies.tabletop import COLOURS
from bhd_lerobot.policies.manipulation.grasp import SeenObject
from bhd_lerobot.policies.manipulation.skills import SceneObject


def scene_object(seen: SeenObject) -> SceneObject:
    """Return an object under the name of the colour that its own is nearest to."""
    colour = min(COLOURS, key=lambda name: sum((a - b) ** 2 for a, b in zip(COLOURS[name], seen.colour, strict=True)))
    return SceneObject(seen.index, seen.kind, colour, seen.position, seen.size)
