"""Checks of the columns of a dataset's Parquet files, on which all readers rely.

Every function returns what is wrong, as text; an empty text if nothing is.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import types

from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES

COUNTERS = ("episode_index", "length", "dataset_from_index", "dataset_to_index")
_MOST = 2**31 - 1  # the highest number of a file or chunk
_TEXT: Sequence[Callable[[pa.DataType], bool]] = (types.is_string, types.is_large_string)
_NUMBER = (types.is_integer, types.is_floating)
_KINDS = {"float": _NUMBER, "int": _NUMBER, "uint": _NUMBER, "bool": (types.is_boolean,), "string": _TEXT}


def wrong_columns(schema: pa.Schema, features: Mapping[str, Mapping[str, Any]]) -> str:
    """Return in which way the columns of a data file contradict the features.

    Numbers may be of another width or kind than described, as after an edit with pandas: LeRobot casts them.
    """
    if twice := repeated(schema):
        return twice
    for key, feature in {**features, **DEFAULT_FEATURES}.items():
        if feature["dtype"] == "video":
            continue
        if key not in schema.names:
            return f"it has no column {key!r}"
        kind, shape = schema.field(key).type, tuple(feature["shape"])
        if not _is_like(kind, feature["dtype"], shape):
            return f"its column {key!r} is {kind}; {_described(feature)}"
        if key in DEFAULT_FEATURES and types.is_floating(kind) != (feature["dtype"] == "float32"):
            return f"its column {key!r} is {kind}; it must be {feature['dtype']}"
    return ""


def _described(feature: Mapping[str, Any]) -> str:
    return f"meta/info.json declares {feature['dtype']} of shape {list(feature['shape'])}"


def _is_like(kind: pa.DataType, dtype: str, shape: tuple[int, ...]) -> bool:
    family = _KINDS.get(dtype.rstrip("0123456789"))
    if family is None or dtype in ("image", "language"):
        return types.is_nested(kind) or dtype not in ("image", "language")  # another program's: it knows what it is
    if isinstance(kind, pa.ExtensionType):
        kind = kind.storage_type
    depth = 0
    while is_listed(kind):
        if types.is_fixed_size_list(kind) and depth < len(shape) and kind.list_size != shape[depth]:
            return False
        kind, depth = kind.value_type, depth + 1
    return depth == (0 if shape == (1,) else len(shape)) and any(is_one(kind) for is_one in family)


def repeated(schema: pa.Schema) -> str:
    """Return which name several columns have; no reader can distinguish them."""
    twice = next((name for name, count in Counter(schema.names).items() if count > 1), None)
    return "" if twice is None else f"it has more than one column {twice!r}"


def wrong_values(table: pa.Table) -> str:
    """Return which column of numbers lacks some, or has lists of several lengths, which are no array."""
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
        while isinstance(kind, pa.ExtensionType) or is_listed(kind):
            kind = kind.storage_type if isinstance(kind, pa.ExtensionType) else kind.value_type
        if not any(is_one(kind) for is_one in (*_NUMBER, types.is_boolean)):
            continue
        if wrong := next(filter(None, map(wrong_array, column.chunks)), ""):
            return f"in its column {name!r}, {wrong}"
    return ""


def wrong_array(array: pa.Array) -> str:
    """Return why numbers, or lists of them, are no array of numbers."""
    while True:
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        if array.null_count:
            return f"{array.null_count} of {len(array)} values are missing"
        if not is_listed(array.type):
            return ""
        if len(pc.unique(pc.list_value_length(array))) > 1:
            return "lists have several lengths"
        array = array.flatten()


def is_listed(kind: pa.DataType) -> bool:
    """Return whether a type is one of Arrow's lists."""
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def wrong_row(row: Mapping[str, Any], cameras: Sequence[str]) -> str:
    """Return what is wrong with the row of an episode in `meta/episodes`."""
    tasks = row.get("tasks")
    if not isinstance(tasks, list) or not all(isinstance(task, str) for task in tasks):
        return "has no list of instructions"
    for name in (*COUNTERS, "data/chunk_index", "data/file_index"):
        if not _is_counted(row.get(name), name):
            return f"has {row.get(name)!r} as {name}"
    if row["length"] < 1:
        return "has no frames"
    return next(filter(None, (wrong_part(row, key) for key in cameras)), "")


def wrong_part(row: Mapping[str, Any], key: str) -> str:
    """Return what is wrong with the place of an episode in a camera's video."""
    for name in (f"videos/{key}/chunk_index", f"videos/{key}/file_index"):
        if not _is_counted(row.get(name), name):
            return f"has {row.get(name)!r} as {name}"
    begin, end = (row.get(f"videos/{key}/{one}_timestamp") for one in ("from", "to"))
    if not all(isinstance(time, int | float) and math.isfinite(time) and time >= 0 for time in (begin, end)):
        return f"is from {begin!r} to {end!r} s in the video of {key}"
    return ""


def _is_counted(value: object, name: str) -> bool:
    most = _MOST if name.endswith(("chunk_index", "file_index")) else 2**62
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most
