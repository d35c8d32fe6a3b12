"""The data files and videos of a dataset that is assembled from episodes of others."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.picks import Group, Plan, Run
from bhd_lerobot.datasets.format import video
from bhd_lerobot.datasets.format.columns import NUMBERS, frames_of, numbers_of, wrong_number
from bhd_lerobot.datasets.format.meta_files import MEBIBYTE, PARQUET_OPTIONS
from bhd_lerobot.datasets.format.state import corrupt, read_frames, slot_columns
from bhd_lerobot.datasets.format.video_splice import Span, splice
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import DatasetMismatchError

type Take = Callable[[Path, Path], None]
"""How a file that stays as it is gets to its new place."""


def data_groups(plan: Plan) -> list[Group]:
    """Return which new data file holds which runs of episodes."""
    runs = list(plan.files.runs("data"))
    sizes = [(run.source.root / layout.data_file(run.slot)).stat().st_size * run.share for run in runs]
    limit = plan.info["data_files_size_in_mb"] * MEBIBYTE
    return _groups(runs, sizes, limit, plan.info["chunks_size"], [None] * len(runs))


def video_groups(plan: Plan, key: str) -> list[Group]:
    """Return which new video of a camera holds which runs of episodes; all of one video have the same encoding."""
    runs = list(plan.files.runs(f"videos/{key}"))
    paths = [run.source.root / layout.video_file(key, run.slot) for run in runs]
    signatures = {path: video.stream_signature(path) for path in dict.fromkeys(paths)}
    sizes = [path.stat().st_size * run.share for run, path in zip(runs, paths, strict=True)]
    limit = plan.info["video_files_size_in_mb"] * MEBIBYTE
    return _groups(runs, sizes, limit, plan.info["chunks_size"], [signatures[path] for path in paths])


def build_data(
    plan: Plan, groups: Sequence[Group], new: Path, disk: Disk, *, take: Take, schema: pa.Schema | None = None
) -> None:
    """Write the data files below `new`, and into the rows the file of each episode."""
    first = groups[0].runs[0]
    schema = schema or _schema(first.source.root / layout.data_file(first.slot))
    for group in groups:
        target = new / layout.data_file(group.target)
        disk.make_folder(target.parent)
        sources = [run.source.root / layout.data_file(run.slot) for run in group.runs]
        if len(sources) == 1 and _is_same(group.runs[0], sources[0], plan):
            take(sources[0], target)
        else:
            disk.write(target, b"")
            with pq.ParquetWriter(target, schema, **PARQUET_OPTIONS) as writer:
                for run, source in zip(group.runs, sources, strict=True):
                    for table in _episodes(run, source, plan):
                        writer.write_table(_as(schema, table, source))
            disk.flush(target)
        for place in (place for run in group.runs for place in run.places):
            plan.rows[place].update(slot_columns("data", group.target))


def build_videos(plan: Plan, key: str, groups: Sequence[Group], new: Path, disk: Disk, *, take: Take) -> None:
    """Write the videos of a camera below `new`, and into the rows the place of each episode; see `build_data`."""
    fps, rows, kind = plan.info["fps"], plan.rows, f"videos/{key}"
    for group in groups:
        target = new / layout.video_file(key, group.target)
        disk.make_folder(target.parent)
        parts = []
        for run in group.runs:
            old = [plan.picks[place].row for place in run.places]
            spans = [(round(row[f"{kind}/from_timestamp"] * fps), row["length"]) for row in old]
            parts.append((run.source.root / layout.video_file(key, run.slot), spans))
        if len(parts) == 1 and group.runs[0].whole:
            take(parts[0][0], target)
            starts = [span[0] for span in parts[0][1]]
        else:
            disk.write(target, b"")
            splice([(path, _joined(spans)) for path, spans in parts], target, fps)
            disk.flush(target)
            lengths = [length for _, spans in parts for _, length in spans]
            starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int).tolist()
        places = [place for run in group.runs for place in run.places]
        for place, start in zip(places, starts, strict=True):
            rows[place].update(slot_columns(kind, group.target))
            rows[place][f"{kind}/from_timestamp"] = start / fps
            rows[place][f"{kind}/to_timestamp"] = (start + rows[place]["length"]) / fps


def _joined(spans: Iterable[Span]) -> list[Span]:
    """Join spans that follow each other: only the first frame of the whole must be a key frame."""
    joined: list[Span] = []
    for start, length in spans:
        if joined and sum(joined[-1]) == start:
            joined[-1] = joined[-1][0], joined[-1][1] + length
        else:
            joined.append((start, length))
    return joined


def _groups(
    runs: Sequence[Run], sizes: Iterable[float], limit: float, chunks_size: int, kinds: Sequence[Any]
) -> list[Group]:
    """Pack runs in order, as many into one file as fit below `limit` bytes; runs of several kinds share no file."""
    groups: list[Group] = []
    filled = 0.0
    for run, size, kind, before in zip(runs, sizes, kinds, [None, *kinds], strict=False):
        if not groups or kind != before or filled + size >= limit:
            groups.append(Group(layout.next_slot(groups[-1].target if groups else None, chunks_size), []))
            filled = 0.0
        groups[-1].runs.append(run)
        filled += size
    return groups


def _is_same(run: Run, path: Path, plan: Plan) -> bool:
    """Return whether a data file can stay as it is: its frames have the numbers that they are to have."""
    if not run.whole or any(plan.picks[place].columns for place in run.places):
        return False
    table = read_frames(path, [*NUMBERS, "task_index"])
    tasks = np.concatenate([plan.task_indexes(place) for place in run.places])
    is_numbered = not wrong_number(table, numbers_of([plan.rows[place] for place in run.places]))
    return is_numbered and np.array_equal(table["task_index"].to_numpy(), tasks)


def _schema(path: Path) -> pa.Schema:
    try:
        return pq.read_schema(path)
    except (OSError, pa.ArrowException) as error:
        raise corrupt(path, error) from error


def _episodes(run: Run, path: Path, plan: Plan) -> Iterable[pa.Table]:
    """Yield the frames of each episode of a run, with their new numbers; readers fetch an episode as one row group."""
    frames = frames_of(path, plan.files.rows(run.source, "data")[run.slot])
    for place in run.places:
        new, part = plan.rows[place], frames[plan.picks[place].row["episode_index"]]
        changed: dict[str, np.ndarray] = {
            "episode_index": np.full(new["length"], new["episode_index"]),
            "index": np.arange(new["dataset_from_index"], new["dataset_to_index"]),
            "task_index": plan.task_indexes(place),
            **plan.picks[place].columns,
        }
        for name, values in changed.items():
            position = part.schema.get_field_index(name)
            part = part.set_column(position, part.schema.field(position), pa.array(values, part.schema.types[position]))
        yield part.combine_chunks()


def _as(schema: pa.Schema, table: pa.Table, path: Path) -> pa.Table:
    if table.schema.equals(schema, check_metadata=True):
        return table
    try:
        return table.select(schema.names).cast(schema)
    except (pa.ArrowException, KeyError) as error:
        raise DatasetMismatchError(f"The columns of {path} are stored in a different format: {error}.") from error
