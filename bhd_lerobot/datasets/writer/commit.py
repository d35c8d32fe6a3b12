"""The steps that turn one finished episode into a part of the dataset."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.compact import EpisodeStats
from bhd_lerobot.datasets.format.episode_table import episode_table
from bhd_lerobot.datasets.format.meta_files import PARQUET_OPTIONS, tasks_table
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.format.state import DatasetState, Row, slot_columns, slot_of
from bhd_lerobot.datasets.format.video import VideoSettings, video_info
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.storage.layout import Slot


@dataclass(frozen=True)
class EpisodeContent:
    """Everything about one episode.

    Attributes:
        columns: all columns, shape (T,) or (T, d).
        tasks: all instructions of the dataset, this one included, in the order of their index.
    """

    columns: Mapping[str, np.ndarray]
    videos: Mapping[str, Path]
    stats: EpisodeStats
    task: str
    tasks: list[str]
    metadata_types: Mapping[str, pa.DataType]
    metadata: Row


class Committer:
    """Writes episodes: everything into the staging folder first, then renames, ``info.json`` last.

    A failure while staging (a full disk, for example) leaves the dataset untouched; between the renames it leaves
    files that ``info.json`` does not count, which the next open drops.
    """

    def __init__(self, schema: Schema, disk: Disk, video: VideoSettings) -> None:
        self._schema, self._disk, self._video = schema, disk, video
        self._features_text: tuple[dict[str, Any], str] | None = None

    def commit(self, state: DatasetState, content: EpisodeContent) -> DatasetState:
        """Write an episode and return the state after it; `state` itself is not changed."""
        root, length = state.root, len(next(iter(content.columns.values())))
        staging = root / layout.STAGING / "save"
        self._disk.make_folder(staging)
        info, index, start = dict(state.info), state.num_episodes, state.num_frames
        moves: list[tuple[Path, str]] = []
        row: Row = {"episode_index": index, "tasks": [content.task], "length": length}

        slot = _next_slot(state, "data")
        row |= slot_columns("data", slot) | {"dataset_from_index": start, "dataset_to_index": start + length}
        table = self._schema.table(content.columns)
        moves.append((self._stage(staging / "data.parquet", table, **PARQUET_OPTIONS), layout.data_file(slot)))

        for key, path in content.videos.items():
            slot = _next_slot(state, f"videos/{key}")
            row |= slot_columns(f"videos/{key}", slot)
            row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": length / info["fps"]}
            self._disk.flush(path)
            moves.append((path, layout.video_file(key, slot)))
            if "info" not in info["features"][key]:
                feature = {**info["features"][key], "info": video_info(path, self._video)}
                info["features"] = {**info["features"], key: feature}

        slot = _next_slot(state, "meta/episodes")
        row |= slot_columns("meta/episodes", slot) | content.metadata
        # Statistics of columns can be computed again from the data; those of images only at the price of decoding.
        stats = {key: {name: value[None] for name, value in content.stats[key].items()} for key in content.videos}
        table = episode_table([row], content.metadata_types, stats)
        options = {"compression": "none", "use_dictionary": False, "write_statistics": False}
        moves.append((self._stage(staging / "episodes.parquet", table, **options), layout.episodes_file(slot)))

        if len(content.tasks) > len(state.tasks):
            moves.insert(0, (self._stage(staging / "tasks.parquet", tasks_table(content.tasks)), layout.TASKS))
        info |= {"total_episodes": index + 1, "total_frames": start + length, "total_tasks": len(content.tasks)}
        info["splits"] = {"train": f"0:{index + 1}"}
        self._disk.write(staging / "info.json", self._info_text(info))
        # Last: with the new count in place the episode exists, and not before.
        moves.append((staging / "info.json", layout.INFO))

        for _, name in moves:
            self._disk.make_folder((root / name).parent)
        for source, name in moves:
            self._disk.move(source, root / name)
        # The list of rows is shared, not copied: it is by far the largest part and only ever grows.
        state.rows.append(row)
        state.without_stats.add(index)
        return replace(state, info=info, tasks=content.tasks, metadata_types=dict(content.metadata_types))

    def take_back(self, root: Path, info: dict[str, Any], tasks: list[str]) -> None:
        """Return to the ``info.json``, which says how many episodes there are, and to the tasks of an earlier state."""
        staging = root / layout.STAGING / "save"
        self._disk.make_folder(staging)
        self._disk.write(staging / "info.json", self._info_text(info))
        self._stage(staging / "tasks.parquet", tasks_table(tasks))  # a full disk ends here
        self._disk.move(staging / "info.json", root / layout.INFO)
        if tasks:
            self._disk.move(staging / "tasks.parquet", root / layout.TASKS)
        else:
            self._disk.remove(root / layout.TASKS)

    def _stage(self, path: Path, table: pa.Table, **options: Any) -> Path:
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink, **options)
        self._disk.write(path, memoryview(sink.getvalue()))
        return path

    def _info_text(self, info: dict[str, Any]) -> bytes:
        """Return ``info.json``. The features make up nearly all of it and hardly change, so their text is kept."""
        if self._features_text is None or self._features_text[0] is not info["features"]:
            text = json.dumps(info["features"], indent=4, ensure_ascii=False).replace("\n", "\n    ")
            self._features_text = (info["features"], text)
        frame = json.dumps({**info, "features": "@"}, indent=4, ensure_ascii=False)
        return frame.replace('"features": "@"', f'"features": {self._features_text[1]}', 1).encode()


def _next_slot(state: DatasetState, kind: str) -> Slot:
    last = slot_of(state.rows[-1], kind) if state.rows else None
    return layout.next_slot(last, state.info["chunks_size"])
