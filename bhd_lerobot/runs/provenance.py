"""What is stored with every episode, so that it can be understood and run again."""

import json
from dataclasses import asdict
from importlib import metadata
from typing import Any

from bhd_lerobot import __version__
from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.runs.episode import Episode


def versions() -> dict[str, str]:
    """Return the versions of what decides an episode."""
    return {"bhd_lerobot": __version__, **{name: metadata.version(name) for name in ("lerobot", "mujoco", "numpy")}}


def episode_metadata(episode: Episode, *, split: str, task: dict[str, Any], brain: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata columns of an episode: plain values, structures as JSON."""
    outcome = episode.outcome
    return {
        "episode": episode.spec.index,
        # As text: a 63-bit number does not survive a reader that takes numbers for floats.
        "seed": str(episode.spec.seed),
        "split": split,
        "success": outcome.success,
        "outcome": outcome.event.cause,
        "score": outcome.score,
        **outcome.details,
        "task": _json(task),
        "brain": _json(brain),
        "scene": scene_to_json(episode.arena),
        "initial_state": episode.initial_state.tolist(),
        "timing": _json(asdict(episode.timing)),
        "versions": _json(versions()),
    }


def scene_to_json(arena: Arena) -> str:
    """Return an arena as JSON: a replay needs no generator that may have changed since."""
    return _json(
        {
            "name": arena.name,
            "extent": arena.extent,
            "start": arena.start,
            "shapes": [[s.kind, s.x, s.y, s.yaw, s.size_x, s.size_y, s.height] for s in arena.shapes],
        }
    )


def scene_from_json(text: str) -> Arena:
    """Return the arena that `scene_to_json` wrote.

    Raises:
        DatasetError: the text is no such arena.
    """
    try:
        scene = json.loads(text)
        shapes = tuple(Shape(*row) for row in scene["shapes"])
        return Arena(scene["name"], shapes, tuple(scene["extent"]), tuple(scene["start"]))
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"The recorded scene cannot be read: {error!r}.") from error


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
