"""Reads and checks `meta/info.json`, which any program may have written.

| key | valid | if it is left out |
|---|---|---|
| `codebase_version` | text that begins with v3. | refused |
| `fps` | a number above 0 | refused |
| `features` | an object: features by name, each with a `dtype` and a `shape` | refused |
| `total_episodes`, `total_frames`, `total_tasks` | whole numbers from 0 | refused: what is lost is not 0 |
| `chunks_size` | a whole number from 1 | 1000 |
| `data_files_size_in_mb`, `video_files_size_in_mb` | numbers above 0 | 100 and 200 |
| `data_path`, `video_path` | text, or null | LeRobot's layout |
| `robot_type` | text, or null | null |
| `splits` | an object | empty |

The defaults are those of LeRobot's `DatasetInfo`. Keys that are not listed stay as they are.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.places import wrong_info
from bhd_lerobot.errors import DatasetError

COUNTS = ("total_episodes", "total_frames", "total_tasks")
_REQUIRED = ("codebase_version", "features", "fps", *COUNTS)
_SIZES = ("data_files_size_in_mb", "video_files_size_in_mb")
_DEFAULTS: Mapping[str, Any] = {
    "chunks_size": layout.CHUNKS_SIZE,
    "data_files_size_in_mb": layout.DATA_FILES_SIZE_IN_MB,
    "video_files_size_in_mb": layout.VIDEO_FILES_SIZE_IN_MB,
    "data_path": layout.DATA_PATH,
    "video_path": layout.VIDEO_PATH,
    "robot_type": None,
}
_MOST = 2**31 - 1  # of sizes: what Arrow's lists can hold
_MOST_COUNTED = 2**63 - 1
_FPS = (1e-3, 1e6)  # [Hz] beyond them, times of frames are no numbers any more that a clock has
_DIMENSIONS = 5  # as many as LeRobot's columns have

CONVERT = "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=USER/NAME --root=FOLDER --push-to-hub=false"
"""Command that converts a dataset in a folder, or first downloads it to there."""


class InfoError(ValueError):
    """The content of an `info.json` is not valid. The message has neither the name of the file nor a remedy."""


def parse_object(content: bytes) -> dict[str, Any]:
    """Return a JSON object."""
    try:
        values = json.loads(content.decode("utf-8"))
        json.dumps(values, ensure_ascii=False).encode()  # half a surrogate pair is JSON, and no text
    except RecursionError:
        raise InfoError("it is nested too deeply to be read") from None
    except ValueError as error:
        raise InfoError(" ".join(str(error).split())) from error
    if not isinstance(values, dict):
        raise InfoError(f"it is {kind_of(values)} and no JSON object")
    return values


def read_info(path: Path, place: str | Path, *, features: bool = True, counts: bool = True) -> dict[str, Any]:
    """Return the content of an `info.json`, checked and with defaults; see `checked_info`."""
    return checked_info(parse_object(path.read_bytes()), place, features=features, counts=counts)


def checked_info(
    values: Mapping[str, Any], place: str | Path, *, features: bool = True, counts: bool = True
) -> dict[str, Any]:
    """Return the content of an `info.json` with defaults for what may be left out."""
    for key in _REQUIRED if counts else ("codebase_version", "features", "fps"):
        if key not in values:
            raise InfoError(f"it has no {key!r}")
    if not str(values["codebase_version"]).startswith("v3."):
        raise DatasetError(
            f"{place} has dataset format {shown(values['codebase_version'], quoted=False)}; this program reads v3.x. "
            f"LeRobot converts v2.1, and keeps the old one beside it: {CONVERT}"
        )
    info = {**_DEFAULTS, **values}
    info["splits"] = {} if values.get("splits") is None else values["splits"]
    for key, valid, is_valid in _RULES:
        if (counts or key not in COUNTS) and not is_valid(info[key]):
            hint = f"; left out, it is {_DEFAULTS[key]}" if _DEFAULTS.get(key) is not None else ""
            raise InfoError(f"{key!r} is {shown(info[key])}; it must be {valid}{hint}")
    if wrong := wrong_info(info):
        raise InfoError(wrong)
    if features:
        for key, feature in info["features"].items():
            if wrong := wrong_feature(feature):
                raise InfoError(f"the feature {shown(key)} {wrong}")
    return info


def wrong_feature(feature: object) -> str:
    """Return what is wrong with the description of a feature; empty if nothing is."""
    if not isinstance(feature, dict):
        return f"is {kind_of(feature)} and no JSON object"
    if not isinstance(feature.get("dtype"), str):
        return f"has {shown(feature.get('dtype'))} as dtype; it must be text"
    if wrong := _wrong_shape(feature["dtype"], feature.get("shape")):
        return wrong
    if not isinstance(feature.get("names"), list | dict | None):
        return f"has the names {shown(feature['names'])}; they must be a list, an object or null"
    if not isinstance(feature.get("info"), dict | None):
        return f"has {shown(feature['info'])} as info; it must be an object or null"
    return ""


def _wrong_shape(dtype: str, shape: object) -> str:
    if not isinstance(shape, list) or not 1 <= len(shape) <= _DIMENSIONS or not all(_is_whole(n, 1) for n in shape):
        return f"has the shape {shown(shape)}; it must be 1 to {_DIMENSIONS} whole numbers from 1"
    if dtype in ("video", "image") and len(shape) != 3:
        return f"has the shape {shown(shape)}; an image has 3 numbers"
    return ""


def shown(value: object, *, quoted: bool = True) -> str:
    """Return a value for a message, shortened."""
    try:
        text = repr(value) if quoted or not isinstance(value, str) else value
    except ValueError:  # Python writes no whole number of more than 4300 digits
        text = "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]} ... ({len(text)} characters)"


def kind_of(value: object) -> str:
    """Return what a JSON value is, as text."""
    names = {dict: "an object", list: "a list", str: "text", bool: "a truth value", int: "a number", float: "a number"}
    return names.get(type(value), "nothing")


def _is_whole(value: object, least: int, most: int = _MOST) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_number(value: object, least: float, most: float) -> bool:
    # A NaN is not between any two numbers.
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


_RULES = (
    ("features", "an object", lambda value: isinstance(value, dict)),
    ("fps", f"a number from {_FPS[0]:g} to {_FPS[1]:g} [frames/s]", lambda value: _is_number(value, *_FPS)),
    *((key, "a whole number from 0", lambda value: _is_whole(value, 0, _MOST_COUNTED)) for key in COUNTS),
    ("chunks_size", "a whole number from 1", lambda value: _is_whole(value, 1)),
    *((key, "a number above 0 [MB]", lambda value: _is_number(value, math.ulp(0.0), _MOST)) for key in _SIZES),
    *((key, "text or null", lambda value: isinstance(value, str | None)) for key in ("data_path", "video_path")),
    ("robot_type", "text or null", lambda value: isinstance(value, str | None)),
    ("splits", "an object", lambda value: isinstance(value, dict)),
)
