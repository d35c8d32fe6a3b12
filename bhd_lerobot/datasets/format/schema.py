"""From LeRobot feature dictionaries to Arrow tables, without any work per row."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.storage.places import wrong_name
from bhd_lerobot.errors import ConfigError, FrameError, unknown_name

DEFAULT_FEATURES: dict[str, dict[str, Any]] = {
    "timestamp": {"dtype": "float32", "shape": (1,), "names": None},
    "frame_index": {"dtype": "int64", "shape": (1,), "names": None},
    "episode_index": {"dtype": "int64", "shape": (1,), "names": None},
    "index": {"dtype": "int64", "shape": (1,), "names": None},
    "task_index": {"dtype": "int64", "shape": (1,), "names": None},
}
"""Columns that every LeRobot dataset has and that the recorder fills in."""

LANGUAGE = "language_persistent"
"""LeRobot's column for language that stays valid in an episode; its values are lists of rows."""

_ARROW = {
    "float32": pa.float32(),
    "float64": pa.float64(),
    "int64": pa.int64(),
    "bool": pa.bool_(),
    "string": pa.string(),
}
_OBJECTS = ("string", "language")  # kept as Python objects until they are written


@dataclass(frozen=True)
class Column:
    """One column that a caller fills in: its key, numpy type and the shape of one frame's value, ``()`` for scalars."""

    key: str
    dtype: np.dtype
    shape: tuple[int, ...]


class Schema:
    """The columns of a dataset, checked once.

    Attributes:
        features: all features in LeRobot's form, ours first, LeRobot's default ones last.
        videos: (height, width) in pixels of every camera feature.
        arrow: the Arrow schema of a data file, with the same metadata that the `datasets` library writes.
    """

    def __init__(self, features: Mapping[str, Mapping[str, Any]]) -> None:
        """Check `features`; LeRobot's default features may be among them."""
        own = {key: _checked(key, feature) for key, feature in features.items() if key not in DEFAULT_FEATURES}
        if not own:
            raise ConfigError("A dataset needs at least one feature of its own; none was given.")
        self.features: dict[str, dict[str, Any]] = {**own, **{k: dict(v) for k, v in DEFAULT_FEATURES.items()}}
        self.columns = tuple(
            Column(key, np.dtype(object if ft["dtype"] in _OBJECTS else ft["dtype"]), _row_shape(ft["shape"]))
            for key, ft in own.items()
            if ft["dtype"] != "video"
        )
        self.videos: dict[str, tuple[int, int]] = {
            key: (ft["shape"][0], ft["shape"][1]) for key, ft in own.items() if ft["dtype"] == "video"
        }
        self.arrow = _arrow_schema(self.features)
        self.float_keys = [k for k, ft in self.features.items() if ft["dtype"] not in (*_OBJECTS, "video")]

    def table(self, columns: Mapping[str, np.ndarray]) -> pa.Table:
        """Return an Arrow table over the memory of `columns`.

        Args:
            columns: key -> array of shape (T,) or (T, d), C-contiguous and of the feature's dtype, for every feature
                but the videos.
        """
        arrays = []
        for field in self.arrow:
            values = columns[field.name]
            if field.name == LANGUAGE:
                arrays.append(_language_array(values, field.type))
            elif values.ndim == 2:
                arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1]))
            else:
                arrays.append(pa.array(values, type=field.type))
        return pa.Table.from_arrays(arrays, schema=self.arrow)


def _language_array(values: np.ndarray, kind: pa.ListType) -> pa.ListArray:
    """Return the rows of every frame as Arrow's nested arrays, which Arrow itself cannot make with JSON inside."""
    rows = [row for frame in values for row in frame]
    names = [kind.value_type.field(index).name for index in range(kind.value_type.num_fields)]
    for row in rows:
        if set(row) != set(names) or row["tool_calls"] is not None:
            raise FrameError(f"A row of {LANGUAGE!r} holds {', '.join(names)}, and no tool calls; got {row!r}.")
    parts = [
        pa.nulls(len(rows), field.type)
        if field.name == "tool_calls"
        else pa.array([row[field.name] for row in rows], type=field.type)
        for field in kind.value_type
    ]
    offsets = np.concatenate([[0], np.cumsum([len(frame) for frame in values])]).astype(np.int32)
    structs = pa.StructArray.from_arrays(parts, fields=list(kind.value_type))
    return pa.ListArray.from_arrays(offsets, structs, type=kind)


def _row_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """LeRobot stores a value of shape (1,) as a scalar."""
    return () if shape == (1,) else shape


def _checked(key: str, feature: Mapping[str, Any]) -> dict[str, Any]:
    if wrong := wrong_name(key):
        raise ConfigError(f"A feature's name is not valid: {wrong}. It must not be empty or contain '/'.")
    dtype = feature.get("dtype")
    if dtype not in _ARROW and dtype not in ("video", "language"):
        raise ConfigError(f"Feature {key!r}: {unknown_name('dtype', dtype, [*_ARROW, 'video', 'language'])}")
    if (dtype == "language") != (key == LANGUAGE):
        raise ConfigError(f"Feature {key!r}: dtype 'language' is for {LANGUAGE!r} and for nothing else.")
    try:
        shape = tuple(int(size) for size in feature["shape"])
    except (KeyError, TypeError, ValueError):
        raise ConfigError(f"Feature {key!r}: shape {feature.get('shape')!r} is not a list of sizes.") from None
    if dtype == "video":
        if len(shape) != 3 or shape[2] != 3 or min(shape) < 2:
            raise ConfigError(f"Feature {key!r}: a video needs the shape (height, width, 3); got {shape}.")
        if shape[0] % 2 or shape[1] % 2:
            raise ConfigError(
                f"Feature {key!r}: height and width must be even, because video encoders store colour at half the "
                f"resolution; got {shape[0]} x {shape[1]}."
            )
    elif len(shape) != 1 or shape[0] < 1 or (dtype in _OBJECTS and shape != (1,)):
        wanted = "(1,)" if dtype in _OBJECTS else "(size,)"
        raise ConfigError(f"Feature {key!r}: dtype {dtype} needs the shape {wanted}; got {shape}. Flatten it.")
    checked = {**feature, "dtype": dtype, "shape": shape}
    checked.setdefault("names", None)
    return checked


def _language() -> tuple[pa.DataType, Any]:
    """Return the Arrow type of LeRobot's persistent language column, and its description for `datasets`."""
    from datasets import Features

    from bhd_lerobot.stock import language  # seconds to import, and rarely needed

    described = Features({"column": language.language_persistent_column_feature()}).to_dict()["column"]
    return language.language_persistent_arrow_type(), described


def _arrow_schema(features: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    fields, described = [], {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        if feature["dtype"] == "language":
            arrow, described[key] = _language()
            fields.append(pa.field(key, arrow))
            continue
        value = {"dtype": feature["dtype"], "_type": "Value"}
        arrow = _ARROW[feature["dtype"]]
        if feature["shape"] == (1,):
            described[key] = value
        else:
            size = feature["shape"][0]
            arrow = pa.list_(pa.field("element", arrow), size)
            described[key] = {"feature": value, "length": size, "_type": "List"}
        fields.append(pa.field(key, arrow))
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": described}})})
