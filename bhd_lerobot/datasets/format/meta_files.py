"""``meta/episodes`` and ``meta/stats.json``: the files that hold what is known of every episode."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.format.episode_table import episode_table
from bhd_lerobot.datasets.format.state import Row, slot_columns
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.datasets.storage.layout import Slot

PARQUET_OPTIONS: dict[str, Any] = {"compression": "snappy", "use_dictionary": False, "write_page_checksum": True}
"""Plain pages: dictionaries cost three times the time on floats and save nothing. Checksums find damaged values."""

MEBIBYTE = 1024**2


def write_meta(
    new: Path,
    info: Mapping[str, Any],
    rows: list[Row],
    types: Mapping[str, pa.DataType],
    stats: Mapping[str, statistics.Stats],
    *,
    disk: Disk,
    extra: Mapping[str, pa.DataType] | None = None,
    done: int = 0,
    slot: Slot | None = None,
) -> None:
    """Write the rows and statistics of episodes, and the statistics of all of them.

    Args:
        rows: one per episode, in order; the numbers of the file it is written to are filled in.
        stats: feature -> statistic -> values of all episodes, shape (E, ...).
        done: so many of the first episodes are in files already.
        slot: the last of those files.
    """
    limit = info["data_files_size_in_mb"] * MEBIBYTE
    bytes_per_row = 512 + sum(values[:1].nbytes for stat in stats.values() for values in stat.values())
    step = max(1, int(0.9 * limit / bytes_per_row))
    for start in range(done, len(rows), step):
        part = slice(start, min(start + step, len(rows)))
        slot = layout.next_slot(slot, info["chunks_size"])
        for row in rows[part]:
            row.update(slot_columns("meta/episodes", slot))
        values = {key: {name: array[part] for name, array in stat.items()} for key, stat in stats.items()}
        sink = pa.BufferOutputStream()
        table = episode_table(rows[part], types, values, extra)
        pq.write_table(table, sink, write_statistics=False, **PARQUET_OPTIONS)
        disk.make_folder((new / layout.episodes_file(slot)).parent)
        disk.write(new / layout.episodes_file(slot), sink.getvalue())
    total = {key: statistics.aggregate(stat) for key, stat in stats.items()}
    lists = {key: {name: values.tolist() for name, values in stat.items()} for key, stat in total.items()}
    disk.write(new / layout.STATS, json.dumps(lists).encode())


def tasks_table(tasks: list[str]) -> pa.Table:
    """Return ``tasks.parquet``: LeRobot expects a pandas table whose index is the sentence."""

    def described(name: str | None, kind: str, dtype: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}

    note = {
        "index_columns": ["task"],
        "column_indexes": [described(None, "unicode", "object")],
        "columns": [described("task_index", "int64", "int64"), described("task", "unicode", "object")],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(note)})
