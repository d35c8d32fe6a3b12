"""Scenes as JSON: what is stored with an episode, and what a running robot shows to those who watch it."""

import json
from dataclasses import asdict
from typing import Any

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.fetch_scene import FetchScene, Stand
from bhd_lerobot.bodies.tabletop import TableObject, TableScene, Variation
from bhd_lerobot.errors import DatasetError


def scene_to_json(scene: Any) -> str:
    """Return a scene as JSON: a replay needs no generator that may have changed since."""
    if isinstance(scene, Arena):
        return _json(_arena_fields(scene))
    if isinstance(scene, FetchScene):
        return _json(asdict(scene) | {"arena": _arena_fields(scene.arena)})
    return "null" if scene is None else _json(asdict(scene))


def scene_from_json(text: str) -> Any:
    """Return what `scene_to_json` wrote: an `Arena`, a `TableScene` or a `FetchScene`; None if it is not known."""
    try:
        scene = json.loads(text)
        if scene is None:
            return None
        if "shapes" in scene:
            return _arena(scene)
        objects = tuple(TableObject(**tuples(one)) for one in scene.pop("objects"))
        variation = Variation(**tuples(scene.pop("variation")))
        if "arena" in scene:
            arena, pick, place = (scene.pop(name) for name in ("arena", "pick", "place"))
            parts: dict[str, Any] = {"arena": _arena(arena), "pick": Stand(**pick), "place": Stand(**place)}
            return FetchScene(objects=objects, variation=variation, **parts, **tuples(scene))
        return TableScene(objects=objects, variation=variation, **tuples(scene))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"The recorded scene cannot be read: {error!r}.") from error


def _arena_fields(arena: Arena) -> dict[str, Any]:
    return {
        "name": arena.name,
        "extent": arena.extent,
        "start": arena.start,
        "shapes": [[s.kind, s.x, s.y, s.yaw, s.size_x, s.size_y, s.height] for s in arena.shapes],
        **({} if arena.goal is None else {"goal": arena.goal}),
        **({"report_seed": arena.report_seed} if arena.report_seed else {}),
    }


def _arena(fields: dict[str, Any]) -> Arena:
    shapes = tuple(Shape(*row) for row in fields["shapes"])
    goal = tuple(fields["goal"]) if "goal" in fields else None
    ends, start, seed = tuple(fields["extent"]), tuple(fields["start"]), int(fields.get("report_seed", 0))
    return Arena(fields["name"], shapes, ends, start, goal, report_seed=seed)


def tuples(fields: dict[str, Any]) -> dict[str, Any]:
    """Turn the lists of JSON into tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in fields.items()}


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
