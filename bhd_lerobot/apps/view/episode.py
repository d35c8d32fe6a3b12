"""Everything that the page shows of one episode, as one piece of bytes."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from bhd_lerobot.apps.view.geometry import scene_of, views_of
from bhd_lerobot.apps.view.groups import names_of, numbers, sections
from bhd_lerobot.apps.view.marking import marks_of
from bhd_lerobot.apps.view.packing import pack
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.state import DatasetState, Row
from bhd_lerobot.tasks.task import Event

# Long, and of no use on the page, or shown in a form of its own.
_HIDDEN = (
    "initial_state",
    "scene",
    "timing",
    "plan",
    "goals",
    "results",
    "goal_frames",
    "interventions",
    "realtime",
)


def packed_episode(state: DatasetState, row: Row, table: pa.Table) -> bytes:
    """Return an episode's description and arrays, packed."""
    features = state.info["features"]
    columns = {key: values for key in table.column_names if (values := numbers(table[key], len(table))) is not None}
    widths = {key: values.shape[1] for key, values in columns.items()}
    robot = state.info.get("robot_type")
    views, places = views_of(robot, features, columns)
    header = {
        "index": row["episode_index"],
        "frames": row["length"],
        "fps": state.info["fps"],
        "instruction": ", ".join(row.get("tasks") or []),
        "metadata": _metadata(row),
        "timing": _json(row, "timing"),
        "plan": _json(row, "plan"),
        "goals": _goals(row),
        "marks": marks_of(state.root, row["episode_index"]),
        "names": {key: names_of(features[key], width) for key, width in widths.items()},
        "sections": sections(features, widths, robot),
        "bands": [*_bands(table, state.info["fps"]), *_modes(columns.get(keys.MODE))],
        "events": _events(columns.get(keys.EVENT)),
        "interventions": _interventions(row, columns.get(keys.EVENT)),
        "flags": {
            "limits": {str(limit.value): _words(limit.name) for limit in Limit if limit.value},
            "watchdog": {str(watchdog.value): _words(watchdog.name) for watchdog in Watchdog if watchdog.value},
        },
        "not_finite": {key: count for key, values in columns.items() if (count := _not_finite(values))},
        "views": views,
        "scene": scene_of(row),
        "videos": [_video(row, key) for key, feature in features.items() if feature["dtype"] in ("video", "image")],
    }
    return pack(header, {**columns, **{f"view.{name}": values for name, values in places.items()}})


def _not_finite(values: NDArray) -> int:
    return int(values.size - np.isfinite(values).sum()) if np.issubdtype(values.dtype, np.floating) else 0


def _bands(table: pa.Table, fps: float) -> list[dict[str, Any]]:
    """Return what was continuing, as text: for every text column its runs of equal text."""
    bands = []
    for key in table.column_names:
        if pa.types.is_string(table[key].type) or pa.types.is_large_string(table[key].type):
            bands.append({"name": key, "runs": _runs(table[key].to_pylist())})
    if keys.LANGUAGE in table.column_names and keys.SUBTASK not in table.column_names:
        bands.append({"name": keys.SUBTASK, "runs": _subtasks(table[keys.LANGUAGE][0].as_py(), len(table), fps)})
    return [band for band in bands if band["runs"]]


def _subtasks(rows: Any, frames: int, fps: float) -> list[list[Any]]:
    """Return the subtasks of LeRobot's language column, each from when it began to the next one."""
    try:
        begun = sorted((round(row["timestamp"] * fps), row["content"]) for row in rows if row["style"] == "subtask")
    except (KeyError, TypeError):
        return []
    ends = [frame for frame, _ in begun[1:]] + [frames]
    return [[frame, end, text] for (frame, text), end in zip(begun, ends, strict=True) if text and frame < end]


def _modes(modes: NDArray | None) -> list[dict[str, Any]]:
    """Return the cerebellum's modes as a band, if it was not in the same one all the time."""
    runs = _runs(modes[:, 0].tolist()) if modes is not None else []
    if len(runs) < 2:
        return []
    known = Mode._value2member_map_
    named = [[first, end, _words(Mode(value).name) if value in known else f"{value}"] for first, end, value in runs]
    return [{"name": "mode", "runs": named}]


def _runs(values: Iterable[Any]) -> list[list[Any]]:
    """Return segments of equal values as [first frame, frame after the last, value]; what is empty is left out."""
    runs: list[list[Any]] = []
    last: Any = None
    for frame, value in enumerate(values):
        if frame and value == last:
            runs[-1][1] = frame + 1
        else:
            runs.append([frame, frame + 1, value])
        last = value
    return [run for run in runs if run[2] not in (None, "")]


def _events(events: NDArray | None) -> list[list[Any]]:
    """Return [frame, name] of what happened, without interventions, which last."""
    if events is None:
        return []
    frames = np.flatnonzero((events[:, 0] != Event.NOTHING) & (events[:, 0] != Event.INTERVENTION))
    return [[int(frame), _event_name(int(events[frame, 0]))] for frame in frames]


def _event_name(value: int) -> str:
    return _words(Event(value).cause) if value in Event._value2member_map_ else f"event {value}"


def _interventions(row: Row, events: NDArray | None) -> list[list[Any]]:
    """Return [first frame, frame after the last, why] of every intervention."""
    stored = _json(row, "interventions")
    if isinstance(stored, list):
        return [[*span[:2], str(span[2]) if len(span) > 2 else ""] for span in stored if isinstance(span, list)]
    if events is None:
        return []
    return [[first, end, ""] for first, end, value in _runs((events[:, 0] == Event.INTERVENTION).tolist()) if value]


def _goals(row: Row) -> list[list[Any]]:
    """Return [frame, name, code, message] of the end of every goal."""
    results = _json(row, "results")
    if not isinstance(results, list):
        return []
    return [
        [result[0], result[1], result[3], result[4]]
        for result in results
        if isinstance(result, list) and len(result) == 5
    ]


def _video(row: Row, key: str) -> dict[str, Any]:
    """Return where in which file a camera's video of the episode lies."""
    place = f"videos/{key}"
    if f"{place}/chunk_index" not in row:
        return {"key": key, "kind": "image"}
    return {
        "key": key,
        "kind": "video",
        "chunk": row[f"{place}/chunk_index"],
        "file": row[f"{place}/file_index"],
        "from": row[f"{place}/from_timestamp"],
        "to": row[f"{place}/to_timestamp"],
    }


def _metadata(row: Row) -> dict[str, Any]:
    own = {key.removeprefix(PREFIX): value for key, value in row.items() if key.startswith(PREFIX)}
    return {key: value for key, value in own.items() if key not in _HIDDEN and not isinstance(value, Mapping)}


def _json(row: Row, name: str) -> Any:
    try:
        return json.loads(row[PREFIX + name])
    except (KeyError, TypeError, ValueError):
        return None


def _words(name: str | None) -> str:
    return (name or "").lower().replace("_", " ")
