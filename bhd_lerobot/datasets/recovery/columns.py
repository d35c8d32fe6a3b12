"""Whether `meta/info.json` describes the columns of a corrupted dataset's files: it may be another recording's."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format import info as meta_info
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.format.state import UNREADABLE
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetCorruptError, DatasetError, brief

_IMAGES = ("video", "image")
_NO_STATISTICS = ("string", "language", *_IMAGES)  # of images there may be some


def misfit(root: Path, info: Mapping[str, Any]) -> str:
    """Return in which way a dataset's files contradict the columns of `info.json`; empty if they do not.

    Data files with a footer name their columns, and `meta/stats.json` those with numbers. It is a misfit if none of
    them agrees.
    """
    found = [_difference(info, sizes, complete) for sizes, complete in _witnesses(root)]
    return found[0] if found and all(found) else ""


def wrong_rate(info: Mapping[str, Any], table: pa.Table) -> str:
    """Return in which way the timestamps contradict the frame rate; empty if they do not."""
    seconds, frames = table["timestamp"].to_numpy(), table["frame_index"].to_numpy()
    last = int(frames.argmax())
    if frames[last] > 0 and seconds[last] > 0 and abs(seconds[last] * info["fps"] - frames[last]) > 0.5:
        return f"it states {info['fps']:g} frames a second, but the timestamps give {frames[last] / seconds[last]:.3g}"
    return ""


def lost_cameras(root: Path, info: Mapping[str, Any]) -> list[str]:
    """Return the cameras of which there is no video and no image."""
    if any(root.glob("tmp*")):  # videos that are being made, which do not say whose they are
        return []
    keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    return [key for key in keys if not (root / "videos" / key).is_dir() and not (root / "images" / key).is_dir()]


def read_info(path: Path) -> dict[str, Any]:
    """Return an `info.json` that describes the columns."""
    try:
        return meta_info.read_info(path, path, counts=False)
    except (OSError, meta_info.InfoError, DatasetError) as error:
        raise DatasetCorruptError(str(error).rstrip(".")) from error


def _witnesses(root: Path) -> Iterator[tuple[dict[str, int | None], bool]]:
    """Yield the columns of the files: the size of each, if it is known, and whether all columns are there."""
    for path in sorted((root / "data").glob("chunk-*/file-*.parquet")):
        try:
            schema = pq.read_schema(path)
        except UNREADABLE:
            continue
        yield {field.name: field.type.list_size if _is_vector(field.type) else None for field in schema}, True
    try:
        stats = json.loads((root / layout.STATS).read_text(encoding="utf-8"))
        yield {key: len(one["mean"]) if _is_flat(one["mean"]) else None for key, one in stats.items()}, False
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return


def _is_vector(kind: pa.DataType) -> bool:
    return pa.types.is_fixed_size_list(kind) and not pa.types.is_nested(kind.value_type)


def _is_flat(mean: Any) -> bool:
    return isinstance(mean, list) and not any(isinstance(value, list) for value in mean)


def _difference(info: Mapping[str, Any], sizes: Mapping[str, int | None], complete: bool) -> str:
    """Return how columns differ from those that are described.

    Args:
        sizes: the columns, and how many numbers each has; None if unknown.
        complete: whether they are all columns but videos; otherwise all that are numbers, and perhaps images.
    """
    features = {**DEFAULT_FEATURES, **info["features"]}
    unlisted = ("video",) if complete else _NO_STATISTICS
    wanted = {key for key, feature in features.items() if feature["dtype"] not in unlisted}
    if not sizes:
        return ""
    lacks, more = sorted(sizes.keys() - features.keys()), sorted(wanted - sizes.keys())
    texts = [f"it does not describe {brief(lacks)}"] if lacks else []
    texts += [f"it describes {brief(more)}, which {'is' if len(more) == 1 else 'are'} not there"] if more else []
    for key in sorted(sizes.keys() & wanted):
        shape, size = features[key]["shape"], sizes[key]
        if size is not None and len(shape) == 1 and shape[0] != size:
            texts.append(f"it states that {key} has {shape[0]} numbers, but it has {size}")
    return "; ".join(texts)
