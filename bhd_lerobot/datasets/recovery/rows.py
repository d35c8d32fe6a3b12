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
from bhd_lerobot.datasets.format.state import Row, numbered_tasks, slot_columns
from bhd_lerobot.datasets.recovery.evidence import EpisodeRows
from bhd_lerobot.datasets.recovery.videos import FoundEpisode
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.validate.findings import Findings
from bhd_lerobot.errors import DatasetCorruptError

_LOST_TASK = "(the instruction was lost)"


def tasks_of(
    root: Path, recovered: Sequence[FoundEpisode], stored: EpisodeRows, findings: Findings
) -> tuple[list[str], dict[int, int]]:
    """Return the instructions that are used, and the new number of each old one."""
    used = sorted({int(index) for episode in recovered for index in pc.unique(episode.table["task_index"]).to_pylist()})
    try:
        sentences, reason = numbered_tasks(root / layout.TASKS), "it does not have their numbers"
    except DatasetCorruptError as error:
        sentences, reason = {}, str(getattr(error, "wrong", error))
    for episode in recovered:
        # Of an episode with one instruction both the number and the words are stored.
        words = stored.rows.get(episode.number, {}).get("tasks") or []
        numbers = pc.unique(episode.table["task_index"]).to_pylist()
        if len(words) == len(numbers) == 1:
            sentences.setdefault(int(numbers[0]), words[0])
    if set(used) - sentences.keys():
        findings.error("counts", layout.TASKS, f"the words of some instructions ({reason})")
    texts: dict[str, int] = {}
    known: dict[int, int] = {}
    for index in used:
        known[index] = texts.setdefault(sentences.get(index, f"{_LOST_TASK} {index}"), len(texts))
    return list(texts), known


def rows_of(recovered: list[FoundEpisode], tasks: Sequence[str], known: dict[int, int]) -> list[Row]:
    """Return the rows of the new dataset, and number the frames of the episodes accordingly."""
    rows: list[Row] = []
    start = 0
    for index, episode in enumerate(recovered):
        length = episode.table.num_rows
        renumbered = np.array([known[int(task)] for task in episode.table["task_index"].to_numpy()])
        numbered = {
            "episode_index": np.full(length, index),
            "index": np.arange(start, start + length),
            "task_index": renumbered,
        }
        for name, values in numbered.items():
            place = episode.table.schema.get_field_index(name)
            column = pa.array(values, episode.table.schema.types[place])
            episode.table = episode.table.set_column(place, episode.table.schema.field(place), column)
        sentences = [tasks[task] for task in dict.fromkeys(renumbered.tolist())]
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


def info_of(info: dict[str, Any], recovered: Sequence[FoundEpisode], tasks: int) -> dict[str, Any]:
    """Return ``info.json`` with the counts of the new dataset."""
    described = copy.deepcopy(info)
    return described | {
        "total_episodes": len(recovered),
        "total_frames": sum(episode.table.num_rows for episode in recovered),
        "total_tasks": tasks,
        "splits": {"train": f"0:{len(recovered)}"},
        "chunks_size": info.get("chunks_size") or layout.CHUNKS_SIZE,
        "data_files_size_in_mb": info.get("data_files_size_in_mb") or layout.DATA_FILES_SIZE_IN_MB,
        "video_files_size_in_mb": info.get("video_files_size_in_mb") or layout.VIDEO_FILES_SIZE_IN_MB,
        "data_path": layout.DATA_PATH,
    }


def write_data(
    recovered: Sequence[FoundEpisode], rows: Sequence[Row], info: dict[str, Any], new: Path, disk: Disk
) -> None:
    """Write the data files, and into the rows where each episode lies."""
    limit = info["data_files_size_in_mb"] * MEBIBYTE
    slot: layout.Slot | None = None
    writer: pq.ParquetWriter | None = None
    try:
        for episode, row in zip(recovered, rows, strict=True):
            if writer is None or (new / layout.data_file(slot or (0, 0))).stat().st_size >= limit:
                if writer is not None:
                    writer.close()
                slot = layout.next_slot(slot, info["chunks_size"])
                target = new / layout.data_file(slot)
                disk.make_folder(target.parent)
                disk.write(target, b"")
                writer = pq.ParquetWriter(target, recovered[0].table.schema, **PARQUET_OPTIONS)
            writer.write_table(_as(recovered[0].table.schema, episode.table))
            row.update(slot_columns("data", slot or (0, 0)))
    finally:
        if writer is not None:
            writer.close()


def _as(schema: pa.Schema, table: pa.Table) -> pa.Table:
    return table if table.schema.equals(schema, check_metadata=True) else table.cast(schema)
