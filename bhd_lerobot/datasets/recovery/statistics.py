"""Statistics of what another program recorded: exact, of images from the images, of matrices by LeRobot's function."""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.columns import flat, video_frames
from bhd_lerobot.datasets.format.state import Row, slot_of
from bhd_lerobot.datasets.storage import layout


def stats_of(
    episodes: Iterable[pa.Table],
    features: Mapping[str, Mapping[str, Any]],
    new: Path,
    rows: Sequence[Row],
    stored: Sequence[Mapping[str, Mapping[str, np.ndarray]]] | None = None,
) -> dict[str, statistics.Stats]:
    """Return feature -> statistic -> values of all episodes, shape (E, ...).

    Args:
        stored: statistics of each episode's images that are known already. Those of depth are never computed here.
    """
    from bhd_lerobot.stock import compute_episode_stats

    plain = {
        key: {**feature, "shape": tuple(feature["shape"])}
        for key, feature in features.items()
        if feature["dtype"] not in ("video", "image", "string", "language")
    }
    stacked: dict[str, dict[str, list[np.ndarray]]] = {}
    for table, row in zip(episodes, rows, strict=True):
        columns = {key: _array(table, key, feature["shape"]) for key, feature in plain.items()}
        matrices = {key: columns.pop(key).astype(np.float64) for key in list(columns) if columns[key].ndim > 2}
        own = {**statistics.column_stats(columns, finite=False), **compute_episode_stats(matrices, plain)}
        known = {} if stored is None else stored[row["episode_index"]]
        for key, feature in features.items():
            if feature["dtype"] not in ("video", "image"):
                continue
            if key in known:
                own[key] = known[key]
                continue
            if 3 not in (feature["shape"][0], feature["shape"][-1]):
                continue  # depth: its statistics are in metres, by the encoder's scale
            images = _video(new, key, row) if feature["dtype"] == "video" else _images(table, key)
            own[key] = statistics.image_stats(np.stack([statistics.image_histogram(image) for image in images]))
        for key, stat in own.items():
            for name, values in stat.items():
                stacked.setdefault(key, {}).setdefault(name, []).append(
                    np.asarray(values, None if name == "count" else np.float64)
                )
    # What only some episodes have, such as depth of those whose rows are left, is of no use for all.
    whole = {
        key: {name: np.stack(values) for name, values in stat.items() if len(values) == len(rows)}
        for key, stat in stacked.items()
    }
    return {key: stat for key, stat in whole.items() if stat}


def _array(table: pa.Table, key: str, shape: tuple[int, ...]) -> np.ndarray:
    return flat(table[key]).to_numpy(zero_copy_only=False).reshape(len(table), *(() if shape == (1,) else shape))


def _images(table: pa.Table, key: str) -> Iterator[np.ndarray]:
    from PIL import Image

    for value in table[key].to_pylist():
        with Image.open(io.BytesIO(value["bytes"])) as image:
            yield np.asarray(image.convert("RGB"))


def _video(new: Path, key: str, row: Row) -> Iterator[np.ndarray]:
    path = new / layout.video_file(key, slot_of(row, f"videos/{key}"))
    return video_frames(path, row[f"videos/{key}/from_timestamp"], row["length"])
