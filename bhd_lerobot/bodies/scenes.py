"""Scenes as JSON: what is stored with an episode, and what a running robot shows to those who watch it."""

import json
from dataclasses import asdict
from typing import Any

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableObject, TableScene, Variation
from bhd_lerobot.errors import DatasetError


def scene_to_json(scene: Any) -> str:
    """Return a scene as JSON: a replay needs no generator that may have changed since."""
    if isinstance(scene, Arena):
        return _json(
            {
                "name": scene.name,
                "extent": scene.extent,
                "start": scene.start,
                "shapes": [[s.kind, s.x, s.y, s.yaw, s.size_x, s.size_y, s.height] for s in scene.shapes],
                **({} if scene.goal is None else {"goal": scene.goal}),
                **({"report_seed": scene.report_seed} if scene.report_seed else {}),
            }
        )
    return "null" if scene is None else _json(asdict(scene))


def scene_from_json(text: str) -> Any:
    """Return the scene that `scene_to_json` wrote: an `Arena` or a `TableScene`; None if it is not known."""
    try:
        scene = json.loads(text)
        if scene is None:
            return None
        if "shapes" in scene:
            shapes = tuple(Shape(*row) for row in scene["shapes"])
            goal = tuple(scene["goal"]) if "goal" in scene else None
            ends, start, seed = tuple(scene["extent"]), tuple(scene["start"]), int(scene.get("report_seed", 0))
            return Arena(scene["name"], shapes, ends, start, goal, report_seed=seed)
        objects = tuple(TableObject(**tuples(one)) for one in scene.pop("objects"))
        variation = Variation(**tuples(scene.pop("variation")))
        return TableScene(objects=objects, variation=variation, **tuples(scene))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"The recorded scene cannot be read: {error!r}.") from error


def tuples(fields: dict[str, Any]) -> dict[str, Any]:
    """Turn the lists of JSON into tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in fields.items()}


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
