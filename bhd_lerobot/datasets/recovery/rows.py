"""The new rows, counts and data files of what was recovered of a corrupted dataset."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format.meta_files import MEBIBYTE, PARQUET_OPTIONS
from bhd_lerobot.datasets.format.state import Row, read_tasks, slot_columns
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.videos import Found
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import DatasetCorruptError

_LOST_TASK = "(the instruction was lost)"


def tasks_of(root: Path, kept: Sequence[Found], told: EpisodeRows, lost: list[str]) -> tuple[list[str], dict[int, int]]:
    """Return the instructions that are used, and the new number of each old one."""
    used = sorted({int(index) for one in kept for index in pc.unique(one.table["task_index"]).to_pylist()})
    try:
        sentences = dict(enumerate(read_tasks(root / layout.TASKS)))
    except DatasetCorruptError as error:
        sentences = {}
        for one in kept:
            # Where an episode has one instruction, its number and its words are both there.
            words = told.rows.get(one.number, {}).get("tasks") or []
            numbers = pc.unique(one.table["task_index"]).to_pylist()
            if len(words) == len(numbers) == 1:
                sentences[int(numbers[0])] = words[0]
        if set(used) - sentences.keys():
            lost.append(f"{layout.TASKS}: the words of some instructions ({getattr(error, 'wrong', error)})")
    texts: dict[str, int] = {}
    known: dict[int, int] = {}
    for index in used:
        known[index] = texts.setdefault(sentences.get(index, f"{_LOST_TASK} {index}"), len(texts))
    return list(texts), known


def rows_of(kept: list[Found], tasks: Sequence[str], known: dict[int, int]) -> list[Row]:
    """Return the rows of the new dataset, and number the frames of the episodes accordingly."""
    rows: list[Row] = []
    start = 0
    for index, one in enumerate(kept):
        length = one.table.num_rows
        told = np.array([known[int(task)] for task in one.table["task_index"].to_numpy()])
        numbered = {
            "episode_index": np.full(length, index),
            "index": np.arange(start, start + length),
            "task_index": told,
        }
        for name, values in numbered.items():
            place = one.table.schema.get_field_index(name)
            column = pa.array(values, one.table.schema.types[place])
            one.table = one.table.set_column(place, one.table.schema.field(place), column)
        sentences = [tasks[task] for task in dict.fromkeys(told.tolist())]
        rows.append(
            {
                "episode_index": index,
                "tasks": sentences,
                "length": length,
                "dataset_from_index": start,
                "dataset_to_index": start + length,
            }
        )
        start += length
    return rows


def info_of(info: dict[str, Any], kept: Sequence[Found], tasks: int) -> dict[str, Any]:
    """Return ``info.json`` with the counts of the new dataset."""
    described = copy.deepcopy(info)
    return described | {
        "total_episodes": len(kept),
        "total_frames": sum(one.table.num_rows for one in kept),
        "total_tasks": tasks,
        "splits": {"train": f"0:{len(kept)}"},
        "chunks_size": info.get("chunks_size") or layout.CHUNKS_SIZE,
        "data_files_size_in_mb": info.get("data_files_size_in_mb") or layout.DATA_FILES_SIZE_IN_MB,
        "video_files_size_in_mb": info.get("video_files_size_in_mb") or layout.VIDEO_FILES_SIZE_IN_MB,
        "data_path": layout.DATA_PATH,
    }


def write_data(kept: Sequence[Found], rows: Sequence[Row], info: dict[str, Any], new: Path, disk: Disk) -> None:
    """Write the data files, and into the rows where each episode lies."""
    limit = info["data_files_size_in_mb"] * MEBIBYTE
    slot: layout.Slot | None = None
    writer: pq.ParquetWriter | None = None
    try:
        for one, row in zip(kept, rows, strict=True):
            if writer is None or (new / layout.data_file(slot or (0, 0))).stat().st_size >= limit:
                if writer is not None:
                    writer.close()
                slot = layout.next_slot(slot, info["chunks_size"])
                target = new / layout.data_file(slot)
                disk.make_folder(target.parent)
                disk.write(target, b"")
                writer = pq.ParquetWriter(target, kept[0].table.schema, **PARQUET_OPTIONS)
            writer.write_table(_as(kept[0].table.schema, one.table))
            row.update(slot_columns("data", slot or (0, 0)))
    finally:
        if writer is not None:
            writer.close()


def _as(schema: pa.Schema, table: pa.Table) -> pa.Table:
    return table if table.schema.equals(schema, check_metadata=True) else table.cast(schema)
