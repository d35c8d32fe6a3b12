"""The rows of ``meta/episodes``: light columns, metadata of ours, and statistics."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.expected import is_listed, wrong_array
from bhd_lerobot.datasets.format.state import UNREADABLE, Row, corrupt
from bhd_lerobot.errors import FrameError

PREFIX = "bhd/"

_NEEDED = ("min", "max", "mean", "std", "count")  # quantiles may be absent: older versions have none
_INT = pa.int64()
_TASKS = pa.list_(pa.field("element", pa.string()))
_TYPES: dict[type, pa.DataType] = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
_FLOATS = pa.list_(pa.field("element", pa.float64()))


def metadata_types(metadata: Mapping[str, Any]) -> dict[str, pa.DataType]:
    """Return the column type of every value of an episode's metadata."""
    return {key: _type_of(key, value) for key, value in metadata.items()}


def _type_of(key: str, value: Any) -> pa.DataType:
    if isinstance(value, np.generic):
        value = value.item()
    if type(value) in _TYPES:
        return _TYPES[type(value)]
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple) and all(type(v) in (int, float) or isinstance(v, np.floating) for v in value):
        return _FLOATS
    raise FrameError(f"Episode metadata {key!r} must be str, int, float, bool or a list of floats; got {value!r}.")


def checked_metadata(metadata: Mapping[str, Any], types: Mapping[str, pa.DataType]) -> Row:
    """Return the metadata columns of one episode."""
    if metadata.keys() != types.keys():
        raise FrameError(
            f"Every episode needs the same metadata. Missing: {sorted(types.keys() - metadata.keys())}; "
            f"not known before: {sorted(metadata.keys() - types.keys())}."
        )
    row: Row = {}
    for key, kind in types.items():
        given, value = _type_of(key, metadata[key]), metadata[key]
        if kind == pa.float64() and given == _INT:
            value = float(value)
        elif given != kind and not (pa.types.is_list(kind) and pa.types.is_list(given)):
            raise FrameError(f"Episode metadata {key!r} was {kind} in the episodes before; got {value!r}.")
        row[PREFIX + key] = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    return row


def episode_table(
    rows: Sequence[Row],
    types: Mapping[str, pa.DataType],
    stats: Mapping[str, Mapping[str, np.ndarray]],
    extra: Mapping[str, pa.DataType] | None = None,
) -> pa.Table:
    """Return rows of ``meta/episodes``.

    Args:
        rows: light columns of E episodes, all with the same keys.
        types: type of the metadata columns, by name without prefix.
        stats: feature -> statistic -> values of shape (E, ...).
    """
    names, arrays = [], []
    for name in rows[0]:
        if name == "tasks":
            kind = _TASKS
        elif name.startswith(PREFIX):
            kind = types[name.removeprefix(PREFIX)]
        elif extra is not None and name in extra:
            kind = extra[name]
        else:
            kind = pa.float64() if name.endswith("_timestamp") else _INT
        names.append(name)
        try:
            arrays.append(pa.array([row.get(name) for row in rows], type=kind))
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise FrameError(f"{name!r} of the episodes is {kind} and cannot hold the new value: {error}.") from error
    for feature, values in stats.items():
        for statistic, stacked in values.items():
            names.append(f"stats/{feature}/{statistic}")
            arrays.append(_nested(stacked))
    return pa.Table.from_arrays(arrays, names=names)


def _nested(stacked: np.ndarray) -> pa.Array:
    """Return an array of shape (E, a, b, ...) as a column of E lists of lists."""
    array: pa.Array = pa.array(stacked.reshape(-1))
    for size in reversed(stacked.shape[1:]):
        offsets = np.arange(0, len(array) + 1, size, dtype=np.int32)
        kind = pa.list_(pa.field("element", array.type))
        array = pa.ListArray.from_arrays(pa.array(offsets), array, type=kind)
    return array


def read_stats(file: pq.ParquetFile) -> dict[str, dict[str, np.ndarray]]:
    """Return the statistics in one file of ``meta/episodes``: feature -> statistic -> values of shape (E, ...)."""
    names = [name for name in file.schema_arrow.names if name.startswith("stats/")]
    if len(set(names)) != len(names):
        raise ValueError("it has more than one column of a statistic")
    table = file.read(columns=names, use_threads=False)
    result: dict[str, dict[str, np.ndarray]] = {}
    for name in names:
        feature, _, statistic = name.removeprefix("stats/").rpartition("/")
        values, shape = table[name].combine_chunks(), [table.num_rows]
        if wrong := wrong_array(values):
            raise ValueError(f"in its column {name!r}, {wrong}")
        while is_listed(values.type):
            inner = values.flatten()
            shape.append(len(inner) // max(len(values), 1))
            values = inner
        if not (pa.types.is_integer(values.type) or pa.types.is_floating(values.type)) or 0 in shape[1:]:
            raise ValueError(f"its column {name!r} is {table[name].type} and holds no numbers")
        result.setdefault(feature, {})[statistic] = values.to_numpy(zero_copy_only=False).reshape(shape)
    for feature, stat in result.items():
        shapes = {values.shape for name, values in stat.items() if name != "count"}
        if lacking := [name for name in _NEEDED if name not in stat]:
            raise ValueError(f"it has no {lacking[0]} of {feature!r} among its statistics")
        if len(shapes) > 1 or stat["count"].size != table.num_rows or not (stat["count"] > 0).all():
            raise ValueError(f"its statistics of {feature!r} do not fit each other")
    return result


def stored_stats(path: Path) -> tuple[list[int], dict[str, dict[str, np.ndarray]]]:
    """Return the episodes in one file of ``meta/episodes``, in its order, and their statistics as `read_stats` does."""
    try:
        file = pq.ParquetFile(path)
        order = file.read(columns=["episode_index"], use_threads=False)["episode_index"].to_pylist()
        return order, read_stats(file)
    except (*UNREADABLE, KeyError) as error:
        raise corrupt(path, error) from error
