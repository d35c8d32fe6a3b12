"""What a remote `meta/info.json` says, as far as a transfer believes it. Anybody may have written it."""

import json
from typing import Any

from bhd_lerobot.data import layout
from bhd_lerobot.data.places import wrong_info
from bhd_lerobot.errors import DatasetError

_COUNTS = ("total_episodes", "total_frames", "total_tasks")


def parse_info(content: bytes | None, place: str) -> dict[str, Any]:
    """Return the content of a `meta/info.json` that has the shape of one.

    What is said by it is of the right kind then: features by name, each with a `dtype`; a number of frames a second;
    whole numbers of episodes, frames and tasks.

    Args:
        content: the file; None if it is not there any more.
        place: whose it is, for messages.

    Raises:
        DatasetError: it is none, or that of another format; says what is wrong.
    """
    if content is None:
        raise DatasetError(f"{place} is no LeRobot dataset any more: its {layout.INFO} is gone.")
    try:
        info = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise DatasetError(f"{place} is no LeRobot dataset: its {layout.INFO} cannot be read ({reason}).") from error
    if not isinstance(info, dict) or "codebase_version" not in info:
        found = "has no 'codebase_version'" if isinstance(info, dict) else f"is {_kind(info)} and no JSON object"
        raise DatasetError(f"{place} is no LeRobot dataset: its {layout.INFO} {found}.")
    if not str(info["codebase_version"]).startswith("v3."):
        raise DatasetError(
            f"{place} has dataset format {info['codebase_version']}; this program reads v3.x. Convert it with LeRobot."
        )
    if wrong := _wrong(info):
        raise DatasetError(f"{place} is no LeRobot dataset: in its {layout.INFO}, {wrong}.")
    return info


def _wrong(info: dict[str, Any]) -> str:
    """Return what has another shape than it has in every dataset; nothing if all is well."""
    features = info.get("features")
    if not isinstance(features, dict):
        return f"'features' is {_kind(features)} and no JSON object"
    for key, feature in features.items():
        if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
            return f"the feature {key!r} has no 'dtype'"
    fps = info.get("fps")
    if not isinstance(fps, int | float) or isinstance(fps, bool) or not 0 < fps < float("inf"):
        return f"'fps' is {fps!r} and no number of frames a second"
    for key in _COUNTS:
        count = info.get(key)
        if not isinstance(count, int) or isinstance(count, bool) or count < 0:
            return f"{key!r} is {count!r} and no whole number"
    for key in ("data_path", "video_path", "robot_type"):
        if not isinstance(info.get(key), str | None):
            return f"{key!r} is {_kind(info[key])} and no text"
    return wrong_info(info)


def _kind(value: object) -> str:
    names = {dict: "an object", list: "a list", str: "text", bool: "a truth value", int: "a number", float: "a number"}
    return names.get(type(value), "nothing")
